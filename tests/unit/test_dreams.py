"""Looks inside a policy with a world model: what belongs to which step."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Corridor

from jaxsafe.algos import ALGOS, dreamer
from jaxsafe.config import ConfigError
from jaxsafe.learn.acting import Learned, Player
from jaxsafe.learn.dreaming import Memory
from jaxsafe.nn.rssm import Latent
from jaxsafe.nn.two_hot import symlog
from jaxsafe.report import dreams
from jaxsafe.types import Policy


class Adding:
    """A model whose latent is what it saw, and then the sum of the actions that it was told."""

    def apply(self, params: Any, *args: Any, method: str) -> Any:
        return getattr(self, method)(*args)

    def imagine(self, latent, action, key):
        return Latent(latent.deter + action.sum(), latent.stoch)

    def decode(self, latent):
        return symlog(latent.deter)


def test_what_is_lived_seen_and_foreseen_belongs_to_its_step(monkeypatch):
    """The latent of a step is of its observation, its action leads to the next, and what is foreseen
    begins with the action of the step after which the eyes close."""
    env: Any = Corridor(dt=0.2)

    def act(learned, carry, obs, key):
        action = jax.random.uniform(key, (2,), minval=-1.0)
        return action, Memory(Latent(obs, jnp.zeros(1)), action, carry.step + 1), {"risk": obs[0]}

    policy = Policy(
        lambda learned: Memory(Latent(jnp.zeros(4), jnp.zeros(1)), jnp.zeros(2), jnp.int32(0)), act
    )
    learned: Any = SimpleNamespace(config=dreamer.DreamerConfig(), params={"model": None})
    player = Player(policy, learned, env)
    monkeypatch.setattr(dreams, "world_of", lambda *_: Adding())
    episode = dreams.play(player, jax.random.key(0), 12)
    np.testing.assert_array_equal(episode.latent.deter, episode.state.obs)
    np.testing.assert_array_equal(episode.said["risk"], episode.state.obs[:, 0])
    before = jax.tree.map(lambda x: x[:-1], episode.state)
    after = jax.vmap(env.step)(before, episode.action[:-1])
    np.testing.assert_allclose(after.obs, episode.state.obs[1:], rtol=1e-6)
    np.testing.assert_allclose(dreams.decoded(player, episode.latent), episode.state.obs, rtol=1e-5)
    found = dreams.foreseen(player, episode, 3, 4, jax.random.key(1))
    told = episode.action[3:7].sum(-1).cumsum()
    np.testing.assert_allclose(found.deter, episode.state.obs[3] + told[:, None], rtol=1e-5)


def test_a_strip_has_true_and_imagined_frames_of_the_same_steps_below_each_other(monkeypatch):
    """Frames of 2 x 2 pixels that are as bright as their step, in a model that counts on by 2."""

    class Counting:
        def apply(self, params, *args, method):
            return getattr(self, method)(*args)

        def imagine(self, latent, action, key):
            return Latent(latent.deter + 2, latent.stoch)

        def decode(self, latent):
            frame = latent.deter[..., None, None] / 255 * jnp.ones((2, 2, 6))
            return {"vision": frame, "vector": latent.deter}

    player: Any = SimpleNamespace(
        task=None, learned=SimpleNamespace(config=dreamer.DreamerConfig(), params={"model": None})
    )
    monkeypatch.setattr(dreams, "world_of", lambda *_: Counting())
    t = jnp.arange(9.0)[:, None]
    vision = (t[:, :, None, None] * jnp.ones((2, 2, 6))).astype(jnp.uint8)
    state: Any = SimpleNamespace(obs={"vision": vision, "vector": t})
    episode: Any = SimpleNamespace(state=state, latent=Latent(t, t), action=t)
    found = dreams.strip(player, episode, 3, 2, jax.random.key(0))
    assert found.shape == (6, 6, 3) and found.dtype == np.uint8
    np.testing.assert_array_equal(found[::2, ::2, 0], [[3, 4, 5], [3, 4, 5], [3, 5, 7]])
    assert dreams.strip(player, episode, 6, 2, jax.random.key(0)).shape == (6, 6, 3)
    with pytest.raises(ValueError, match="steps=3: expected at most 2, which the episode has after 6"):
        dreams.strip(player, episode, 6, 3, jax.random.key(0))
    blind: Any = SimpleNamespace(state=SimpleNamespace(obs=t), latent=Latent(t, t), action=t)
    with pytest.raises(ConfigError, match="sees no pictures"):
        dreams.strip(player, blind, 3, 2, jax.random.key(0))


def test_a_policy_without_a_world_model_or_a_shield_is_refused_by_name():
    unused: Any = None
    player, key = (
        Player(unused, Learned(ALGOS["cpo"].config(), {}, (), ()), Corridor()),
        jax.random.key(0),
    )
    of_dreamer = player._replace(learned=Learned(ALGOS["dreamer"].config(), {}, (), ()))
    no_model = "cpo has no world model to look into; valid: ambs, dreamer, "
    with pytest.raises(ConfigError, match=no_model):
        dreams.play(player, key)
    with pytest.raises(ConfigError, match=no_model):
        dreams.decoded(player, Latent(jnp.zeros(1), jnp.zeros(1)))
    with pytest.raises(ConfigError, match=r"dreamer has no shield to look into; valid: ambs$"):
        dreams.shield_dreams(of_dreamer, unused, 0, key)
