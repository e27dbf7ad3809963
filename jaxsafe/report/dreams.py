"""Looks inside a policy with a world model: what it makes of what it sees, and what it foresees."""

from typing import Any, NamedTuple

import jax

from jaxsafe.algos import ambs
from jaxsafe.learn.acting import Player, Playing
from jaxsafe.learn.observations import vector_of, with_vector
from jaxsafe.learn.world_model import world_of
from jaxsafe.nn.rssm import Latent
from jaxsafe.nn.two_hot import symexp
from jaxsafe.types import PyTree, State


class Lived(NamedTuple):
    """T steps of an episode as its policy lived them, [T, ...].

    state: what it met. Reward and cost are of the step that led there.
    latent, action: where it thought that it was, and what it did there.
    said: what it reported beside its action, as `risk` and `overruled`, by name.
    alive: bool, whether the episode still ran.
    """

    state: State
    latent: Latent
    action: jax.Array
    said: dict[str, jax.Array]
    alive: jax.Array


def lived(player: Player, key: jax.Array, steps: int | None = None) -> Lived:
    """An episode of sampled actions, up to its time limit or for so many `steps`."""
    reset_key, act_key = jax.random.split(key)

    def step(now: Playing, key: jax.Array) -> tuple[Playing, Lived]:
        action, carry, said = player.decide(now.carry, now.state, key)
        state = player.task.step(now.state, action)
        found = Lived(now.state, carry.latent, carry.action, said, now.alive)
        return Playing(state, carry, now.alive & ~state.ended), found

    def episode() -> Lived:
        keys = jax.random.split(act_key, steps or player.task.episode_length)
        return jax.lax.scan(step, player.start(reset_key), keys)[1]

    return jax.jit(episode)()


def painted(player: Player, latents: Latent) -> PyTree:
    """What the model thinks that is observed in `latents` [...]: vectors, and pictures in [0, 1]."""

    def decoded() -> PyTree:
        found = applied(player, latents, method="decode")
        return with_vector(found, symexp(vector_of(found)))

    return jax.jit(decoded)()


def foreseen(player: Player, episode: Lived, step: int, steps: int, key: jax.Array) -> Latent:
    """The latents of the `steps` steps after `step`, as the model foresees them: it is told what was
    done, but no longer sees what came of it."""

    def ahead(latent: Latent, x: tuple[jax.Array, jax.Array]) -> tuple[Latent, Latent]:
        latent = applied(player, latent, *x, method="imagine")
        return latent, latent

    def dreamed() -> Latent:
        actions = episode.action[step : step + steps]
        start = jax.tree.map(lambda x: x[step], episode.latent)
        return jax.lax.scan(ahead, start, (actions, jax.random.split(key, steps)))[1]

    return jax.jit(dreamed)()


def shield_dreams(player: Player, episode: Lived, step: int, key: jax.Array) -> ambs.Dreamt:
    """What a shield dreams at a `step` of `episode`."""
    latent, action = jax.tree.map(lambda x: x[step], (episode.latent, episode.action))
    return jax.jit(lambda: ambs.dreamt(player.task, player.learned, latent, action, key))()


def applied(player: Player, *args: Any, method: str) -> Any:
    """A method of the policy's world model, whose heads are not read."""
    world = world_of(player.task, {}, player.learned.config)
    return world.apply(player.learned.params["model"], *args, method=method)
