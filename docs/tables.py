"""Write the tables of the docs from the code: python docs/tables.py

Each table stands between <!-- table: NAME --> and <!-- end -->; a test holds the files to them.
"""

import functools
from pathlib import Path

from jaxsafe import algos
from jaxsafe.envs import SafetyGym, make
from jaxsafe.interop import migrate
from jaxsafe.interop.migrate.on_policy import ON_POLICY
from jaxsafe.learn.conventions import Convention, conventions
from jaxsafe.report.tables import between_marks
from jaxsafe.run.settings import presets

HERE = Path(__file__).parent
ROBOTS = ("point", "car", "doggo")


@functools.cache
def robots(task: str) -> dict[str, SafetyGym]:
    """The environments of a task by name."""
    return {name: make(name, engine="c") for name in (f"{robot}_{task}" for robot in ROBOTS)}


PRICE = "there the price moves at every gradient step"
MODEL = "there a refit of several epochs keeps the last weights of each model, not the best"
LAST = f"{MODEL}; C is of 1000 steps of the planner"
PERTURBED = "there the next action is perturbed by the present network, not by its target"
NO_OPTION = {  # what OmniSafe does otherwise, and no option of ours brings back
    **dict.fromkeys(("DDPGLag", "TD3Lag", "SACLag", "DDPGPID", "TD3PID", "SACPID"), PRICE),
    "PETS": MODEL,
    "CCEPETS": LAST,
    "RCEPETS": LAST,
    "CAPPETS": LAST,
    "LOOP": f"{MODEL}; a plan's value is that of the action before its end",
    "SafeLOOP": f"{LAST}; a plan's value is that of the action before its end",
    "VAEBC": "there evaluation draws latents",
    "BCQ": PERTURBED,
    "BCQLag": f"{PERTURBED}; the price moves by Q_c of the present observation",
    "CRABS": "there it begins with a checkpoint to download, and models have gates",
}


def omnisafe_algorithms() -> str:
    """Every algorithm of OmniSafe, ticked if it is here, with what it does otherwise."""
    ours = migrate.algorithms()
    kinds = {theirs: migrate.family_of(algos.ALGOS[name]) for theirs, name in ours.items()}
    order = [*reversed(migrate.FAMILIES)]
    every = sorted(kinds, key=lambda theirs: (order.index(kinds[theirs]), theirs.lower()))
    lines = [
        f"All {len(every)} of OmniSafe's algorithms are here.",
        "",
        "| family | OmniSafe | here | what differs there |",
        "|---|---|---|---|",
    ]
    for theirs in every:
        name = ours[theirs]
        found = conventions(algos.ALGOS[name].config)
        differs = ", ".join(f"`{option}`" for c in found for option in c.options)
        differs = "; ".join(part for part in (differs, NO_OPTION.get(theirs)) if part)
        here = f"✓ [`{name}`](../algorithms/{name}.md)"
        lines.append(f"| {kinds[theirs]} | `{theirs}` | {here} | {differs or 'nothing'} |")
    return "\n".join(lines)


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
    """What scripts/migrate.py makes of each key of OmniSafe's configs. The other families' rows are the
    keys with which they do otherwise than the on-policy algorithms, or which those do not have."""
    lines = ["| algorithms | OmniSafe | here | |", "|---|---|---|---|"]
    for kind, family in reversed(migrate.FAMILIES.items()):
        common = {} if family.rules is ON_POLICY else ON_POLICY
        for key, rule in family.rules.items():
            if rule != common.get(key):
                ours = ", ".join(f"`{option}`" for option in rule.ours.split()) or "no option"
                lines.append(f"| {kind} | `{key}` | {ours} | {rule.note} |")
    return "\n".join(lines)


PRESETS = {  # all but `fast`, which has no settings of its own
    "published": "the first of the published settings below",
    "omnisafe": "OmniSafe's settings",
    "omnisafe_navigation": "OmniSafe's settings of its navigation tasks",
    "omnisafe_velocity": "OmniSafe's settings of velocity tasks",
    "frequent": "longer rollouts or more gradient steps: Walker2d, Swimmer, Humanoid",
    "early_price": "`frequent`, and a price on cost of 1 at the start: Swimmer",
    "entropy": "a bonus for entropy that fades: Car Push",
    "parallel": "on a GPU OmniSafe's replay ratio or, on policy, its settings with 160 environments",
    "parallel_navigation": "that ratio for Goal: a slower policy and price, and targets of three steps",
    "navigation": "for Goal, Button, Push: OmniSafe's temperature of Goal, and targets of three steps",
    "velocity": "plans as long as OmniSafe's of velocity tasks, else nearly the defaults",
    "true_model": "plans in the simulator, not in learned models",
    "decay": "learning rates that fall: HalfCheetah, Ant",
    "cpu": "for two cores and half an hour",
    "proprio": "DreamerV3's settings of vectors",
    "ambs": "AMBS's settings of vectors, with `env.wrap.action_repeat=2`",
    "plpg": "AMBS's settings of vectors, and its penalty PLPG",
    "penl": "the same with PENL",
    "copt": "the same with COPT",
    "pixels": "for pictures of 64 x 64 on a GPU, with `env.wrap.action_repeat=2`: large networks",
    "true_dynamics": "a shield that looks ahead in the simulator",
    "safe_dreamer": "SafeDreamer's settings of vectors, with `env.wrap.action_repeat=4`",
    "paper": "the authors' settings",
    "racing": "the authors' settings of racing, with `env.observe_vision=true`",
}
FEW = 6  # names fit into a cell; more are told by their family


def preset_table() -> str:
    """Every preset but the default, what it is for, and which algorithms have it."""
    having = {name: [a for a, row in algos.ALGOS.items() if name in presets(row)] for name in PRESETS}
    known = {name for row in algos.ALGOS.values() for name in presets(row)}
    assert known == {"fast", *PRESETS}, known ^ {"fast", *PRESETS}
    lines = ["| preset | what it has | algorithms |", "|---|---|---|"]
    for name, what in PRESETS.items():
        which = ", ".join(f"`{a}`" for a in having[name])
        lines.append(
            f"| `{name}` | {what} | {which if len(having[name]) <= FEW else len(having[name])} |"
        )
    return "\n".join(lines)


TABLES = {
    HERE / "choosing.md": {"presets": preset_table},
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
