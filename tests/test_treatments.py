import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsafe.algos.ppo_lag import PPOLagConfig
from jaxsafe.treatments import lagrangian, none


def test_the_multiplier_takes_adams_steps_by_hand():
    cfg = PPOLagConfig(cost_limit=25.0, dual_lr=0.1, lam_init=1.0)
    dual = lagrangian.update(lagrangian.init(cfg), jnp.float32(35.0), cfg)
    # the first step of Adam is lr times the sign of the gradient
    np.testing.assert_allclose(dual.lam, 1.1, rtol=1e-6)
    dual = lagrangian.update(dual, jnp.float32(20.0), cfg)
    # gradients -10, then 5: m = 0.9 (0.1 -10) + 0.1 5 and v = 0.999 (0.001 100) + 0.001 25,
    # over 1 - 0.9^2 and 1 - 0.999^2
    m, v = (-0.9 + 0.5) / 0.19, (0.0999 + 0.025) / 0.001999
    np.testing.assert_allclose(dual.lam, 1.1 - 0.1 * m / v**0.5, rtol=1e-5)


@pytest.mark.parametrize("cost, bound", [(0.0, 0.0), (1e6, 0.3)])
def test_the_multiplier_stays_in_its_interval(cost, bound):
    cfg = PPOLagConfig(dual_lr=0.1, lam_max=0.3)
    dual = lagrangian.init(cfg)
    for _ in range(10):
        dual = lagrangian.update(dual, jnp.float32(cost), cfg)
    np.testing.assert_allclose(dual.lam, bound, rtol=1e-6)


def test_the_mixed_advantage_by_hand():
    dual = lagrangian.init(PPOLagConfig(lam_init=3.0))
    mixed = lagrangian.advantage(dual, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(mixed, [0.25, -0.75])


def test_no_treatment_keeps_nothing_and_sees_only_reward():
    assert jax.tree.leaves(none.init(PPOLagConfig())) == []
    assert none.advantage((), jnp.float32(2.0), jnp.float32(9.0)) == 2.0
