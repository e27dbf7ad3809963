"""P3O: PPO with an exact penalty on what the clipped cost surrogate exceeds the limit by.

    maximise_theta  E[min(w A_r, clip(w) A_r)] - kappa max(0, E[max(w A_c, clip(w) A_c)] + c)

c: (J_c - cost_limit) / mean episode length, the violation in cost per step.

Source: Zhang et al. (2022), "Penalized Proximal Policy Optimization for Safe Reinforcement Learning",
arXiv:2205.11814, equation 13.
Differs from it: c, which there is (1 - gamma) times the discounted violation, another mean per step.
OmniSafe takes c per episode (`per_step=False`) and does not clip the cost's surrogate
(`clip_cost=False`).
"""

from typing import Any

import jax
import jax.numpy as jnp

from jaxsafe.algos import ppo
from jaxsafe.config import config
from jaxsafe.learn.batch import pmean
from jaxsafe.learn.on_policy import on_policy_pair
from jaxsafe.learn.steps import Context, Pair, Step, adam_epochs
from jaxsafe.learn.surrogates import clipped, pessimistic, plain
from jaxsafe.nn.gaussian import Gaussian
from jaxsafe.types import Algorithm, Env, Metrics, PyTree


@config
class P3OConfig(ppo.PPOConfig):
    kappa: float = 20.0  # reward advantages, of standard deviation 1, per unit of cost; OmniSafe
    per_step: bool = True  # the violation c in cost per step; OmniSafe: per episode
    clip_cost: bool = True  # max(w A_c, clip(w) A_c); OmniSafe: w A_c


PUBLISHED: dict[str, dict[str, Any]] = {
    name: options | {"epochs": 10, "critic_epochs": 10} for name, options in ppo.PUBLISHED.items()
}


def update(
    actor: PyTree,
    opt_state: PyTree,
    objectives: Pair,
    batch: Any,
    context: Context,
) -> tuple[PyTree, PyTree, Metrics]:
    cfg = context.cfg
    violation = context.excess / context.length if cfg.per_step else context.excess

    def objective(actor: PyTree, batch: Any) -> tuple[jax.Array, Metrics]:
        reward, metrics = objectives.reward(actor, batch)
        cost, _ = objectives.cost(actor, batch)
        # max(0, x) of the mean over all devices, as a factor: its gradient is this device's share
        beyond = jax.lax.stop_gradient(pmean(cost, context.axis_name) + violation)
        penalty = cfg.kappa * jnp.where(beyond > 0, cost + violation, 0.0)
        return reward - penalty, metrics | {"train/penalty": penalty}

    return adam_epochs.update(actor, opt_state, objective, batch, context)


def surrogate_c(
    dist: Gaussian, batch: Any, advantage: jax.Array, cfg: Any
) -> tuple[jax.Array, Metrics]:
    return (pessimistic if cfg.clip_cost else plain)(dist, batch, advantage, cfg)


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    step = Step(adam_epochs.init, update)
    return on_policy_pair(env, clipped, step, axis_name, surrogate_c=surrogate_c)
