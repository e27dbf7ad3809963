"""Write the tables of the README and of the docs from the code: python docs/tables.py

Each table stands between <!-- table: NAME --> and <!-- end -->; a test holds the files to them.
"""

import functools
from pathlib import Path

from jaxsafe.algos import ALGOS
from jaxsafe.envs import ENVS, SafetyGym, make
from jaxsafe.interop.migrate import ALGORITHMS, OMNISAFE
from jaxsafe.report.tables import between_marks
from jaxsafe.run import compat

HERE = Path(__file__).parent
ROBOTS = ("point", "car", "doggo")


@functools.cache
def robots(task: str) -> dict[str, SafetyGym]:
    """The environments of a task by name."""
    return {name: make(name, engine="c") for name in (f"{robot}_{task}" for robot in ROBOTS)}


def environments() -> str:
    """A row a task: the size of each robot's observation, and its costs."""
    lines = ["| task | point | car | doggo | costs |", "|---|---:|---:|---:|---|"]
    for task in dict.fromkeys(name.split("_")[1] for name in ENVS):
        made = list(robots(task).values())
        sizes = " | ".join(str(env.obs_size) for env in made)
        lines.append(f"| `{task}` | {sizes} | {', '.join(made[0].cost_names) or 'none'} |")
    return "\n".join(lines)


def algorithms() -> str:
    lines = ["| algorithm | what it does |", "|---|---|"]
    return "\n".join(lines + [f"| `{name}` | {entry.summary} |" for name, entry in ALGOS.items()])


def omnisafe_algorithms() -> str:
    lines = ["| OmniSafe | here |", "|---|---|"]
    return "\n".join(lines + [f"| `{theirs}` | `{ours}` |" for theirs, ours in ALGORITHMS.items()])


def omnisafe_conventions() -> str:
    """What jaxsafe/compat.py reproduces, with the algorithms that have it."""
    lines = ["| OmniSafe | here | options | algorithms |", "|---|---|---|---|"]
    for c in compat.OMNISAFE:
        options = ", ".join(f"`algo.{k}={str(v).lower()}`" for k, v in c.options.items())
        takers = [f"`{name}`" for name, entry in ALGOS.items() if c.applies(entry.config)]
        which = "all" if len(takers) == len(ALGOS) else ", ".join(takers)
        lines.append(f"| {c.theirs} | {c.ours} | {options} | {which} |")
    return "\n".join(lines)


def omnisafe_keys() -> str:
    """What jaxsafe/migrate.py makes of each key of OmniSafe's configs."""
    lines = ["| OmniSafe | here | |", "|---|---|---|"]
    for key, rule in OMNISAFE.items():
        ours = ", ".join(f"`{option}`" for option in rule.ours.split()) or "no option"
        lines.append(f"| `{key}` | {ours} | {rule.note} |")
    return "\n".join(lines)


TABLES = {
    HERE.parent / "README.md": {"environments": environments, "algorithms": algorithms},
    HERE / "howto" / "migrate.md": {
        "omnisafe algorithms": omnisafe_algorithms,
        "omnisafe conventions": omnisafe_conventions,
        "omnisafe keys": omnisafe_keys,
    },
}


def filled(path: Path) -> str:
    """The file's text with its tables made anew."""
    return between_marks(path.read_text(), {name: table() for name, table in TABLES[path].items()})


if __name__ == "__main__":
    for path in TABLES:
        path.write_text(filled(path))
