"""The policies of a run folder: to act with, and to start another run from.

A policy is the part of a checkpoint that `act` and `task` read. Nothing in the folder is executed.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.config import ConfigError, flat
from jaxsafe.learn.on_policy import Algorithm
from jaxsafe.run import checkpoint, run_folder
from jaxsafe.run.settings import DEFAULT, REGISTERED, Entries, Settings, load, make_env, settle
from jaxsafe.run.spread import Program, members
from jaxsafe.types import Env, PyTree

POLICY = ("params", "normaliser")  # the fields of a train state that another run can start from

ACTING = (*POLICY, "dual")  # what an algorithm's `act` and `task` read, beside its config


class Opened(NamedTuple):
    """The policies of a run folder, ready to act. `ts` is a train state with a leading axis over them:
    every seed of the first setting, then of the next."""

    folder: Path
    settings: Settings
    env: Env
    algo: Algorithm
    ts: PyTree

    def actor(self, index: int) -> "Actor":
        """One of the policies.

        Raises:
            ConfigError: the run has fewer.
        """
        count = len(self.settings.configs) * self.settings.train.num_seeds
        if not 0 <= index < count:
            raise ConfigError(f"index {index}: the run has {count} policies, from 0, in {self.folder}")
        ts = jax.tree.map(lambda x: x[index], self.ts)
        return Actor(self.settings, self.env, self.algo, ts)


def open_run(folder: Path, code: Sequence[str] = (), entries: Entries = REGISTERED) -> Opened:
    """The newest policies of a run folder. Executes nothing from it.

    Args:
        folder: the run folder.
        code: 'env=module:name' and 'algo=module:name', where the run was trained with the user's code.
            They are imported.
        entries: the caller's environment and algorithm, where the run was trained with objects.
    Raises:
        ConfigError: no run folder, one without a checkpoint, or one of another environment.
    """
    saved = run_folder.read_config(folder)
    for text in code:
        kind, _, name = text.partition("=")
        if kind not in DEFAULT:
            raise ConfigError(f"{text}: expected env=MODULE:NAME or algo=MODULE:NAME")
        if name != saved[kind]["name"]:
            raise ConfigError(f"{text}: {folder} was trained with {kind}={saved[kind]['name']}")
        load(kind, name)
    settings = settle(saved, entries)
    if not checkpoint.checkpoints(folder / "checkpoints"):
        raise ConfigError(f"{folder} holds no checkpoint")
    env = make_env(settings)
    return Opened(folder, settings, env, *policy_of(settings, env, folder))


class Actor(NamedTuple):
    """One policy of a run, ready to act. `ts` is the train state of that member alone."""

    settings: Settings
    env: Env
    algo: Algorithm
    ts: PyTree

    def act(self, obs: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """The deterministic action [A]; what a film calls."""
        return self.algo.act(self.ts, obs, None)


def policy_of(settings: Settings, env: Env, folder: Path) -> tuple[Algorithm, PyTree]:
    """The algorithm, and the newest policy of each seed in a train state."""
    algo = settings.row.make(env, None)

    def one_step(cfg: Any) -> Any:
        return dataclasses.replace(cfg, num_envs=1, horizon=1, minibatches=1)

    state = jax.eval_shape(
        lambda: algo.init(jax.random.key(0), jax.tree.map(np.float32, one_step(settings.algo)))
    )
    run = members(settings.configs, settings.train)
    arrays = read_policy(folder, len(run), fields=ACTING)
    ts = policy_state(state, arrays, len(run), folder)
    floats = jax.tree.map(lambda *x: np.array(x, np.float32), *[one_step(m.algo) for m in run])
    return algo, dataclasses.replace(ts, config=floats)


def read_policy(
    folder: Path,
    rows: int,
    warn: Callable[[str], None] | None = None,
    fields: Sequence[str] = POLICY,
) -> dict[str, np.ndarray]:
    """`fields` of the newest checkpoint of a run folder, by leaf name, [rows, ...].

    Rows beyond the run's members are the copies on the other devices of a split one.
    """
    arrays, _ = checkpoint.load(folder / "checkpoints", warn)
    policy = {name: x[:rows] for name, x in arrays.items() if name.split(".")[0] in fields}
    if any(len(x) != rows for x in policy.values()):
        raise ConfigError(f"{folder} holds fewer than the {rows} policies of its config.yaml")
    return policy


def policy_state(like: PyTree, policy: dict[str, np.ndarray], rows: int, source: Path) -> PyTree:
    """A train state with `rows` policies and zeros elsewhere; `like` is one, without that axis."""
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct((rows, *x.shape), x.dtype), like)
    check_policy(like, policy, source, ACTING)
    arrays = {
        name: policy[name] if name in policy else np.zeros(x.shape, x.dtype)
        for name, x in checkpoint.as_data(like).items()
    }
    return checkpoint.from_arrays(like, arrays)


def check_policy(
    like: PyTree,
    policy: dict[str, np.ndarray],
    source: Path,
    fields: Sequence[str] = POLICY,
    why: str = "",
) -> None:
    """Raise ConfigError unless `policy` fits `fields` of the train state `like`, whatever its rows."""
    expected = dict(zip(checkpoint.leaf_names(like), jax.tree.leaves(like), strict=True))
    expected = {k: v for k, v in expected.items() if k.split(".")[0] in fields}
    for name in sorted({*expected, *policy}):
        have, want = (
            str(list(x[name].shape[1:])) if name in x else "absent" for x in (policy, expected)
        )
        if have != want:
            raise ConfigError(
                f"the policy of {source} does not fit: {name} is {have}, expected {want}{why}"
            )


def warm_start(
    settings: Settings, program: Program, say: Callable[[str], None]
) -> Callable[[PyTree], PyTree]:
    """What gives a fresh train state the parameters and normalisers of the run `init_from`.

    A seed starts from the same seed there, or, where there is none, from the one it equals modulo
    their number; of settings trained side by side there, the first counts.

    Raises:
        ConfigError: no run, or one whose networks have other shapes.
    """
    source = Path(settings.train.init_from or "").expanduser()
    saved = settle(run_folder.read_config(source), settings.entries)
    if not checkpoint.checkpoints(source / "checkpoints"):
        raise ConfigError(f"init_from={source} holds no checkpoint")
    first, count = saved.train.seed, saved.train.num_seeds
    policy = read_policy(source, count, say)
    there, here = flat(saved.plain()), flat(settings.plain())
    options = [k for k in here if k.startswith("env.") and saved.env_name == settings.env_name]
    differ = [
        f"{name} is {there.get(name)} there, {here[name]} here"
        for name in (
            "env.name",
            "algo.hidden",
            "algo.trunk",
            "algo.std",
            "algo.obs_normalize",
            *options,
        )
        if there.get(name) != here[name]
    ]
    like = jax.eval_shape(program.init, program.start)
    check_policy(like, policy, source, why="; ".join(["", *differ[:3]]))
    units = [plain.get("algo.activation") for plain in (there, here)]  # no shape tells them apart
    if units[0] != units[1]:
        raise ConfigError(
            f"the policy of {source} does not fit: "
            f"algo.activation is {units[0]} there, {units[1]} here; expected the same"
        )
    rows = [(m.seed - first) % count for m in program.members]
    pairs = {m.seed: first + row for m, row in zip(program.members, rows, strict=True)}
    of = f" of its setting {members(saved.configs, saved.train)[0].setting}"
    say(
        f"starting from {source}: seed "
        + ", ".join(f"{seed} from its seed {old}" for seed, old in pairs.items())
        + of * (len(saved.configs) > 1)
    )
    return lambda ts: with_policy(ts, policy, rows)


def with_policy(ts: PyTree, policy: dict[str, np.ndarray], rows: Sequence[int]) -> PyTree:
    """`ts` with the parameters and normaliser of `policy`: row `rows[i]` of it for member i.

    The copies of a member on several devices share its row.
    """
    leaves, treedef = jax.tree.flatten(ts)
    picks = np.resize(rows, len(leaves[0]))
    named = zip(checkpoint.leaf_names(ts), leaves, strict=True)
    return treedef.unflatten(
        [jnp.asarray(policy[name][picks], x.dtype) if name in policy else x for name, x in named]
    )
