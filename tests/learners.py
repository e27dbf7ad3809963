"""Algorithms with their compiled updates, shared by the contract tests; most are on-policy.

Most of a contract test's time is compiling. So structure is held for every row without compiling, and
what needs numbers is compiled for `covering()` rows alone, once, as one program of three members that
all claims share.
"""

import dataclasses
import operator
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import FAST
from toys import START, Corridor, updated

from jaxsafe.algos import ALGOS
from jaxsafe.config import ConfigError
from jaxsafe.learn.on_policy import Improved, Method, OnPolicyConfig, on_policy_loop
from jaxsafe.learn.steps import Context
from jaxsafe.learn.world_model import latents_of
from jaxsafe.run import compat
from jaxsafe.types import Algorithm, Env, Metrics, PyTree, Shared

TINY: dict[str, Any] = {"num_envs": 8, "horizon": 25, "minibatches": 2, "hidden": (8,)}
OPTIONS: dict[str, Any] = {
    "reward_normalize": True,
    "entropy_coef": 0.01,
    "entropy_decay": True,
    "total_iterations": 3.0,
    "activation": "relu",
    "std": "state",
    "min_std": 0.2,
    "cost_window": 3,
}


def on_policy_names(holds: str = "") -> list[str]:
    """The on-policy algorithms; with `holds` those whose row says so."""
    rows = {name: row for name, row in ALGOS.items() if issubclass(row.config, OnPolicyConfig)}
    return sorted(name for name, member in rows.items() if holds in ("", member.holds))


def options_of(name: str) -> set[str]:
    return {field.name for field in dataclasses.fields(ALGOS[name].config)}


def covering() -> list[str]:
    """Rows that among them have a method of every module and every option of any algorithm.

    Each step, treatment and augmentation has options of its own or a module of its own, so each is in
    one of these rows. A new algorithm is among them if it brings a new part.
    """
    parts = {name: options_of(name) | {ALGOS[name].config.__module__} for name in on_policy_names()}
    missing, chosen = set().union(*parts.values()), []
    while missing:
        best = max(parts, key=lambda name: len(parts[name] & missing))
        chosen.append(best)
        missing -= parts[best]
    return sorted(chosen)


def others_slowly(quick: list[str]) -> list[Any]:
    """`quick`, and the other on-policy algorithms with the marker of slow tests."""
    rest = [name for name in on_policy_names() if name not in quick]
    return [*quick, *(pytest.param(name, marks=pytest.mark.slow) for name in rest)]


def by_adam(name: str) -> bool:
    """Whether the policy moves by epochs of Adam, not by natural gradients."""
    return "epochs" in options_of(name)


def normalises_cost(name: str) -> bool:
    """Whether the algorithm takes costs in standard deviations; some add them to a violation."""
    cfg = ALGOS[name].config(**TINY, cost_normalize=True)
    algo = ALGOS[name].make(Corridor())
    try:
        jax.eval_shape(lambda: algo.init(jax.random.key(0), cfg, START))
    except ConfigError:
        return False
    return True


def every_option(name: str, estimator: str = "vtrace") -> dict[str, Any]:
    """Options of which each makes the program another one, all at once."""
    options = OPTIONS | compat.overrides("omnisafe", ALGOS[name].config)
    return options | {"estimator": estimator, "cost_normalize": normalises_cost(name)}


class Compiled(NamedTuple):
    """An algorithm; `update(ts)`, and `together(ts)` of several members, both compiled."""

    algo: Algorithm
    update: Callable[[PyTree], tuple[PyTree, Metrics]]
    together: Callable[[PyTree], tuple[PyTree, Metrics]]


@cache
def compiled(name: str, env: Any = Corridor()) -> Compiled:  # noqa: B008
    algo = ALGOS[name].make(env)
    update = updated(algo)
    together = jax.vmap(update)
    return Compiled(
        algo,
        jax.jit(update, compiler_options=FAST),
        jax.jit(together, compiler_options=FAST),
    )


def begin(name: str, env: Any = Corridor(), seed: int = 0, **options: Any) -> PyTree:  # noqa: B008
    """The train state of one member."""
    return member(members(name, [seed], env, **options), 0)


def members(name: str, seeds: list[int], env: Any = Corridor(), **options: Any) -> PyTree:  # noqa: B008
    """Train states side by side; options that are arrays have a value for each member."""
    swept = {k: v for k, v in options.items() if isinstance(v, jax.Array)}
    cfg = ALGOS[name].config(**TINY | {k: v for k, v in options.items() if k not in swept})
    return initial(name, env, cfg)(jnp.stack([jax.random.key(seed) for seed in seeds]), swept)


@cache
def initial(name: str, env: Any, cfg: Any) -> Callable[[jax.Array, dict[str, jax.Array]], PyTree]:
    algo = compiled(name, env).algo

    def init(key: jax.Array, swept: dict[str, jax.Array]) -> PyTree:
        return algo.init(key, dataclasses.replace(cfg, **swept), START)

    return jax.jit(jax.vmap(init), compiler_options=FAST)


def telling(env: Env, tell: Callable[[Any, Context], Metrics]) -> Algorithm:
    """The on-policy loop with a policy that never moves, and the metrics `tell(batch, context)`."""

    def improve(ts: Any, batch: Any, context: Context) -> Improved:
        told = tell(batch, context) | {"train/nonfinite": jnp.zeros(())}
        return Improved(ts.params["actor"], (), (), told)

    method = Method(lambda cfg: None, lambda actor, cfg: (), lambda cfg: (), improve)
    return on_policy_loop(env, method, None)


def two_members(algo: Algorithm, cfg: Any) -> tuple[PyTree, Callable]:
    """Their states at first, and the compiled update, which uses up its argument."""
    init = jax.vmap(lambda key: algo.init(key, cfg, START))
    ts = jax.jit(init, compiler_options=FAST)(jax.random.split(jax.random.key(3), 2))
    update = jax.jit(jax.vmap(algo.update, in_axes=(0, None)), donate_argnums=0)
    return ts, update.lower(ts, START).compile(FAST)


def at(iteration: int, since: int = 0) -> Shared:
    return Shared(np.int32(iteration), np.int32(since))


def copy(tree: PyTree) -> PyTree:
    return jax.tree.map(jnp.copy, tree)


def member(tree: PyTree, i: int) -> PyTree:
    return jax.tree.map(operator.itemgetter(i), tree)


def numbers(tree: PyTree) -> list[jax.Array]:
    """Leaves as arrays, keys as their data."""
    return [jax.random.key_data(x) if is_key(x) else x for x in jax.tree.leaves(tree)]


def is_key(x: jax.Array) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def likeliest_latents(world: Any, params: PyTree, rows: Any) -> Any:
    """What a world model makes of the rows [T, B]: the latents of its loss, without chance."""
    embedded = world.apply(params, rows.obs, method="embed")
    return latents_of(world, params, rows, embedded, None)
