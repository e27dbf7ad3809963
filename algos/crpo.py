"""CRPO: TRPO on the reward while the cost is near its limit, on the cost while it is beyond.

    maximise_theta  E[w A]   subject to   KL(old || new) <= delta
    A = A_r if J_c <= cost_limit + tolerance, else -A_c

Source: Xu, Liang and Lan (2021), "CRPO: A New Approach for Safe Reinforcement Learning with
Convergence Guarantee", arXiv:2011.05869, algorithm 1; its steps are natural gradients, these TRPO's,
as in OmniSafe's OnCRPO.
"""

from typing import Any

from jaxsafe.algos import trpo
from jaxsafe.config import config
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.surrogates import plain
from jaxsafe.learn.treatments import switch
from jaxsafe.learn.trust_region import trust_region
from jaxsafe.types import Algorithm, Env


@config
class CRPOConfig(trpo.TRPOConfig):
    tolerance: float = 2.0  # cost per episode; OmniSafe


PUBLISHED: dict[str, dict[str, Any]] = trpo.PUBLISHED


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, switch, plain, trust_region, axis_name)
