"""The algorithms by name. A new one is a module and a line here."""

import importlib
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from jaxsafe.algos import (
    bc,
    cpo,
    cppo_pid,
    crpo,
    cup,
    focops,
    ipo,
    npg,
    p3o,
    pcpo,
    pdo,
    pg,
    ppo,
    ppo_early_terminated,
    ppo_lag,
    ppo_penalty,
    ppo_saute,
    ppo_simmer_pid,
    rcpo,
    sac,
    trpo,
    trpo_early_terminated,
    trpo_lag,
    trpo_pid,
    trpo_saute,
    trpo_simmer_pid,
)
from jaxsafe.config import ConfigError, nearest
from jaxsafe.types import Algorithm


class Entry(NamedTuple):
    config: type[Any]
    make: Callable[..., Algorithm]  # make(env, axis_name=None)
    summary: str = ""
    # setting -> overrides of the config that reproduce it
    published: Mapping[str, dict[str, Any]] = MappingProxyType({})


ALGOS: dict[str, Entry] = {
    "bc": Entry(bc.BCConfig, bc.make, "imitates a data set by regression, blind to cost"),
    "cpo": Entry(
        cpo.CPOConfig, cpo.make, "trust-region step within a linearised constraint", cpo.PUBLISHED
    ),
    "cppo_pid": Entry(
        cppo_pid.CPPOPIDConfig,
        cppo_pid.make,
        "PPO with a price on cost from a PID controller",
        cppo_pid.PUBLISHED,
    ),
    "crpo": Entry(
        crpo.CRPOConfig,
        crpo.make,
        "TRPO on reward or on cost, by whether the limit holds",
        crpo.PUBLISHED,
    ),
    "cup": Entry(
        cup.CUPConfig, cup.make, "PPO step, then a projection towards lower cost", cup.PUBLISHED
    ),
    "focops": Entry(
        focops.FOCOPSConfig,
        focops.make,
        "first-order steps near the optimal policy of a constrained problem",
        focops.PUBLISHED,
    ),
    "ipo": Entry(ipo.IPOConfig, ipo.make, "PPO with a logarithmic barrier at the limit", ipo.PUBLISHED),
    "npg": Entry(npg.NPGConfig, npg.make, "natural policy gradient, no constraint", npg.PUBLISHED),
    "p3o": Entry(p3o.P3OConfig, p3o.make, "PPO with an exact penalty beyond the limit", p3o.PUBLISHED),
    "pcpo": Entry(
        pcpo.PCPOConfig,
        pcpo.make,
        "trust-region step projected onto a linearised constraint",
        pcpo.PUBLISHED,
    ),
    "pdo": Entry(
        pdo.PDOConfig, pdo.make, "policy gradient with an adaptive price on cost", pdo.PUBLISHED
    ),
    "pg": Entry(pg.PGConfig, pg.make, "policy gradient, no constraint", pg.PUBLISHED),
    "ppo": Entry(ppo.PPOConfig, ppo.make, "clipped policy steps, no constraint", ppo.PUBLISHED),
    "ppo_early_terminated": Entry(
        ppo_early_terminated.PPOEarlyTerminatedConfig,
        ppo_early_terminated.make,
        "PPO whose training episodes end where they break the limit",
        ppo_early_terminated.PUBLISHED,
    ),
    "ppo_lag": Entry(
        ppo_lag.PPOLagConfig, ppo_lag.make, "PPO with an adaptive price on cost", ppo_lag.PUBLISHED
    ),
    "ppo_penalty": Entry(
        ppo_penalty.PPOPenaltyConfig,
        ppo_penalty.make,
        "PPO with a fixed price on cost",
        ppo_penalty.PUBLISHED,
    ),
    "ppo_saute": Entry(
        ppo_saute.PPOSauteConfig,
        ppo_saute.make,
        "PPO that sees its budget on cost, and earns nothing without",
        ppo_saute.PUBLISHED,
    ),
    "ppo_simmer_pid": Entry(
        ppo_simmer_pid.PPOSimmerPIDConfig,
        ppo_simmer_pid.make,
        "PPO-Saute with a budget that a PID controller raises",
        ppo_simmer_pid.PUBLISHED,
    ),
    "rcpo": Entry(
        rcpo.RCPOConfig,
        rcpo.make,
        "natural policy gradient with an adaptive price on cost",
        rcpo.PUBLISHED,
    ),
    "sac": Entry(sac.SACConfig, sac.make, "soft actor-critic, no constraint", sac.PUBLISHED),
    "trpo": Entry(trpo.TRPOConfig, trpo.make, "trust-region steps, no constraint", trpo.PUBLISHED),
    "trpo_early_terminated": Entry(
        trpo_early_terminated.TRPOEarlyTerminatedConfig,
        trpo_early_terminated.make,
        "TRPO whose training episodes end where they break the limit",
        trpo_early_terminated.PUBLISHED,
    ),
    "trpo_lag": Entry(
        trpo_lag.TRPOLagConfig, trpo_lag.make, "TRPO with an adaptive price on cost", trpo_lag.PUBLISHED
    ),
    "trpo_pid": Entry(
        trpo_pid.TRPOPIDConfig,
        trpo_pid.make,
        "TRPO with a price on cost from a PID controller",
        trpo_pid.PUBLISHED,
    ),
    "trpo_saute": Entry(
        trpo_saute.TRPOSauteConfig,
        trpo_saute.make,
        "TRPO that sees its budget on cost, and earns nothing without",
        trpo_saute.PUBLISHED,
    ),
    "trpo_simmer_pid": Entry(
        trpo_simmer_pid.TRPOSimmerPIDConfig,
        trpo_simmer_pid.make,
        "TRPO-Saute with a budget that a PID controller raises",
        trpo_simmer_pid.PUBLISHED,
    ),
}


def load(address: str) -> None:
    """Import 'module:name', from the working directory too, and register it under that address.

    This executes the module, so an address comes from the user, never from a file.

    Raises:
        ConfigError: no such module, or nothing of that name in it.
    """
    module, _, name = address.partition(":")
    if not (module and name):
        raise ConfigError(f"algo={address}: expected module:name")
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if not error.name or not f"{module}.".startswith(f"{error.name}."):  # a module that it imports
            raise
        raise ConfigError(f"algo={address}: no module {module!r} in {here} or installed") from error
    if name not in vars(found):
        public = [key for key in vars(found) if not key.startswith("_")]
        raise ConfigError(f"algo={address}: {module} has no {name!r}{nearest(name, public)}")
    entry = vars(found)[name]
    if not isinstance(entry, Entry):
        raise ConfigError(f"algo={address} ({type(entry).__name__}) is no Entry of jaxsafe.algos")
    ALGOS[address] = entry
