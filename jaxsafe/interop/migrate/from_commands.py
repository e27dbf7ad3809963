"""From a command of AMBS, or of ALF with SEditor's configs, to the nearest command line here.

    jaxsafe migrate ambs "python train.py --task safetygym_Safexp-PointGoal1-v0 --run.steps 500000"
    jaxsafe migrate alf "python -m alf.bin.train --conf seditor_safety_gym_conf.py --conf_param=..."

SEditor's configs become `algo=seditor`, and those without an editor have `algo.edit=none` beside it,
each on SEditor's own tasks. In racing agents see pictures. A command of AMBS becomes `algo=ambs` with
the preset of its penalty, and pictures or vectors, as its configs say.
Source: the READMEs and configs of sacktock/AMBS @5184901 and hnyu/seditor @f78b720.
"""

import ast
import shlex
from collections.abc import Callable
from typing import Any, NamedTuple

from jaxsafe import envs
from jaxsafe.config import ConfigError, Seed, convert, nearest
from jaxsafe.interop.migrate.found import Line, Migrated, as_option
from jaxsafe.nn.rssm import NAMED
from jaxsafe.run.settings import nested, settings_from_options

AMBS_REPEAT = 2  # raw steps in a step, of AMBS's safetygym configs
PICTURES: dict[str, Any] = {  # AMBS's safetygym_vision, which sees nothing else
    "env.observe_vision": True, "env.vision_size": [64, 64], "algo.encoder": "cnn",
    "algo.replay_ratio": 512,
}  # fmt: skip
# of SEditor's configs
SEDITOR: dict[str, Any] = {"total_steps": 5_000_000, "algo": "seditor", "preset": "published"}
RACING: dict[str, Any] = SEDITOR | {
    "preset": "racing", "env": "car_racing1", "env.observe_vision": True,
}  # fmt: skip


def never(value: Any) -> bool:
    return False


class Flag(NamedTuple):
    """What becomes of a flag: `turn(value)` gives options, `note` says why there is none, and
    `lost(value)` whether it asked for more."""

    turn: Callable[[Any], dict[str, Any]] = lambda value: {}
    note: str = ""
    lost: Callable[[Any], bool] = lambda value: True


def ambs_task(value: Any) -> dict[str, Any]:
    suite, _, name = str(value).partition("_")
    if suite != "safetygym":
        raise ConfigError(f"--task {value} has no counterpart: of AMBS's tasks we have Safety Gym's")
    return {"env": envs.canonical(name)}


def ambs_steps(value: Any) -> dict[str, Any]:
    return {"total_steps": AMBS_REPEAT * convert(value, int, "--run.steps")}


def ambs_configs(value: Any) -> dict[str, Any]:
    names = str(value).split()
    seen = PICTURES if "safetygym_vision" in names else {}
    size = next((size for size in NAMED if size in names), None)
    return seen | ({"algo.size": size} if size else {})


def all_but_pictures(env: str) -> dict[str, bool]:
    """What switches off all that a task shows besides a picture."""
    defaults = envs.env_defaults(env).items()
    return {f"env.{k}": False for k, value in defaults if k.startswith("observe_") and value is True}


def seditor_tasks() -> dict[str, str]:
    """Our names of SEditor's tasks. Those of its fork have Safety Gym's ids."""
    tasks = [name for name in envs.ENVS if name.startswith(("seditor_", "car_racing"))]
    return {name.removeprefix("seditor_"): name for name in tasks}


def seditor_task(value: Any) -> dict[str, Any]:
    name = envs.canonical(str(value))
    if name not in seditor_tasks():
        raise ConfigError(f"{value} is no task of SEditor's{nearest(name, seditor_tasks())}")
    return {"env": seditor_tasks()[name]}


AMBS: dict[str, Flag] = {
    "task": Flag(ambs_task),
    "seed": Flag(lambda value: {"seed": convert(value, Seed, "--seed")}),
    "run.steps": Flag(ambs_steps),
    "envs.amount": Flag(lambda value: {"num_envs": value}),
    "logdir": Flag(note="run_dir names a run's folder", lost=never),
    "configs": Flag(ambs_configs, "vectors, and size=small", lambda value: value != "safetygym"),
    "penalty_coeff": Flag(lambda value: {"algo.penalty_coef": value}),
    "plpg": Flag(lambda value: {"preset": "plpg"} if value else {}, "off", lost=never),
    "copt": Flag(lambda value: {"preset": "copt"} if value else {}, "off", lost=never),
    "penl_critic_type": Flag(note="both of its types are the same critic", lost=never),
    "normalise_ret": Flag(note="no option: rewards keep their weight, as with False", lost=bool),
}
ALF: dict[str, Flag] = {
    "create_environment.env_name": Flag(seditor_task),
    "create_environment.num_parallel_environments": Flag(lambda value: {"num_envs": value}),
    "TrainerConfig.num_env_steps": Flag(lambda value: {"total_steps": value}),
    "TrainerConfig.random_seed": Flag(lambda value: {"seed": value}),
    "root_dir": Flag(note="run_dir names a run's folder", lost=never),
}


def ambs(command: str) -> Migrated:
    """The command line for a command of AMBS.

    Raises:
        ConfigError: a task without counterpart, no task, or a value that cannot be.
    """
    found, lines = turned(dict(flags_of(command)), AMBS)
    begin = {"algo": "ambs", "preset": "penl", "env.wrap.action_repeat": AMBS_REPEAT}
    if "env" in found and "algo.encoder" in found:
        found |= all_but_pictures(found["env"])
    return migrated(begin | found, lines, "--task")


def alf(command: str) -> Migrated:
    """The command line for a command of ALF with one of SEditor's configs. Raises as `ambs`."""
    flags: dict[str, Any] = {}
    conf = ""
    for name, value in flags_of(command):
        if name == "conf":
            conf = value
        elif name == "conf_param":
            key, _, text = value.partition("=")
            flags[key.strip()] = literal(text.strip())
        else:
            flags[name] = value
    name = conf.rpartition("/")[2]
    if "seditor" not in name and not name.startswith(("sac_safety_gym", "sac_safe_car_racing")):
        raise ConfigError(f"--conf {conf or '?'}: expected SEditor's, as in seditor_safety_gym_conf.py")
    found, lines = turned(flags, ALF)
    options = RACING if "racing" in name else SEDITOR
    if "seditor" not in name:
        options = options | {"algo.edit": "none"}
    said = [as_option(k, v) for k, v in options.items() if k.startswith(("algo", "preset"))]
    lines.append(Line("conf", conf, " ".join(said)))
    return migrated(options | found, lines, "create_environment.env_name")


def flags_of(command: str) -> list[tuple[str, str]]:
    """(name, value) of --name value ..., --name=value; several values with spaces between."""
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise ConfigError(f"cannot read the command: {error}") from error
    found: list[tuple[str, str]] = []
    for word in words:
        if word.startswith("--"):
            name, _, value = word[2:].partition("=")
            found.append((name, value))
        elif found:
            name, value = found[-1]
            found[-1] = name, f"{value} {word}".strip()
    return found


def literal(text: str) -> Any:
    """The Python literal that ALF reads; its text if it is none. Executes nothing."""
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, RecursionError, MemoryError):
        return text


def turned(flags: dict[str, Any], rules: dict[str, Flag]) -> tuple[dict[str, Any], list[Line]]:
    found: dict[str, Any] = {}
    lines = []
    for name, value in flags.items():
        value = literal(value) if isinstance(value, str) else value
        rule = rules.get(name, Flag(note=f"no option{nearest(name, rules)}"))
        options = rule.turn(value)
        found |= options
        text = " ".join(as_option(k, v) for k, v in options.items()) or rule.note
        lines.append(Line(name, value, text, lost=not options and rule.lost(value)))
    return found, lines


def migrated(options: dict[str, Any], lines: list[Line], task: str) -> Migrated:
    if "env" not in options:
        raise ConfigError(f"the command names no task: expected {task}")
    settings_from_options(nested(options))
    return Migrated([as_option(k, v) for k, v in options.items()], lines)
