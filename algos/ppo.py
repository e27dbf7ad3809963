"""PPO: proximal policy optimisation, blind to cost.

    maximise_theta  E[min(w A, clip(w, 1 - eps, 1 + eps) A)],  w = pi(a | s) / pi_old(a | s)

Source: Schulman et al. (2017), "Proximal Policy Optimization Algorithms", arXiv:1707.06347.
Differs from it: passes stop once KL(old || new) > target_kl, as in safety-starter-agents and
OmniSafe; the value function is a network of its own, unless `trunk` is shared. A cost critic is trained
for its metrics alone.
"""

from typing import Any

from jaxsafe.algos import pg
from jaxsafe.config import config
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.steps import adam_epochs
from jaxsafe.learn.surrogates import clipped
from jaxsafe.learn.treatments import none
from jaxsafe.types import Algorithm, Env


@config
class PPOConfig(pg.PGConfig):
    clip: float = 0.2  # eps; the paper


# PPO.yaml differs from PolicyGradient.yaml by its passes.
PUBLISHED: dict[str, dict[str, Any]] = {
    name: options | {"epochs": 40, "critic_epochs": 40} for name, options in pg.PUBLISHED.items()
}


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, none, clipped, adam_epochs, axis_name)
