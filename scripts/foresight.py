"""How far a world model foresees cost: python scripts/foresight.py RUN [--episodes 40] [--depth 15]

Plays episodes with sampled actions of the run's policy. From every third step the model dreams along
the actions that were then taken. For each depth prints the area under the ROC curve of the predicted
cost, as a sign of a cost above 0 (a coin has 0.5), and the share of the cost's variance that is
predicted (below 0 the mean would do better).
"""

import argparse
import sys
from typing import NamedTuple

from jaxsafe.commands.jaxsafe import leaving_at_ctrl_c

with leaving_at_ctrl_c():
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxsafe import Run
    from jaxsafe.algos import ambs, dreamer, safe_dreamer
    from jaxsafe.commands.guard import guarded
    from jaxsafe.config import ConfigError
    from jaxsafe.learn.acting import Player
    from jaxsafe.learn.dreaming import Behaviour
    from jaxsafe.learn.world_model import read, world_of
    from jaxsafe.report.dreams import Episode, foreseen, play
    from jaxsafe.run.flags import Parser

BEHAVIOURS: dict[str, Behaviour] = {
    "dreamer_lag": dreamer.priced,
    "dreamer_pid": dreamer.billed,
    "osrp": safe_dreamer.planned,
    "osrp_lag": safe_dreamer.planned_at_a_price,
    "ambs": ambs.shielded_behaviour,
}
FIRST, EVERY, DREAMS = 20, 3, 8  # the first start, steps between two, dreams of each


class Costs(NamedTuple):
    """Of each depth, what the model predicts and what came, as the model counts cost: float [depth, S]
    of S starts. With ambs a violation counts `violation_cost`."""

    predicted: np.ndarray
    paid: np.ndarray


def costs_ahead(
    player: Player, behaviour: Behaviour, episodes: Episode, depth: int, key: jax.Array
) -> Costs:
    """Of dreams from steps of whole `episodes`, leaves [N, T, ...]."""
    learned = player.learned
    world = world_of(player.task, behaviour.all_heads(learned.config), learned.config)
    count, length = episodes.alive.shape
    starts = jnp.arange(FIRST, length - depth, EVERY)

    def dreamed(episode: Episode, start: jax.Array, key: jax.Array) -> jax.Array:
        latent, action = (
            jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, depth), x)
            for x in (episode.latent, episode.action)
        )
        here = episode._replace(latent=latent, action=action)
        latents = foreseen(player, here, 0, depth, key)
        return read(world, learned.params["model"], latents.features)["cost"]

    def of_one(episode: Episode, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        def mean(start: jax.Array) -> jax.Array:
            keys = jax.random.split(jax.random.fold_in(key, start), DREAMS)
            return jax.vmap(lambda key: dreamed(episode, start, key))(keys).mean(0)

        later = starts[:, None] + 1 + jnp.arange(depth)
        paid = behaviour.targets(player.task, episode.state, learned.config)["cost"]
        return jax.vmap(mean)(starts), paid[later]

    found = jax.lax.map(lambda x: of_one(*x), (episodes, jax.random.split(key, count)))
    return Costs(*(np.asarray(x).reshape(-1, depth).T for x in found))


def roc_area(score: np.ndarray, true: np.ndarray) -> float:
    """The area under the ROC curve: how likely a case scores higher than another; ties count half."""
    cases, others = np.sort(score[true]), np.sort(score[~true])
    if not len(cases) or not len(others):
        return float("nan")
    below = np.searchsorted(others, cases, "left") + np.searchsorted(others, cases, "right")
    return below.sum() / (2 * len(cases) * len(others))


def explained(predicted: np.ndarray, paid: np.ndarray) -> float:
    """1 - E[(predicted - paid)^2] / Var[paid]."""
    return float(1 - ((predicted - paid) ** 2).mean() / paid.var())


def command() -> int:
    parser = Parser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", metavar="RUN")
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--depth", type=int, default=15)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    run = Run(args.run)
    name = run.config["algo"]["name"]
    if name not in BEHAVIOURS:
        raise ConfigError(f"algo={name}: expected one whose model predicts cost: {[*BEHAVIOURS]}")
    play_key, dream_key = jax.random.split(jax.random.key(args.seed))
    player = run.player()
    most = player.task.episode_length - FIRST - 1
    if not (1 <= args.depth <= most and args.episodes >= 1):
        raise ConfigError(
            f"--episodes {args.episodes} --depth {args.depth}: expected at least one episode, and "
            f"a depth from 1 to {most}"
        )
    keys = jax.random.split(play_key, args.episodes)
    episodes = jax.jit(jax.vmap(lambda key: play(player, key)))(keys)
    found = costs_ahead(player, BEHAVIOURS[name], episodes, args.depth, dream_key)
    cost = episodes.state.cost.sum(1).mean()
    print(f"{args.run}: {args.episodes} episodes, cost of an episode {cost:.1f}")
    print("depth  ROC area  explained")
    for k, (predicted, paid) in enumerate(zip(*found, strict=True), 1):
        print(f"{k:5}  {roc_area(predicted, paid > 0):8.3f}  {explained(predicted, paid):9.2f}")
    return 0


def main() -> int:
    return guarded(command)


if __name__ == "__main__":
    sys.exit(main())
