"""PPO-Simmer: PPO-Saute whose episodes start with a part of the budget that a controller raises.

    z_0 = B / cost_limit, then z, the reward and the step as in PPO-Saute
    B = clip(d + u, 0, cost_limit),   u = clip(K_p e + K_i sum e + K_aw (u' - u'_raw), -U, U)
    e = s e' + (1 - s) (d - J_c),   once an iteration; ' is the iteration before

d rises on a line to cost_limit: the task starts safer than it has to be, and simmers up. u' is what
the clips left of u'_raw, both at U and at the bounds of B, so that the sum does not wind up.

Source: Sootla et al. (2022), "Effects of Safety State Augmentation on Safe Exploration",
arXiv:2206.02675, PI Simmer; the filter, the sum over the last `simmer_window` errors and both clips
are from the authors' code.
Differs from it: d is a line, there a staircase. OmniSafe has B' for d, so that u adds up
(`simmer_adds`), and calls K_aw a derivative's gain; its episodes after the first of an epoch start at
z = 1, the share of B (`simmer_full`).
"""

from typing import Any

from jaxsafe.algos import ppo
from jaxsafe.config import config
from jaxsafe.learn.augment import OMNISAFE_SIMMER, SimmerConfig, schedule, simmer
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.steps import adam_epochs
from jaxsafe.learn.surrogates import clipped
from jaxsafe.types import Algorithm, Env


@config
class PPOSimmerPIDConfig(SimmerConfig, ppo.PPOConfig):
    pass


# What PPOSimmerPID.yaml and TRPOSimmerPID.yaml add to those of PPO and TRPO.
SIMMER: dict[str, Any] = {"saute_discount": 0.999, "unsafe_reward": -1.0, **OMNISAFE_SIMMER}

# For Point and Car on Goal, and Point on Circle, PPOSimmerPID.yaml adds what PPOSaute.yaml does:
# algo.saute_discount=0.9999 algo.unsafe_reward=-0.2 algo.epochs=80 algo.critic_epochs=80, and on Goal
# algo.obs_normalize=false.
PUBLISHED: dict[str, dict[str, Any]] = {
    name: options | SIMMER for name, options in ppo.PUBLISHED.items()
}


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, schedule, clipped, adam_epochs, axis_name, simmer)
