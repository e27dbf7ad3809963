"""The families of OmniSafe's algorithms, and what its names stand for here."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from jaxsafe import algos, envs
from jaxsafe.config import ConfigError, nearest
from jaxsafe.envs.registry import IMPLIED
from jaxsafe.interop.migrate.found import as_option
from jaxsafe.interop.migrate.model_based import MODEL_BASED, REPEAT
from jaxsafe.interop.migrate.off_policy import OFF_POLICY
from jaxsafe.interop.migrate.offline import OFFLINE
from jaxsafe.interop.migrate.on_policy import ON_POLICY
from jaxsafe.interop.migrate.rules import Rule
from jaxsafe.learn.model_based import ModelBasedConfig
from jaxsafe.learn.off_policy import OffPolicyConfig
from jaxsafe.learn.offline import OfflineConfig
from jaxsafe.learn.row import Row
from jaxsafe.run.settings import OFFLINE_UPDATES

NONE: Mapping[str, Any] = MappingProxyType({})


class Family(NamedTuple):
    """Algorithms whose keys mean the same.

    config: what our configs of the family are.
    run: the options of a run, beside those of all families, with our defaults.
    theirs: OmniSafe's defaults that are not in the preset.
    """

    config: type
    rules: dict[str, Rule]
    run: Mapping[str, Any]
    theirs: Mapping[str, Any] = NONE


FAMILIES = {  # the first that an algorithm's config is one of
    "model-based": Family(
        ModelBasedConfig, MODEL_BASED, {"eval_every": 0, REPEAT: 1}, {"total_steps": 1_000_000}
    ),
    "offline": Family(
        OfflineConfig,
        OFFLINE,
        {"total_updates": OFFLINE_UPDATES, "dataset": None},
        {"total_updates": 1_000_000, "eval_episodes": 10},
    ),
    "off-policy": Family(OffPolicyConfig, OFF_POLICY, NONE, {"total_steps": 1_000_000}),
    "on-policy": Family(object, ON_POLICY, NONE),
}
KNOWN = OFFLINE | OFF_POLICY | MODEL_BASED


def family_of(row: Row) -> str:
    return next(name for name, family in FAMILIES.items() if issubclass(row.config, family.config))


def only_of(key: str) -> Rule:
    """For a key of another family's algorithms."""
    families = [name for name, family in FAMILIES.items() if key in family.rules]
    return Rule("", f"a key of {' and '.join(families)} algorithms")


def algorithms() -> dict[str, str]:
    """OmniSafe's names of the algorithms, and ours."""
    return dict(sorted((row.omnisafe, name) for name, row in algos.ALGOS.items() if row.omnisafe))


def find_algorithm(theirs: str) -> str:
    known = algorithms()
    if not theirs:
        raise ConfigError(f"no algorithm in the file: add --algo, one of {', '.join(known)}")
    if theirs not in known:
        raise ConfigError(f"unknown algorithm {theirs} of OmniSafe{nearest(theirs, known)}")
    return known[theirs]


def find_environment(theirs: str) -> list[str]:
    """Options for the environment that OmniSafe calls `theirs`, or that is called so here."""
    if not theirs:
        raise ConfigError("no env_id in the file: add --env, as in --env SafetyPointGoal1-v0")
    theirs = theirs.removesuffix("-modelbased")  # of the tasks of its planners
    if (alias := theirs.replace("Gymnasium-", "-")) in envs.ALIASES:
        implied = (as_option(f"env.{k}", v) for k, v in IMPLIED.get(alias, {}).items())
        return [f"env={envs.canonical(alias)}", *implied]
    if theirs.startswith("Safety"):
        raise ConfigError(
            f"{theirs} has no counterpart: of Safety-Gymnasium's tasks we have Point's and Car's Goal, "
            "Button, Push, Circle and Run, and the velocity tasks; --env chooses another, by "
            "Safety-Gymnasium's name or ours"
        )
    return [f"env={envs.canonical(theirs)}"]
