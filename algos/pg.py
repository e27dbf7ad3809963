"""PG: the policy gradient, by several passes over each batch, blind to cost.

    maximise_theta  E[w A],  w = pi(a | s) / pi_old(a | s)

Source: Sutton et al. (1999), "Policy Gradient Methods for Reinforcement Learning with Function
Approximation", with generalised advantages.
Differs from it, as OmniSafe does: the ratio w lets a batch serve several steps, until
KL(old || new) > target_kl.
"""

from typing import Any

from jaxsafe.config import config
from jaxsafe.learn.on_policy import OMNISAFE, OnPolicyConfig, on_policy
from jaxsafe.learn.steps import adam_epochs
from jaxsafe.learn.surrogates import plain
from jaxsafe.learn.treatments import none
from jaxsafe.types import Algorithm, Env


@config
class PGConfig(OnPolicyConfig):
    lr: float = 3e-4  # of the policy; OmniSafe, safety-starter-agents
    lr_decay: bool = False  # of lr, linearly to 0 at total_iterations; OmniSafe: True
    epochs: int = 10  # passes over each batch; with 8 minibatches the 80 steps of safety-starter-agents
    target_kl: float = 0.02  # nats, checked after each pass; OmniSafe
    critics_stop: bool = False  # the critics have no more passes than the policy had; OmniSafe


# OmniSafe @15603dd, configs/on-policy/PolicyGradient.yaml. Its minibatches of 64 do not divide
# 20 * 1000 steps: these are of 80.
PUBLISHED: dict[str, dict[str, Any]] = {
    "omnisafe": {
        **OMNISAFE,
        "epochs": 10,
        "critic_epochs": 10,
        "minibatches": 250,
        "critic_lr": 3e-4,
        "lr_decay": True,
    }
}


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, none, plain, adam_epochs, axis_name)
