"""P3O: PPO with a penalty that is felt beyond the limit alone."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from jaxsafe.algos import pg, ppo
from jaxsafe.config import Weight, config
from jaxsafe.learn.batch import pmean
from jaxsafe.learn.conventions import Convention
from jaxsafe.learn.on_policy import on_policy_pair, presets
from jaxsafe.learn.row import Row
from jaxsafe.learn.steps import Context, Objective, Pair, PolicyStep, adam_epochs
from jaxsafe.learn.surrogates import clipped, pessimistic, plain
from jaxsafe.nn.gaussian import Gaussian
from jaxsafe.types import Algorithm, Env, Metrics, PyTree


@config
class P3OConfig(ppo.PPOConfig):
    """P3O: PPO with an exact penalty on what the clipped cost surrogate exceeds the limit by.

        maximise_theta  E[min(w A_r, clip(w) A_r)] - kappa max(0, E[max(w A_c, clip(w) A_c)] + c)

    c: (J_c - cost_limit) / mean episode length, the violation in cost per step.

    Source: Zhang et al. (2022), "Penalized Proximal Policy Optimization for Safe Reinforcement
    Learning", arXiv:2205.11814, equation 13.
    Differs from it: the paper's c is the discounted violation, times (1 - gamma). Both are violations
    per step, but weigh the steps differently. OmniSafe takes c per episode (`per_step=False`) and does
    not clip the cost's surrogate (`clip_cost=False`).
    """

    CONVENTIONS: ClassVar = (
        Convention(
            {"per_step": False, "clip_cost": False},
            "the penalty is kappa max(0, E[w A_c] + J_c - cost_limit), per episode",
            "it is the paper's, clipped and per step",
        ),
    )

    # Price of a unit of cost beyond the limit, in standard deviations of A_r, as in OmniSafe.
    kappa: Weight = 20.0
    # Whether the violation c is in cost per step. OmniSafe's is per episode.
    per_step: bool = True
    # Whether the cost's surrogate is max(w A_c, clip(w) A_c). OmniSafe's is w A_c.
    clip_cost: bool = True
    # Whether the mean of A_c over each minibatch is subtracted. Neither the paper nor OmniSafe does it.
    # That mean is noise, whose positive part the penalty keeps as a margin. Without it costs end over
    # the limit.
    centre_cost: bool = False


def penalised(objectives: Pair, context: Context) -> Objective:
    """The reward's objective less the penalty on the cost's."""
    cfg = context.cfg
    violation = context.violation / (context.episode_length if cfg.per_step else 1.0)

    def objective(actor: PyTree, batch: Any) -> tuple[jax.Array, Metrics]:
        reward, metrics = objectives.reward(actor, batch)
        cost, _ = objectives.cost(actor, batch)
        # A_c is centred over the whole batch. Its mean over a minibatch is noise, which max(0, x) turns
        # into a penalty.
        cost -= jnp.mean(batch.adv_c) if cfg.centre_cost else 0.0
        # max(0, x) of the mean over all devices, as a factor: its gradient is this device's share
        beyond = jax.lax.stop_gradient(pmean(cost, context.axis_name) + violation)
        penalty = cfg.kappa * jnp.where(beyond > 0, cost + violation, 0.0)
        return reward - penalty, metrics | {"train/penalty": penalty}

    return objective


def update(
    actor: PyTree,
    opt_state: PyTree,
    objectives: Pair,
    batch: Any,
    context: Context,
) -> tuple[PyTree, PyTree, Metrics]:
    return adam_epochs.update(actor, opt_state, penalised(objectives, context), batch, context)


def surrogate_c(
    dist: Gaussian, batch: Any, advantage: jax.Array, cfg: Any
) -> tuple[jax.Array, Metrics]:
    return (pessimistic if cfg.clip_cost else plain)(dist, batch, advantage, cfg)


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    step = PolicyStep(adam_epochs.init, update)
    return on_policy_pair(env, clipped, step, axis_name, surrogate_c=surrogate_c)


ROWS = {
    "p3o": Row(
        P3OConfig,
        make,
        "PPO with an exact penalty beyond the limit",
        presets(ppo.PUBLISHED | {"epochs": 10, "critic_epochs": 10}),
        omnisafe="P3O",
        lever=pg.LEVER | {"kappa": 5.0},
    ),
}
