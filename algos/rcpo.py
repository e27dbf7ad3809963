"""RCPO: reward-constrained policy optimisation, a natural gradient that pays for cost.

    theta <- theta + sqrt(2 delta / g'H^-1 g) H^-1 g,  g = gradient of E[w (A_r - lam A_c)] / (1 + lam)
    minimise_lam    -lam (J_c - cost_limit),  lam >= 0, by Adam, once an iteration, before the policy

Source: Tessler, Mankowitz and Mannor (2019), "Reward Constrained Policy Optimization",
arXiv:1805.11074.
Differs from it, as OmniSafe does: advantages are mixed, where the paper takes lam c from the reward
and trains one critic for both; natural gradients, where it has plain ones.
"""

from typing import Any

from jaxsafe.algos import npg
from jaxsafe.config import config
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.surrogates import plain
from jaxsafe.learn.treatments import LagrangianConfig, lagrangian
from jaxsafe.learn.trust_region import natural_gradient
from jaxsafe.types import Algorithm, Env


@config
class RCPOConfig(LagrangianConfig, npg.NPGConfig):
    pass


# RCPO.yaml differs from NaturalPG.yaml by the multiplier alone.
PUBLISHED: dict[str, dict[str, Any]] = {
    name: options | {"dual_lr": 0.035} for name, options in npg.PUBLISHED.items()
}


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, lagrangian, plain, natural_gradient, axis_name)
