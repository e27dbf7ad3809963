"""Time updates without physics: python scripts/profile_learner.py ppo_lag [key=value ...] --seeds 5

The environment has the sizes of point_goal1 and costs nothing to step, so that what is left of an
update is the learner: acting, estimates, the policy's step and the critics'. Options are preset=,
compat= and algo.OPTION= of train. Prints the median.
"""

import argparse
import statistics
import sys
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxsafe import algos
from jaxsafe.commands.benchmark import config_of, timed, training
from jaxsafe.config import ConfigError, nearest
from jaxsafe.types import State


@dataclass(frozen=True)
class Weightless:
    """60 numbers that rotate; observation, reward and cost are read off them."""

    obs_size: int = 60
    action_size: int = 2
    episode_length: int = 1000
    cost_names: tuple[str, ...] = ("first",)

    def reset(self, key: jax.Array) -> State:
        return self._state(jax.random.normal(key, (self.obs_size,)))

    def step(self, state: State, action: jax.Array) -> State:
        return self._state(0.99 * jnp.roll(state.physics, 1) + 0.01 * action.sum())

    def _state(self, x: jax.Array) -> State:
        return State(x, x, x[0], jnp.abs(x[1]), jnp.abs(x[1:2]), jnp.bool_(False), {})


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("algo", metavar="ALGO")
    parser.add_argument("options", nargs="*", metavar="key=value")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--num-envs", type=int, help="of each seed")
    parser.add_argument("--horizon", type=int)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_intermixed_args()
    try:
        if args.algo not in algos.ALGOS:
            raise ConfigError(f"unknown algo {args.algo!r}{nearest(args.algo, algos.ALGOS)}")
        cfg = config_of(args.algo, args.options, num_envs=args.num_envs, horizon=args.horizon)
        state, update = training(Weightless(), args.algo, cfg, args.seeds, devices=1)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    before = 2 + -(-getattr(cfg, "learning_starts", 0) // (cfg.num_envs * cfg.horizon))
    compiling, runs = timed(update, state, before=before, repeats=args.repeats)
    print(
        f"{' '.join([args.algo, *args.options])}, {args.seeds} x {cfg.num_envs} x {cfg.horizon}: "
        f"{1e3 * statistics.median(runs):.1f} ms an update, compiled in {compiling:.1f} s"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
