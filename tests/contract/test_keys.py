"""No algorithm or environment draws twice from one random key, as far as JAX sees when it traces."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import pytest
from toys import START, Corridor

from jaxsafe import envs
from jaxsafe.algos import ALGOS, cup
from jaxsafe.learn.offline import OfflineConfig, data_set_like

ONE_OF_EACH_MODULE = sorted({row.config.__module__: name for name, row in ALGOS.items()}.values())
# Updates map these policies, which scan over keys. JAX takes such keys for used ones.
PLANNING = {"ambs", "loop", "pets", "safe_dreamer"}


def trace(fn: Callable, *args: Any) -> None:
    with jax.debug_key_reuse(True):
        jax.jit(fn).trace(*args)


def test_jax_sees_that_a_key_is_used_twice():
    with pytest.raises(jax.errors.KeyReuseError):
        trace(lambda key: jax.random.normal(key) + jax.random.uniform(key), jax.random.key(0))


@pytest.mark.parametrize("name", ONE_OF_EACH_MODULE)
def test_an_algorithm_uses_each_key_once(name):
    row, env = ALGOS[name], Corridor()
    algo, cfg, key = row.make(env), row.config(**row.lever), jax.random.key(0)
    offline = issubclass(row.config, OfflineConfig)
    shared = START._replace(data=data_set_like(env)) if offline else START

    def init(key, shared):
        return algo.init(key, cfg, shared)

    def act(ts, key):
        reset_key, act_key = jax.random.split(key)
        learned = algo.learned(ts)
        state = algo.task(learned).reset(reset_key)
        return algo.policy.act(learned, algo.policy.init(learned), state.obs, act_key)

    def update_twice(ts, shared):
        return update(update(ts, shared)[0], shared)

    trace(init, key, shared)
    ts, update = jax.eval_shape(init, key, shared), jax.jit(algo.update)
    trace(act, ts, key)
    if row.config.__module__.rpartition(".")[2] not in PLANNING:
        trace(update_twice, ts, shared)


AT_RANDOM = {"engine": "c", "action_noise": 0.1, "frameskip_binom_p": 0.5}
IN_PARTS = ((-1.5, -1.5, 0.0, 1.5), (0.0, -1.5, 1.5, 1.5))


@pytest.mark.parametrize(
    "name, options",
    [
        ("point_goal1", AT_RANDOM | {"goal_placements": IN_PARTS, "hazards_placements": IN_PARTS}),
        ("point_button1", AT_RANDOM),
        ("hopper_velocity", {"engine": "c"}),
        ("car_racing1", {}),
    ],
)
def test_an_environment_uses_each_key_once(name, options):
    env = envs.make(name, **options)
    trace(env.reset, jax.random.key(0))
    state = jax.eval_shape(env.reset, jax.random.key(0))
    trace(env.step, state, jnp.zeros(env.action_size))


def test_each_step_of_cup_has_a_key_of_its_own(monkeypatch):
    """JAX overlooks the keys of its loops. In place of each there is one draw."""

    def draw(actor, opt_state, objective, batch, context):
        drawn = jax.random.uniform(context.key)
        return actor, opt_state, dict.fromkeys(("train/kl", "train/passes", "train/nonfinite"), drawn)

    monkeypatch.setattr(cup, "adam_epochs", cup.adam_epochs._replace(update=draw))
    algo = cup.make(Corridor())
    ts = jax.eval_shape(lambda key: algo.init(key, cup.CUPConfig(), START), jax.random.key(0))
    trace(algo.update, ts, START)
