"""CUP: a PPO step and a projection, one after the other."""

import dataclasses
from typing import Annotated, Any, ClassVar

import jax
import jax.numpy as jnp

from jaxsafe.algos import pg, ppo
from jaxsafe.config import Bounds, Cap, KLStop, config
from jaxsafe.learn.constraints import constrained_costs, each
from jaxsafe.learn.on_policy import Batch, Improved, Method, TrainState, on_policy_loop, presets
from jaxsafe.learn.row import Row
from jaxsafe.learn.steps import Context, adam_epochs, mean_kl
from jaxsafe.learn.surrogates import clipped, plain, with_entropy
from jaxsafe.learn.treatments import LagrangianConfig, lagrangian
from jaxsafe.nn.gaussian import kl
from jaxsafe.nn.networks import action_dist
from jaxsafe.types import Algorithm, Env, Metrics, PyTree


@config
class CUPConfig(LagrangianConfig, ppo.PPOConfig):
    """CUP: a PPO step on the reward, then a projection towards lower cost.

        1. theta_1: maximise  E[min(w A_r, clip(w) A_r)]
        2. theta:   minimise  E[lam (1 - gamma gae_lambda) / (1 - gamma) w A_c + KL(pi || pi_1)]
        minimise_lam  -lam (J_c - cost_limit),  0 <= lam <= lam_max,  by Adam

    An iteration first moves the price lam. Then step 1 improves reward and gives the policy pi_1, and
    step 2 takes back cost without going far from pi_1. w = pi(a | s) / pi_old(a | s) is with the policy
    that collected the batch in both steps. gamma and gae_lambda are `cost_discount` and
    `cost_gae_lambda`.

    Source: Yang et al. (2022), "Constrained Update Projection Approach to Safe Policy Optimization",
    arXiv:2209.07089, algorithm 1 and equation 22.
    Differs from it, as OmniSafe does: Adam moves lam, A_c is centred, and each step stops at target_kl.
    On a shared trunk both steps train the values, too.

    The cost may end below the limit, with lam = 0, and so may that of every method with a price. This
    was measured on a task of two observations whose best policy mixes two actions at one of them. The
    best policy that does not mix costs 0.80 of the limit. CUP ended there with 5 of 8 seeds,
    PPO-Lagrangian with 6, and both with all 8 at a tenfold `lr`. A price that is too high for a while
    removes the second action. Then the price falls to 0, but the policy no longer tries that action.
    CPO ended within 1% of the limit with all 8 seeds.
    """

    POLICY_STEPS: ClassVar = 2

    # Passes of each of the two steps stop when the KL is above this (nats), as in OmniSafe.
    target_kl: KLStop = 0.01
    # Discount of costs. The projection divides by 1 - cost_discount.
    cost_discount: Annotated[float, Bounds(0, 0.9999)] = 0.99
    lam_max: Cap = 2.0  # The highest price, as in OmniSafe.


def projection(
    actor: PyTree, batch: Batch, lam: jax.Array | float, cfg: Any
) -> tuple[jax.Array, Metrics]:
    """What the second step maximises, with `batch.old` the policy of the first."""
    dist = action_dist(actor, batch.obs, cfg)
    scale = (1 - cfg.cost_discount * cfg.cost_gae_lambda) / (1 - cfg.cost_discount)
    cost, _ = each(lambda adv_c: plain(dist, batch, adv_c, cfg), constrained_costs(cfg))(batch.adv_c)
    return -(jnp.sum(lam * scale * cost) + jnp.mean(kl(dist, batch.old))), {}


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    def improve(ts: TrainState, batch: Batch, context: Context) -> Improved:
        cfg = context.cfg
        dual = lagrangian.update(ts.dual, context.episode_cost, cfg, context.iteration)
        contexts = [context._replace(key=key) for key in jax.random.split(context.key)]

        def earn(actor: PyTree, batch: Batch) -> tuple[jax.Array, Metrics]:
            earned = with_entropy(clipped, context.iteration)
            return earned(action_dist(actor, batch.obs, cfg), batch, batch.adv_r, cfg)

        actor, opt_state, metrics = adam_epochs.update(
            ts.params["actor"], ts.opt_state["actor"], earn, batch, contexts[0]
        )
        better = dataclasses.replace(batch, old=action_dist(actor, batch.obs, cfg))

        def project(actor: PyTree, batch: Batch) -> tuple[jax.Array, Metrics]:
            return projection(actor, batch, dual.lam, cfg)

        actor, opt_state, second = adam_epochs.update(actor, opt_state, project, better, contexts[1])
        metrics |= {f"{name}_projection": x for name, x in second.items()}
        metrics["train/nonfinite"] += metrics.pop("train/nonfinite_projection")
        # that of step 1 says whether it stopped, that of both is the policy's
        metrics["train/kl_reward"] = metrics["train/kl"]
        final = action_dist(actor, batch.obs, cfg)
        metrics["train/kl"] = mean_kl(batch.old, final, context.axis_name)
        return Improved(actor, opt_state, dual, metrics | lagrangian.metrics(dual))

    method = Method(adam_epochs.check, adam_epochs.init, lagrangian.init, improve, constrained_costs)
    return on_policy_loop(env, method, axis_name)


ROWS = {
    "cup": Row(
        CUPConfig,
        make,
        "PPO step, then a projection towards lower cost",
        presets(ppo.PUBLISHED | {"dual_lr": 0.035}),
        omnisafe="CUP",
        lever=pg.LEVER,
    ),
}
