"""Whether the members of a run still learn, and what stopped being finite first where one does not.

diverged.json of a run folder has the members that were given up, a `Lost` each. There is none as long
as all learn.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.run import checkpoint, files
from jaxsafe.run.programs import Member
from jaxsafe.types import PyTree

PATIENCE = 10  # iterations without any learning, after which a member is given up
FILE = "diverged.json"
KINDS = {"obs": "observation", "reward": "reward", "cost": "cost"}  # train/bad_obs, ...


class Diverged(RuntimeError):
    """No member of a run learns any more. The message is one line for the user."""


class Lost(NamedTuple):
    """A member that is given up."""

    iteration: int  # at which
    seed: int
    setting: str  # '' where there is but one
    why: str  # one line for the user


class Health(NamedTuple):
    """Whether what the policies of M members have learned is finite, and whether it changes.

    finite: by name of a parameter, bool [M].
    mark: uint32 [M], a checksum of the parameters. A change of theirs stays unseen once in 4e9 cases.
    """

    finite: dict[str, jax.Array]
    mark: jax.Array


def health(learned: PyTree) -> Health:
    """`Health` of `learned` [M, ...], the settings among it left aside."""
    named = dict(zip(checkpoint.leaf_names(learned), jax.tree.leaves(learned), strict=True))
    floats = {k: x for k, x in named.items() if not k.startswith("config") and x.dtype == jnp.float32}
    rows = {k: x.reshape(x.shape[0], -1) for k, x in floats.items()}

    def mark(x: jax.Array) -> jax.Array:
        bits = jax.lax.bitcast_convert_type(x, jnp.uint32)
        return (bits * (2 * jnp.arange(x.shape[1], dtype=jnp.uint32) + 1)).sum(1)

    none = jnp.zeros(len(jax.tree.leaves(learned)[0]), jnp.uint32)  # of a method that learns nothing
    total = sum(((i + 1) * mark(x) for i, x in enumerate(rows.values())), start=none)
    return Health({k: jnp.isfinite(x).all(1) for k, x in rows.items()}, total)


class Watch:
    """Judges every iteration of a run.

    Args:
        members: of the run.
        about: what to add on a member that is given up: its unusual settings.
        lost: those that were given up before the run was resumed.
    """

    def __init__(
        self,
        members: Sequence[Member],
        about: Callable[[Member], str],
        lost: Iterable[Lost] = (),
    ):
        self.members, self.about = members, about
        self.idle = np.zeros(len(members), int)  # iterations since a member last learned
        self.mark: np.ndarray | None = None
        known = {(x.seed, x.setting): x for x in lost}
        named = {i: known.get((m.seed, m.setting)) for i, m in enumerate(members)}
        self.lost: dict[int, Lost] = {i: x for i, x in named.items() if x}  # by member

    def __call__(
        self, iteration: int, shown: str, values: Mapping[str, np.ndarray], now: Health
    ) -> list[str]:
        """What is new, a line for each member that is given up.

        Args:
            iteration: the number of this one.
            shown: how far training is, in words.
            values: the metrics of the iteration, [M] by name.
            now: after it.
        """
        count = len(self.members)
        mark = np.asarray(now.mark)[:count]
        same = np.zeros(count, bool) if self.mark is None else mark == self.mark
        nothing = np.zeros(count)
        unseen = np.isnan(values.get("train/return_estimate", nothing))  # every step was bad
        self.idle = np.where(same & (values["train/nonfinite"] > 0) | unseen, self.idle + 1, 0)
        self.mark, lines = mark, []
        for i, member in enumerate(self.members):
            first = next((k for k, x in now.finite.items() if not np.asarray(x)[i]), None)
            if i in self.lost or (first is None and self.idle[i] < PATIENCE):
                continue
            what = f"{first} is not finite" if first else self.nothing_learned(i, values)
            who = ", ".join([f"seed {member.seed}", *([member.setting] if member.setting else [])])
            lines.append(f"{f'{who} ' * (count > 1)}diverged at {shown}: {what}; {self.about(member)}")
            self.lost[i] = Lost(iteration, member.seed, member.setting, lines[-1])
        return lines

    def nothing_learned(self, i: int, values: Mapping[str, np.ndarray]) -> str:
        kinds = [word for k, word in KINDS.items() if values.get(f"train/bad_{k}", np.zeros(i + 1))[i]]
        worlds = f"the {' and the '.join(kinds)} of worlds" if kinds else "the gradient of the loss"
        return f"nothing was learned in {PATIENCE} iterations, as {worlds} is not finite"

    @property
    def over(self) -> bool:
        """Whether no member is left."""
        return len(self.lost) == len(self.members)

    @property
    def verdict(self) -> str:
        """Why the run is over, in one line; '' while it is not."""
        if not self.over:
            return ""
        first, *others = self.lost.values()
        return f"{first.why}{f'; so did {len(others)} more' if others else ''}"


def write_lost(folder: Path, lost: Iterable[Lost]) -> None:
    files.write(folder / FILE, json.dumps([x._asdict() for x in lost], indent=1))


def read_lost(folder: Path) -> list[Lost]:
    """The members of a run folder that were given up.

    Raises:
        ConfigError: the file cannot be read.
    """
    path = folder / FILE
    if not files.there(path):
        return []
    found = files.read_json(path)
    with files.reading(path):
        return [
            Lost(int(x["iteration"]), int(x["seed"]), str(x["setting"]), str(x["why"])) for x in found
        ]


def lost_by(folder: Path, iteration: int) -> list[Lost]:
    """`read_lost` up to an iteration, from which the run goes on. Later ones leave the file, as rows of
    metrics.csv do."""
    if not files.there(folder / FILE):
        return []
    kept = [x for x in read_lost(folder) if x.iteration <= iteration]
    if kept:
        write_lost(folder, kept)
    else:
        (folder / FILE).unlink()
    return kept


def seeds_in_words(seeds: Sequence[int]) -> str:
    """'seed 1', or 'seeds 1, 2'."""
    return f"seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}"
