"""Write a page for each algorithm, docs/algorithms/NAME.md, from the code: python docs/pages.py

Equations, source and departures are the module's docstring; settings and their origin are the lines of
its config; results are those of docs/results. A test holds the pages to the code.
"""

import dataclasses
import importlib
import inspect
import re
import sys
from pathlib import Path

from jaxsafe import run_folder
from jaxsafe.algos import ALGOS, Entry

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "results"))
results = importlib.import_module("make")


def prose(docstring: str) -> tuple[str, str]:
    """The docstring's first line, and the rest as Markdown: what is indented is code."""
    title, _, text = inspect.cleandoc(docstring).partition("\n")
    blocks = []
    for block in text.strip("\n").split("\n\n"):
        if block.startswith("    "):
            blocks.append(f"```text\n{inspect.cleandoc(block)}\n```")
        else:  # Source and departures begin lines of their own
            blocks.append(re.sub(r"\n(?=Source:|Differs from)", "\n\n", block))
    return title, "\n\n".join(blocks)


def settings(config: type) -> str:
    """A row a field: its default, and the comment beside it in the class that defines it."""
    comments = {}
    for cls in reversed(config.__mro__[:-1]):
        for name, comment in re.findall(r"^    (\w+): .*?(?:  # (.*))?$", inspect.getsource(cls), re.M):
            comments[name] = comment or comments.get(name, "")
    rows = ["| setting | default | |", "|---|---|---|"]
    for field in dataclasses.fields(config):
        note = comments[field.name].replace("|", "\\|")
        rows.append(f"| `algo.{field.name}` | `{field.default}` | {note} |")
    return "\n".join(rows)


def published(entry: Entry) -> str:
    """What `preset=published` changes."""
    lines = []
    for origin, options in entry.published.items():
        changed = ", ".join(f"`{name}={value}`" for name, value in options.items())
        lines.append(f"`preset=published` ({origin}): {changed}.")
    return "\n\n".join(lines)


def measured(name: str) -> str:
    """The runs of this algorithm in docs/results."""
    rows = []
    for folder in sorted((HERE / "results").glob(f"*-{name}*/")):
        env, algo, *preset = folder.name.split("-")
        if algo != name:
            continue
        metrics = run_folder.read_metrics(folder)
        ret, cost = (results.last_tenth(metrics, f"train/{k}") for k in ("return", "cost"))
        how = f"`{env}`, preset {preset[0] if preset else 'fast'}, {len(set(metrics['seed']))} seeds"
        rows.append(f"| {how} | {ret} | {cost} | {results.published(env, algo)} |")
    if not rows:
        return "Not run at length yet; it learns the small exact problem of tests/test_on_policy.py."
    head = "| 1e7 steps a seed, limit 25 | return, last 10% | cost | published |\n|---|---|---|---|\n"
    return head + "\n".join(rows)


def page(name: str) -> str:
    entry = ALGOS[name]
    title, text = prose(importlib.import_module(entry.make.__module__).__doc__ or "")
    module = entry.make.__module__.rsplit(".", 1)[1]
    return f"""# {title.removesuffix(".")}

    python scripts/train.py env=point_goal1 algo={name}

{text}

The code: [algos/{module}.py](../../algos/{module}.py).

## Settings

[O] is OmniSafe's default, [S] that of safety-starter-agents.

{settings(entry.config)}

{published(entry)}

## Results

{measured(name)}
"""


def pages() -> dict[Path, str]:
    found = {HERE / "algorithms" / f"{name}.md": page(name) for name in ALGOS}
    lines = [f"| [`{name}`]({name}.md) | {entry.summary} |" for name, entry in ALGOS.items()]
    index = "# Algorithms\n\n| | |\n|---|---|\n" + "\n".join(lines) + "\n"
    return found | {HERE / "algorithms" / "README.md": index}


if __name__ == "__main__":
    for path, text in pages().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
