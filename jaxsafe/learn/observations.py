"""Observations: a vector, or a dict with the `vector` and `vision`, a picture beside it.

A picture is uint8 [..., height, width, channels]. It stays so in rollouts and in the replay.
"""

from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.config import ConfigError, config
from jaxsafe.nn.cnn import FEATURES, encoded, init_encoder
from jaxsafe.types import Env, PyTree


@config
class EncoderConfig:
    """For algorithms that take pictures."""

    TAKES_PICTURES: ClassVar = True  # False where an algorithm adds a part that takes vectors

    # What becomes of pictures. cnn: convolutions make 128 numbers of them, which go with the vector.
    # none: there are no pictures.
    encoder: Literal["none", "cnn"] = "none"


def vector_of(obs: PyTree) -> Any:
    """Of an observation, what is not a picture."""
    return obs["vector"] if isinstance(obs, dict) else obs


def with_vector(obs: PyTree, vector: Any) -> PyTree:
    """`obs` with another vector."""
    return obs | {"vector": vector} if isinstance(obs, dict) else vector


def observation_like(env: Env) -> Any:
    """The shapes and types of what `env` observes. It is traced, not simulated."""
    return jax.eval_shape(env.reset, jax.random.key(0)).obs


def blank(like: PyTree) -> PyTree:
    """Zeros of these shapes and types, to initialise networks with."""
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)


def init_features(
    key: jax.Array, env: Env, obs_size: int, cfg: EncoderConfig
) -> tuple[dict[str, PyTree], int]:
    """The encoder among a learner's networks, if it has one, and how many numbers are in `features`.

    obs_size: of the vector.
    """
    if cfg.encoder == "none":
        return {}, obs_size
    return {"encoder": init_encoder(key, blank(observation_like(env)))}, obs_size + FEATURES


def features(params: dict[str, PyTree], obs: PyTree) -> jax.Array:
    """`obs` as one vector: what the encoder among `params` makes of it, if there is one."""
    return encoded(params["encoder"], obs) if "encoder" in params else obs


def check_observation(like: PyTree, cfg: Any) -> None:
    """Refuse settings that do not fit what is observed.

    Raises:
        ConfigError: pictures without an encoder for them, an encoder without pictures, or parts that
            no network takes.
    """
    takes = isinstance(cfg, EncoderConfig) and cfg.TAKES_PICTURES
    shows = isinstance(like, dict)
    if shows and like.keys() != {"vector", "vision"}:
        raise ConfigError("env.observation_flatten=false: expected true, learners take a vector")
    if shows and not takes:
        raise ConfigError(
            "env.observe_vision=true: this algorithm takes vectors; those that take pictures, as "
            "ppo_lag, sac_lag, seditor, dreamer and bc, have algo.encoder=cnn"
        )
    if takes and (cfg.encoder == "cnn") != shows:
        pictures = "env.observe_vision=true"
        expected = f"cnn for {pictures}" if shows else f"none, or {pictures} for pictures"
        raise ConfigError(f"algo.encoder={cfg.encoder}: expected {expected}")


def check_fits(obs: Any, like: PyTree) -> None:
    """Refuse `obs` unless it is such an observation as `like`, or a batch [...] of them.

    Raises:
        ConfigError: other parts or sizes, or something that is no observation.
    """
    found, wanted = (x if isinstance(x, dict) else {"": x} for x in (obs, like))
    arrays = all(isinstance(x, jax.Array | np.ndarray) for x in found.values())
    fits = arrays and found.keys() == wanted.keys()
    if fits:
        batches = {name: found[name].ndim - x.ndim for name, x in wanted.items()}
        fits = all(found[name].shape[max(0, batches[name]) :] == x.shape for name, x in wanted.items())
        fits = fits and len({found[name].shape[:batch] for name, batch in batches.items()}) == 1
    if not fits:
        raise ConfigError(
            f"the observation is {parts_in_words(obs)}, expected {parts_in_words(like)} or a batch of "
            "them, as run.env() observes"
        )


def parts_in_words(obs: Any) -> str:
    """'vector [60], vision [64, 64, 3]': the parts of an observation, by their shapes."""
    if isinstance(obs, dict):
        return ", ".join(f"{name} {parts_in_words(x)}" for name, x in sorted(obs.items()))
    shaped = isinstance(obs, jax.Array | np.ndarray | jax.ShapeDtypeStruct)
    return str([*obs.shape]) if shaped else f"a {type(obs).__name__}"
