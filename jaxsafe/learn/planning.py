"""Planning with a model: the cross-entropy method (CEM), by scores and by weights that are handed in.

    a_s ~ N(mean, var), clipped to [-1, 1],   s = 1 .. S plans of H actions
    R_s, C_s = scores of what the model's particles do with plan s
    w = weigh(R, C),   mean <- sum_s w_s a_s,   var <- sum_s w_s (a_s - mean)^2

This is repeated `cem_iterations` times; mean and var keep a share of what they were. The first action
of the last mean is executed. The next step begins with the mean moved on by one step, and with the
variance that there was at first.

The mean is all that the policy remembers: its carry. The algorithms differ in scores and weights. These
make a `Planner`.

Source: Chua et al. (2018), "Deep Reinforcement Learning in a Handful of Trials using Probabilistic
    Dynamics Models", arXiv:1805.12114.
Differs from it: there and in OmniSafe the variance of n elites is divided by n - 1.
"""

import itertools
import math
from collections.abc import Callable
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from jaxsafe.config import Amount, Bounds, ConfigError, Iterations, Share, Weight, config
from jaxsafe.learn.acting import Learned
from jaxsafe.learn.batch import select
from jaxsafe.learn.models import Model, learned_model, simulator
from jaxsafe.nn import drawn
from jaxsafe.types import Env, Policy, PyTree

HIGHEST = jax.lax.Precision.HIGHEST


@config
class PlanConfig:
    """For algorithms that plan."""

    ACTS_BY: ClassVar = (
        "plan_steps", "cem_iterations", "plans", "particles", "plan_var", "mean_momentum",
        "var_momentum", "var_stop",
    )  # fmt: skip

    plan_steps: Iterations = 7  # H, steps that are planned ahead, as in OmniSafe.
    cem_iterations: Iterations = 5  # Times that the plans are improved, as in OmniSafe.
    plans: Amount = 512  # S, plans that are tried each time, as in OmniSafe.
    particles: Amount = 4  # Courses of events for each plan and each model, as in OmniSafe.
    plan_var: Annotated[float, Bounds(0, 100)] = 4.0  # The variance at first, as in OmniSafe.
    mean_momentum: Share = 0.1  # The share of the old mean that is kept, as in OmniSafe.
    var_momentum: Share = 0.1  # The share of the old variance that is kept, as in OmniSafe.
    # A plan of no larger variance is not improved any further.
    var_stop: Weight = 0.0


class Imagined(NamedTuple):
    """What a model thinks of S plans over H steps, for P particles of each of M models.

    reward, cost, spread: float [H, M, P, S], see `models.Prediction`; all are 0 after the end of an
    episode. obs: what is seen after the last step, [M, P, S, O]. alive: bool [M, P, S],
    whether the episode still goes on then.
    """

    reward: jax.Array
    cost: jax.Array
    spread: jax.Array
    obs: jax.Array
    alive: jax.Array


PlanCost = Callable[[Imagined, Learned], jax.Array]  # -> float [S]
Weigh = Callable[[jax.Array, jax.Array, Any], jax.Array]  # (return [S], cost [S], cfg) -> weights [S]


class Planner(NamedTuple):
    """What one method adds to the planning.

    plan_return(imagined, learned, key) -> float [S], the return of each plan.
    cost(imagined, learned) -> float [S], the cost of each plan, summed over its steps. The policy
        scales it to a whole episode, whose cost `weigh` compares with the limit.
    weigh(ret, cost, cfg) -> weights, float [S], whose sum is 1.
    propose(model, learned, seen, key) -> further plans to try: arrays [.., H, A], or () for none.
    """

    plan_return: Callable[[Imagined, Learned, jax.Array], jax.Array]
    cost: PlanCost
    weigh: Weigh
    propose: Callable[[Model, Learned, PyTree, jax.Array], tuple[jax.Array, ...]] = lambda *_: ()


# ---- imagination -------------------------------------------------------------------------------


def particles_of(seen: PyTree, shape: tuple[int, ...]) -> PyTree:
    """`seen` of one environment, repeated for each particle: leaves [*shape, ...]."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (*shape, *x.shape)), seen)


def imagine(model: Model, learned: Learned, seen: PyTree, plans: jax.Array, key: jax.Array) -> Imagined:
    """What the model's particles do with `plans` [S, H, A], from where `seen` was seen.

    Args:
        seen: an observation or, for the simulator, a State.
    """
    cfg, fitted = learned.config, learned.params["model"]
    shape = (*model.particles(cfg), len(plans))

    def step(
        now: tuple[PyTree, jax.Array], x: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[PyTree, jax.Array], tuple[jax.Array, ...]]:
        (latent, alive), (action, key) = now, x
        action = jnp.broadcast_to(action, (*shape, action.shape[-1]))
        after = model.predict(fitted, latent, action, key, cfg)
        told = (after.reward, after.cost, after.spread)
        return (after.latent, alive & ~after.end), tuple(jnp.where(alive, x, 0.0) for x in told)

    start = particles_of(seen, shape), jnp.ones(shape, bool)
    keys = jax.random.split(key, plans.shape[1])
    (latent, alive), made = jax.lax.scan(step, start, (jnp.moveaxis(plans, 1, 0), keys))
    reward, cost, spread = made
    return Imagined(reward, cost, spread, model.observe(latent), alive)


# ---- scores ------------------------------------------------------------------------------------


def mean_return(imagined: Imagined, learned: Learned, key: jax.Array) -> jax.Array:
    """The sum of rewards, a mean over particles: float [S]."""
    return imagined.reward.mean((1, 2)).sum(0)


def no_cost(imagined: Imagined, learned: Learned) -> jax.Array:
    return jnp.zeros(imagined.cost.shape[-1])


def mean_cost(imagined: Imagined, learned: Learned) -> jax.Array:
    """The sum of costs, a mean over particles: float [S]."""
    return imagined.cost.mean((1, 2)).sum(0)


def worst_cost(imagined: Imagined, learned: Learned) -> jax.Array:
    """The sum over steps of the largest cost among the particles: float [S]."""
    return imagined.cost.max((1, 2)).sum(0)


def cautious_cost(imagined: Imagined, learned: Learned) -> jax.Array:
    """As `mean_cost`, float [S], but each step costs c + kappa max_m |sigma_m|. The maximum is over the
    models, at the same plan, step and number of the particle. kappa is `learned.dual`."""
    penalty = imagined.spread.max(1, keepdims=True)  # [H, 1, P, S]
    if learned.config.uncertainty == "mixed":
        # each number as often as there are models, one after the other, and read as [M, P, S]
        penalty = jnp.repeat(penalty, imagined.spread.shape[1]).reshape(imagined.spread.shape)
    return (imagined.cost + learned.dual * penalty).mean((1, 2)).sum(0)


# ---- weights -----------------------------------------------------------------------------------


def sound(ret: jax.Array, cost: jax.Array) -> jax.Array:
    """The plans whose scores are finite, bool [S]."""
    return jnp.isfinite(ret) & jnp.isfinite(cost)


def standing(ret: jax.Array, cost: jax.Array, cfg: Any) -> tuple[jax.Array, jax.Array]:
    """Whether at least `elites` plans are feasible, bool [], and which are, bool [S].

    A cost at the limit is feasible.

    Raises:
        ConfigError: there are fewer than `elites` plans.
    """
    if cfg.elites > len(ret):
        raise ConfigError(f"elites={cfg.elites}: expected at most plans={len(ret)}")
    feasible = (cost <= cfg.cost_limit) & sound(ret, cost)
    return feasible.sum() >= cfg.elites, feasible


def elites(ret: jax.Array, cost: jax.Array, cfg: Any) -> jax.Array:
    """Equal weights for the `elites` feasible plans that earn most. If fewer are feasible, for the
    `elites` plans that cost least. A plan whose scores are not finite only counts if all are such."""
    enough, feasible = standing(ret, cost, cfg)
    value = jnp.where(enough, jnp.where(feasible, ret, -jnp.inf), -cost)
    value = jnp.where(sound(ret, cost), value, -jnp.inf)
    best = jax.lax.top_k(value, cfg.elites)[1]
    counts = sound(ret, cost)[best]
    counts |= ~counts.any()
    return jnp.zeros_like(ret).at[best].set(counts / counts.sum())


def exponential(exponent: jax.Array, counts: jax.Array) -> jax.Array:
    """Weights in proportion to exp(exponent), for the plans that count, bool [S]; equal ones if none
    does."""
    exponent = jnp.where(counts, exponent, -jnp.inf)
    return jax.nn.softmax(jnp.where(counts.any(), exponent, 0.0))


def by_return(ret: jax.Array, cost: jax.Array, cfg: Any) -> jax.Array:
    """Weights in proportion to exp(temperature R)."""
    return exponential(cfg.temperature * ret, sound(ret, cost))


def by_return_within_limit(ret: jax.Array, cost: jax.Array, cfg: Any) -> jax.Array:
    """Weights in proportion to exp(temperature R) among the feasible plans. If fewer than `elites` are
    feasible, in proportion to exp(-cost_temperature C) among all."""
    enough, feasible = standing(ret, cost, cfg)
    exponent = jnp.where(enough, cfg.temperature * ret, -cfg.cost_temperature * cost)
    return exponential(exponent, jnp.where(enough, feasible, sound(ret, cost)))


# ---- the cross-entropy method ------------------------------------------------------------------


class Belief(NamedTuple):
    """Mean and variance of the plans that are drawn, float [H, A]."""

    mean: jax.Array
    var: jax.Array


def cem(
    score: Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]],
    weigh: Weigh,
    mean: jax.Array,
    proposals: tuple[jax.Array, ...],
    key: jax.Array,
    cfg: Any,
) -> jax.Array:
    """The mean of the plans after `cem_iterations`, float [H, A].

    Args:
        score: (plans [S, H, A], key) -> return and cost, float [S] each.
        weigh: see `Planner`.
        mean: where to begin, float [H, A].
        proposals: plans [.., H, A] that are tried each time, too.
    """

    def improve(now: Belief, key: jax.Array) -> tuple[Belief, None]:
        draw_key, score_key = jax.random.split(key)
        noise = jax.random.normal(draw_key, (cfg.plans, *mean.shape))
        plans = jnp.clip(now.mean + jnp.sqrt(now.var) * noise, -1.0, 1.0)
        plans = jnp.concatenate([plans, *proposals])
        weights = weigh(*score(plans, score_key), cfg)
        best = jnp.tensordot(weights, plans, 1, precision=HIGHEST)
        var = jnp.tensordot(weights, (plans - best) ** 2, 1, precision=HIGHEST)
        new = Belief(
            cfg.mean_momentum * now.mean + (1 - cfg.mean_momentum) * best,
            cfg.var_momentum * now.var + (1 - cfg.var_momentum) * var,
        )
        return select(now.var.max() > cfg.var_stop, new, now), None

    start = Belief(mean, jnp.full(mean.shape, cfg.plan_var))
    return jax.lax.scan(improve, start, jax.random.split(key, cfg.cem_iterations))[0].mean


def moved_on(mean: jax.Array) -> jax.Array:
    """The mean of the plan one step later, [H, A]: the last action comes twice."""
    return jnp.concatenate([mean[1:], mean[-1:]])


def key_of_step(step: jax.Array) -> jax.Array:
    """The draws of a plan or of a shield whose actions are to be the same each time. They differ from
    step to step: one that errs to the left does so once."""
    return jax.random.fold_in(jax.random.key(0), step)


def planning_bytes(env: Env, cfg: Any) -> int:
    """The least that planning for one environment holds at once: what is kept of each step of all
    courses of events, and two neighbouring layers of the networks that predict one step of them. The
    kernel of a Hopper GPU has no layers in memory (`nn.drawn`)."""
    model = simulator(env) if cfg.true_model else learned_model(env)
    courses = cfg.plans * math.prod(model.particles(cfg))
    outputs = 2 * (1 + cfg.learn_cost + env.obs_size)  # means and variances
    layers = (env.obs_size + env.action_size, *cfg.model_hidden, outputs)
    fused = cfg.model_dtype == "bfloat16" and drawn.serves(layers[0], cfg.model_hidden, outputs // 2)
    network = 0 if cfg.true_model or fused else max(a + b for a, b in itertools.pairwise(layers))
    size = jnp.dtype(cfg.model_dtype).itemsize
    return courses * (4 * (3 * cfg.plan_steps + env.obs_size) + size * network)


class Plan(NamedTuple):
    """What the policy remembers: the mean of its plan, [H, A], and how many steps it has acted, []."""

    mean: jax.Array
    step: jax.Array


def planning_policy(env: Env, planner: Planner) -> Policy:
    """The policy that plans anew at each step."""
    simulated, ensemble = simulator(env), learned_model(env)

    def init(learned: Learned) -> Plan:
        return Plan(jnp.zeros((learned.config.plan_steps, env.action_size)), jnp.int32(0))

    def act(
        learned: Learned, carry: Plan, seen: PyTree, key: jax.Array | None
    ) -> tuple[jax.Array, Plan, dict[str, Any]]:
        cfg = learned.config
        model = simulated if cfg.true_model else ensemble
        plan_key, propose_key = jax.random.split(key_of_step(carry.step) if key is None else key)
        per_episode = env.episode_length / cfg.plan_steps

        def score(plans: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
            imagine_key, ret_key = jax.random.split(key)
            imagined = imagine(model, learned, seen, plans, imagine_key)
            ret = planner.plan_return(imagined, learned, ret_key)
            return ret, per_episode * planner.cost(imagined, learned)

        proposals = planner.propose(model, learned, seen, propose_key)
        mean = cem(score, planner.weigh, carry.mean, proposals, plan_key, cfg)
        return mean[0], Plan(moved_on(mean), carry.step + 1), {}

    return Policy(init, act, privileged=lambda learned: learned.config.true_model)
