"""FOCOPS: first-order constrained optimisation in policy space.

    maximise_theta  E[1{KL <= eta} (w A / temperature - KL)],  A = (A_r - lam A_c) / (1 + lam)
    minimise_lam    -lam (J_c - cost_limit),  0 <= lam <= lam_max, once an iteration, before the policy

KL: KL(new || old) of each state; w = pi(a | s) / pi_old(a | s).

Source: Zhang, Vuong and Ross (2020), "First Order Constrained Optimization in Policy Space",
arXiv:2002.06506, equation 11 and algorithm 1.
Differs from it: Adam on lam, and the scale 1 / (1 + lam), as in OmniSafe; the indicator is per state
as in the paper (OmniSafe's multiplies the mean of the minibatch, `per_state=False`).
"""

from typing import Any

from jaxsafe.algos import pg
from jaxsafe.config import config
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.steps import adam_epochs
from jaxsafe.learn.surrogates import near_old
from jaxsafe.learn.treatments import LagrangianConfig, lagrangian
from jaxsafe.types import Algorithm, Env


@config
class FOCOPSConfig(LagrangianConfig, pg.PGConfig):
    temperature: float = 1.5  # lambda of the paper; OmniSafe
    near_kl: float = 0.02  # eta, nats; OmniSafe
    per_state: bool = True  # each state's KL gates its own gain; OmniSafe: the mean gain, by the share
    lam_max: float = 2.0  # nu_max of the paper; OmniSafe


PUBLISHED: dict[str, dict[str, Any]] = {
    name: options | {"epochs": 40, "critic_epochs": 40, "dual_lr": 0.035}
    for name, options in pg.PUBLISHED.items()
}


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, lagrangian, near_old, adam_epochs, axis_name)
