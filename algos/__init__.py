"""The algorithms by name. A new one is a module and a line here."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxsafe.algos import cpo, ppo, ppo_lag
from jaxsafe.on_policy import Algorithm


class Entry(NamedTuple):
    config: type[Any]
    make: Callable[..., Algorithm]  # make(env, axis_name=None)
    summary: str
    published: dict[str, dict[str, Any]]  # setting -> overrides of the config that reproduce it


ALGOS: dict[str, Entry] = {
    "cpo": Entry(
        cpo.CPOConfig, cpo.make, "trust-region step within a linearised constraint", cpo.PUBLISHED
    ),
    "ppo": Entry(ppo.PPOConfig, ppo.make, "clipped policy steps, no constraint", ppo.PUBLISHED),
    "ppo_lag": Entry(
        ppo_lag.PPOLagConfig, ppo_lag.make, "PPO with an adaptive price on cost", ppo_lag.PUBLISHED
    ),
}
