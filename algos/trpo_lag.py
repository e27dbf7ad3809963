"""TRPO-Lagrangian: TRPO whose advantage pays for cost at an adaptive price.

    maximise_theta  E[w A]   subject to   KL(old || new) <= delta,   A = (A_r - lam A_c) / (1 + lam)
    minimise_lam    -lam (J_c - cost_limit),  lam >= 0, by Adam, once an iteration, before the policy

Source: Ray, Achiam and Amodei (2019), "Benchmarking Safe Exploration in Deep Reinforcement
Learning".
Differs from it as PPO-Lagrangian does.
"""

from typing import Any

from jaxsafe.algos import trpo
from jaxsafe.config import config
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.surrogates import plain
from jaxsafe.learn.treatments import LagrangianConfig, lagrangian
from jaxsafe.learn.trust_region import trust_region
from jaxsafe.types import Algorithm, Env


@config
class TRPOLagConfig(LagrangianConfig, trpo.TRPOConfig):
    pass


# TRPOLag.yaml differs from TRPO.yaml by the multiplier alone.
PUBLISHED: dict[str, dict[str, Any]] = {
    name: options | {"dual_lr": 0.035} for name, options in trpo.PUBLISHED.items()
}


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, lagrangian, plain, trust_region, axis_name)
