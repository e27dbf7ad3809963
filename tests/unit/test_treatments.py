import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsafe.algos.ppo import CPPOPIDConfig, IPOConfig, PPOLagConfig, PPOPenaltyConfig
from jaxsafe.algos.sac import SACLagConfig
from jaxsafe.algos.seditor import SEditorConfig, soft_lagrangian
from jaxsafe.algos.trpo import CRPOConfig
from jaxsafe.learn.treatments import (
    barrier,
    damped_lagrangian,
    lagrangian,
    no_treatment,
    penalty,
    pid,
    switch,
)


def test_the_multiplier_takes_adams_steps_by_hand():
    cfg = PPOLagConfig(cost_limit=25.0, dual_lr=0.1, lam_init=1.0)
    dual = lagrangian.update(lagrangian.init(cfg), jnp.float32(35.0), cfg, 0)
    # the first step of Adam is lr times the sign of the gradient
    np.testing.assert_allclose(dual.lam, 1.1, rtol=1e-6)
    dual = lagrangian.update(dual, jnp.float32(20.0), cfg, 0)
    # gradients -10, then 5: m = 0.9 (0.1 -10) + 0.1 5 and v = 0.999 (0.001 100) + 0.001 25,
    # over 1 - 0.9^2 and 1 - 0.999^2
    m, v = (-0.9 + 0.5) / 0.19, (0.0999 + 0.025) / 0.001999
    np.testing.assert_allclose(dual.lam, 1.1 - 0.1 * m / v**0.5, rtol=1e-5)


def test_a_damped_price_is_the_multiplier_and_a_share_of_the_violation():
    cfg = SACLagConfig(dual_lr=0.1, lam_init=1.0, dual_damping=0.02, dual_eps=30.0, lam_max=1.5)
    dual = damped_lagrangian.init(cfg)
    assert dual.lam == 1.0
    dual = damped_lagrangian.update(dual, jnp.float32(35.0), cfg, 0)
    # 10 above the limit of 25: Adam's first step is 0.1 10 / (10 + 30)
    np.testing.assert_allclose(dual.multiplier.lam, 1.025, rtol=1e-6)
    np.testing.assert_allclose(dual.lam, 1.025 + 0.02 * 10, rtol=1e-6)
    dual = damped_lagrangian.update(dual, jnp.float32(60.0), cfg, 0)
    assert dual.lam == 1.5 > dual.multiplier.lam
    dual = damped_lagrangian.update(dual, jnp.float32(-60.0), cfg, 0)
    assert dual.lam == 0.0 < dual.multiplier.lam


@pytest.mark.parametrize("treatment", [lagrangian, damped_lagrangian, soft_lagrangian])
def test_a_price_is_at_most_the_highest_before_it_first_moves_too(treatment):
    made = SEditorConfig if treatment is soft_lagrangian else SACLagConfig
    dual = treatment.init(made(lam_init=5.0, lam_max=2.0))
    np.testing.assert_allclose(dual.lam, 2.0, rtol=1e-6)


def test_damping_ends_the_swing_of_a_policy_that_answers_late():
    """J_c follows 60 - 100 lam through two lags of 20 moves each."""

    def swing(damping, eps, moves):
        cfg = SACLagConfig(dual_lr=0.01, lam_init=0.0, dual_damping=damping, dual_eps=eps)

        def move(carry, _):
            dual, policy, cost = carry
            policy = policy + (60.0 - 100.0 * dual.lam - policy) / 20
            cost = cost + (policy - cost) / 20
            return (damped_lagrangian.update(dual, cost, cfg, 0), policy, cost), cost

        begin = damped_lagrangian.init(cfg), jnp.float32(60.0), jnp.float32(60.0)
        costs = jax.jit(lambda: jax.lax.scan(move, begin, length=moves)[1])()
        return float(jnp.abs(costs[-300:] - 25.0).max())

    default = SACLagConfig()
    assert swing(0.0, 1e-8, 1000) > 10  # a multiplier alone swings on
    assert swing(default.dual_damping, 1e-8, 2000) > 10  # when it has come to rest it begins again
    for moves in (1000, 2000, 4000):
        assert swing(default.dual_damping, default.dual_eps, moves) < 0.1


@pytest.mark.parametrize("cost, bound", [(0.0, 0.0), (1e6, 0.3)])
def test_the_multiplier_stays_in_its_interval(cost, bound):
    cfg = PPOLagConfig(dual_lr=0.1, lam_max=0.3)
    dual = lagrangian.init(cfg)
    for _ in range(10):
        dual = lagrangian.update(dual, jnp.float32(cost), cfg, 0)
    np.testing.assert_allclose(dual.lam, bound, rtol=1e-6)


def test_the_mixed_advantage_by_hand():
    dual = lagrangian.init(PPOLagConfig(lam_init=3.0))
    mixed = lagrangian.advantage(dual, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(mixed, [0.25, -0.75])


def test_no_treatment_keeps_nothing_and_sees_only_reward():
    assert jax.tree.leaves(no_treatment.init(PPOLagConfig())) == []
    assert no_treatment.advantage((), jnp.float32(2.0), jnp.float32(9.0)) == 2.0


def test_the_controller_by_hand():
    cfg = CPPOPIDConfig(
        cost_limit=25.0,
        lam_init=2.0,
        pid_kp=0.1,
        pid_ki=0.01,
        pid_kd=0.2,
        pid_smoothing=0.5,
        pid_delay=2,
    )
    dual = pid.init(cfg)
    assert dual.lam == 2.0
    dual = pid.update(dual, jnp.float32(35.0), cfg, 0)
    # error 10: I = 2 + 0.1, P = 0.5 10, smoothed cost 17.5, which rose from 0
    np.testing.assert_allclose(dual.lam, 0.1 * 5 + 2.1 + 0.2 * 17.5, rtol=1e-6)
    dual = pid.update(dual, jnp.float32(5.0), cfg, 0)
    # error -20: I = 2.1 - 0.2, P = 0.5 5 - 10, smoothed cost 11.25, two iterations after 0
    np.testing.assert_allclose(dual.lam, 0.1 * -7.5 + 1.9 + 0.2 * 11.25, rtol=1e-6)
    dual = pid.update(dual, jnp.float32(5.0), cfg, 0)
    # I = 1.9 - 0.2, P = -3.75 - 10, smoothed cost 8.125: that it fell from 17.5 takes nothing off
    np.testing.assert_allclose(dual.lam, 0.1 * -13.75 + 1.7, rtol=1e-5)
    told = pid.metrics(dual)
    np.testing.assert_allclose([told["train/lam"], told["train/integral"]], [0.325, 1.7], rtol=1e-5)
    np.testing.assert_allclose(
        pid.advantage(dual, jnp.ones(1), 2 * jnp.ones(1)), [0.35 / 1.325], rtol=1e-4
    )
    for _ in range(8):
        dual = pid.update(dual, jnp.float32(0.0), cfg, 0)
    assert dual.integral == 0 and dual.lam == 0  # neither winds up below


@pytest.mark.parametrize(
    "cost, price", [(24.0, 0.5), (20.0, 0.1), (24.9, 0.6), (25.0, 0.6), (40.0, 0.6)]
)
def test_the_barrier_is_steep_near_the_limit_and_as_steep_as_allowed_beyond(cost, price):
    cfg = IPOConfig(cost_limit=25.0, barrier=0.5, price_max=0.6)
    dual = barrier.update(barrier.init(cfg), jnp.float32(cost), cfg, 0)
    np.testing.assert_allclose(dual, price, rtol=1e-5)
    mixed = barrier.advantage(dual, jnp.float32(1.0), jnp.float32(2.0))
    np.testing.assert_allclose(mixed, (1 - 2 * price) / (1 + price), rtol=1e-5)


def test_the_switch_turns_beyond_the_tolerance():
    cfg = CRPOConfig(cost_limit=25.0, tolerance=2.0)
    for cost, expected in ((0.0, 3.0), (27.0, 3.0), (27.1, -4.0)):
        over = switch.update(switch.init(cfg), jnp.float32(cost), cfg, 0)
        assert switch.advantage(over, jnp.float32(3.0), jnp.float32(4.0)) == expected


def test_a_fixed_price_is_fixed():
    cfg = PPOPenaltyConfig(price=0.5)
    price = penalty.update(penalty.init(cfg), jnp.float32(1e6), cfg, 0)
    assert penalty.advantage(price, jnp.float32(3.0), jnp.float32(4.0)) == 1.0
