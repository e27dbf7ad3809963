"""PPO-Lagrangian: PPO whose advantage pays for cost at an adaptive price.

    maximise_theta  E[min(w A, clip(w, 1 - eps, 1 + eps) A)],  A = (A_r - lam A_c) / (1 + lam)
    minimise_lam    -lam (J_c - cost_limit),  lam >= 0, by Adam, once an iteration, before the policy

Source: Ray, Achiam and Amodei (2019), "Benchmarking Safe Exploration in Deep Reinforcement
Learning"; the 1 / (1 + lam) scale is from the authors' code.
In the authors' code only the reward term is clipped, and Adam moves a softplus of lam; here, as in
OmniSafe, both terms are clipped, and Adam moves lam. J_c is of this batch (`returns.mean_length`),
where OmniSafe has the last 100 episodes.
"""

from typing import Any

from jaxsafe.algos import ppo
from jaxsafe.config import config
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.steps import adam_epochs
from jaxsafe.learn.surrogates import clipped
from jaxsafe.learn.treatments import LagrangianConfig, lagrangian
from jaxsafe.types import Algorithm, Env


@config
class PPOLagConfig(LagrangianConfig, ppo.PPOConfig):
    pass


# PPOLag.yaml differs from PPO.yaml by the multiplier alone.
PUBLISHED: dict[str, dict[str, Any]] = {
    name: options | {"dual_lr": 0.035} for name, options in ppo.PUBLISHED.items()
}


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, lagrangian, clipped, adam_epochs, axis_name)
