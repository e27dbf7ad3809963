"""The policies of a run folder: to act with, and to start another run from.

A policy is networks, a normaliser and a config. It has a file of its own beside the checkpoints.
Nothing in the folder is executed.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.config import ConfigError, flat
from jaxsafe.envs.registry import OF_ENGINE
from jaxsafe.learn.acting import Player
from jaxsafe.learn.offline import data_set_like
from jaxsafe.learn.row import NOTHING
from jaxsafe.run import checkpoint, files, run_folder
from jaxsafe.run.programs import Program, members
from jaxsafe.run.settings import (
    DEFAULT,
    NO_EXTRAS,
    Extras,
    Settings,
    acting,
    as_options,
    check_read_from,
    load,
    make_env,
    settings_of_run,
)
from jaxsafe.types import Algorithm, Env, PyTree, Shared

ROBOT = "env.robot_base"
CODE = ("env=MODULE:NAME", "algo=MODULE:NAME", f"{ROBOT}=PATH")  # what a user gives beside a run folder
ONLY_CODE = f"with a run, expected {' or '.join(CODE)}, if its environment, algorithm or robot is yours"
POLICY = ("params", "normaliser")  # what another run can start from, of all that is learned


class RunPolicies(NamedTuple):
    """The policies of a run folder, ready to act.

    `learned` is what they are made of, with a leading axis over policies: every seed of the first
    setting, then of the next.
    """

    folder: Path
    settings: Settings
    env: Env
    algo: Algorithm
    learned: PyTree

    def one(self, index: int) -> "RunPolicy":
        """One of the policies.

        Raises:
            ConfigError: the run has fewer.
        """
        count = self.settings.num_members
        if not 0 <= index < count:
            have = f"{count} policies, from 0" if count > 1 else "one policy, 0"
            raise ConfigError(f"index {index}: the run has {have}, in {self.folder}")
        learned = jax.tree.map(lambda x: x[index], self.learned)
        return RunPolicy(self.settings, self.env, self.algo, learned)


def open_run(
    folder: Path,
    code: Sequence[str] = (),
    extras: Extras = NO_EXTRAS,
    acts_by: Mapping[str, Any] = NOTHING,
) -> RunPolicies:
    """The newest policies of a run folder. Executes nothing from it.

    Args:
        folder: the run folder.
        code: 'env=module:name' and 'algo=module:name', where the run was trained with the user's code.
            They are imported. 'env.robot_base=path', where it was trained with the user's robot.
        extras: the caller's environment and algorithm, where the run was trained with objects.
        acts_by: other values of settings that the policies act by, as of `settings.acting`.
    Raises:
        ConfigError: no run folder, one without a checkpoint, one of another environment, a word of
            `code` that is something else, or a setting that cannot be another.
    """
    saved = run_folder.read_config(folder)
    for text in code:
        if "=" not in text:
            raise ConfigError(f"{text}: expected one run folder, and beside it {' or '.join(CODE)}")
    given = dict(text.split("=", 1) for text in code)
    for kind, name in given.items():
        if kind not in (*DEFAULT, ROBOT):
            raise ConfigError(f"{kind}={name}: {ONLY_CODE}")
        there = flat(saved).get(kind if kind == ROBOT else f"{kind}.name")
        if name != there:
            raise ConfigError(f"{kind}={name}: {folder} was trained with {kind}={there}")
        if kind in DEFAULT:
            load(kind, name)
    settings = settings_of_run(saved, extras)
    check_read_from(settings, folder, {*given, "dataset", "init_from"})  # these two are not read here
    if not checkpoint.checkpoints(policy_folder(folder)):
        raise ConfigError(f"{folder} holds no checkpoint")
    env = make_env(settings)
    if acts_by:
        settings = acting(settings, acts_by)
        with as_options(settings.row):
            for cfg in settings.configs:
                settings.row.check(cfg, env, ())
    return RunPolicies(folder, settings, env, *member_policies(settings, env, folder))


class RunPolicy(NamedTuple):
    """One policy of a run, ready to act."""

    settings: Settings
    env: Env
    algo: Algorithm
    learned: PyTree

    @property
    def player(self) -> Player:
        return Player(self.algo.policy, self.learned, self.algo.task(self.learned))


def check_same_task(folders: Sequence[Path], settings: Sequence[Settings]) -> None:
    """Raise ConfigError if runs were trained on different environments."""
    first, *others = (flat(each.plain()["env"]) for each in settings)
    for folder, other in zip(folders[1:], others, strict=True):
        names = sorted({*first, *other} - {"name", *OF_ENGINE})
        for name in ("name", *names):  # another name is why other fields differ
            if first.get(name) != other.get(name):
                raise ConfigError(
                    f"env.{name} is {first.get(name)} in {folders[0]}, {other.get(name)} in {folder}; "
                    "expected runs of the same task"
                )


def member_policies(settings: Settings, env: Env, folder: Path) -> tuple[Algorithm, PyTree]:
    """The algorithm, and what each member's policy has learned by the newest checkpoint, [S, ...]."""
    algo = settings.row.make(env, None)
    offline = not algo.clocks(settings.algo).steps  # shapes alone count, so that no data set is read
    shared = Shared(np.int32(0), data=data_set_like(env) if offline else ())

    def untrained(cfg: Any) -> PyTree:
        return algo.learned(algo.init(jax.random.key(0), cfg, shared))

    run = members(settings.configs, settings.train)
    floats = jax.tree.map(lambda *x: np.array(x, np.float32), *[m.config for m in run])
    like = jax.eval_shape(untrained, jax.tree.map(lambda x: x[0], floats))
    arrays = read_policy(folder, len(run))
    return algo, learned_from(like, arrays, floats, folder)


def policy_folder(folder: Path) -> Path:
    """Where the policies of a run lie: in policy/ or, of one that was killed between its first
    checkpoint and them, in the checkpoints."""
    alone = files.inside(folder, "policy")
    return alone if checkpoint.checkpoints(alone) else files.inside(folder, "checkpoints")


def read_policy(
    folder: Path,
    rows: int,
    warn: Callable[[str], None] | None = None,
) -> dict[str, np.ndarray]:
    """The newest policies of a run folder by leaf name, [rows, ...], with whatever else lies there.

    Rows beyond the run's members are the copies on the other devices of a split one.
    """
    arrays, _ = checkpoint.load(policy_folder(folder), warn)
    policy = {name: x[:rows] for name, x in arrays.items() if x.ndim}
    if any(len(x) != rows for x in policy.values()):
        raise ConfigError(f"{folder} holds fewer than the {rows} policies of its config.yaml")
    return policy


def learned_from(like: PyTree, policy: dict[str, np.ndarray], configs: PyTree, source: Path) -> PyTree:
    """What S policies have learned, [S, ...].

    Args:
        like: that of one, without the axis, or its shapes.
        policy: from `read_policy`.
        configs: the algorithm's, floats [S], from config.yaml.
        source: the run folder, for messages.
    Raises:
        ConfigError: the policies are of other networks.
    """
    rows = len(jax.tree.leaves(configs)[0])
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct((rows, *x.shape), x.dtype), like)
    check_policy(like, policy, source)
    arrays = policy | checkpoint.to_arrays({"config": configs})
    have = checkpoint.kinds(arrays)
    for name, want in checkpoint.kinds(checkpoint.as_data(like)).items():
        if have.get(name) != want:
            raise ConfigError(
                f"the policy of {source} does not fit: {name} is "
                f"{checkpoint.leaf_in_words(have.get(name))}, expected {checkpoint.leaf_in_words(want)}"
            )
    return checkpoint.from_arrays(like, arrays)


def check_policy(like: PyTree, policy: dict[str, np.ndarray], source: Path, why: str = "") -> None:
    """Raise ConfigError unless `policy` has the networks of `like`, whatever its rows."""

    def networks(named: dict[str, Any]) -> dict[str, Any]:
        return {k: v for k, v in named.items() if k.split(".")[0] in POLICY}

    expected = dict(zip(checkpoint.leaf_names(like), jax.tree.leaves(like), strict=True))
    expected, policy = networks(expected), networks(policy)
    for name in sorted({*expected, *policy}):
        found = [
            (x[name].dtype, list(x[name].shape[1:])) if name in x else None for x in (policy, expected)
        ]
        if found[0] != found[1]:
            types = len({x[0] for x in found if x}) > 1
            have, want = ("absent" if x is None else f"{x[0]} {x[1]}" if types else x[1] for x in found)
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
    saved = settings_of_run(run_folder.read_config(source), settings.extras)
    if not checkpoint.checkpoints(policy_folder(source)):
        raise ConfigError(f"init_from={source} holds no checkpoint")
    first, count = saved.train.seed, saved.train.num_seeds
    policy = read_policy(source, count, say)
    there, here = flat(saved.plain()), flat(settings.plain())
    options = [k for k in here if k.startswith("env.") and saved.env_name == settings.env_name]
    differ = [
        f"{name} is {there.get(name)} there, {here.get(name)} here"
        for name in (
            "env.name",
            "algo.hidden",
            "algo.trunk",
            "algo.std",
            "algo.size",
            "algo.encoder",
            "algo.obs_bins",
            "algo.obs_normalize",
            "algo.name",
            *options,
        )
        if there.get(name) != here.get(name)
    ]
    like = jax.eval_shape(program.init, program.start, program.shared())
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
    """`ts` with the networks and normaliser of `policy`: row `rows[i]` of it for member i.

    The copies of a member on several devices share its row.
    """
    leaves, treedef = jax.tree.flatten(ts)
    picks = np.resize(rows, len(leaves[0]))

    def start(name: str, x: jax.Array) -> jax.Array:
        taken = name in policy and name.split(".")[0] in POLICY
        return jnp.asarray(policy[name][picks], x.dtype) if taken else x

    named = zip(checkpoint.leaf_names(ts), leaves, strict=True)
    return treedef.unflatten([start(name, x) for name, x in named])
