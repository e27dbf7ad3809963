"""NPG: the natural policy gradient, blind to cost.

    theta <- theta + sqrt(2 delta / g'H^-1 g) H^-1 g

g: gradient of E[w A]; H: the Fisher matrix.

Source: Kakade (2001), "A Natural Policy Gradient".
Differs from it: delta, the KL of the step, sets its length, as in OmniSafe.
"""

from typing import Any

from jaxsafe.algos import trpo
from jaxsafe.config import config
from jaxsafe.learn.on_policy import OnPolicyConfig, on_policy
from jaxsafe.learn.surrogates import plain
from jaxsafe.learn.treatments import none
from jaxsafe.learn.trust_region import natural_gradient
from jaxsafe.types import Algorithm, Env


@config
class NPGConfig(OnPolicyConfig):
    target_kl: float = 0.02  # delta, nats; OmniSafe's 0.01 is of a mean over (2) action dimensions
    kl_per_action: bool = False  # the KL is a mean over action dimensions; OmniSafe
    damping: float = 0.1  # added to the Fisher matrix; OmniSafe
    cg_iterations: int = 15  # OmniSafe


PUBLISHED: dict[str, dict[str, Any]] = trpo.PUBLISHED  # the same


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, none, plain, natural_gradient, axis_name)
