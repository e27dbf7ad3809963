"""TRPO-PID: TRPO whose price on cost is the output of a PID controller.

    maximise_theta  E[w A]   subject to   KL(old || new) <= delta,   A = (A_r - lam A_c) / (1 + lam)
    lam <- (K_p P + I + K_d D)+, as in CPPO-PID

Source: Stooke, Achiam and Abbeel (2020), "Responsive Safety in Reinforcement Learning by PID
Lagrangian Methods", arXiv:2007.03964, whose policy steps are PPO's.
"""

from typing import Any

from jaxsafe.algos import trpo
from jaxsafe.config import config
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.surrogates import plain
from jaxsafe.learn.treatments import PIDConfig, pid
from jaxsafe.learn.trust_region import trust_region
from jaxsafe.types import Algorithm, Env


@config
class TRPOPIDConfig(PIDConfig, trpo.TRPOConfig):
    pass


# TRPOPID.yaml differs from TRPO.yaml by the controller alone.
PUBLISHED: dict[str, dict[str, Any]] = trpo.PUBLISHED


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, pid, plain, trust_region, axis_name)
