"""Looks inside a policy with a world model: what it makes of what it sees, and what it foresees."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.algos import ALGOS, ambs
from jaxsafe.config import ConfigError
from jaxsafe.learn.acting import Player, Step, played
from jaxsafe.learn.observations import vector_of, with_vector
from jaxsafe.learn.world_model import WorldModelConfig, world_of
from jaxsafe.nn.rssm import Latent
from jaxsafe.nn.two_hot import symexp
from jaxsafe.types import PyTree, State


class Episode(NamedTuple):
    """T steps of an episode.

    state: State [T, ...], in which the policy acted. Reward and cost are of the step that led there.
    latent: [T, ...], the model's, after it saw that state's observation.
    action: float [T, A], taken there.
    said: [T] by name, what the policy reports beside its action, such as `risk` and `overruled`.
    alive: bool [T], whether the episode had not ended before. What comes later means nothing.
    """

    state: State
    latent: Latent
    action: jax.Array
    said: dict[str, jax.Array]
    alive: jax.Array


def play(player: Player, key: jax.Array, steps: int | None = None) -> Episode:
    """An episode of sampled actions, up to its time limit or for so many `steps`.

    Raises:
        ConfigError: the policy has no world model.
    """
    check_model(player, WorldModelConfig, "no world model")

    def seen(step: Step) -> Episode:
        now, carry = step.now, step.carry
        return Episode(now.state, carry.latent, carry.action, step.said, now.alive)

    return jax.jit(lambda: played(player, key, seen, sampled=True, steps=steps or 0)[1])()


def decoded(player: Player, latents: Latent) -> PyTree:
    """What the model expects to observe in `latents` [...].

    A vector, float [..., O], in the units of observations; with pictures a dict of it and of `vision`,
    float [..., H, W, C] in [0, 1].
    """

    def observations() -> PyTree:
        found = applied(player, latents, method="decode")
        return with_vector(found, symexp(vector_of(found)))

    return jax.jit(observations)()


def foreseen(player: Player, episode: Episode, step: int, steps: int, key: jax.Array) -> Latent:
    """The model's latents of steps `step` + 1 to `step` + `steps`, [steps, ...]. It is told the actions
    of the episode, but sees no observation after `step`.

    Raises:
        ValueError: the episode has fewer actions from `step` on.
    """
    left = len(episode.action) - step
    if steps > left:
        raise ValueError(
            f"steps={steps}: expected at most {left}, which the episode has from {step} on"
        )

    def ahead(latent: Latent, x: tuple[jax.Array, jax.Array]) -> tuple[Latent, Latent]:
        latent = applied(player, latent, *x, method="imagine")
        return latent, latent

    def dreamed() -> Latent:
        actions = episode.action[step : step + steps]
        start = jax.tree.map(lambda x: x[step], episode.latent)
        return jax.lax.scan(ahead, start, (actions, jax.random.split(key, steps)))[1]

    return jax.jit(dreamed)()


def strip(player: Player, episode: Episode, step: int, steps: int, key: jax.Array) -> np.ndarray:
    """Pictures of steps `step` to `step` + `steps` side by side, uint8 [3 H, (steps + 1) W, C].

    Above what was observed, then what the model makes of its latents, and below what it foresees: there
    it sees the first step alone. Of several frames the newest is shown.

    Raises:
        ConfigError: the policy sees no pictures.
        ValueError: the episode has fewer observations after `step`.
    """
    left = len(episode.action) - 1 - step  # what its last action led to was not observed
    if steps > left:
        raise ValueError(f"steps={steps}: expected at most {left}, which the episode has after {step}")
    shown = slice(step, step + steps + 1)
    obs, latent = jax.tree.map(lambda x: x[shown], (episode.state.obs, episode.latent))
    if not isinstance(obs, dict):
        raise ConfigError("this policy sees no pictures: expected env.observe_vision=true")
    ahead = foreseen(player, episode, step, steps, key)
    closed = jax.tree.map(lambda now, later: jnp.concatenate([now[:1], later]), latent, ahead)
    painted = (255 * decoded(player, x)["vision"] for x in (latent, closed))
    rows = [np.asarray(x)[..., :3] for x in (obs["vision"], *painted)]
    return np.concatenate([np.concatenate(row.round().astype(np.uint8), axis=1) for row in rows])


def shield_dreams(player: Player, episode: Episode, step: int, key: jax.Array) -> ambs.Dreamt:
    """Dreams such as a shield has at a `step` of `episode`, drawn anew by `key`.

    With `verify_action` they begin with the action that was taken. Where the shield overruled, that is
    not the one that it looked at. With `shield=true_dynamics` the shield looked ahead in the simulator;
    these are the model's dreams.

    Raises:
        ConfigError: the policy has no shield.
    """
    check_model(player, ambs.AMBSConfig, "no shield")
    latent, action = jax.tree.map(lambda x: x[step], (episode.latent, episode.action))
    return jax.jit(lambda: ambs.dreamt(player.task, player.learned, latent, action, key))()


def check_model(player: Player, kind: type[Any], lacking: str) -> None:
    """Raise ConfigError unless the policy learned with a config of this kind, with the algorithms that
    have one."""
    config = player.learned.config
    if isinstance(config, kind):
        return
    whose = [name for name, row in ALGOS.items() if row.config is type(config)]
    valid = [name for name, row in ALGOS.items() if issubclass(row.config, kind)]
    name = " or ".join(whose) or type(config).__name__
    raise ConfigError(f"{name} has {lacking} to look into; valid: {', '.join(valid)}")


def applied(player: Player, *args: Any, method: str) -> Any:
    """A method of the policy's world model that reads none of its heads."""
    check_model(player, WorldModelConfig, "no world model")
    world = world_of(player.task, {}, player.learned.config)
    return world.apply(player.learned.params["model"], *args, method=method)
