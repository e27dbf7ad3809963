"""From the dict that Safety Gym's Engine takes to our command line."""

import dataclasses
from typing import Any

from jaxsafe import envs
from jaxsafe.config import ConfigError, nearest
from jaxsafe.envs.safety_gym import suite
from jaxsafe.envs.safety_gym.config import config_from_plain, defaults
from jaxsafe.interop.migrate.found import Line, Migrated, as_option

# Options that Engine does not have.
OURS_ALONE = (
    "rules", "observation", "awake", "contact_room", "bounds_num", "bounds", "bounds_cost",
    "vision_camera",
)  # fmt: skip


def safety_gym(config: dict[str, Any]) -> Migrated:
    """The command line for the dict that Safety Gym's Engine takes; its options are ours by name.

    The environment is the registered one of that task and robot, if any, that differs least from it.

    Raises:
        ConfigError: an option that Engine does not have, or a value of the wrong type.
    """
    known = [field for field in defaults() if field not in OURS_ALONE]
    for key in config:
        if key not in known:
            raise ConfigError(f"unknown option {key} of Engine{nearest(str(key), known)}")
    options = dataclasses.asdict(config_from_plain(defaults(**config)))

    def differences(name: str) -> dict[str, Any]:
        other = envs.env_defaults(name)
        return {k: v for k, v in options.items() if v != other[k]}

    def distance(name: str) -> tuple[bool, bool, int]:
        found = differences(name)
        return "task" in found, "robot_base" in found, len(found)

    name = min(suite.suite(), key=distance)
    argv = [f"env={name}", *(as_option(f"env.{k}", v) for k, v in differences(name).items())]
    return Migrated(argv, [Line(k, config[k], as_option(f"env.{k}", options[k])) for k in config])
