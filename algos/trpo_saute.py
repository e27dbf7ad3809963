"""TRPO-Saute: TRPO that sees what is left of its budget on cost, and earns only while there is some.

    z_0 = 1,   z_{t+1} = (z_t - c_t / B) / gamma_n,   B = cost_limit mean_{t<T} gamma_n^t
    maximise_theta  E[w A]   subject to   KL(old || new) <= delta,   A of  r_t if z_{t+1} > 0, else n

Source: Sootla et al. (2022), "Saute RL: Almost Surely Safe Reinforcement Learning Using State
Augmentation", arXiv:2202.06558.
Differs from it as PPO-Saute does.
"""

from typing import Any

from jaxsafe.algos import trpo
from jaxsafe.config import config
from jaxsafe.learn.augment import SauteConfig, saute
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.surrogates import plain
from jaxsafe.learn.treatments import none
from jaxsafe.learn.trust_region import trust_region
from jaxsafe.types import Algorithm, Env


@config
class TRPOSauteConfig(SauteConfig, trpo.TRPOConfig):
    pass


# TRPOSaute.yaml differs from TRPO.yaml by the budget. For Point and Car on Goal and Circle it adds
# algo.saute_discount=0.9999 algo.unsafe_reward=-0.2.
PUBLISHED: dict[str, dict[str, Any]] = {
    name: options | {"saute_discount": 0.999, "unsafe_reward": -1.0}
    for name, options in trpo.PUBLISHED.items()
}


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, none, plain, trust_region, axis_name, saute)
