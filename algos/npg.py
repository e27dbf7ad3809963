"""Natural policy gradients, with and without a price on cost."""

from functools import partial
from typing import Any

from jaxsafe.config import config
from jaxsafe.learn.on_policy import OMNISAFE, OnPolicyConfig, on_policy, presets
from jaxsafe.learn.row import Row
from jaxsafe.learn.surrogates import plain
from jaxsafe.learn.treatments import LagrangianConfig, Treatment, lagrangian, no_treatment
from jaxsafe.learn.trust_region import NaturalConfig, natural_gradient
from jaxsafe.types import Algorithm, Env


@config
class NPGConfig(NaturalConfig, OnPolicyConfig):
    """NPG: the natural policy gradient, blind to cost.

        theta <- theta + sqrt(2 delta / g'H^-1 g) H^-1 g

    g: gradient of E[w A]; H: the Fisher matrix.

    Source: Kakade (2001), "A Natural Policy Gradient".
    Differs from it: the step is as long as makes its KL delta, as in OmniSafe.
    """


@config
class RCPOConfig(LagrangianConfig, NPGConfig):
    """RCPO: reward-constrained policy optimisation, a natural gradient that pays for cost.

        theta <- theta + sqrt(2 delta / g'H^-1 g) H^-1 g
        g = gradient of E[w (A_r - lam A_c)] / (1 + lam)
        minimise_lam    -lam (J_c - cost_limit),  lam >= 0,  by Adam

    An iteration first moves the price lam, and then the policy. delta, g and H are as in NPG.

    Source: Tessler, Mankowitz and Mannor (2019), "Reward Constrained Policy Optimization",
    arXiv:1805.11074.
    Differs from it, as OmniSafe does: the advantages of reward and cost are mixed. The paper subtracts
    lam c from the reward and trains one critic for both. Gradients are natural, and plain in the paper.
    """


def make(env: Env, axis_name: str | None = None, treatment: Treatment = no_treatment) -> Algorithm:
    return on_policy(env, treatment, plain, natural_gradient, axis_name)


# OmniSafe @15603dd, configs/on-policy/TRPO.yaml and NaturalPG.yaml. Their minibatches of 128 do not
# divide 20 * 1000 steps: these are of 125. Their target_kl is 0.01 per action dimension, which the
# default is for Point and Car; for Doggo's 12 it is algo.target_kl=0.12, or compat=omnisafe.
PUBLISHED: dict[str, Any] = {**OMNISAFE, "critic_epochs": 10, "minibatches": 160, "critic_lr": 1e-3}

ROWS = {
    "npg": Row(
        NPGConfig,
        make,
        "natural policy gradient, no constraint",
        presets(PUBLISHED),
        omnisafe="NaturalPG",
        holds="nothing",
    ),
    "rcpo": Row(
        RCPOConfig,
        partial(make, treatment=lagrangian),
        "natural policy gradient with an adaptive price on cost",
        presets(PUBLISHED | {"dual_lr": 0.035}),
        omnisafe="RCPO",
    ),
}
