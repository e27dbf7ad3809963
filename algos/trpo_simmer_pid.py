"""TRPO-Simmer: TRPO-Saute whose episodes start with a part of the budget that a controller raises.

    z_0 = B / cost_limit, then z, the reward and the step as in TRPO-Saute
    B = clip(d + u, 0, cost_limit), as in PPO-Simmer

Source: Sootla et al. (2022), "Effects of Safety State Augmentation on Safe Exploration",
arXiv:2206.02675, PI Simmer.
Differs from it as PPO-Simmer does.
"""

from typing import Any

from jaxsafe.algos import trpo
from jaxsafe.algos.ppo_simmer_pid import SIMMER
from jaxsafe.config import config
from jaxsafe.learn.augment import SimmerConfig, schedule, simmer
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.surrogates import plain
from jaxsafe.learn.trust_region import trust_region
from jaxsafe.types import Algorithm, Env


@config
class TRPOSimmerPIDConfig(SimmerConfig, trpo.TRPOConfig):
    pass


# For Point and Car on Goal and Circle TRPOSimmerPID.yaml adds algo.saute_discount=0.9999
# algo.unsafe_reward=-0.2.
PUBLISHED: dict[str, dict[str, Any]] = {
    name: options | SIMMER for name, options in trpo.PUBLISHED.items()
}


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, schedule, plain, trust_region, axis_name, simmer)
