import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import FAST
from jax.flatten_util import ravel_pytree
from scipy.optimize import minimize
from toys import context

from jaxsafe.algos.cpo import (
    BOUNDED,
    FREE,
    RECOVER,
    RETURN,
    CPOConfig,
    Direction,
    Margin,
    Problem,
    cpo_step,
    multipliers,
    solution,
    step_by,
)
from jaxsafe.learn.estimates import Batch
from jaxsafe.learn.steps import Pair, mean_kl
from jaxsafe.learn.surrogates import plain
from jaxsafe.nn.gaussian import log_prob, sample
from jaxsafe.nn.networks import action_dist, init_params

solve = jax.jit(multipliers)


def step_of(g, b, hessian, c, delta):
    """The step that the dual's multipliers give, in float64 but for the dual itself, and the case."""
    h_g, h_b = np.linalg.solve(hessian, g), np.linalg.solve(hessian, b)
    scalars = [jnp.float32(x) for x in (g @ h_g, g @ h_b, b @ h_b, c, delta)]
    lam, nu, case = (np.float64(x) for x in solve(*scalars))
    return (-nu * h_b if case == RECOVER else (h_g - nu * h_b) / lam), int(case), lam, nu


@pytest.mark.parametrize("kappa", [-0.9999999, -0.99999, -0.9999, -0.99])
@pytest.mark.parametrize("nearer", [0.1, 0.5, 0.9])
def test_a_safe_step_keeps_its_gain_where_cost_is_nearly_in_proportion_to_reward(kappa, nearer):
    """The best gain is -kappa rho + sqrt((1 - kappa^2)(1 - rho^2)), with rho the cosine of g and b."""
    rho = 1 - nearer * (1 + kappa)
    best = -kappa * rho + np.sqrt((1 - kappa**2) * (1 - rho**2))
    lam, nu, case = (np.float64(x) for x in solve(*map(jnp.float32, (1.0, rho, 1.0, kappa, 0.5))))
    gain, cost = (1 - nu * rho) / lam, (rho - nu) / lam  # g'x and b'x of x = (h_g - nu h_b) / lam
    assert case == BOUNDED and gain > 0.98 * best and cost + kappa < 1e-5


def problems(count, seed=0):
    """Random problems whose violations spread evenly over the cases."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        n = int(rng.integers(2, 6))
        root = rng.standard_normal((n, n))
        hessian = root @ root.T / n + 0.1 * np.eye(n)
        g, b = rng.standard_normal((2, n)) * 10.0 ** rng.uniform(-2, 1, (2, 1))
        if rng.random() < 0.2:  # nearly parallel gradients, either way
            b = rng.choice([-1, 1]) * g * 10.0 ** rng.uniform(-1, 1) + 0.05 * rng.standard_normal(n)
        delta = 10.0 ** rng.uniform(-3, -1)
        c = rng.uniform(-1.4, 1.4) * np.sqrt(2 * delta * (b @ np.linalg.solve(hessian, b)))
        yield g, b, hessian, c, delta


def oracle(g, b, hessian, c, delta, start):
    """max g'x in the trust region and the half-space by SLSQP, in units of the trust region."""
    root = np.linalg.cholesky(np.linalg.inv(hessian)) * np.sqrt(2 * delta)  # x = root y, |y| <= 1
    g, b = root.T @ g, root.T @ b
    gn, bn = np.linalg.norm(g), np.linalg.norm(b)
    result = minimize(
        lambda y: -(g @ y) / gn,
        start,
        jac=lambda y: -g / gn,
        constraints=[
            {"type": "ineq", "fun": lambda y: 1 - y @ y, "jac": lambda y: -2 * y},
            {"type": "ineq", "fun": lambda y: -(b @ y + c) / bn, "jac": lambda y: -b / bn},
        ],
        method="SLSQP",
        options={"maxiter": 300, "ftol": 1e-12},
    )
    # 8: no better point found along the search direction, which happens at the optimum
    return root @ result.x, result.status in (0, 8)


def test_steps_are_the_optima_that_an_independent_solver_finds():
    seen, bound = np.zeros(4, int), 0
    for g, b, hessian, c, delta in problems(1500):
        x, case, _, nu = step_of(g, b, hessian, c, delta)
        seen[case] += 1
        radius = np.sqrt(2 * delta)
        reach = radius * np.sqrt(b @ np.linalg.solve(hessian, b))  # the most cost a step can change
        assert x @ hessian @ x <= 2 * delta * (1 + 5e-3)
        if case == RECOVER:
            assert c >= reach * (1 - 1e-5)
            np.testing.assert_allclose(b @ x, -reach, rtol=1e-4)  # the steepest descent in cost
            continue
        assert b @ x + c <= 2e-4 * reach
        start = -np.clip(c / reach + 0.05, -0.5, 0.99) * b / np.linalg.norm(b)
        best, success = oracle(g, b, hessian, c, delta, start)
        assert success
        x_g, x_b = np.linalg.solve(hessian, g), np.linalg.solve(hessian, b)
        gain = radius * np.sqrt(g @ x_g)  # the most reward a step can add
        sine = np.sqrt(1 - (g @ x_b) ** 2 / ((g @ x_g) * (b @ x_b)))
        np.testing.assert_allclose(g @ x / gain, g @ best / gain, atol=2e-3 if sine > 0.011 else 1e-2)
        bound += nu > 0
    assert seen.min() > 100 and bound > 200


def test_the_multipliers_are_the_papers():
    """lam = sqrt((q - r^2 / s) / (2 delta - c^2 / s)), nu = (lam c + r) / s, if it binds."""
    binding = 0
    for g, b, hessian, c, delta in problems(300, seed=1):
        h_g, h_b = np.linalg.solve(hessian, g), np.linalg.solve(hessian, b)
        q, r, s = g @ h_g, g @ h_b, b @ h_b
        _, case, lam, nu = step_of(g, b, hessian, c, delta)
        if case in (RETURN, BOUNDED) and nu > 0 and r**2 < 0.99 * q * s:
            expected = np.sqrt((q - r**2 / s) / (2 * delta - c**2 / s))
            np.testing.assert_allclose(lam, expected, rtol=2e-3)
            np.testing.assert_allclose(
                nu, (expected * c + r) / s, rtol=5e-3, atol=1e-3 * np.sqrt(q / s)
            )
            binding += 1
        elif case != RECOVER and nu == 0:
            np.testing.assert_allclose(lam, np.sqrt(q / (2 * delta)), rtol=1e-4)
    assert binding > 30


# H = I, delta = 1/2: the unit disc. Reward to the right, cost to the right or up.
@pytest.mark.parametrize(
    "b, c, case, x",
    [
        ([1, 0], -2.0, FREE, [1, 0]),  # the limit is beyond reach
        ([0, 1], -0.5, BOUNDED, [1, 0]),  # the best step costs nothing
        ([-1, 0], -0.5, BOUNDED, [1, 0]),  # and here it lowers cost
        ([0.6, 0.8], -0.6, BOUNDED, [1, 0]),  # the best step just touches the limit
        ([0.6, 0.8], 0.0, RETURN, [0.8, -0.6]),  # on the limit: along it
        ([0, 1], 0.6, RETURN, [0.8, -0.6]),  # as much right as being safe again leaves
        ([-1, 0], 0.5, RETURN, [1, 0]),  # reward and safety agree
        ([0, 1], 1.0, RECOVER, [0, -1]),  # one point left
        ([0, 1], 7.0, RECOVER, [0, -1]),  # none left
        ([0, 0], -1.0, FREE, [1, 0]),  # cost does not depend on the policy
        ([0, 0], 0.0, RETURN, [1, 0]),
        ([0, 0], 1.0, RECOVER, [0, 0]),  # nothing can be done
        ([1, 0], -0.5, BOUNDED, [0.5, 0]),  # gradients parallel: to the limit, no further
        ([1, 0], 0.5, RETURN, [-0.5, 0]),
    ],
)
def test_the_plane_by_hand(b, c, case, x):
    step, found, *_ = step_of(np.array([1.0, 0.0]), np.array(b, float), np.eye(2), c, 0.5)
    assert found == case
    np.testing.assert_allclose(step, x, atol=1e-4)


@pytest.mark.parametrize("c, earns", [(-2.0, True), (-0.5, True), (0.5, False), (2.0, False)])
def test_reward_must_not_fall_where_the_present_policy_is_safe(c, earns):
    g, b = jnp.array([1.0, 0.0]), jnp.array([0.6, 0.8])
    problem = Problem(g, g, b, g @ g, g @ b, b @ b, jnp.float32(c), jnp.float32(0.5))
    assert solution(problem, None).earns == earns


def test_scales_of_the_gradients_change_the_multipliers_and_not_the_step():
    for g, b, hessian, c, delta in problems(100, seed=2):
        x, case, *_ = step_of(g, b, hessian, c, delta)
        for scale in (1e-5, 1e4):
            y, other, *_ = step_of(scale * g, b / scale, hessian, c / scale, delta)
            assert case == other
            for v in (g, b):
                assert abs(v @ x - v @ y) < 2e-3 * np.linalg.norm(v) * np.linalg.norm(x)


def test_no_reward_gradient_leaves_what_safety_needs():
    zero = np.zeros(2)
    step, case, *_ = step_of(zero, np.array([0.0, 1.0]), np.eye(2), 0.5, 0.5)
    assert case == RETURN and np.isfinite(step).all()
    np.testing.assert_allclose(step[1], -0.5, atol=1e-5)


def test_the_dual_is_finite_everywhere():
    values = jnp.array([0.0, 1e-30, 1e-8, 1.0, 1e8])
    q, s, c, rho = (
        x.ravel()
        for x in jnp.meshgrid(
            values, values, jnp.array([-1e3, -1e-9, 0, 1e-9, 1e3]), jnp.array([-1.0, 0, 1.0])
        )
    )
    out = jax.vmap(multipliers)(q, rho * jnp.sqrt(q) * jnp.sqrt(s), s, c, jnp.full_like(q, 0.01))
    assert all(jnp.isfinite(x).all() for x in out)
    assert (out[0] >= 0).all() and (out[1] >= 0).all()


KEYS = jax.random.split(jax.random.key(0), 3)


@cache
def problem():
    """A policy, and a batch of its actions, of which both together earn and the first costs."""
    cfg = CPOConfig(hidden=(8,))
    actor = init_params(KEYS[0], jnp.zeros(3), 2, cfg)["actor"]
    obs = jax.random.normal(KEYS[1], (256, 3))
    old = action_dist(actor, obs, cfg)
    action = sample(old, KEYS[2])
    adv_r, adv_c = action.sum(-1), 0.5 * action[:, 0]
    adv_r, adv_c = (x - x.mean() for x in (adv_r, adv_c))
    return actor, Batch(obs, action, log_prob(old, action), old, adv_r, adv_c, adv_r, adv_c)


def moved(cfg, actor, violation, margin, batch, axis_name=None):
    """(actor, margin, metrics) after a step; floats of the config are arguments of one program."""

    def objective(adv):
        return lambda actor, batch: plain(action_dist(actor, batch.obs, cfg), batch, adv(batch), cfg)

    pair = Pair(objective(lambda batch: batch.adv_r), objective(lambda batch: batch.adv_c))
    told = context(cfg, axis_name=axis_name, violation=LENGTH * violation, episode_length=LENGTH)
    return cpo_step.update(actor, margin, pair, batch, told)


one_step = jax.jit(moved, compiler_options=FAST)


def learner(**options):
    """(violation, margin) -> one_step from the problem's policy."""
    actor, batch = problem()
    cfg = CPOConfig(hidden=(8,), **options)
    return lambda violation, margin: one_step(cfg, actor, jnp.float32(violation), margin, batch)


START = Margin(jnp.zeros(()))
LENGTH = 1024  # steps of an episode; a power of 2 loses no digits


def test_the_margin_adds_up_violations_and_is_never_negative():
    step = learner(margin_lr=0.1)
    margin, seen = START, []
    for violation in (0.1, 0.2, -0.1, -0.3, -0.2, 0.1):
        _, margin, metrics = step(violation, margin)
        assert metrics["train/violation"] == np.float32(violation)  # the margin is not in it
        seen.append(float(margin.margin))
        assert metrics["train/margin"] == margin.margin
    np.testing.assert_allclose(seen, [0.01, 0.03, 0.02, 0.0, 0.0, 0.01], atol=1e-6)


def test_the_margin_is_bounded_by_what_a_step_can_promise():
    cfg, (actor, batch) = CPOConfig(hidden=(8,)), problem()
    _, margin, metrics = learner(margin_max=1.5)(9.0, START)
    actor, unravel = ravel_pytree(actor)

    def divergence(params):
        return mean_kl(batch.old, action_dist(unravel(params), batch.obs, cfg), None)

    def cost(params):
        return plain(action_dist(unravel(params), batch.obs, cfg), batch, batch.adv_c, cfg)[0]

    hessian = np.float64(jax.hessian(divergence)(actor)) + cfg.damping * np.eye(actor.size)
    b = np.float64(jax.grad(cost)(actor))
    reach = np.sqrt(2 * cfg.target_kl * (b @ np.linalg.solve(hessian, b)))
    np.testing.assert_allclose(margin.margin, 1.5 * reach, rtol=1e-3)
    assert metrics["train/case"] == RECOVER


def test_a_margin_counts_as_violation_and_without_its_rate_there_is_none():
    plain_step, with_margin = (learner(margin_lr=lr, violation_gain=1.0) for lr in (0.0, 0.5))
    assert plain_step(0.02, START)[1] == START
    for violation in (0.02, -0.02):
        after, margin, _ = with_margin(violation, Margin(jnp.float32(0.03)))
        same, _, _ = plain_step(violation + margin.margin, START)
        jax.tree.map(np.testing.assert_array_equal, after, same)
    safe, _, metrics = with_margin(-0.02, START)  # no margin: nothing is added
    jax.tree.map(np.testing.assert_array_equal, safe, plain_step(-0.02, START)[0])
    assert metrics["train/case"] == BOUNDED


def test_a_gain_multiplies_the_violation_and_not_the_margin():
    plain_step, with_gain = (
        learner(margin_lr=lr, violation_gain=gain) for lr, gain in ((0.0, 1.0), (0.5, 4.0))
    )
    for violation in (2**-8, -(2**-8)):
        after, margin, metrics = with_gain(violation, Margin(jnp.float32(2**-7)))
        assert margin.margin == 2**-7 + violation / 2
        assert metrics["train/violation"] == violation
        same, _, _ = plain_step(4 * violation + margin.margin, START)
        jax.tree.map(np.testing.assert_array_equal, after, same)


def test_a_violation_per_episode_leaves_nothing_between_all_reward_and_all_cost():
    step = learner(per_step=False, margin_lr=0.0)
    for violation, case in ((-0.02, FREE), (0.02, RECOVER)):
        _, _, metrics = step(violation, START)
        assert metrics["train/case"] == case
        assert metrics["train/violation"] == np.float32(violation) * LENGTH


@partial(jax.jit, compiler_options=FAST)
def on_two_devices(cfg, actor, violation, halves):
    def on_one(half):
        return moved(cfg, actor, violation, START, half, "devices")

    return jax.vmap(on_one, axis_name="devices")(halves)


@pytest.mark.parametrize(
    "violation, case", [(-9.0, FREE), (-0.02, BOUNDED), (0.02, RETURN), (9.0, RECOVER)]
)
def test_a_step_keeps_its_promises_and_two_devices_take_it_as_one(violation, case):
    cfg, (actor, batch) = CPOConfig(hidden=(8,), violation_gain=1.0), problem()
    after, _, metrics = one_step(cfg, actor, jnp.float32(violation), START, batch)
    m = {name.removeprefix("train/"): float(x) for name, x in metrics.items()}
    assert m["case"] == case and m["accepted"] == 1 and m["nonfinite"] == 0
    assert 0.002 < m["kl"] <= cfg.target_kl and max(m["cg_residual_r"], m["cg_residual_c"]) < 0.01
    assert m["objective_c"] <= max(-violation, 0.0) + 1e-6
    assert m["objective"] > 0 or case in (RETURN, RECOVER)
    assert m["objective_c"] < 0 or case in (FREE, BOUNDED)

    halves = jax.tree.map(lambda x: x.reshape(2, 128, *x.shape[1:]), batch)
    parts, _, _ = on_two_devices(cfg, actor, jnp.float32(violation), halves)
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(parts), strict=True):
        np.testing.assert_allclose(b[0], b[1], rtol=1e-6)
        np.testing.assert_allclose(a, b[0], rtol=1e-3, atol=1e-4)


def test_a_residual_is_that_of_its_own_gradient():
    cfg, (actor, batch) = CPOConfig(hidden=(8,), cg_iterations=2), problem()
    for field, zero, other in (("adv_r", "r", "c"), ("adv_c", "c", "r")):
        without = dataclasses.replace(batch, **{field: jnp.zeros(256)})
        _, _, m = one_step(cfg, actor, jnp.float32(0.0), START, without)
        assert m[f"train/cg_residual_{zero}"] == 0 and m[f"train/cg_residual_{other}"] > 1e-3


def tried(direction, earns, violation):
    """The metrics of a step along `direction(problem)`, with one cost or, for two violations, two."""
    cfg, (actor, batch) = CPOConfig(hidden=(8,), margin_lr=0.0), problem()
    violation = jnp.array(violation)

    def of(adv):
        return lambda actor, batch: plain(action_dist(actor, batch.obs, cfg), batch, adv, cfg)

    def both(actor, batch):
        costs = batch.adv_c, batch.action[:, 1] - batch.action[:, 1].mean()
        return jnp.stack([of(adv)(actor, batch)[0] for adv in costs]), {}

    def step():
        step = step_by(lambda p, cfg: Direction(direction(p), jnp.bool_(earns), {}))
        pair = Pair(of(batch.adv_r), both if violation.ndim else of(batch.adv_c))
        told = context(cfg, violation=violation)
        return step.update(actor, Margin(jnp.zeros_like(violation)), pair, batch, told)[2]

    return jax.jit(step, compiler_options=FAST)()


def short(x):
    return 0.01 * x / jnp.linalg.norm(x)


@pytest.mark.parametrize(
    "direction, earns, violation, accepted",
    [
        (lambda p: short(p.h_b), False, 0.0, 0),  # cost rises from the limit
        (lambda p: short(-p.h_b), False, 0.0, 1),
        (lambda p: short(p.h_b[1] - p.h_b[0]), False, [0.0, 0.0], 0),  # the second of two costs rises
        (lambda p: short(-p.h_b[1] - p.h_b[0]), False, [0.0, 0.0], 1),
        (lambda p: short(-p.h_g), True, -9.0, 0),  # reward falls, far below the limit
        (lambda p: short(-p.h_g), False, -9.0, 1),
    ],
)
def test_a_step_that_breaks_a_promise_is_not_taken(direction, earns, violation, accepted):
    metrics = tried(direction, earns, violation)
    assert metrics["train/accepted"] == accepted and (metrics["train/kl"] > 0) == accepted


def test_a_step_beyond_the_trust_region_is_shortened():
    metrics = tried(lambda p: 10 * jnp.sqrt(2 * p.delta / p.q) * p.h_g, True, -9.0)
    assert metrics["train/accepted"] == 1 and metrics["train/line_search"] > 5
    assert 0.002 < metrics["train/kl"] <= CPOConfig().target_kl
