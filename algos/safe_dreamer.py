"""SafeDreamer, which plans in the dreams of a world model, among plans of a low cost."""

from functools import partial
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from jaxsafe.algos import dreamer
from jaxsafe.config import Amount, Bounds, Iterations, Share, Weight, config
from jaxsafe.learn.acting import Learned
from jaxsafe.learn.bill import PriceClockConfig
from jaxsafe.learn.dreaming import (
    Behaviour,
    Memory,
    Outcome,
    Scene,
    dreaming_learner,
    dreaming_policy,
    seen,
)
from jaxsafe.learn.off_policy import off_policy
from jaxsafe.learn.planning import PlanConfig, cem, elites, key_of_step, moved_on, particles_of
from jaxsafe.learn.row import Row
from jaxsafe.learn.steps import Trainable
from jaxsafe.learn.treatments import CappedPIDConfig, Treatment, capped_pid, no_treatment
from jaxsafe.learn.world_model import dream_returns, read, value_of, world_of
from jaxsafe.nn.rssm import Latent
from jaxsafe.types import Algorithm, Env, Metrics, Policy, PyTree


@config
class OSRPConfig(PlanConfig, dreamer.DreamerConfig):
    """OSRP: SafeDreamer that plans in dreams, among plans of a low cost.

        R(a_1 .. a_H) = r_1 + discount k_1 ((1 - td_lambda) V(s_1) + td_lambda (r_2 + ..)),   V at s_H
        C(a_1 .. a_H) = T / H  sum_h c_h,   T the steps of an episode
        elites: the largest R among plans with C <= cost_limit;
                if there are fewer of these than elites, the smallest C of all plans
        acts with the first action of the mean that CEM finds

    in dreams of Dreamer's model, which has a head of cost, c. V is the critic of Dreamer's actor. That
    actor learns in dreams, blind to cost, and serves the critic alone: the planner acts.

    Source: Huang et al. (2024), "SafeDreamer: Safe Reinforcement Learning with World Models",
    arXiv:2307.07176; the settings are from the authors' code.
    Differs from it: the model and the actor are those of Dreamer's later version. The authors weigh the
    loss of cost's head by 10 on steps that cost; here its weight is 1. They scale C by 1000 / H even
    where actions are repeated; here T counts the policy's steps. C = cost_limit is allowed here, not
    there. The actor proposes no plans, as in the authors' settings; the paper mixes some in. On vectors
    the authors observe positions in place of lidars, weigh the loss of vectors by 5, and compute costs
    from decoded positions.
    """

    ACTS_BY: ClassVar = ("elites", "cost_limit")

    # The undiscounted cost that an episode may have, as in the authors' code.
    cost_limit: Weight = 2.0
    # The weight of the critic's loss on replayed rewards. They are those of the planner, so it is 0, as
    # in the authors' code.
    replay_value: Weight = 0.0
    plan_steps: Iterations = 15  # H, steps that are planned ahead, as in the paper.
    cem_iterations: Iterations = 6  # Times that the plans are improved, as in the paper.
    plans: Amount = 500  # S, plans that are tried each time, as in the paper.
    particles: Amount = 1  # Dreams of each plan, as in the authors' code.
    # The best plans, which make the next mean and variance. As in the paper.
    elites: Amount = 50
    plan_var: Annotated[float, Bounds(0, 100)] = 1.0  # The variance at first, as in the authors' code.
    mean_momentum: Share = 0.1  # The share of the old mean that is kept, as in the authors' code.
    var_momentum: Share = 0.0  # The share of the old variance that is kept, as in the authors' code.


@config
class OSRPLagConfig(CappedPIDConfig, PriceClockConfig, OSRPConfig):
    """OSRP-Lag: OSRP whose plans also pay for cost, at the price of a PID controller.

        elites: the largest R - lam R_c, among the same plans as in OSRP
        I   <- clip(I + pid_ki e, 0, price_max),   e = J_c - cost_limit,   every `dual_every` steps
        lam  = clip(pid_kp e + I + pid_kd max(0, J_c - J_c'), 0, price_max)

    R_c is the return of cost, with a critic of its own. J_c is the smoothed cost of an episode, and
    J_c' what it was before. The rest is as in OSRP.

    Source: Huang et al. (2024), "SafeDreamer: Safe Reinforcement Learning with World Models",
    arXiv:2307.07176; the settings are from the authors' code.
    Differs from it: as OSRP does. There the price moves after each episode. The error and the cost are
    smoothed once more, by 0.95, the rise is over 10 moves, I starts at 0.001 and has no upper bound.
    J_c is smoothed before `dual_starts`, too.
    """

    # Environment steps between two moves of the price. The authors' moves with each episode.
    dual_every: Annotated[int, Bounds(1, 2**30)] = 1_000
    # Environment steps before cost counts, as in the authors' code. The price first moves `dual_every`
    # steps later.
    dual_starts: Annotated[int, Bounds(0, 2**31 - 1)] = 5_000


# ---- learning ----------------------------------------------------------------------------------


def learn_with_cost_critic(
    trained: dict[str, PyTree], memory: PyTree, scene: Scene, key: jax.Array
) -> Outcome:
    """As Dreamer, and a critic of what its actor's dreams cost, which the actor does not see."""
    found = dreamer.learn_reward(trained, memory["range"], scene, key)
    _, loss, metrics = dreamer.learn_cost(trained, found.dreams, scene, scene.batch.rows.cost)
    return Outcome(found.loss + loss, {"range": found.range}, found.metrics | metrics)


planned = dreamer.blind._replace(heads=dreamer.billed.heads, targets=dreamer.billed.targets)
planned_at_a_price = planned._replace(learn=learn_with_cost_critic, critics=("critic_r", "critic_c"))


# ---- planning ----------------------------------------------------------------------------------


class PlanMemory(NamedTuple):
    """What the policy remembers: where it was, what it did there, the mean of its plan, [H, A], and how
    many steps it has acted, []."""

    latent: Latent
    action: jax.Array
    mean: jax.Array
    step: jax.Array


def scores(
    env: Env,
    behaviour: Behaviour,
    treatment: Treatment,
    learned: Learned,
    latent: Latent,
    plans: jax.Array,
    key: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """What each of `plans` [S, H, A] earns in dreams from `latent`, and C: float [S] each.

    With a critic of cost it earns R - lam R_c.
    """
    cfg, params = learned.config, learned.params
    world = world_of(env, behaviour.all_heads(cfg), cfg)
    shape = (cfg.particles, len(plans))
    start = particles_of(latent, shape)

    def step(now: Latent, x: tuple[jax.Array, jax.Array]) -> tuple[Latent, jax.Array]:
        action, key = x
        action = jnp.broadcast_to(action, (*shape, action.shape[-1]))
        after: Any = world.apply(params["model"], now, action, key, method="imagine")
        return after, after.features

    keys = jax.random.split(key, plans.shape[1])
    later = jax.lax.scan(step, start, (jnp.moveaxis(plans, 1, 0), keys))[1]
    features = jnp.concatenate([start.features[None], later])
    says = read(world, params["model"], features)

    def returns(of: str, critic: str, discount: jax.Array | float) -> jax.Array:
        args = says[of], value_of(params[critic], features, cfg), says["cont"]
        return dream_returns(*args, discount=discount, decay=cfg.td_lambda)[0].mean(0)

    ret = returns("reward", "critic_r", cfg.discount)
    if "critic_c" in behaviour.critics:
        ret = treatment.advantage(learned.dual, ret, returns("cost", "critic_c", cfg.cost_discount))
    cost = says["cost"][1:].mean(1).sum(0)
    return ret, env.episode_length / plans.shape[1] * cost


def dream_planning_policy(env: Env, behaviour: Behaviour, treatment: Treatment) -> Policy:
    """The policy that plans anew at each step, in dreams."""
    acting = dreaming_policy(env, behaviour)

    def init(learned: Learned) -> PlanMemory:
        begin = acting.init(learned)
        mean = jnp.zeros((learned.config.plan_steps, env.action_size))
        return PlanMemory(begin.latent, begin.action, mean, begin.step)

    def act(
        learned: Learned, carry: PlanMemory, obs: PyTree, key: jax.Array | None
    ) -> tuple[jax.Array, PlanMemory, Metrics]:
        latent_key, plan_key = (None, key_of_step(carry.step)) if key is None else jax.random.split(key)
        memory = Memory(carry.latent, carry.action, carry.step)
        latent = seen(env, behaviour, learned, memory, obs, latent_key)
        score = partial(scores, env, behaviour, treatment, learned, latent)
        mean = cem(score, elites, carry.mean, (), plan_key, learned.config)
        return mean[0], PlanMemory(latent, mean[0], moved_on(mean), carry.step + 1), {}

    return Policy(init=init, act=act)


# ---- rows --------------------------------------------------------------------------------------


def make(
    env: Env,
    axis_name: str | None = None,
    behaviour: Behaviour = planned,
    treatment: Treatment = no_treatment,
) -> Algorithm:
    policy = dream_planning_policy(env, behaviour, treatment)
    learner = dreaming_learner(env, behaviour, policy, axis_name)

    def init(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> Trainable:
        scores = jnp.zeros(cfg.plans)
        elites(scores, scores, cfg)  # refuses settings that it cannot serve
        return learner.init(key, obs_size, action_size, cfg)

    return off_policy(env, learner._replace(init=init), treatment, axis_name)


LEVER: dict[str, Any] = dreamer.LEVER | {
    "plan_steps": 1, "plans": 64, "elites": 8, "cem_iterations": 4, "cost_limit": 2.5,
}  # fmt: skip

ROWS = {
    "osrp": Row(
        OSRPConfig,
        make,
        "SafeDreamer: planning in a world model's dreams, among plans of a low cost",
        {"safe_dreamer": dreamer.VECTORS},
        total_steps=1_000_000,
        lever=LEVER,
    ),
    "osrp_lag": Row(
        OSRPLagConfig,
        partial(make, behaviour=planned_at_a_price, treatment=capped_pid),
        "OSRP whose plans also pay for cost, at the price of a PID controller",
        {"safe_dreamer": dreamer.VECTORS},
        total_steps=1_000_000,
        lever=LEVER | {"dual_every": 256, "dual_starts": 512},
    ),
}
