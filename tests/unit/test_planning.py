"""The cross-entropy method, its scores and its weights: by hand, and where the best plan is known."""

import dataclasses
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import FAST
from scipy.special import softmax

from jaxsafe.algos import ALGOS, loop, pets
from jaxsafe.learn.acting import Learned
from jaxsafe.learn.models import Model, Prediction, init_fitted
from jaxsafe.learn.normalise import Normaliser
from jaxsafe.learn.planning import (
    Imagined,
    by_return,
    by_return_within_limit,
    cautious_cost,
    cem,
    elites,
    imagine,
    mean_cost,
    planning_policy,
    worst_cost,
)
from jaxsafe.types import State

PLAIN: dict[str, Any] = {"plans": 128, "elites": 16, "plan_steps": 4}


def learned_by(cfg: Any, dual: Any = (), **params: Any) -> Learned:
    return Learned(cfg, {"model": ()} | params, dual, ())


# ---- the method ----------------------------------------------------------------------------------


def test_the_best_plan_of_a_linear_system_with_a_quadratic_cost_is_found_within_1_per_cent():
    """x <- x + a / 2,  R = -sum x^2 - sum a^2 / 10, whose best plan solves a linear system."""
    cfg = pets.PETSConfig(plans=512, elites=32, plan_steps=4, cem_iterations=15, plan_var=1.0)
    x0 = np.array([0.5, -0.3])

    def ret(plans):
        x = x0 + jnp.cumsum(plans / 2, axis=1)
        return -(x**2).sum((1, 2)) - (plans**2).sum((1, 2)) / 10

    def score(plans, key):
        return ret(plans), jnp.zeros(len(plans))

    plan = jax.jit(lambda key: cem(score, elites, jnp.zeros((4, 2)), (), key, cfg))(jax.random.key(0))
    sums = np.tril(np.ones((4, 4))) / 2
    best = np.linalg.solve(sums.T @ sums + np.eye(4) / 10, -sums.T @ np.ones((4, 1)) @ x0[None])
    assert np.abs(best).max() < 1
    found, most = ret(plan[None])[0], ret(jnp.asarray(best)[None])[0]
    assert most >= found > most * 1.01  # both are negative
    np.testing.assert_allclose(plan, best, atol=0.05)


def test_plans_are_drawn_anew_each_time():
    """Mean and variance stay, so that plans differ by their draws alone."""
    momenta: dict[str, Any] = {"mean_momentum": 1.0, "var_momentum": 1.0}
    cfg = pets.PETSConfig(plans=2, elites=1, cem_iterations=3, plan_var=0.01, **momenta)
    tried = []

    def score(plans, key):
        tried.append(plans)
        return jnp.zeros(2), jnp.zeros(2)

    with jax.disable_jit():
        cem(score, elites, jnp.zeros((4, 1)), (), jax.random.key(0), cfg)
    assert len(np.unique(tried)) == 3 * 2 * 4


@dataclass(frozen=True)
class Shore:
    """A walk along a line: x <- x + a / 5, which pays what it goes ahead. Beyond 1/2 a step costs 1."""

    obs_size: int = 1
    action_size: int = 1
    episode_length: int = 8
    cost_names: tuple[str, ...] = ("water",)

    def at(self, x: float) -> State:
        return self._state(jnp.float32(x), jnp.zeros(()))

    def step(self, state: State, action: jax.Array) -> State:
        move = jnp.clip(action[0], -1.0, 1.0) / 5
        return self._state(state.physics + move, move)

    def _state(self, x: jax.Array, reward: jax.Array) -> State:
        cost = (x > 0.5).astype(jnp.float32)
        return State(x, x[None], reward, cost, cost[None], jnp.bool_(False), {})


SHORE: Any = Shore()  # as much of an environment as planning needs


@cache
def walk(name: str):
    """From x = 0 and from x = 0.95, planning in the simulator: x [2, 9] and plans [2, 8, H]."""
    env, row = SHORE, ALGOS[name]
    planner = {"pets": pets.PETS, "cce_pets": pets.CCE, "rce_pets": pets.RCE, "cap_pets": pets.CAP}
    policy = planning_policy(env, planner[name])
    learned = learned_by(row.config(**PLAIN, true_model=True, cost_limit=1.0), dual=jnp.ones(()))

    def play(x):
        def step(now, key):
            state, carry = now
            action, carry, _ = policy.act(learned, carry, state, key)
            state = env.step(state, action)
            return (state, carry), (state.physics, carry.mean)

        start = env.at(x), policy.init(learned)
        return jax.lax.scan(step, start, jax.random.split(jax.random.key(0), 8))[1]

    x, plans = jax.jit(jax.vmap(play), compiler_options=FAST)(jnp.array([0.0, 0.95]))
    assert policy.privileged(learned) and plans.shape == (2, 8, 4, 1)
    return np.asarray(x), np.asarray(plans)


@pytest.mark.parametrize("name", ["cce_pets", "rce_pets", "cap_pets"])
def test_constrained_planners_stop_at_the_shore_and_leave_the_water_the_shortest_way(name):
    x, plans = walk(name)
    ahead = x[0] + plans[0, :, :-1, 0].sum(-1) / 5  # where the plan ends
    assert x[0].max() <= 0.5 and ahead.min() > 0.45 and ahead.max() <= 0.5
    assert (x[1] > 0.5).sum() == 2  # no plan leaves it in fewer steps, and none is allowed
    assert x[1, 2:].max() <= 0.5


def test_a_planner_without_a_constraint_walks_on_and_its_plan_moves_along_with_it():
    x, plans = walk("pets")
    assert x[0, -1] > 1.4
    np.testing.assert_array_equal(plans[:, :, -1], plans[:, :, -2])  # moved on, the last one twice


# ---- particles -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "limit, most, cost, expected",
    [
        (1.0, None, 51.0, 0.002),  # kappa_lr times 50 would leave no plan feasible
        (25.0, None, 26.0, 0.001),
        (25.0, None, 1000.0, 0.05),
        (25.0, 0.03, 1000.0, 0.03),
        (25.0, None, 20.0, 0.0),
    ],
)
def test_kappa_rises_with_the_violation_up_to_a_share_of_the_limit(limit, most, cost, expected):
    cfg = pets.CAPConfig(cost_limit=limit, kappa_max=most)
    found = pets.caution(200).update(jnp.float32(0), jnp.float32(cost), cfg, 0)
    assert found == pytest.approx(expected, rel=1e-5)


def test_a_particle_keeps_its_model_its_plan_and_its_penalty():
    """A model whose state remembers who it is: particle p of model m under plan s."""
    m, p, s, h = 2, 3, 8, 2
    number = np.arange(m * p * s, dtype=np.float32).reshape(m, p, s)
    models, particles = jnp.arange(2.0).reshape(2, 1, 1), jnp.arange(3.0).reshape(1, 3, 1)

    def predict(fitted, latent, action, key, cfg):
        told = 24 * models + 8 * particles + action[..., 0]  # `number`, as plan s is all s
        zero = jnp.zeros_like(told)
        return Prediction(latent + told[..., None], told, zero, told**2, zero > 1)

    model = Model(lambda cfg: (m, p), predict, lambda latent: latent)
    plans = jnp.broadcast_to(jnp.arange(8.0)[:, None, None], (s, h, 1))
    learned = learned_by(pets.CAPConfig(), dual=jnp.float32(0.5))
    imagined = imagine(model, learned, jnp.zeros(1), plans, jax.random.key(0))
    np.testing.assert_array_equal(imagined.reward, np.stack([number] * h))
    np.testing.assert_array_equal(imagined.obs[..., 0], h * number)
    cost = cautious_cost(imagined, learned)
    by_hand = h * 0.5 * (number[1] ** 2).mean(0)  # model 1 has the larger spread, of each particle
    np.testing.assert_allclose(cost, by_hand, rtol=1e-6)
    shuffled = np.random.default_rng(0).permutation(s)
    none_feasible = pets.CAPConfig(elites=3, cost_limit=0.0)
    weights = elites(jnp.zeros(s), cost[shuffled] + 1.0, none_feasible)
    np.testing.assert_allclose(weights, np.where(shuffled < 3, 1 / 3, 0), rtol=1e-6)


def test_each_step_of_a_plan_has_chances_of_its_own():
    def predict(fitted, latent, action, key, cfg):
        reward = jax.random.uniform(key, latent.shape[:-1])
        return Prediction(latent, reward, 0 * reward, reward, reward > 1)

    model, plans = Model(lambda cfg: (2, 3), predict, lambda latent: latent), jnp.zeros((4, 5, 1))
    imagined = imagine(model, learned_by(pets.PETSConfig()), jnp.zeros(1), plans, jax.random.key(0))
    assert len(np.unique(imagined.reward)) == 5 * 2 * 3 * 4


def test_mixed_uncertainty_is_that_of_other_plans():
    """OmniSafe's: numbers of three plans, each twice for two models, are read plan by plan."""
    spread = jnp.array(
        [[[[1.0, 2.0, 4.0]], [[0.5, 0.5, 0.5]]], [[[0.0, 0.0, 0.0]], [[8.0, 0.0, 16.0]]]]
    )
    zero, end = jnp.zeros_like(spread), jnp.zeros((2, 1, 3))
    imagined = Imagined(zero, zero, spread, end, end)  # [H, M, P, S], two steps
    learned = learned_by(pets.CAPConfig(uncertainty="mixed"), dual=jnp.float32(0.5))
    # p0 p0 p1 for the first model, p1 p2 p2 for the second
    of_steps = [[(1 + 2) / 2, (1 + 4) / 2, (2 + 4) / 2], [(8 + 0) / 2, (8 + 16) / 2, (0 + 16) / 2]]
    np.testing.assert_allclose(cautious_cost(imagined, learned), 0.5 * np.sum(of_steps, 0), rtol=1e-6)
    own = learned_by(pets.CAPConfig(), dual=jnp.float32(0.5))
    np.testing.assert_allclose(cautious_cost(imagined, own), [4.5, 1.0, 10.0], rtol=1e-6)


def test_the_mean_and_the_worst_cost_by_hand():
    of_steps = [[[1.0, 0.0], [0.0, 3.0]], [[2.0, 0.0], [0.0, 0.0]]]  # [H, M, P]
    cost = jnp.array(of_steps)[..., None]
    imagined = Imagined(cost, cost, cost, cost, cost > 0)
    learned = learned_by(pets.CCEConfig())
    assert mean_cost(imagined, learned)[0] == (1 + 3) / 4 + 2 / 4
    assert worst_cost(imagined, learned)[0] == 3 + 2


@pytest.mark.parametrize(
    "name, least, most",
    [
        ("pets", 1.8, 2.0),
        ("cce_pets", 1.8, 2.0),
        ("cap_pets", 1.8, 2.0),
        ("rce_pets", 0.3, 0.7),
        ("loop", 1.8, 2.0),
        ("safe_loop", 0.3, 0.7),
    ],
)
def test_the_worst_case_counts_for_the_rows_that_say_so(name, least, most):
    """Two steps, which pay what they go ahead. One model of three is sure that they cost three times as
    much, the others that they cost nothing. A mean cost of 2.1 allows all plans, and a worst cost of
    2.1 those that go 0.7 ahead."""
    env: Any = dataclasses.replace(SHORE, episode_length=2)
    row, nets = ALGOS[name], STEEP if "loop" in name else {}
    settings: dict[str, Any] = {
        "models": 3, "model_hidden": (), "particles": 1, "plan_steps": 2, "plans": 200,
        "cem_iterations": 8, "plan_var": 1.0, "cost_limit": 2.1,
    }  # fmt: skip
    cfg = row.config(**settings | ({"hidden": (), "layer_norm": False} if nets else {}))
    model = init_fitted(jax.random.key(0), env, cfg).params
    weight = jnp.zeros((3, 2, 6)).at[:, 1, 0].set(1.0).at[0, 1, 1].set(3.0)  # reward and cost, of a
    layers = (model.ensemble.layers[0].replace(weight=weight),)
    low = jnp.full_like(model.ensemble.low, -30.0)
    model = model.replace(ensemble=model.ensemble.replace(layers=layers, low=low, high=low + 1e-3))
    learned = learned_by(cfg, dual=jnp.zeros(()), model=model, **nets)
    policy = row.make(env).policy

    def act(key):
        action, carry, _ = policy.act(learned, policy.init(learned), jnp.zeros(1), key)
        return action[0] + carry.mean[0, 0]

    ahead = jax.jit(act, compiler_options=FAST)(jax.random.key(0))
    assert least <= ahead <= most + 1e-3


def test_cap_pets_pays_for_its_models_uncertainty_at_the_price_kappa():
    """Two steps, which pay what they go ahead. sigma of the reward is exp(2 a - 2) or a little less,
    and a limit of 0.27 on the sum over both allows a of about 0 at a price of 1."""
    env: Any = dataclasses.replace(SHORE, episode_length=2)
    row = ALGOS["cap_pets"]
    cfg = row.config(
        models=3, model_hidden=(), plan_steps=2, plans=200, elites=16, cem_iterations=8, plan_var=1.0,
        cost_limit=0.27,
    )  # fmt: skip
    model = init_fitted(jax.random.key(0), env, cfg).params
    outputs = {"mean of the reward": 0, "log variance of the reward": 3}
    weight, bias = jnp.zeros((3, 2, 6)), jnp.zeros((3, 6))
    weight = weight.at[:, 1, outputs["mean of the reward"]].set(1.0)
    weight = weight.at[:, 1, outputs["log variance of the reward"]].set(4.0)
    bias = bias.at[:, outputs["log variance of the reward"]].set(-4.0)
    low = model.ensemble.low.at[:, 1:].set(-30.0)  # of cost and observation it is sure
    high = model.ensemble.high.at[:, 1:].set(-30.0 + 1e-3)
    layers = (model.ensemble.layers[0].replace(weight=weight, bias=bias),)
    model = model.replace(ensemble=model.ensemble.replace(layers=layers, low=low, high=high))
    policy = row.make(env).policy

    def ahead(kappa):
        learned = learned_by(cfg, dual=kappa, model=model)
        action, carry, _ = policy.act(learned, policy.init(learned), jnp.zeros(1), jax.random.key(0))
        return action[0] + carry.mean[0, 0]

    free, priced = jax.jit(jax.vmap(ahead), compiler_options=FAST)(jnp.array([0.0, 1.0]))
    assert free > 1.5 and -0.3 < priced < 0.1


# ---- the border of the feasible ------------------------------------------------------------------

RET = jnp.array([5.0, 4.0, 3.0, 2.0, 1.0])


def test_a_cost_at_the_limit_is_feasible_and_one_above_it_is_not():
    cfg = pets.CCEConfig(elites=2, cost_limit=1.0)
    at = elites(RET, jnp.array([1.0, 1.0, 0.5, 2.0, 2.0]), cfg)
    np.testing.assert_allclose(at, [0.5, 0.5, 0, 0, 0])  # by cost alone 2 is among them
    above = elites(RET, jnp.array([1 + 1e-6, 1.0, 0.5, 0.0, 2.0]), cfg)
    np.testing.assert_allclose(above, [0, 0.5, 0.5, 0, 0])  # by cost alone 3 is among them


def test_as_many_feasible_plans_as_elites_are_enough_and_one_less_changes_the_rule():
    """The hard rule takes the same plans by either rule if all that are feasible are elites. The soft
    one has weights by return or by cost."""
    cfg = loop.SafeLOOPConfig(elites=3, temperature=1.0, cost_temperature=1.0, cost_limit=1.0)
    enough = by_return_within_limit(RET, jnp.array([3.0, 1.0, 1.0, 0.5, 2.0]), cfg)
    np.testing.assert_allclose(enough, softmax([-np.inf, 4, 3, 2, -np.inf]), rtol=1e-5)
    cost = jnp.array([3.0, 2.5, 1.0, 0.5, 2.0])
    few = by_return_within_limit(RET, cost, cfg)
    np.testing.assert_allclose(few, softmax(-cost), rtol=1e-5)
    np.testing.assert_allclose(elites(RET, cost, cfg), [0, 0, 1 / 3, 1 / 3, 1 / 3])  # by cost alone


def test_a_plan_that_is_not_finite_is_never_among_the_best():
    cfg = pets.CCEConfig(elites=2, cost_limit=1.0)
    ret, cost = RET.at[0].set(jnp.nan), jnp.zeros(5).at[1].set(jnp.nan)
    np.testing.assert_allclose(elites(ret, cost, cfg), [0, 0, 0.5, 0.5, 0])
    many = dataclasses.replace(cfg, elites=4)  # more than are finite
    np.testing.assert_allclose(elites(ret, cost, many), [0, 0, 1 / 3, 1 / 3, 1 / 3], rtol=1e-6)
    np.testing.assert_allclose(elites(ret * jnp.nan, cost, many).sum(), 1)
    soft = loop.SafeLOOPConfig(elites=2, temperature=1.0, cost_limit=1.0)
    weights = by_return_within_limit(ret, cost, soft)
    assert (weights[:2] == 0).all() and jnp.isclose(weights.sum(), 1)
    nothing = by_return_within_limit(jnp.full(5, jnp.nan), cost, soft)
    np.testing.assert_allclose(nothing, 0.2)


def test_soft_weights_by_hand():
    cfg = loop.SafeLOOPConfig(elites=2, temperature=2.0, cost_temperature=3.0, cost_limit=1.0)
    w = np.exp(2.0 * np.array([4.0, 2.0]))
    enough = by_return_within_limit(RET, jnp.array([1.5, 1.0, 2.0, 0.0, 2.0]), cfg)
    np.testing.assert_allclose(enough, np.array([0, w[0], 0, w[1], 0]) / w.sum(), rtol=1e-5)
    cost = np.array([1.5, 2.0, 1.2, 0.9, 1.1])
    few = by_return_within_limit(RET, jnp.asarray(cost), cfg)
    np.testing.assert_allclose(few, np.exp(-3 * cost) / np.exp(-3 * cost).sum(), rtol=1e-5)


# ---- LOOP ----------------------------------------------------------------------------------------


def linear(*kernel: Any) -> dict[str, Any]:
    """A network, or a stack of them, of one layer without a bias."""
    weight = jnp.array(kernel)
    bias = jnp.zeros((*weight.shape[:-2], weight.shape[-1]))
    return {"params": {"Dense_0": {"kernel": weight, "bias": bias}}}


# Q_1(s, a) = a + s / 2 and Q_2 = a - s / 2, so that either may be the smaller; the actor: tanh(-5 s)
STEEP: dict[str, Any] = {
    "critic_r": linear([[0.5], [1.0]], [[-0.5], [1.0]]),
    "actor": linear([-5.0, 0.0]),
}


def test_the_plan_is_worth_the_smaller_value_of_what_the_actor_does_at_its_end():
    """From s' = s + a the plan should go down, where Q(s', a) of the action before would have it go
    up."""
    cfg = loop.LOOPConfig(hidden=(), layer_norm=False, plan_steps=2, discount=0.5, true_model=True)
    learned = learned_by(cfg, **STEEP)
    planner = loop.planner(SHORE)

    def ret(s, alive=True):
        obs = jnp.broadcast_to(s[:, None], (1, 1, len(s), 1))
        reward = jnp.array([3.0, 4.0]).reshape(2, 1, 1, 1) * jnp.ones((2, 1, 1, len(s)))
        imagined = Imagined(reward, reward, reward, obs, jnp.full((1, 1, len(s)), alive))
        return planner.plan_return(imagined, learned, jax.random.key(0))

    s = jnp.array([-1.0, 0.1, 1.0])
    smaller = np.tanh(-5 * s) - np.abs(s) / 2
    np.testing.assert_allclose(ret(s), 3 + 0.5 * 4 + 0.25 * smaller, rtol=1e-5)
    np.testing.assert_allclose(ret(s, alive=False), 3 + 0.5 * 4)  # after an end nothing is left
    assert jnp.argmax(ret(s)) == 0


def test_actor_and_critics_see_normalised_observations_in_plans():
    """Of mean 1 and standard deviation 2: 5 is 2 for them."""
    cfg = loop.LOOPConfig(hidden=(), layer_norm=False, plan_steps=1, discount=0.5)
    normaliser = Normaliser(jnp.ones(()), jnp.ones(1), 4 * jnp.ones(1))
    actor = linear([0.25, 0.0])
    actor["params"]["Dense_0"]["bias"] = jnp.array([0.0, -20.0])
    params = {"model": (), "critic_r": STEEP["critic_r"], "actor": actor}
    learned = Learned(cfg, params, (), normaliser)
    planner, zero = loop.planner(SHORE), jnp.zeros((1, 1, 1, 1))
    imagined = Imagined(zero, zero, zero, jnp.full((1, 1, 1, 1), 5.0), jnp.ones((1, 1, 1), bool))
    found = planner.plan_return(imagined, learned, jax.random.key(0))
    np.testing.assert_allclose(found, 0.5 * (np.tanh(0.25 * 2) - 2 / 2), rtol=1e-5)

    def predict(fitted, latent, action, key, cfg):
        return Prediction(latent, zero[0], zero[0], zero[0], zero[0] > 0)

    model = Model(lambda cfg: (1, 1), predict, lambda latent: latent)
    (plans,) = planner.propose(model, learned, jnp.full(1, 5.0), jax.random.key(0))
    np.testing.assert_allclose(plans, np.tanh(0.25 * 2), atol=1e-4)


def test_the_first_action_leads_to_where_the_actor_does_most():
    """One step ahead, unpaid: the actor does most where s' = s + a / 5 is low. Q of the action that
    leads there is the larger the more that goes up."""

    @dataclass(frozen=True)
    class Unpaid(Shore):
        def _state(self, x: jax.Array, reward: jax.Array) -> State:
            return super()._state(x, 0.0 * reward)

    env: Any = Unpaid()
    options: dict[str, Any] = {"plan_steps": 1, "plan_var": 1.0, "true_model": True}
    cfg = loop.LOOPConfig(hidden=(), layer_norm=False, **options)
    policy, learned = planning_policy(env, loop.planner(env)), learned_by(cfg, **STEEP)

    def act(key):
        return policy.act(learned, policy.init(learned), env.at(0.0), key)[0]

    np.testing.assert_allclose(jax.jit(act, compiler_options=FAST)(jax.random.key(0)), -1, atol=0.1)


def test_what_the_actor_does_in_each_model_is_among_the_plans():
    """In model m a step goes m ahead, and the actor does tanh(s / 4)."""
    cfg = loop.LOOPConfig(hidden=(), plan_steps=3, actor_plans=2, particles=4)
    bias = jnp.array([0.0, -20.0])  # of the mean and of the log standard deviation
    actor = {"params": {"Dense_0": {"kernel": jnp.array([[0.25, 0.0]]), "bias": bias}}}

    def predict(fitted, latent, action, key, cfg):
        zero = jnp.zeros(latent.shape[:-1])
        return Prediction(latent + jnp.arange(5.0).reshape(5, 1, 1, 1), zero, zero, zero, zero > 0)

    model = Model(lambda cfg: (5, cfg.particles), predict, lambda latent: latent)
    planner = loop.planner(SHORE)
    (plans,) = planner.propose(model, learned_by(cfg, actor=actor), jnp.zeros(1), jax.random.key(0))
    assert plans.shape == (5 * 2, 3, 1)
    seen = np.arange(5)[:, None] * np.arange(3)  # [M, H]
    np.testing.assert_allclose(plans[..., 0], np.repeat(np.tanh(seen / 4), 2, 0), atol=1e-4)


def test_each_action_of_the_actors_plans_is_drawn_anew():
    """In a model in which nothing moves."""
    cfg = loop.LOOPConfig(hidden=(), plan_steps=3, actor_plans=2, obs_normalize=False)
    actor = {"params": {"Dense_0": {"kernel": jnp.zeros((1, 2)), "bias": jnp.zeros(2)}}}

    def predict(fitted, latent, action, key, cfg):
        zero = jnp.zeros(latent.shape[:-1])
        return Prediction(latent, zero, zero, zero, zero > 0)

    model, learned = (
        Model(lambda cfg: (5, 1), predict, lambda latent: latent),
        learned_by(cfg, actor=actor),
    )
    (plans,) = loop.planner(SHORE).propose(model, learned, jnp.zeros(1), jax.random.key(0))
    assert len(np.unique(plans)) == 5 * 2 * 3


def test_a_narrow_plan_is_not_improved_any_further():
    cfg = dataclasses.replace(loop.LOOPConfig(plans=16), plan_var=1e-4, var_stop=1e-3)
    mean = jnp.full((2, 1), 0.3)

    def score(plans, key):
        return plans.sum((1, 2)), jnp.zeros(16)

    plan = cem(score, by_return, mean, (), jax.random.key(0), cfg)
    np.testing.assert_array_equal(plan, mean)


def test_mean_and_variance_keep_their_shares_of_what_they_were():
    """One plan, all 1/2, has all the weight, so the new variance is 0. Halved twice, the first variance
    of 1 is below `var_stop`, and of the first mean, 1, no more is given up."""
    momenta: dict[str, Any] = {"mean_momentum": 0.3, "var_momentum": 0.5}
    cfg = pets.PETSConfig(plans=4, plan_var=1.0, var_stop=0.3, **momenta)

    def last(plans, key):
        return jnp.arange(5.0), jnp.zeros(5)

    def best_alone(ret, cost, cfg):
        return (ret == 4).astype(jnp.float32)

    proposals = (jnp.full((1, 2, 1), 0.5),)
    plan = cem(last, best_alone, jnp.ones((2, 1)), proposals, jax.random.key(0), cfg)
    np.testing.assert_allclose(plan, 0.5 + 0.3**2 * 0.5, rtol=1e-6)


def test_a_plan_that_is_narrow_in_some_of_its_numbers_is_improved_further():
    """Two plans share the weight. They agree on the first action alone, whose variance is soon 0."""
    momenta: dict[str, Any] = {"mean_momentum": 0.3, "var_momentum": 0.5}
    cfg = pets.PETSConfig(plans=4, plan_var=1.0, var_stop=0.3, cem_iterations=5, **momenta)

    def score(plans, key):
        return jnp.arange(6.0), jnp.zeros(6)

    def last_two(ret, cost, cfg):
        return 0.5 * (ret >= 4)

    proposals = (jnp.array([[[0.5], [1.0]], [[0.5], [-1.0]]]),)
    plan = cem(score, last_two, jnp.ones((2, 1)), proposals, jax.random.key(0), cfg)
    np.testing.assert_allclose(plan[:, 0], [0.5 + 0.3**5 * 0.5, 0.3**5], rtol=1e-5)
