"""Train SAC on a task of Brax, which has no cost: python scripts/brax_sac.py [TASK] [key=value ...]

    python scripts/brax_sac.py halfcheetah                       # 3e6 steps
    python scripts/brax_sac.py ant preset=parallel total_steps=1e6 num_seeds=4

The preset of `sac` is `frequent`. Options are those of scripts/train.py, one value each, without env
and env.*. The run folder, its curves and its evaluation are those of every run. Backends differ in
their physics: figures are comparable within one alone. Speed beside Brax's own SAC, with as many
environments and gradient steps:

    python scripts/benchmark.py scripts.brax_sac:task --algo sac --peer brax-sac
"""

import argparse
import sys

from jaxsafe.commands.jaxsafe import leaving_at_ctrl_c

with leaving_at_ctrl_c():
    import brax.envs

    import jaxsafe
    from jaxsafe.commands.guard import guarded
    from jaxsafe.config import ConfigError, flat
    from jaxsafe.interop.brax import FromBrax, from_brax
    from jaxsafe.run.arguments import read_values
    from jaxsafe.run.flags import Parser

BACKENDS = ("generalized", "spring", "positional", "mjx")


def task(env_name: str = "halfcheetah", backend: str = "generalized") -> FromBrax:
    """A task of Brax, without cost."""
    try:
        made = brax.envs.get_environment(env_name, backend=backend)
    except KeyError as error:
        raise ConfigError(f"Brax has no task {env_name}") from error
    env = from_brax(made, costs=())
    env.engine = f"brax {backend}"
    return env


def command() -> int:
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "words", nargs="*", metavar="TASK, key=value", help="of brax.envs (halfcheetah)"
    )
    parser.add_argument(
        "--backend", default="generalized", choices=BACKENDS, help="of Brax (generalized)"
    )
    args = parser.parse_args()
    names = [word for word in args.words if "=" not in word] or ["halfcheetah"]
    if len(names) > 1:
        raise ConfigError(f"{' '.join(names)}: expected one task")
    given = read_values([word for word in args.words if "=" in word])
    for name in given.several:
        raise ConfigError(f"{name}: expected one value")
    options = {"total_steps": 3_000_000, "video": False, **flat(given.options)}
    if "env.name" in options:
        raise ConfigError(f"env={options['env.name']}: name a task of Brax instead, as halfcheetah")
    algo = options.pop("algo.name", "sac")
    if algo == "sac":
        options.setdefault("preset", "frequent")
    jaxsafe.train(task(names[0], args.backend), algo, **options)
    return 0


def main() -> int:
    """Exit status: as of scripts/train.py."""
    return guarded(command)


if __name__ == "__main__":
    sys.exit(main())
