"""Write the tables of the docs from the code: python docs/tables.py

Each table stands between <!-- table: NAME --> and <!-- end -->; a test holds the files to them.
"""

import functools
from pathlib import Path

from jaxsafe import algos
from jaxsafe.envs import SafetyGym, make
from jaxsafe.interop import migrate
from jaxsafe.learn.conventions import Convention, conventions
from jaxsafe.report.tables import between_marks

HERE = Path(__file__).parent
ROBOTS = ("point", "car", "doggo")


@functools.cache
def robots(task: str) -> dict[str, SafetyGym]:
    """The environments of a task by name."""
    return {name: make(name, engine="c") for name in (f"{robot}_{task}" for robot in ROBOTS)}


def omnisafe_algorithms() -> str:
    lines = ["| OmniSafe | here |", "|---|---|"]
    names = migrate.algorithms().items()
    return "\n".join(lines + [f"| `{theirs}` | `{ours}` |" for theirs, ours in names])


def omnisafe_conventions() -> str:
    """What `compat=omnisafe` reproduces, with the algorithms that have it."""
    taken: list[tuple[Convention, list[str]]] = []
    for name, row in algos.ALGOS.items():
        for convention in conventions(row.config):
            names = next((names for known, names in taken if known == convention), [])
            if not names:
                taken.append((convention, names))
            names.append(f"`{name}`")
    lines = ["| OmniSafe | here | options | algorithms |", "|---|---|---|---|"]
    for c, names in sorted(taken, key=lambda item: -len(item[1])):
        options = ", ".join(f"`algo.{k}={str(v).lower()}`" for k, v in c.options.items())
        which = "all" if len(names) == len(algos.ALGOS) else ", ".join(names)
        lines.append(f"| {c.theirs} | {c.ours} | {options} | {which} |")
    return "\n".join(lines)


def omnisafe_keys() -> str:
    """What scripts/migrate.py makes of each key of OmniSafe's configs."""
    lines = ["| OmniSafe | here | |", "|---|---|---|"]
    offline = {key: rule for key, rule in migrate.OFFLINE.items() if key not in migrate.OMNISAFE}
    for key, rule in (migrate.OMNISAFE | offline).items():
        ours = ", ".join(f"`{option}`" for option in rule.ours.split()) or "no option"
        lines.append(f"| `{key}` | {ours} | {rule.note} |")
    return "\n".join(lines)


TABLES = {
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
