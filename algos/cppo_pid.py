"""CPPO-PID: PPO whose price on cost is the output of a PID controller.

    maximise_theta  E[min(w A, clip(w, 1 - eps, 1 + eps) A)],  A = (A_r - lam A_c) / (1 + lam)
    lam <- (K_p P + I + K_d D)+,   I <- (I + K_i (J_c - cost_limit))+

P: J_c - cost_limit, smoothed; D: what the smoothed J_c rose over `pid_delay` iterations, or 0.

Source: Stooke, Achiam and Abbeel (2020), "Responsive Safety in Reinforcement Learning by PID
Lagrangian Methods", arXiv:2007.03964, algorithm 2.
"""

from typing import Any

from jaxsafe.algos import ppo
from jaxsafe.config import config
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.steps import adam_epochs
from jaxsafe.learn.surrogates import clipped
from jaxsafe.learn.treatments import PIDConfig, pid
from jaxsafe.types import Algorithm, Env


@config
class CPPOPIDConfig(PIDConfig, ppo.PPOConfig):
    pass


# CPPOPID.yaml differs from PPO.yaml by the controller alone.
PUBLISHED: dict[str, dict[str, Any]] = ppo.PUBLISHED


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, pid, clipped, adam_epochs, axis_name)
