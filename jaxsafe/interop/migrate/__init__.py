"""From a config of OmniSafe, or of Safety Gym's Engine, to the command line that does the same here.

    jaxsafe migrate omnisafe CONFIG.json|.yaml [--algo PPOLag] [--env SafetyPointGoal1-v0]
    jaxsafe migrate safety_gym CONFIG.json|.yaml

The command goes to stdout. What became of every key goes to stderr. CONFIG is

    omnisafe    the config.json of a run, or a file of its configs, or a part of either. What a file
                leaves out has OmniSafe's default: preset=published compat=omnisafe.
    safety_gym  the dict that Engine(config) is given.

Source: the configs of OmniSafe after 0.5.0 (2025), and Safety Gym's Engine.
"""

from jaxsafe.interop.migrate.families import FAMILIES, algorithms, family_of, find_environment
from jaxsafe.interop.migrate.found import Migrated, flatten, read_file, report
from jaxsafe.interop.migrate.from_engine import safety_gym
from jaxsafe.interop.migrate.from_omnisafe import omnisafe

__all__ = [
    "FAMILIES",
    "Migrated",
    "algorithms",
    "family_of",
    "find_environment",
    "flatten",
    "omnisafe",
    "read_file",
    "report",
    "safety_gym",
]
