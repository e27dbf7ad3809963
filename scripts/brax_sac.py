"""Train SAC on a task of Brax, which has no cost: python scripts/brax_sac.py [TASK] [key=value ...]

    python scripts/brax_sac.py halfcheetah                       # 3e6 steps
    python scripts/brax_sac.py ant preset=parallel total_steps=1e6 num_seeds=4

The preset of `sac` is `frequent`. Options are those of scripts/train.py, without lists. The run folder,
its curves and its evaluation are those of every run. Backends differ in their physics: figures are
comparable within one alone. Speed beside Brax's own SAC, with as many environments and gradient steps:

    python scripts/benchmark.py scripts.brax_sac:task --algo sac --peer brax-sac
"""

import argparse

import brax.envs

import jaxsafe
from jaxsafe.interop.brax import FromBrax, from_brax
from jaxsafe.run.arguments import read_values


def task(name: str = "halfcheetah", backend: str = "generalized") -> FromBrax:
    """A task of Brax, without cost."""
    env = from_brax(brax.envs.get_environment(name, backend=backend), costs=())
    env.engine = f"brax {backend}"
    return env


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", nargs="?", default="halfcheetah", help="of brax.envs (halfcheetah)")
    parser.add_argument("options", nargs="*", metavar="key=value")
    parser.add_argument("--backend", default="generalized", help="of Brax (generalized)")
    args = parser.parse_args()
    options = {"total_steps": 3_000_000, "video": False, **read_values(args.options).options}
    algo = options.pop("algo", "sac")
    if algo == "sac":
        options.setdefault("preset", "frequent")
    jaxsafe.train(task(args.task, args.backend), algo, **options)


if __name__ == "__main__":
    main()
