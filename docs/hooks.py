"""What mkdocs does on the way to a page, so that the same files read well on GitHub.

- The list of pages: those of SECTIONS, and all there are in its folders, by their titles.
- A line LINK <!-- readme: SECTION --> becomes that section of the README, without its heading; with
  <!-- readme: SECTION: WORDS --> the part of it that begins with **WORDS**. GitHub shows LINK.
- Links to files that are no part of the site lead to copies of them in source/, as text; links to
  folders without README.md to a list of what is in them.
- Docstrings of the reference get lists of fields, and blank lines before sections: `laid_out`.
"""

import posixpath
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
SOURCES = "docs/source/"  # if it were a folder: where the copies are on the site
SECTIONS: list[tuple[str, list[str]]] = [
    ("Home", ["index.md"]),
    ("Start", ["start.md", "concepts.md"]),
    ("How to", ["howto/"]),
    ("Environments", ["environments/"]),
    ("Algorithms", ["algorithms/"]),
    ("Results", ["results/", "benchmark.md", "performance.md", "fidelity.md"]),
    ("Reference", ["reference/"]),
]
MARK = re.compile(r"^.*<!-- readme: (?P<section>[^:\n]+?)(?:: (?P<words>[^\n]+?))? -->$", re.M)
LINK = re.compile(r"(\]\(|src=\")([^)\"\s]+)")
FIELD = re.compile(r"^(?=[a-z_])([\w, ]+(?:\([\w, ]+\))?(?: \[[^\]]*\])?): (?=\S)", re.M)
BEFORE_SECTION = re.compile(r"(?<=\S)\n(?=(?:Args|Returns|Raises|Source):)")


def listed(docs: Path) -> list[Any]:
    """The site's list of pages, as mkdocs wants it; README.md of a folder comes first."""
    nav: list[Any] = []
    for title, names in SECTIONS:
        pages: list[str] = []
        for name in names:
            found = [*(docs / name).rglob("*.md")] if name.endswith("/") else [docs / name]
            found.sort(key=lambda path: (path != docs / name / "README.md", heading(path)))
            pages += [str(path.relative_to(docs)) for path in found]
        nav.append({title: pages[0] if len(pages) == 1 else pages})
    return nav


def heading(page: Path) -> str:
    return page.read_text().partition("\n")[0].lstrip("# ")


def section(readme: str, title: str, words: str | None = None) -> str:
    """The text under `## title`, or under the title of the file; with `words` the part they begin.

    Raises:
        KeyError: the README has nothing of that name.
    """
    for part in re.split(r"^##? ", f"\n{readme}", flags=re.M)[1:]:
        head, _, body = part.partition("\n")
        if head != title:
            continue
        if words is None:
            return body.strip()
        for block in re.split(r"\n(?=\*\*)", body):
            if block.startswith(f"**{words}**"):
                return block.strip()
    raise KeyError(f"README.md has no {title}{f', {words}' if words else ''}")


def homes(docs: Path) -> dict[str, str]:
    """Where each section of the README is on the site: '#train' -> 'start.md'."""
    found = {}
    for page in sorted(docs.rglob("*.md")):
        for mark in MARK.finditer(page.read_text()):
            if not mark["words"]:
                slug = re.sub(r"[^\w -]", "", mark["section"].lower()).replace(" ", "-")
                found[f"#{slug}"] = page.relative_to(docs).as_posix()
    return found


def relinked(text: str, origin: str, page: str, docs: Path) -> str:
    """`text` of the file `origin`, with links that work on `page`; both are paths in the repository."""

    def replace(match: re.Match[str]) -> str:
        before, target = match.groups()
        path, hash, anchor = target.partition("#")
        if re.match(r"\w+:", target) or (not path and origin == page):
            return match[0]
        full = posixpath.normpath(posixpath.join(posixpath.dirname(origin), path or "README.md"))
        if full == "README.md" and hash:  # a section of it: where the site has it, if anywhere
            home = homes(docs).get(hash + anchor)
            if home and f"docs/{home}" == page:
                return f"{before}{hash}{anchor}"
            full, hash, anchor = f"docs/{home}" if home else full, "", ""
        if (ROOT / full / "README.md").exists():
            full = f"{full}/README.md"
        if not full.startswith("docs/") or full.endswith(".py") or (ROOT / full).is_dir():
            full = f"{SOURCES}{full}.txt"
        return before + posixpath.relpath(full, posixpath.dirname(page)) + hash + anchor

    code = re.compile(r"^(?:```.*?^```|    .*?$)", re.M | re.S)
    kept = [m.span() for m in code.finditer(text)]
    return LINK.sub(lambda m: m[0] if any(a <= m.start() < b for a, b in kept) else replace(m), text)


def composed(text: str, page: str, docs: Path) -> str:
    """A page as the site has it. `page` is its path in the repository."""
    readme = (ROOT / "README.md").read_text()
    parts, last = [], 0
    for mark in MARK.finditer(text):
        included = section(readme, mark["section"], mark["words"])
        parts += [relinked(text[last : mark.start()], page, page, docs)]
        parts += [relinked(included, "README.md", page, docs)]
        last = mark.end()
    return "".join([*parts, relinked(text[last:], page, page, docs)])


def sources(docs: Path) -> set[str]:
    """The files of the repository to which pages link and that are no part of the site."""
    found = set()
    for path in docs.rglob("*.md"):
        page = path.relative_to(ROOT).as_posix()
        for _, target in LINK.findall(composed(path.read_text(), page, docs)):
            full = posixpath.normpath(posixpath.join(posixpath.dirname(page), target))
            if full.startswith(SOURCES):
                found.add(full.removeprefix(SOURCES).removesuffix(".txt"))
    return found


def laid_out(docstring: str) -> str:
    """Sections apart, and each paragraph of lines `name: what` as a list."""
    blocks = BEFORE_SECTION.sub("\n\n", docstring).split("\n\n")
    for i, block in enumerate(blocks):
        if FIELD.match(block):
            blocks[i] = re.sub(r"\n(?!- )\s*", "\n    ", FIELD.sub(r"- `\1`: ", block))
        elif block.startswith("Source: "):  # text, where a section would be made of it
            blocks[i] = re.sub(r"\s*\n\s*", " ", block.replace("Source: ", "*Source:* ", 1))
    return "\n\n".join(blocks)


def on_config(config: Any) -> Any:
    config.nav = listed(Path(config.docs_dir))
    return config


def on_files(files: Any, config: Any) -> Any:
    from mkdocs.structure.files import File  # here, so that tests need no mkdocs

    for path in sorted(sources(Path(config.docs_dir))):
        where, full = f"{SOURCES}{path}.txt".removeprefix("docs/"), ROOT / path
        names = sorted(file.name for file in full.iterdir()) if full.is_dir() else []
        text = "\n".join([path, *names]) if names else full.read_text()
        files.append(File.generated(config, where, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    return composed(markdown, f"docs/{page.file.src_uri}", Path(config.docs_dir))
