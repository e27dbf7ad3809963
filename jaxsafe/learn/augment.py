"""Augmentations: what an algorithm adds to the task for its learner alone.

Rewards and costs of the environment stay what they are, and with them every metric; only what the
networks see, what the learner is paid and where its episodes end may differ.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from jaxsafe.config import Bounds, Iterations, Real, Share, Weight, config
from jaxsafe.learn.conventions import Convention
from jaxsafe.learn.observations import vector_of, with_vector
from jaxsafe.learn.rollout import Episode, Trajectory, never
from jaxsafe.learn.treatments import Treatment
from jaxsafe.types import Count, Env, PyTree, State

MIN_BUDGET = 1e-6  # cost per episode, so that a limit of 0 divides nothing by zero; OmniSafe


class Augmentation(NamedTuple):
    """What the learner sees and is paid beside the task.

    wrap(env, cfg, dual) -> the Env that the policy acts in, in training and afterwards. What it appends
        to the observation is not normalised. Its floats may be traced.
    renew(resets, cfg, dual) -> State [N], resets drawn in an earlier iteration as they are now.
    stop(episode, cfg) -> bool [N], where an episode of training ends for good.
    reward(traj, cfg) -> float [T, N], what the learner is paid.
    last_obs(traj, cfg) -> [T, N, ...], the observations whose value each step leads to.
    """

    wrap: Callable[[Env, Any, PyTree], Env]
    renew: Callable[[State, Any, PyTree], State]
    stop: Callable[[Episode, Any], jax.Array]
    reward: Callable[[Trajectory, Any], jax.Array]
    last_obs: Callable[[Trajectory, Any], PyTree]


no_augmentation = Augmentation(
    wrap=lambda env, cfg, dual: env,
    renew=lambda resets, cfg, dual: resets,
    stop=lambda episode, cfg: never(episode),
    reward=lambda traj, cfg: traj.reward,
    last_obs=lambda traj, cfg: traj.next_obs,
)


@dataclass(frozen=True)
class Budget:
    """`env` that also shows z, what is left of a budget on cost, as the last entry of its observation.

        z_0 = start,   z_{t+1} = (z_t - c_t / budget) / discount

    so discount^t z_t = start - sum_{s<t} discount^s c_s / budget: a discounted budget, as seen from
    step t. info counts the steps of an episode that end without any: 'unsafe'.

    start: share of the budget, in [0, 1]. budget: in units of cost. discount: in (0, 1].
    """

    env: Env
    start: jax.Array | float
    budget: jax.Array | float
    discount: jax.Array | float

    @property
    def obs_size(self) -> int:
        return self.env.obs_size + 1

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def episode_length(self) -> int:
        return self.env.episode_length

    @property
    def cost_names(self) -> tuple[str, ...]:
        return self.env.cost_names

    def reset(self, key: jax.Array) -> State:
        return self._show(self.env.reset(key), self.start)

    def step(self, state: State, action: jax.Array) -> State:
        info = {name: x for name, x in state.info.items() if name != "unsafe"}
        vector = vector_of(state.obs)
        z, obs = vector[-1], with_vector(state.obs, vector[:-1])
        state = self.env.step(dataclasses.replace(state, obs=obs, info=info), action)
        return self._show(state, (z - state.cost / self.budget) / self.discount)

    def _show(self, state: State, z: jax.Array | float) -> State:
        unsafe = jnp.float32(jnp.asarray(z) <= 0)
        obs = with_vector(state.obs, jnp.append(vector_of(state.obs), z))
        return dataclasses.replace(state, obs=obs, info=state.info | {"unsafe": unsafe})


@config
class SauteConfig:
    """For `saute`."""

    CONVENTIONS: ClassVar = (
        Convention(
            {"full_at_end": True},
            "at a time limit, the value is that of a full budget, which is the next episode's",
            "the value is that of the budget that the episode left",
        ),
    )

    # gamma_n, the discount of the budget, as OmniSafe's on Goal and Circle. On Button it has 0.999.
    saute_discount: Annotated[float, Bounds(0.01, 1)] = 0.9999
    # n, the reward of a step that ends without budget, as OmniSafe's on Goal. On Button it has -1.
    unsafe_reward: Real = -0.2
    # Whether the value at a time limit is that of a full budget, z = 1. OmniSafe's is.
    full_at_end: bool = False


def full_budget(env: Env, cfg: Any) -> jax.Array:
    """B: the discounted cost of an episode that spends `cost_limit` evenly."""
    weights = cfg.saute_discount ** jnp.arange(env.episode_length)
    return jnp.maximum(cfg.cost_limit, MIN_BUDGET) * jnp.mean(weights)


def safe_reward(traj: Trajectory, cfg: Any) -> jax.Array:
    return jnp.where(vector_of(traj.next_obs)[..., -1] > 0, traj.reward, cfg.unsafe_reward)


def last_budget(traj: Trajectory, cfg: Any) -> PyTree:
    vector = vector_of(traj.next_obs)
    ended = (traj.truncated & cfg.full_at_end)[..., None]
    return with_vector(traj.next_obs, jnp.where(ended, vector.at[..., -1].set(1.0), vector))


# Sootla et al. (2022), "Saute RL: Almost Surely Safe Reinforcement Learning Using State
# Augmentation", arXiv:2202.06558, section 3; the scale of the budget is from their code
saute = no_augmentation._replace(
    wrap=lambda env, cfg, dual: Budget(env, 1.0, full_budget(env, cfg), cfg.saute_discount),
    reward=safe_reward,
    last_obs=last_budget,
)


# OmniSafe @15603dd, what PPOSaute.yaml and the three like it add to those of PPO and TRPO.
OMNISAFE_SAUTE: dict[str, Any] = {"saute_discount": 0.999, "unsafe_reward": -1.0}
# The same, PPOSimmerPID.yaml and TRPOSimmerPID.yaml: a budget that starts at its bound, and
# steps of at most 1 of 25. With `simmer_adds` far larger gains drive the budget to 0 for good.
OMNISAFE_SIMMER: dict[str, Any] = {
    "budget_init": 1.0,
    "budget_reach": 0.04,
    "simmer_kp": 5e-4,
    "simmer_ki": 1e-5,
    "simmer_kaw": 0.0,
    "simmer_smoothing": 0.995,
    "simmer_window": 10,
}


@config
class SimmerConfig(SauteConfig):
    """For `simmer` with `schedule`."""

    CONVENTIONS: ClassVar = (
        Convention(
            {"simmer_adds": True, "simmer_full": True, **OMNISAFE_SIMMER},
            "the controller's u is added to the last budget, with small gains; z is the share of that "
            "budget which is left, and all but the first of 20 episodes start with z = 1",
            "u is added to the scheduled budget, with larger gains; z is a share of the whole budget",
        ),
    )

    # The budget d at the start, as a share of cost_limit. The authors' pendulum has 0.57.
    budget_init: Share = 0.5
    # Iterations until d is cost_limit. The authors' d arrives in the last sixth of training.
    budget_ramp: Annotated[float, Bounds(1, 1e9)] = 200.0
    # The most that u changes the budget, as a share of cost_limit. The authors' pendulum has 0.14.
    budget_reach: Share = 0.15
    simmer_kp: Weight = 0.1  # K_p, the gain of the smoothed error.
    simmer_ki: Weight = 0.01  # K_i, the gain of the sum of errors. The authors have 0.005 to 0.04.
    # K_aw, the gain of what clipping took from the last u. The authors have 0 to 0.04.
    simmer_kaw: Weight = 0.01
    simmer_smoothing: Share = 0.9  # Share of the past in the error. The authors have 0 to 0.999.
    simmer_window: Iterations = 100  # Errors in the sum, as in the authors' code.
    simmer_adds: bool = False  # Whether u is added to the last B, not to d. OmniSafe's is.
    # Whether z is the share of B that is left, and starts at 1. OmniSafe's does.
    simmer_full: bool = False


class Schedule(NamedTuple):
    """What the controller of the budget remembers; costs are per episode."""

    budget: jax.Array  # float [], B, what a new episode may cost
    errors: jax.Array  # float [simmer_window], smoothed d - J_c, oldest first
    clipped: jax.Array  # float [], what clipping added to the last u


def reference(iteration: Count, cfg: Any) -> jax.Array:
    """d, the budget that is aimed at: a line from budget_init cost_limit to cost_limit."""
    done = jnp.clip(iteration / jnp.maximum(cfg.budget_ramp, 1.0), 0.0, 1.0)
    return cfg.cost_limit * (cfg.budget_init + (1 - cfg.budget_init) * done)


def init_schedule(cfg: Any) -> Schedule:
    budget = jnp.maximum(reference(0, cfg), MIN_BUDGET)
    return Schedule(budget, jnp.zeros(cfg.simmer_window), jnp.zeros(()))


def control_budget(dual: Schedule, episode_cost: jax.Array, cfg: Any, iteration: Count) -> Schedule:
    """B = d + u, u = K_p e + K_i sum e + K_aw (u' - u'_raw), from the error e = d - J_c, smoothed."""
    d = dual.budget if cfg.simmer_adds else reference(iteration + 1, cfg)
    past = cfg.simmer_smoothing
    error = past * dual.errors[-1] + (1 - past) * (d - episode_cost)
    errors = jnp.append(dual.errors[1:], error)
    raw = cfg.simmer_kp * error + cfg.simmer_ki * errors.sum() + cfg.simmer_kaw * dual.clipped
    reach = cfg.budget_reach * cfg.cost_limit
    budget = jnp.clip(
        d + jnp.clip(raw, -reach, reach), MIN_BUDGET, jnp.maximum(cfg.cost_limit, MIN_BUDGET)
    )
    return Schedule(budget, errors, budget - d - raw)


# Sootla et al. (2022), "Effects of Safety State Augmentation on Safe Exploration",
# arXiv:2206.02675, "PI Simmer"; window, filter and clips are from their code
schedule = Treatment(
    init=init_schedule,
    update=control_budget,
    advantage=lambda dual, adv_r, adv_c: adv_r,
    metrics=lambda dual: {"train/budget": dual.budget},
)


def start(cfg: Any, dual: Schedule) -> jax.Array:
    """z_0, the scheduled share of the whole budget."""
    share = dual.budget / jnp.maximum(cfg.cost_limit, MIN_BUDGET)
    return jnp.ones_like(share) if cfg.simmer_full else share


def scheduled(env: Env, cfg: Any, dual: Schedule) -> Budget:
    whole = full_budget(env, cfg)
    if cfg.simmer_full:
        whole = whole * dual.budget / jnp.maximum(cfg.cost_limit, MIN_BUDGET)
    return Budget(env, start(cfg, dual), whole, cfg.saute_discount)


def with_budget(resets: State, cfg: Any, dual: Schedule) -> State:
    vector = vector_of(resets.obs).at[:, -1].set(start(cfg, dual))
    return dataclasses.replace(resets, obs=with_vector(resets.obs, vector))


simmer = saute._replace(
    wrap=scheduled,
    renew=with_budget,
)


@config
class EarlyConfig:
    """For `early`."""

    CONVENTIONS: ClassVar = (
        Convention(
            {"keep_cost": True},
            "the count of cost that ends an episode is not set back by a time limit",
            "each episode counts its own cost",
        ),
    )

    termination_reward: Real = 0.0  # r_e, the reward of the step that breaks the limit.
    # Whether the count of cost goes on into the next episode after a time limit. OmniSafe's does.
    keep_cost: bool = False


def broken(episode: Episode, cfg: Any) -> jax.Array:
    """Whether the step breaks the limit, bool [..., N]."""
    return (episode.kept_cost if cfg.keep_cost else episode.cost) > cfg.cost_limit


# Sun et al. (2021), "Safe Exploration by Solving Early Terminated MDP", arXiv:2107.04200
early = no_augmentation._replace(
    stop=broken,
    reward=lambda traj, cfg: jnp.where(broken(traj.episode, cfg), cfg.termination_reward, traj.reward),
)
