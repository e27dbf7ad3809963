"""TRPO in the early-terminated task: an episode that breaks the cost limit ends there, for good.

    maximise_theta  E[w A]   subject to   KL(old || new) <= delta
    terminated_t  where  sum_{s<=t} c_s > cost_limit;  there r_t is r_e, and the value from then on 0

Source: Sun et al. (2021), "Safe Exploration by Solving Early Terminated MDP", arXiv:2107.04200.
Differs from it as early-terminated PPO does; evaluation runs whole episodes there too.
"""

from typing import Any

from jaxsafe.algos import trpo
from jaxsafe.config import config
from jaxsafe.learn.augment import EarlyConfig, early
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.surrogates import plain
from jaxsafe.learn.treatments import none
from jaxsafe.learn.trust_region import trust_region
from jaxsafe.types import Algorithm, Env


@config
class TRPOEarlyTerminatedConfig(EarlyConfig, trpo.TRPOConfig):
    pass


# TRPOEarlyTerminated.yaml differs from TRPO.yaml by the cost limit alone, which is the default here.
PUBLISHED: dict[str, dict[str, Any]] = trpo.PUBLISHED


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, none, plain, trust_region, axis_name, early)
