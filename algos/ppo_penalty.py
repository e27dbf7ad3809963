"""PPO-Penalty: PPO whose advantage pays for cost at a fixed price.

    maximise_theta  E[min(w A, clip(w, 1 - eps, 1 + eps) A)],  A = A_r - price A_c

The baseline that adaptive prices are compared with; the cost limit is only a mark.
"""

from typing import Any

from jaxsafe.algos import ppo
from jaxsafe.config import config
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.steps import adam_epochs
from jaxsafe.learn.surrogates import clipped
from jaxsafe.learn.treatments import penalty
from jaxsafe.types import Algorithm, Env


@config
class PPOPenaltyConfig(ppo.PPOConfig):
    price: float = 0.5  # standard deviations of A_r per unit of cost; ours, published by nobody


PUBLISHED: dict[str, dict[str, Any]] = ppo.PUBLISHED


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, penalty, clipped, adam_epochs, axis_name)
