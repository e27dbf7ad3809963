"""Several constraints: prices by hand, steps by an oracle, a process solved by a linear program."""

import dataclasses
import sys
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import BUSY, FAST
from learners import on_policy_names, options_of
from scipy.optimize import linprog, minimize
from toys import START, Corridor, Ticker, training, updated

from jaxsafe.algos import ALGOS, cpo, pcpo
from jaxsafe.algos.ppo import CPPOPIDConfig, PPOLagConfig
from jaxsafe.commands import train
from jaxsafe.config import ConfigError
from jaxsafe.learn.constraints import metrics_by_constraint
from jaxsafe.learn.halfspaces import furthest_point, nearest_point
from jaxsafe.learn.normalise import normalise
from jaxsafe.learn.returns import Window
from jaxsafe.learn.treatments import lagrangian, pid
from jaxsafe.nn.networks import value
from jaxsafe.run import loop
from jaxsafe.types import Shared, State

SLOW = partial(pytest.param, marks=pytest.mark.slow)
# on-policy; tests/contract/test_actor_critic.py has the others
SEVERAL = [name for name in on_policy_names() if "cost_limits" in options_of(name)]


# ---- prices ----------------------------------------------------------------------------------


def test_each_multiplier_takes_adams_steps_for_its_own_cost():
    cfg = PPOLagConfig(cost_limits={"b": 25.0, "a": 5.0}, dual_lr=0.1, lam_init=1.0, lam_max=1.15)
    dual = lagrangian.update(lagrangian.init(cfg), jnp.array([4.0, 35.0]), cfg, 0)  # a, then b
    np.testing.assert_allclose(dual.lam, [0.9, 1.1], rtol=1e-6)
    dual = lagrangian.update(dual, jnp.array([15.0, 35.0]), cfg, 0)
    m, v = (-0.09 + 1.0) / 0.19, (0.000999 + 0.1) / 0.001999  # gradients 1, then -10: of a
    np.testing.assert_allclose(dual.lam, [0.9 + 0.1 * m / v**0.5, 1.15], rtol=1e-5)


def test_the_mixed_advantage_of_two_costs_by_hand():
    dual = lagrangian.init(PPOLagConfig(cost_limits={"a": 1.0, "b": 1.0}))
    dual = dual._replace(lam=jnp.array([1.0, 2.0]))
    adv_c = jnp.array([[0.0, 0.0], [1.0, 0.0], [3.0, -1.0]])
    mixed = lagrangian.advantage(dual, jnp.array([1.0, 0.0, 2.0]), adv_c)
    np.testing.assert_allclose(mixed, [0.25, -0.25, 0.25])  # (2 - 3 + 2) / 4


def test_each_controller_is_the_one_of_its_cost_alone():
    options = {"lam_init": 0.5, "pid_smoothing": 0.5, "pid_delay": 2, "pid_kd": 0.2}
    both = CPPOPIDConfig(cost_limits={"a": 5.0, "b": 25.0}, **options)
    dual = pid.init(both)
    alone = [CPPOPIDConfig(cost_limit=x, **options) for x in (5.0, 25.0)]
    duals = [pid.init(cfg) for cfg in alone]
    for costs in ([3.0, 35.0], [9.0, 5.0], [30.0, 5.0], [4.0, 60.0]):
        dual = pid.update(dual, jnp.array(costs), both, 0)
        duals = [
            pid.update(d, jnp.float32(x), c, 0) for d, x, c in zip(duals, costs, alone, strict=True)
        ]
        for together, *apart in zip(dual, *duals, strict=True):
            np.testing.assert_allclose(together, np.stack(apart, -1), rtol=1e-6)


def test_a_metric_of_several_constraints_is_one_each():
    metrics = {"train/lam": jnp.array([1.0, 2.0]), "train/kl": jnp.float32(3.0)}
    assert metrics_by_constraint(metrics, ("a", "b")) == {
        "train/lam_a": 1.0,
        "train/lam_b": 2.0,
        "train/kl": 3.0,
    }
    assert metrics_by_constraint({"train/lam": jnp.float32(1.0)}, ()) == {"train/lam": 1.0}


# ---- trust-region steps ----------------------------------------------------------------------


solve = jax.jit(cpo.multipliers_of_several)
project = jax.jit(lambda problem: pcpo.projected_step(problem, pcpo.PCPOConfig()).step)


def step_of(g, b, hessian, c, delta):
    """The step, in float64 but for the dual itself, and the case; b is [K, P] and c [K]."""
    h_g, h_b = np.linalg.solve(hessian, g), np.linalg.solve(hessian, b.T).T
    arrays = [jnp.asarray(x, jnp.float32) for x in (g @ h_g, h_b @ g, b @ h_b.T, c, delta)]
    lam, nu, case = (np.asarray(x, np.float64) for x in solve(*arrays))
    assert np.isfinite(lam) and np.isfinite(nu).all() and (nu >= 0).all()
    return (-nu @ h_b if case == cpo.RECOVER else (h_g - nu @ h_b) / lam), int(case), nu


def problems(count, k, seed=0):
    """Random problems: feasible ones with any number of active constraints, and infeasible ones."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        n = int(rng.integers(k + 1, 7))
        root = rng.standard_normal((n, n))
        hessian = root @ root.T / n + 0.1 * np.eye(n)
        g, *b = rng.standard_normal((k + 1, n)) * 10.0 ** rng.uniform(-2, 1, (k + 1, 1))
        delta, b = 10.0 ** rng.uniform(-3, -1), np.array(b)
        reach = np.sqrt(2 * delta * np.einsum("ki,ki->k", b, np.linalg.solve(hessian, b.T).T))
        yield g, b, hessian, rng.uniform(-1.2, 1.15, k) * reach, delta


def in_balls_units(g, b, hessian, c, delta):
    """x = root y with |y| <= 1; g and the rows of b then have length 1."""
    root = np.linalg.cholesky(np.linalg.inv(hessian)) * np.sqrt(2 * delta)
    size = np.linalg.norm(b @ root, axis=1)
    return root, root.T @ g / np.linalg.norm(root.T @ g), b @ root / size[:, None], c / size


def slsqp(objective, gradient, e, kappa, ball):
    """The best point of the half-spaces e y + kappa <= 0 and, if `ball`, of |y| <= 1; or None."""
    constraints = [{"type": "ineq", "fun": lambda y: -(e @ y + kappa), "jac": lambda y: -e}]
    if ball:
        constraints += [{"type": "ineq", "fun": lambda y: 1 - y @ y, "jac": lambda y: -2 * y}]
    start = np.linalg.lstsq(e, -kappa - 0.05, rcond=None)[0]
    result = minimize(
        objective, start, jac=gradient, constraints=constraints, method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-13},
    )  # fmt: skip
    feasible = (e @ result.x + kappa).max() < 1e-7 and (not ball or result.x @ result.x < 1 + 1e-7)
    return result.x if feasible else None


@pytest.mark.parametrize("k", [1, 2, 3])
def test_steps_within_several_constraints_are_the_optima_that_an_independent_solver_finds(k):
    seen, active = np.zeros(4, int), np.zeros(k + 1, int)
    for g, b, hessian, c, delta in problems(250, k):
        x, case, nu = step_of(g, b, hessian, c, delta)
        root, along, e, kappa = in_balls_units(g, b, hessian, c, delta)
        y = np.linalg.solve(root, x)
        assert y @ y <= 1 + 1e-3
        nearest = slsqp(lambda y: y @ y / 2, lambda y: y, e, kappa, ball=False)
        assert nearest is not None  # there are more dimensions than half-spaces
        length = np.linalg.norm(nearest)
        if abs(length - 1) < 1e-3:
            continue  # both answers are right
        assert (case == cpo.RECOVER) == (length > 1)
        seen[case] += 1
        if case == cpo.RECOVER:
            np.testing.assert_allclose(y, nearest / length, atol=2e-3)
            assert (e @ y)[kappa > 0].max() < 0  # every constraint that is violated gains
            continue
        assert (e @ y + kappa).max() < 1e-3
        best = slsqp(lambda y, v=along: -(v @ y), lambda y, v=along: -v, e, kappa, ball=True)
        assert best is not None
        held = e[nu > 0]
        apart = np.linalg.norm(along - np.linalg.pinv(held) @ held @ along)  # the sine to their span
        np.testing.assert_allclose(along @ y, along @ best, atol=2e-3 if apart > 0.011 else 1e-2)
        active[(nu > 0).sum()] += 1
    assert seen.sum() > 235 and active.min() > 2, (seen, active)
    assert seen[[cpo.RECOVER, cpo.RETURN, cpo.BOUNDED]].min() > 10, seen


def test_one_constraint_among_several_is_the_closed_form():
    cases = np.zeros(4, int)
    for g, b, hessian, c, delta in problems(200, 1, seed=1):
        h_g, h_b = np.linalg.solve(hessian, g), np.linalg.solve(hessian, b[0])
        scalars = [jnp.float32(v) for v in (g @ h_g, g @ h_b, b[0] @ h_b, c[0], delta)]
        lam, nu, case = (float(v) for v in cpo.multipliers(*scalars))
        x, found, several = step_of(g, b, hessian, c, delta)
        expected = -nu * h_b if case == cpo.RECOVER else (h_g - nu * h_b) / lam
        assert found == case
        cases[found] += 1
        size = np.sqrt(2 * delta)
        root = np.linalg.cholesky(hessian).T
        np.testing.assert_allclose(root @ x / size, root @ expected / size, atol=1e-3)
        np.testing.assert_allclose(several, nu, rtol=5e-3, atol=1e-3 * np.sqrt(g @ h_g / (b[0] @ h_b)))
    assert cases.min() > 5, cases


# H = I, delta = 1/2: the unit disc, reward to the right.
UP, DOWN, LEFT, RIGHT, NONE = [0, 1], [0, -1], [-1, 0], [1, 0], [0, 0]


@pytest.mark.parametrize(
    "b, c, case, x",
    [
        ([UP, RIGHT], [-2.0, -3.0], cpo.FREE, [1, 0]),
        ([UP, RIGHT], [-2.0, -0.5], cpo.BOUNDED, [0.5, 0]),
        ([UP, [0.6, 0.8]], [-0.5, 0.0], cpo.RETURN, [0.8, -0.6]),
        ([UP, RIGHT], [0.6, -0.5], cpo.RETURN, [0.5, -0.6]),  # a corner
        ([UP, UP], [0.6, 0.6], cpo.RETURN, [0.8, -0.6]),  # the same twice
        ([UP, DOWN], [0.0, 0.0], cpo.RETURN, [1, 0]),  # a slit
        ([UP, RIGHT], [0.9, 0.9], cpo.RECOVER, [-(0.5**0.5), -(0.5**0.5)]),
        ([UP, RIGHT], [2.0, 1.0], cpo.RECOVER, [-(0.2**0.5), -(0.8**0.5)]),
        ([UP, RIGHT], [2.0, -5.0], cpo.RECOVER, [0, -1]),  # one is safe and stays out of it
        ([UP, DOWN], [0.5, 0.3], cpo.RECOVER, [0, -0.1]),  # they contradict: halfway
        ([UP, NONE], [-0.5, -1.0], cpo.BOUNDED, [1, 0]),  # a cost that no policy changes
        ([RIGHT, NONE], [-0.5, -1.0], cpo.BOUNDED, [0.5, 0]),
    ],
)
def test_the_plane_by_hand(b, c, case, x):
    problem = np.array([1.0, 0.0]), np.array(b, float), np.eye(2), np.array(c), 0.5
    step, found, _ = step_of(*problem)
    assert found == case
    np.testing.assert_allclose(step, x, atol=2e-3)


def test_the_solvers_are_finite_whatever_comes():
    values = [-1e30, -1.0, 0.0, 1e-9, 1.0, 1e30]
    kappa = jnp.array(np.stack(np.meshgrid(values, values), -1).reshape(-1, 2), jnp.float32)
    for cosine in (-1.0, 0.0, 0.999999, 1.0):
        gram = jnp.array([[1.0, cosine], [cosine, 1.0]])
        for rho in (jnp.zeros(2), jnp.array([1.0, cosine]), jnp.array([-1.0, -cosine])):
            out = jax.vmap(lambda kappa, gram=gram, rho=rho: furthest_point(gram, rho, kappa))(kappa)
            assert all(jnp.isfinite(x).all() for x in out)
        assert jnp.isfinite(jax.vmap(lambda kappa, gram=gram: nearest_point(gram, kappa))(kappa)).all()


@pytest.mark.parametrize("k", [1, 2, 3])
def test_the_projection_onto_several_constraints_is_the_nearest_point(k):
    for g, b, hessian, c, delta in problems(60, k, seed=2):
        h_g, h_b = np.linalg.solve(hessian, g), np.linalg.solve(hessian, b.T).T
        wide = np.pad(h_g, (0, 6 - g.size)), np.pad(h_b, ((0, 0), (0, 6 - g.size)))  # compiled once
        arrays = (jnp.zeros(6), *wide, g @ h_g, h_b @ g, b @ h_b.T, c, delta)
        step = project(cpo.Problem(*(jnp.asarray(x, jnp.float32) for x in arrays)))[: g.size]
        root, along, e, kappa = in_balls_units(g, b, hessian, c, delta)
        best = slsqp(
            lambda y, v=along: (y - v) @ (y - v) / 2, lambda y, v=along: y - v, e, kappa, ball=False
        )
        assert best is not None
        np.testing.assert_allclose(np.linalg.solve(root, step), best, atol=2e-3, rtol=2e-3)


# ---- whole updates ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Levers:
    """Two levers, each of which earns less the further it is pulled; two named costs.

    Observation [2]: signs that say which way to pull, redrawn at each step. With u in [0, 1]^2 the
    action times the signs, from [-1, 1]: reward = sum u (2 - u), paint = u_0 + u_1 / 4, noise = u_1.
    """

    obs_size: int = 2
    action_size: int = 2
    episode_length: int = 10
    cost_names: tuple[str, ...] = ("paint", "noise")

    def reset(self, key: jax.Array) -> State:
        return self._state(key, jnp.zeros(2))

    def step(self, state: State, action: jax.Array) -> State:
        return self._state(state.physics, 0.5 * (1 + jnp.clip(action * state.obs, -1.0, 1.0)))

    def _state(self, key: jax.Array, u: jax.Array) -> State:
        key, sign_key = jax.random.split(key)
        obs = jax.random.rademacher(sign_key, (2,), jnp.float32)
        reward, costs = jnp.sum(u * (2 - u)), jnp.stack([u[0] + u[1] / 4, u[1]])
        return State(key, obs, reward, costs.sum(), costs, jnp.bool_(False), {})


LIMITS = {"paint": 3.75, "noise": 5.0}  # per episode, of 10 steps
UPDATES = 400  # of an off-policy algorithm, 256 steps each
# A policy whose standard deviation has collapsed answers a price only after a hundred iterations, in
# which multipliers swing from 0 to far too much; the entropy keeps it faster than they are.
QUICK = {"lr": 1e-2, "lr_decay": False, "target_kl": 0.1, "epochs": 8, "entropy_coef": 5e-3}
LEARN = {
    "cpo": {},
    "cppo_pid": QUICK | {"lam_init": 0.8, "pid_kp": 0.1, "pid_ki": 0.05, "pid_smoothing": 0.5},
    "ppo_lag": QUICK | {"dual_lr": 0.05},
}


def best_return(limits):
    """Of an episode: the linear program over how often each pull of a grid is chosen."""
    u = np.stack(np.meshgrid(np.arange(21) / 20, np.arange(21) / 20), -1).reshape(-1, 2)
    costs = {"paint": u[:, 0] + u[:, 1] / 4, "noise": u[:, 1]}
    found = linprog(
        -np.sum(u * (2 - u), 1),
        A_ub=np.array([costs[name] for name in limits]),
        b_ub=np.array([*limits.values()]) / 10,
        A_eq=np.ones((1, len(u))),
        b_eq=[1.0],
    )
    return -10 * found.fun


def test_both_limits_bind_at_the_optimum():
    best = best_return(LIMITS)
    np.testing.assert_allclose(best, 10 * (0.25 * 1.75 + 0.5 * 1.5), rtol=1e-6)
    assert all(best_return({name: x}) > 1.05 * best for name, x in LIMITS.items())


@pytest.mark.parametrize("name", ["cpo", SLOW("cppo_pid"), SLOW("ppo_lag")])
def test_the_best_policy_within_both_limits_is_found(name):
    algo = ALGOS[name].make(Levers())
    sizes = {"num_envs": 32, "horizon": 20, "minibatches": 2, "critic_epochs": 4, "hidden": (16,)}
    cfg = ALGOS[name].config(**sizes, cost_limits=LIMITS, **LEARN[name])
    train = jax.jit(jax.vmap(training(algo, cfg, 300)), compiler_options=BUSY)
    _, metrics = train(jax.random.split(jax.random.key(0), 2))
    late = {k: np.asarray(x)[:, -200:].mean(1) for k, x in metrics.items()}
    for cost, most in LIMITS.items():
        assert (late[f"train/cost_{cost}"] < 1.05 * most).all()
    assert (late["train/return"] > 0.93 * best_return(LIMITS)).all()
    assert (late["train/return"] < 1.03 * best_return(LIMITS)).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sac_lag", "sac_pid", "td3_lag", "ddpg_lag"])
def test_off_policy_too_the_policy_comes_near_the_best_within_both_limits(name):
    """A price swings about its value, so the limits hold in the mean of many updates. SAC pays a little
    for its entropy."""
    algo = ALGOS[name].make(Levers())
    cfg = ALGOS[name].config(**{**ALGOS[name].lever, "cost_limits": LIMITS})

    def train(key):
        def update(ts, i):
            return algo.update(ts, Shared(i))

        return jax.lax.scan(update, algo.init(key, cfg, START), jnp.arange(UPDATES))

    _, metrics = jax.jit(jax.vmap(train), compiler_options=BUSY)(jax.random.split(jax.random.key(0), 2))
    late = {k: np.nanmean(np.asarray(x)[:, -UPDATES // 2 :], 1) for k, x in metrics.items()}
    print(name, {k: late[k] for k in ("train/cost_paint", "train/cost_noise", "train/return")})
    for cost, most in LIMITS.items():
        assert (late[f"train/cost_{cost}"] < 1.1 * most).all()
    assert (late["train/return"] > 0.85 * best_return(LIMITS)).all()
    assert (late["train/return"] < 1.03 * best_return(LIMITS)).all()


TINY = {"num_envs": 8, "horizon": 25, "minibatches": 2, "hidden": (8,)}


def begin(name, **options):
    algo = ALGOS[name].make(Ticker())
    cfg = ALGOS[name].config(**TINY, cost_limits={"b": 1.0, "a": 20.0}, **options)
    return algo, lambda: algo.init(jax.random.key(0), cfg, START)


@pytest.mark.parametrize("name", SEVERAL)
def test_an_update_has_a_critic_and_its_metrics_for_each_constraint(name):
    algo, init = begin(name)
    ts = jax.eval_shape(init)
    after, metrics = jax.eval_shape(updated(algo), ts)
    for x, y in zip(jax.tree.leaves(ts), jax.tree.leaves(after), strict=True):
        assert (x.shape, x.dtype, x.weak_type) == (y.shape, y.dtype, y.weak_type)
    assert all(x.dtype == jnp.float32 and x.shape == () for x in metrics.values())
    assert all(x.shape[0] == 2 for x in jax.tree.leaves(ts.params["critic_c"]))
    for cost in ("a", "b"):
        assert f"train/value_loss_c_{cost}" in metrics
        price = "nu" if "train/nu_a" in metrics else "lam"  # cpo's lam is of the trust region
        assert f"train/{price}_{cost}" in metrics and f"train/{price}" not in metrics


@pytest.mark.parametrize(
    "name", [name if name in ("cpo", "ppo_lag") else SLOW(name) for name in SEVERAL]
)
def test_each_constraint_is_charged_its_own_cost(name):
    algo, init = begin(name, cost_window=2)

    def update():
        past = Window(jnp.full((2, 2), 99.0), jnp.int32(2))  # which no metric of an iteration sees
        return algo.update(dataclasses.replace(init(), past_costs=past), START)

    after, metrics = jax.jit(update, compiler_options=FAST)()
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves((after.params, metrics)))
    for mean, cost in ((2.5, "a"), (7.5, "b")):  # 0.5 and 1.5 a step, 5 steps
        for metric in ("cost", "cost_estimate"):
            np.testing.assert_allclose(metrics[f"train/{metric}_{cost}"], mean, rtol=1e-5)
    assert metrics["train/cost_estimate"] == 10.0


def test_each_critic_learns_its_own_cost():
    algo = ALGOS["ppo_lag"].make(Ticker())
    cfg = ALGOS["ppo_lag"].config(
        **TINY, cost_limits={"b": 1.0, "a": 20.0}, cost_discount=0.0, critic_lr=1e-2
    )
    ts, _ = jax.jit(training(algo, cfg, 20), compiler_options=FAST)(jax.random.key(0))
    obs = normalise(ts.normaliser, ts.rollout.state.obs)
    values = jax.vmap(lambda critic: value(critic, obs, cfg).mean())(ts.params["critic_c"])
    np.testing.assert_allclose(values, [0.5, 1.5], atol=0.1)


@pytest.mark.parametrize("name", [pytest.param("cpo", marks=pytest.mark.slow), "ppo_lag"])
def test_limits_are_leaves_and_train_side_by_side(name):
    algo = ALGOS[name].make(Levers())
    cfg = ALGOS[name].config(**TINY, cost_limits={"paint": 8.0, "noise": 4.0})

    def one(paint):
        limits = {"paint": paint, "noise": 4.0}
        return training(algo, dataclasses.replace(cfg, cost_limits=limits), 2)(jax.random.key(0))

    values = jnp.array([8.0, 1.0])
    together = jax.jit(jax.vmap(one), compiler_options=FAST)(values)
    assert together[0].config.cost_limits["paint"].tolist() == [8.0, 1.0]
    for i, x in enumerate(values):
        alone = jax.jit(one, compiler_options=FAST)(x)
        for a, b in zip(
            jax.tree.leaves(together[0].params), jax.tree.leaves(alone[0].params), strict=True
        ):
            np.testing.assert_allclose(a[i], b, rtol=1e-3, atol=1e-3)
    prices = "train/nu_paint" if name == "cpo" else "train/lam_paint"
    assert together[1][prices][0, -1] != together[1][prices][1, -1]


# ---- bad input -------------------------------------------------------------------------------

BAD = {
    "algo.cost_limits={hazard: 5}": "unknown cost 'hazard'; did you mean 'hazards'?",
    "algo.cost_limits={hazards: -1}": "algo.cost_limits.hazards=-1: expected a number between 0 and",
    "algo.cost_limits={hazards: nan}": "algo.cost_limits.hazards=nan: expected a number between 0 and",
    "algo.cost_limits={}": "algo.cost_limits={}: expected names with a number",
    "algo.cost_limits={hazards: many}": "algo.cost_limits.hazards='many': expected a number",
    "algo.cost_limits=[5,10]": "expected names with a number",
    "algo.cost_limits=5": "expected names with a number",
    "env=point_goal2 algo.cost_limits.hazard=5": "unknown cost 'hazard'; did you mean 'hazards'?",
    "algo.cost_limits.hazards=-1": "algo.cost_limits.hazards=-1: expected a number between 0 and",
    "algo=ppo algo.cost_limits.hazards=5": "of ppo; did you mean 'cost_limit'?",
    "algo.clip.hazards=5": "unknown option algo.clip.hazards",
    "algo.cost_limits.hazards.x=5": "unknown option algo.cost_limits.hazards.x",
    "algo=p3o algo.cost_limits={hazards: 5}": "more have cost_limits",
    "algo=ppo algo.cost_limits={hazards: 5}": "of ppo; did you mean 'cost_limit'?",
    "env=point_goal0 algo.cost_limits={hazards: 5}": "the environment has none",
}


@pytest.mark.parametrize("arguments", BAD)
def test_bad_limits_are_one_line_and_status_2(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    head, option, value = arguments.rpartition("algo.c")
    monkeypatch.setattr(sys, "argv", ["train.py", *head.split(), option + value])
    monkeypatch.setattr(loop, "train", lambda *a, **k: pytest.fail("it went on to train"))
    try:
        status = train.main()
    except SystemExit as stop:
        status = stop.code
    lines = capsys.readouterr().err.splitlines()
    assert status == 2
    assert len(lines) == 1 and lines[0].startswith("error: ") and BAD[arguments] in lines[0]


def test_a_wrong_name_or_no_name_is_an_error_without_the_command_line_too():
    algo = ALGOS["cpo"].make(Corridor())
    for limits, message in (({"wal": 1.0}, "did you mean 'wall'"), ({}, "at least")):
        with pytest.raises(ConfigError, match=message):
            algo.init(jax.random.key(0), ALGOS["cpo"].config(**TINY, cost_limits=limits), START)
