"""PDO: primal-dual policy gradient, whose advantage pays for cost at an adaptive price.

    maximise_theta  E[w A],  A = (A_r - lam A_c) / (1 + lam)
    minimise_lam    -lam (J_c - cost_limit),  lam >= 0, by Adam, once an iteration, before the policy

Source: Chow et al. (2018), "Risk-Constrained Reinforcement Learning with Percentile Risk Criteria",
arXiv:1512.01629.
Differs from it, as OmniSafe does: the constraint is on the expected cost, where the paper's is on its
CVaR or on a chance. OmniSafe also normalises rewards and costs, as the published settings do here.
"""

from typing import Any

from jaxsafe.algos import pg
from jaxsafe.config import config
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.steps import adam_epochs
from jaxsafe.learn.surrogates import plain
from jaxsafe.learn.treatments import LagrangianConfig, lagrangian
from jaxsafe.types import Algorithm, Env


@config
class PDOConfig(LagrangianConfig, pg.PGConfig):
    pass


PUBLISHED: dict[str, dict[str, Any]] = {
    name: options
    | {"epochs": 40, "critic_epochs": 40, "dual_lr": 0.035}
    | {"reward_normalize": True, "cost_normalize": True}
    for name, options in pg.PUBLISHED.items()
}


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, lagrangian, plain, adam_epochs, axis_name)
