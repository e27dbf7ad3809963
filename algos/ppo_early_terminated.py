"""PPO in the early-terminated task: an episode that breaks the cost limit ends there, for good.

    maximise_theta  E[min(w A, clip(w, 1 - eps, 1 + eps) A)]
    terminated_t  where  sum_{s<=t} c_s > cost_limit;  there r_t is r_e, and the value from then on 0

What the policy loses is the reward that was to come, so the limit is to hold in every episode. That
is training: evaluation runs whole episodes, whose cost says what the limit was worth.

Source: Sun et al. (2021), "Safe Exploration by Solving Early Terminated MDP", arXiv:2107.04200.
Differs from it: PPO on the observation alone, as in OmniSafe; the paper's policies are off-policy
ones that remember the episode. The count of cost is the episode's own, in each environment (OmniSafe's
goes on after an episode that time ends, `keep_cost`).
A cost critic is trained for its metrics alone.
"""

from typing import Any

from jaxsafe.algos import ppo
from jaxsafe.config import config
from jaxsafe.learn.augment import EarlyConfig, early
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.steps import adam_epochs
from jaxsafe.learn.surrogates import clipped
from jaxsafe.learn.treatments import none
from jaxsafe.types import Algorithm, Env


@config
class PPOEarlyTerminatedConfig(EarlyConfig, ppo.PPOConfig):
    pass


# PPOEarlyTerminated.yaml differs from PPO.yaml by the cost limit alone, which is the default here.
PUBLISHED: dict[str, dict[str, Any]] = ppo.PUBLISHED


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, none, clipped, adam_epochs, axis_name, early)
