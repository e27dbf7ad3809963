"""From a config of OmniSafe to our command line."""

from typing import Any, NamedTuple

from jaxsafe import algos, envs
from jaxsafe.config import Amount, ConfigError, convert, from_dict, nearest
from jaxsafe.envs.velocity.config import VelocityConfig
from jaxsafe.interop.migrate.families import (
    FAMILIES,
    KNOWN,
    family_of,
    find_algorithm,
    find_environment,
    only_of,
)
from jaxsafe.interop.migrate.found import Line, Migrated, as_option, flatten
from jaxsafe.interop.migrate.model_based import REPEAT
from jaxsafe.interop.migrate.rules import Facts, Rule
from jaxsafe.learn.certificate import CertificateConfig
from jaxsafe.learn.model_based import ModelBasedConfig
from jaxsafe.learn.row import Row
from jaxsafe.run.settings import TrainConfig, algo_options


def omnisafe(config: dict[str, Any], algo: str = "", env: str = "") -> Migrated:
    """The command line for a config of OmniSafe.

    Args:
        config: its tree, as in a run's config.json, or with `defaults` as in OmniSafe's own files.
        algo, env: OmniSafe's names, if the config has none; an env may be one of ours.
    Raises:
        ConfigError: a key, an algorithm or an environment that is unknown or has no counterpart, or a
            value of the wrong type or out of bounds.
    """
    values = values_of(config, env)
    their_algo = convert(algo or values.get("algo") or "", str, "algo")
    their_env = convert(env or values.get("env_id") or "", str, "env_id")
    name, target = find_algorithm(their_algo), find_environment(their_env)
    row = algos.ALGOS[name]
    family = FAMILIES[family_of(row)]
    preset, target, repeat = set_up(row, target)
    found = {**family.theirs}
    if REPEAT in family.run:
        found[REPEAT] = repeat = convert(values.get("algo_cfgs.action_repeat", repeat), Amount, REPEAT)
    start = options_of(row, preset)
    facts = Facts(values, start, repeat)
    defaults = f"preset={preset} compat=omnisafe"
    lines = [Line("algo", their_algo, f"algo={name} {defaults}")]
    lines.append(Line("env_id", their_env, " ".join(target)))
    for key in [k for k in KNOWN if k in values and k not in ("algo", "env_id")]:
        became = applied(family.rules.get(key) or only_of(key), values[key], facts, name)
        lines.append(Line(key, values[key], became.text + in_place_of(became, found), became.lost))
        found |= became.options
    found = checked(found, row)
    changed = [as_option(k, v) for k, v in found.items() if v != start[k]]
    return Migrated([*target, f"algo={name}", *defaults.split(), *changed], lines)


def values_of(config: dict[str, Any], env: str) -> dict[str, Any]:
    """The keys of a file with their values, for this environment."""
    if "defaults" in config:
        config = flatten(config["defaults"]) | flatten(config.get(env) or {})
    values = {k: v for k, v in flatten(config).items() if not k.startswith("exp_increment_cfgs.")}
    for key in values:
        if key not in KNOWN:
            raise ConfigError(f"unknown key {key} of OmniSafe{nearest(key, KNOWN)}")
    return values


def set_up(row: Row, target: list[str]) -> tuple[str, list[str], int]:
    """The preset, all options of the environment, and OmniSafe's raw steps in a step.

    Raises:
        ConfigError: OmniSafe's planners do not take the environment.
    """
    task = target[0].removeprefix("env=")
    if issubclass(row.config, CertificateConfig) and not task.startswith("pendulum_"):
        raise ConfigError(f"{target[0]}: CRABS is for SafeInvertedPendulumSwing-v2 alone there")
    if not issubclass(row.config, ModelBasedConfig):
        return "published", target, 1
    if isinstance(envs.ENVS[task], VelocityConfig):
        return "omnisafe_velocity", target, 1
    if "_goal" not in task:
        raise ConfigError(f"{target[0]}: OmniSafe plans in Goal and in the velocity tasks alone")
    return "published", [*target, "env.observation=coordinates"], 5


def options_of(row: Row, preset: str) -> dict[str, Any]:
    """All options that a command for this algorithm has, with the values that they begin with."""
    options = {f"algo.{k}": v for k, v in algo_options(row, preset, "omnisafe").items()}
    if "algo.num_envs" in options:
        options["num_envs"] = options["algo.num_envs"]
    of_all = {name: getattr(TrainConfig, name) for name in ("seed", "eval_episodes", "logger")}
    return options | of_all | {"total_steps": row.total_steps} | {**FAMILIES[family_of(row)].run}


class Became(NamedTuple):
    """What became of a key: options, `text` that says so or why not, `lost` if it asked for more."""

    options: dict[str, Any]
    text: str
    lost: bool = False


def applied(rule: Rule, value: Any, facts: Facts, algo: str) -> Became:
    if not rule.ours:
        return Became({}, rule.note, rule.loses(value))
    options = rule.options(value, facts)
    if options is None:
        return Became({}, rule.note, lost=True)
    if not options:
        return Became({}, "so it is")
    fits = {k: v for k, v in options.items() if k in facts.options}
    if not fits:
        return Became({}, f"{algo} has no {' or '.join(options)}", lost=True)
    return Became(fits, " ".join(as_option(k, v) for k, v in fits.items()))


def in_place_of(became: Became, found: dict[str, Any]) -> str:
    """What earlier keys had made of the same options."""
    options = became.options.items()
    replaced = [as_option(k, found[k]) for k, v in options if k in found and found[k] != v]
    return "".join(f" in place of {option}" for option in replaced)


def checked(found: dict[str, Any], row: Row) -> dict[str, Any]:
    """Options with the types that they have here."""
    of_algo = {k.removeprefix("algo."): v for k, v in found.items() if k.startswith("algo.")}
    cfg = from_dict(row.config, of_algo, "algo.")

    def typed(key: str, value: Any) -> Any:
        if key.startswith("algo."):
            return getattr(cfg, key.removeprefix("algo."))
        return convert(value, str if key in ("dataset", "logger") else int, key)

    whole = {key: typed(key, value) for key, value in found.items()}
    from_dict(TrainConfig, {key: value for key, value in whole.items() if "." not in key})  # in bounds
    return whole
