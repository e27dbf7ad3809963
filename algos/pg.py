"""Policy gradients by epochs of Adam, with and without a price on cost."""

from functools import partial
from typing import Any

from jaxsafe.config import config
from jaxsafe.learn.on_policy import OMNISAFE, OnPolicyConfig, on_policy, presets
from jaxsafe.learn.row import Row
from jaxsafe.learn.steps import AdamConfig, adam_epochs
from jaxsafe.learn.surrogates import plain
from jaxsafe.learn.treatments import LagrangianConfig, Treatment, lagrangian, no_treatment
from jaxsafe.types import Algorithm, Env


@config
class PGConfig(AdamConfig, OnPolicyConfig):
    """PG: the policy gradient, by several passes over each batch, blind to cost.

        maximise_theta  E[w A],  w = pi(a | s) / pi_old(a | s)

    Source: Sutton et al. (1999), "Policy Gradient Methods for Reinforcement Learning with Function
    Approximation", with generalised advantages.
    Differs from it, as OmniSafe does: the ratio w lets a batch serve several steps, until
    KL(old || new) > target_kl.
    """


@config
class PDOConfig(LagrangianConfig, PGConfig):
    """PDO: primal-dual policy gradient, whose advantage pays for cost at an adaptive price.

        maximise_theta  E[w A],  A = (A_r - lam A_c) / (1 + lam)
        minimise_lam    -lam (J_c - cost_limit),  lam >= 0,  by Adam

    An iteration first moves the price lam, and then the policy.

    Source: Chow et al. (2018), "Risk-Constrained Reinforcement Learning with Percentile Risk Criteria",
    arXiv:1512.01629.
    Differs from it, as OmniSafe does: the constraint is on the expected cost. The paper's is on the
    CVaR or on a probability. OmniSafe also normalises rewards and costs. Here `preset=published` does
    so.
    """


def make(env: Env, axis_name: str | None = None, treatment: Treatment = no_treatment) -> Algorithm:
    return on_policy(env, treatment, plain, adam_epochs, axis_name)


# OmniSafe @15603dd, configs/on-policy/PolicyGradient.yaml. Its minibatches of 64 do not divide
# 20 * 1000 steps: these are of 80.
PUBLISHED: dict[str, Any] = {
    **OMNISAFE,
    "epochs": 10,
    "critic_epochs": 10,
    "minibatches": 250,
    "critic_lr": 3e-4,
    "lr_decay": True,
}
LEVER: dict[str, Any] = {"lr": 1e-2, "target_kl": 0.1, "epochs": 8}  # for a problem of two levers
OFTEN: dict[str, Any] = {"epochs": 40, "critic_epochs": 40}  # passes of most of OmniSafe's algorithms
SCALED: dict[str, Any] = {
    "reward_normalize": True, "cost_normalize": True, "reward_centre": True, "cost_centre": True
}  # fmt: skip

ROWS = {
    "pg": Row(
        PGConfig,
        make,
        "policy gradient, no constraint",
        presets(PUBLISHED),
        omnisafe="PolicyGradient",
        holds="nothing",
        lever=LEVER,
    ),
    "pdo": Row(
        PDOConfig,
        partial(make, treatment=lagrangian),
        "policy gradient with an adaptive price on cost",
        presets(PUBLISHED | OFTEN | SCALED | {"dual_lr": 0.035}),
        omnisafe="PDO",
        lever=LEVER | {"lr": 3e-3, "target_kl": 0.03},
    ),
}
