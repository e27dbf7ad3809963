"""IPO: PPO whose price on cost is the slope of a logarithmic barrier.

    maximise_theta  E[min(w A, clip(w, 1 - eps, 1 + eps) A)],  A = (A_r - p A_c) / (1 + p)
    p = barrier / (cost_limit - J_c) within the limit, at most price_max; price_max beyond it

Source: Liu, Ding and Liu (2020), "IPO: Interior-point Policy Optimization under Constraints",
arXiv:1910.09615.
Differs from it, as OmniSafe does: the barrier enters by its gradient at the present policy. OmniSafe
also normalises rewards and costs, as the published settings do here.
"""

from typing import Any

from jaxsafe.algos import ppo
from jaxsafe.config import config
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.steps import adam_epochs
from jaxsafe.learn.surrogates import clipped
from jaxsafe.learn.treatments import barrier
from jaxsafe.types import Algorithm, Env


@config
class IPOConfig(ppo.PPOConfig):
    barrier: float = 0.01  # 1 / t of the paper; OmniSafe
    price_max: float = 1.0  # standard deviations of A_r per unit of cost; OmniSafe


PUBLISHED: dict[str, dict[str, Any]] = {
    name: options
    | {"epochs": 10, "critic_epochs": 10}
    | {"reward_normalize": True, "cost_normalize": True}
    for name, options in ppo.PUBLISHED.items()
}


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, barrier, clipped, adam_epochs, axis_name)
