"""What mkdocs does on the way to a page, so that the same files read well on GitHub.

- The list of pages: those of SECTIONS, and all there are in its folders, by their titles. The menu has
  the part of a title before its colon.
- Links to files that are no part of the site lead to copies of them in source/, as text; links to
  folders without README.md to a list of what is in them.
- Equations of algorithms are typeset: `equations.drawn`.
- Docstrings of the reference get lists of fields, and blank lines before sections: `laid_out`.
"""

import posixpath
import re
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from equations import drawn

ROOT = Path(__file__).parent.parent
SOURCES = "docs/source/"  # if it were a folder: where the copies are on the site
SECTIONS: list[tuple[str, list[str]]] = [
    ("Home", ["index.md"]),
    ("Start", ["start.md", "choosing.md", "concepts.md"]),
    ("How to", ["howto/"]),
    ("Environments", ["environments/"]),
    ("Algorithms", ["algorithms/"]),
    ("Derivations", ["theory/"]),
    ("Results", ["results/", "benchmark.md", "performance.md", "other_libraries.md", "fidelity.md"]),
    ("Reference", ["reference/", "developing.md"]),
]
LINK = re.compile(r"(\]\(|src=\")([^)\"\s]+)")
FIELD = re.compile(r"^(?=[a-z_])([\w, ]+(?:\([\w, ]+\))?(?: \[[^\]]*\])?): (?=\S)", re.M)
BEFORE_SECTION = re.compile(r"(?<=\S)\n(?=(?:Args|Returns|Raises|Source):)")


def listed(docs: Path) -> list[Any]:
    """The site's list of pages, as mkdocs wants it; README.md of a folder comes first."""
    nav: list[Any] = []
    for title, names in SECTIONS:
        pages: list[Any] = []
        for name in names:
            found = [*(docs / name).rglob("*.md")] if name.endswith("/") else [docs / name]
            found.sort(key=lambda path: (path != docs / name / "README.md", in_menu(path)))
            pages += [{in_menu(path): str(path.relative_to(docs))} for path in found]
        nav.append({title: pages})
    return nav


def in_menu(page: Path) -> str:
    """Its heading up to a colon."""
    return page.read_text().partition("\n")[0].lstrip("# ").partition(":")[0]


def relinked(text: str, page: str) -> str:
    """`text` of a page, with links that work on the site; `page` is its path in the repository."""

    def replace(match: re.Match[str]) -> str:
        before, target = match.groups()
        path, hash, anchor = target.partition("#")
        if re.match(r"\w+:", target) or not path:
            return match[0]
        full = posixpath.normpath(posixpath.join(posixpath.dirname(page), path))
        if (ROOT / full / "README.md").exists():
            full = f"{full}/README.md"
        if not full.startswith("docs/") or full.endswith(".py") or (ROOT / full).is_dir():
            full = f"{SOURCES}{full}.txt"
        return before + posixpath.relpath(full, posixpath.dirname(page)) + hash + anchor

    code = re.compile(r"^(?:```.*?^```|    .*?$)", re.M | re.S)
    kept = [m.span() for m in code.finditer(text)]
    return LINK.sub(lambda m: m[0] if any(a <= m.start() < b for a, b in kept) else replace(m), text)


def sources(docs: Path) -> set[str]:
    """The files of the repository to which pages link and that are no part of the site."""
    found = set()
    for path in docs.rglob("*.md"):
        page = path.relative_to(ROOT).as_posix()
        for _, target in LINK.findall(relinked(path.read_text(), page)):
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
    text = relinked(markdown, f"docs/{page.file.src_uri}")
    return drawn(text) if page.file.src_uri.startswith("algorithms/") else text
