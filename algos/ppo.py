"""PPO: proximal policy optimisation, blind to cost.

    maximise_theta  E[min(w A, clip(w, 1 - eps, 1 + eps) A)],  w = pi(a | s) / pi_old(a | s)

Source: Schulman et al. (2017), "Proximal Policy Optimization Algorithms", arXiv:1707.06347.
Differs from it: passes stop once KL(old || new) > target_kl, as in safety-starter-agents and
OmniSafe; the value function is a network of its own. A cost critic is trained for its metrics alone.
"""

from typing import Any

from jaxsafe.config import config
from jaxsafe.on_policy import Algorithm, OnPolicyConfig, on_policy
from jaxsafe.steps import adam_epochs
from jaxsafe.surrogates import clipped
from jaxsafe.treatments import none
from jaxsafe.types import Env


@config
class PPOConfig(OnPolicyConfig):
    lr: float = 3e-4  # of the policy; OmniSafe, safety-starter-agents
    lr_decay: bool = False  # of lr, linearly to 0 at total_iterations; OmniSafe: True
    clip: float = 0.2  # eps; the paper
    epochs: int = 10  # passes over each batch; with 8 minibatches the 80 steps of safety-starter-agents
    target_kl: float = 0.02  # nats, checked after each pass; OmniSafe


# OmniSafe @15603dd, configs/on-policy/PPO.yaml. Its minibatches of 64 do not divide 20 * 1000 steps:
# these are of 80. Its 20 episodes run one after the other, these side by side.
PUBLISHED: dict[str, dict[str, Any]] = {
    "omnisafe": {
        "num_envs": 20,
        "horizon": 1000,
        "stagger": False,
        "init": "torch",
        "init_log_std": 0.0,
        "epochs": 40,
        "critic_epochs": 40,
        "minibatches": 250,
        "critic_lr": 3e-4,
        "lr_decay": True,
    }
}


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, none, clipped, adam_epochs, axis_name)
