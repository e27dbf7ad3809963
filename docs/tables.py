"""Write the README's tables from the registries: python docs/tables.py

Each table stands between <!-- table: NAME --> and <!-- end -->; a test holds README.md to them.
"""

from pathlib import Path

from jaxsafe.algos import ALGOS
from jaxsafe.envs import ENVS, make

README = Path(__file__).parent.parent / "README.md"
ROBOTS = ("point", "car", "doggo")


def environments() -> str:
    """A row a task: the size of each robot's observation, and its costs."""
    lines = ["| task | point | car | doggo | costs |", "|---|---:|---:|---:|---|"]
    for task in dict.fromkeys(name.split("_")[1] for name in ENVS):
        made = [make(f"{robot}_{task}", engine="c") for robot in ROBOTS]
        sizes = " | ".join(str(env.obs_size) for env in made)
        lines.append(f"| `{task}` | {sizes} | {', '.join(made[0].cost_names) or 'none'} |")
    return "\n".join(lines)


def algorithms() -> str:
    lines = ["| algorithm | what it does |", "|---|---|"]
    return "\n".join(lines + [f"| `{name}` | {entry.summary} |" for name, entry in ALGOS.items()])


def filled(text: str) -> str:
    """`text` with its tables made anew."""
    for name, table in (("environments", environments()), ("algorithms", algorithms())):
        begin, end = f"<!-- table: {name} -->\n", "\n<!-- end -->"
        before, _, rest = text.partition(begin)
        text = before + begin + table + end + rest.partition(end)[2]
    return text


if __name__ == "__main__":
    README.write_text(filled(README.read_text()))
