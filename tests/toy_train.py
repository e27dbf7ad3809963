"""scripts/train.py with toys for environments, which compile in seconds."""

import dataclasses
import sys
from types import SimpleNamespace

from toys import Corridor

from jaxsafe import algos
from jaxsafe.run.command import train_main


@dataclasses.dataclass(frozen=True)
class Hall(Corridor):
    engine: str = "toy"


ENVS = SimpleNamespace(
    ENVS={"hall": Hall},
    canonical=lambda name: name,
    env_defaults=lambda name: {"half_width": Hall.half_width},
    make=lambda name, **options: Hall(**options),
)

if __name__ == "__main__":
    sys.exit(train_main(ENVS, algos))
