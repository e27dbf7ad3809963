"""PPO-Saute: PPO that sees what is left of its budget on cost, and earns only while there is some.

    z_0 = 1,   z_{t+1} = (z_t - c_t / B) / gamma_n,   B = cost_limit mean_{t<T} gamma_n^t
    maximise_theta  E[min(w A, clip(w, 1 - eps, 1 + eps) A)],  A of  r_t if z_{t+1} > 0, else n

The policy takes z beside the observation; the limit is to hold in every episode, not on average.

Source: Sootla et al. (2022), "Saute RL: Almost Surely Safe Reinforcement Learning Using State
Augmentation", arXiv:2202.06558; B, which turns a sum into a discounted one, is from the authors' code.
Differs from it: a step that ends at z = 0 exactly is unsafe, as in the authors' code and OmniSafe.
z is not normalised, and the value at a time limit is of the z that the episode ended with (OmniSafe's
is of z = 1, `full_at_end`).
A cost critic is trained for its metrics alone.
"""

from typing import Any

from jaxsafe.algos import ppo
from jaxsafe.config import config
from jaxsafe.learn.augment import SauteConfig, saute
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.steps import adam_epochs
from jaxsafe.learn.surrogates import clipped
from jaxsafe.learn.treatments import none
from jaxsafe.types import Algorithm, Env


@config
class PPOSauteConfig(SauteConfig, ppo.PPOConfig):
    pass


# PPOSaute.yaml differs from PPO.yaml by the budget. For Point and Car on Goal and Circle it adds
# algo.saute_discount=0.9999 algo.unsafe_reward=-0.2 algo.epochs=80 algo.critic_epochs=80, and on Goal
# algo.obs_normalize=false.
PUBLISHED: dict[str, dict[str, Any]] = {
    name: options | {"saute_discount": 0.999, "unsafe_reward": -1.0}
    for name, options in ppo.PUBLISHED.items()
}


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, none, clipped, adam_epochs, axis_name, saute)
