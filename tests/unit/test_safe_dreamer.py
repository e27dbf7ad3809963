"""SafeDreamer's planner by hand: what a plan earns and costs in dreams, and which one it takes."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import FAST
from toys import Corridor

from jaxsafe.algos import safe_dreamer
from jaxsafe.learn.acting import Learned
from jaxsafe.learn.treatments import CappedPID, capped_pid, control_capped, no_treatment
from jaxsafe.nn.rssm import Latent

CFG = safe_dreamer.OSRPLagConfig(
    discount=0.5, cost_discount=0.5, td_lambda=1.0, plan_steps=2, plans=200, elites=20
)
NOWHERE = Latent(jnp.zeros(1), jnp.zeros(1))
PRICE = CappedPID(jnp.float32(0.1), jnp.float32(0), jnp.float32(0))


class Line:
    """A model of a point that an action moves; it earns x, and costs 1 where x > 1."""

    def apply(self, params: Any, *args: Any, method: str) -> Any:
        return getattr(self, method)(*args)

    def imagine(self, latent, action, key):
        return Latent(latent.deter + action, latent.stoch)


@pytest.fixture
def learned(monkeypatch) -> Learned:
    def says(world, params, features):
        x = features[..., 0]
        return {"reward": x, "cost": 1.0 * (x > 1), "cont": jnp.ones_like(x)}

    monkeypatch.setattr(safe_dreamer, "world_of", lambda *_: Line())
    monkeypatch.setattr(safe_dreamer, "read", says)
    monkeypatch.setattr(safe_dreamer, "value_of", lambda critic, features, cfg: 0 * features[..., 0])
    monkeypatch.setattr(safe_dreamer, "seen", lambda *_: NOWHERE)
    return Learned(CFG, {"model": (), "critic_r": (), "critic_c": ()}, PRICE, ())


def test_a_plan_earns_its_discounted_rewards_and_costs_as_much_as_an_episode_of_it(learned):
    """x is .5, 1 by the first plan: .5 + .5 * 1, for free. It is 1, 2 by the second: 1 + .5 * 2, at a
    cost of 1 in 2 steps, 10 in an episode of 20. The price of .1 takes .1 * .5 off."""
    plans = jnp.array([[[0.5], [0.5]], [[1.0], [1.0]]])
    args = (learned, NOWHERE, plans, jax.random.key(0))
    ret, cost = safe_dreamer.scores(Corridor(), safe_dreamer.planned, no_treatment, *args)
    np.testing.assert_allclose(ret, [1.0, 2.0], rtol=1e-6)
    np.testing.assert_allclose(cost, [0.0, 10.0], rtol=1e-6)
    at_a_price = safe_dreamer.planned_at_a_price, capped_pid
    ret, _ = safe_dreamer.scores(Corridor(), *at_a_price, *args)
    np.testing.assert_allclose(ret, [1.0, 1.95], rtol=1e-6)


def test_it_takes_what_earns_most_without_a_cost_and_all_where_none_is_minded(learned):
    """a_1 + a_2 <= 1 is free: 1 and 0 earn most of that, and 1 and 1 most of all."""
    env: Any = Corridor(action_size=1)
    policy = safe_dreamer.dream_planning_policy(env, safe_dreamer.planned, no_treatment)

    @jax.jit
    def acted(limit):
        of = dataclasses.replace(learned, config=dataclasses.replace(CFG, cost_limit=limit))
        return policy.act(of, policy.init(of), jnp.zeros(4), jax.random.key(1))

    found = acted.lower(jnp.float32(2.0)).compile(FAST)
    action, carry, _ = found(jnp.float32(2.0))
    np.testing.assert_allclose(action, 1.0, atol=0.1)
    np.testing.assert_allclose(carry.mean[0], 0.0, atol=0.2)  # moved on by a step
    np.testing.assert_array_equal(carry.action, action)
    action, carry, _ = found(jnp.float32(50.0))
    np.testing.assert_allclose([action, carry.mean[0]], 1.0, atol=0.1)


def test_mean_actions_have_the_draws_of_their_step(learned):
    env: Any = Corridor(action_size=1)
    policy = safe_dreamer.dream_planning_policy(env, safe_dreamer.planned, no_treatment)
    act = jax.jit(lambda carry: policy.act(learned, carry, jnp.zeros(4), None), compiler_options=FAST)
    begun = policy.init(learned)
    action, carry, _ = act(begun)
    assert carry.step == 1 and act(begun)[0] == action
    assert act(begun._replace(step=carry.step))[0] != action


def test_the_price_by_hand():
    """Smoothed by a half: J = 4, then 3; with a limit of 2, gains .01, .02 and .03."""
    cfg = dataclasses.replace(CFG, pid_kp=0.01, pid_ki=0.02, pid_kd=0.03, pid_smoothing=0.5)
    price = capped_pid.init(cfg)
    price = control_capped(price, jnp.float32(8.0), dataclasses.replace(cfg, price_max=9.0), 0)
    np.testing.assert_allclose(price, [0.02 + 0.04 + 0.12, 0.04, 4.0], rtol=1e-5)
    price = control_capped(price, jnp.float32(2.0), cfg, 1)
    np.testing.assert_allclose(price, [0.01 + 0.06, 0.06, 3.0], rtol=1e-5)
    price = control_capped(price, jnp.float32(100.0), cfg, 2)
    np.testing.assert_allclose(price[:2], [0.1, 0.1], rtol=1e-6)  # no more than price_max
    price = control_capped(price, jnp.float32(-200.0), cfg, 3)
    np.testing.assert_allclose(price[:2], [0.0, 0.0])
