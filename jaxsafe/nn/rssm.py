"""DreamerV3's networks: a recurrent state-space model, and the heads that read its latent state.

    memory       h_t = f(h_{t-1}, z_{t-1}, a_{t-1})
    posterior    z_t ~ q(z_t | h_t, x_t),   where x_t is observed
    prior        z_t ~ p(z_t | h_t),        in imagination

f is a gated recurrent unit whose weights are blocks on the diagonal. z_t is `latents` one-hot draws
from `classes` each. Every draw is uniform with a probability of 1%, and its gradient is that of the
probabilities (straight-through). Heads read the features [h_t, z_t].

Source: Hafner et al. (2025), "Mastering Diverse Control Tasks through World Models", Nature 640,
    arXiv:2301.04104; sizes, the recurrent unit and initial weights are from the authors' code.
"""

import re
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxsafe.types import PyTree

UNIFORM = 0.01  # the probability that a draw of a latent is uniform
# names of hidden layers' weights
HIDDEN = re.compile(r"Hidden_\d+/Dense_\d+/|BlockDense_\d+/")


class Size(NamedTuple):
    """deter: of h. hidden: units of the layers about it. latents, classes: of z. units, layers: of
    encoder, decoder, actor and critic. channels: of a picture's layers, each of which halves it.
    blocks: of the recurrent unit's weights. dtype: of the products and outputs of hidden layers and of
    the recurrent unit. Weights, norms' sums, h and last layers are float32 all the same.
    """

    deter: int
    hidden: int
    classes: int
    units: int
    channels: tuple[int, ...]
    latents: int = 32
    layers: int = 3
    blocks: int = 8
    dtype: str = "float32"


def layers_of(depth: int) -> tuple[int, ...]:
    """The channels of a picture's layers."""
    return 2 * depth, 3 * depth, 4 * depth, 4 * depth


# by the number of parameters, about, that they have with a picture for observation. `300k` and, with
# more latents, `500k` are ours, for CPUs and vectors, and `tiny` is for tests
BY_COUNT = {
    "tiny": Size(32, 16, classes=4, units=16, channels=(8,), latents=4, layers=1, blocks=2),
    "300k": Size(128, 64, classes=8, units=64, channels=layers_of(4), latents=8, layers=2, blocks=4),
    "500k": Size(128, 64, classes=8, units=64, channels=layers_of(4), layers=2, blocks=4),
    "1m": Size(512, 64, classes=4, units=64, channels=layers_of(4)),
    "12m": Size(2048, 256, classes=16, units=256, channels=layers_of(16)),
    "25m": Size(3072, 384, classes=24, units=384, channels=layers_of(24)),
    "50m": Size(4096, 512, classes=32, units=512, channels=layers_of(32)),
    "100m": Size(6144, 768, classes=48, units=768, channels=layers_of(48)),
    "200m": Size(8192, 1024, classes=64, units=1024, channels=layers_of(64)),
}
# the names in Dreamer's first version and in AMBS's code, where they have 18, 37, 77 and 200 million
# parameters: the size that is nearest by ratio
NAMED = {"small": "12m", "medium": "50m", "large": "100m", "xlarge": "200m"}
SIZES = BY_COUNT | {name: BY_COUNT[size] for name, size in NAMED.items()}


class Latent(NamedTuple):
    """What the model remembers: h, float [..., D], and z, float [..., latents classes]."""

    deter: jax.Array
    stoch: jax.Array

    @property
    def features(self) -> jax.Array:
        """What heads read, float [..., F]."""
        return jnp.concatenate([self.deter, self.stoch], -1)


class Beliefs(NamedTuple):
    """Log probabilities [..., latents, classes] of z before and after the observation is seen."""

    prior: jax.Array
    posterior: jax.Array


# ---- layers ------------------------------------------------------------------------------------


def fan_in(scale: float) -> Callable[..., jax.Array]:
    return nn.initializers.variance_scaling(scale, "fan_in", "truncated_normal")


def normed(x: jax.Array) -> jax.Array:
    """Divided by the root mean square over the last axis, then SiLU, in the dtype of `x`. Call it in a
    compact `__call__`, whose module then has the scale of the norm."""
    return nn.silu(nn.RMSNorm(1e-4, dtype=x.dtype)(x))


class Hidden(nn.Module):
    """A linear layer, normalised by its root mean square, then SiLU: float [..., I] -> [..., units]."""

    units: int
    dtype: str = "float32"

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        return normed(nn.Dense(self.units, dtype=self.dtype, kernel_init=fan_in(1.0))(x))


class Head(nn.Module):
    """Hidden layers and a linear one, float [..., I] -> [..., out]. `scale` is of the last weights.
    With 0 the outputs are 0 at first. `dtype` is of the hidden layers."""

    layers: int
    units: int
    out: int
    scale: float = 1.0
    dtype: str = "float32"

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for _ in range(self.layers):
            x = Hidden(self.units, self.dtype)(x)
        last = fan_in(self.scale) if self.scale else nn.initializers.zeros
        return nn.Dense(self.out, dtype="float32", kernel_init=last)(x)


class BlockDense(nn.Module):
    """A linear layer of each block, float [..., blocks, I] -> [..., blocks, out], in `dtype`.

    shared: float [..., J], further inputs, which every block sees after its own.
    """

    out: int
    dtype: str = "float32"

    @nn.compact
    def __call__(self, x: jax.Array, shared: jax.Array | None = None) -> jax.Array:
        blocks, own = x.shape[-2:]
        inputs = own + (0 if shared is None else shared.shape[-1])
        init = nn.initializers.variance_scaling(1.0, "fan_in", "truncated_normal", batch_axis=(0,))
        kernel = self.param("kernel", init, (blocks, inputs, self.out))
        bias = self.param("bias", nn.initializers.zeros, (blocks, self.out))
        x, shared, kernel, bias = jax.tree.map(
            lambda x: x.astype(self.dtype), (x, shared, kernel, bias)
        )
        y = jnp.einsum("...bi,bio->...bo", x, kernel[:, :own])
        if shared is not None:  # no copy of them for each block
            y += jnp.einsum("...j,bjo->...bo", shared, kernel[:, own:])
        return y + bias


class Memory(nn.Module):
    """(latent, a) -> the next h, [..., D]: a gated recurrent unit whose weights are blocks.

    u = [W_h h, W_z z, W_a a],   x_k = W_k [h_k, u] for each block k,   y = SiLU(norm(x)), of all blocks
    r, c, g = V_k y_k;   h <- sigmoid(g - 1) tanh(sigmoid(r) c) + (1 - sigmoid(g - 1)) h
    """

    size: Size

    @nn.compact
    def __call__(self, latent: Latent, action: jax.Array) -> jax.Array:
        blocks, width, dtype = self.size.blocks, self.size.deter // self.size.blocks, self.size.dtype
        parts = (latent.deter, latent.stoch, action)
        u = jnp.concatenate([Hidden(self.size.hidden, dtype)(x) for x in parts], -1)

        def split(x: jax.Array) -> jax.Array:
            return x.reshape(*x.shape[:-1], blocks, width)

        def join(x: jax.Array) -> jax.Array:
            return x.reshape(*x.shape[:-2], blocks * width)

        y = normed(join(BlockDense(width, dtype)(split(latent.deter), u)))
        gates = BlockDense(3 * width, dtype)(split(y)).astype(latent.deter.dtype)
        reset, candidate, gate = jnp.split(gates, 3, axis=-1)
        keep = 1 - nn.sigmoid(join(gate) - 1)
        return (1 - keep) * jnp.tanh(nn.sigmoid(join(reset)) * join(candidate)) + keep * latent.deter


def converted(params: PyTree, dtype: str) -> PyTree:
    """`params` with the weights of hidden layers in `dtype`, as their products read them. XLA converts
    a weight that a loop reads at each step anew, and so do this once, before the loop."""

    def one(path: tuple[Any, ...], x: jax.Array) -> jax.Array:
        return x.astype(dtype) if HIDDEN.search("/".join(key.key for key in path)) else x

    return params if dtype == "float32" else jax.tree_util.tree_map_with_path(one, params)


# ---- categorical latents -----------------------------------------------------------------------


def log_probs(logits: jax.Array) -> jax.Array:
    """Of `logits` [..., classes], with 1% of the uniform distribution mixed in."""
    p = jax.nn.softmax(logits)
    return jnp.log((1 - UNIFORM) * p + UNIFORM / logits.shape[-1])


def draw(log_p: jax.Array, key: jax.Array | None) -> jax.Array:
    """One-hot draws from `log_p` [..., latents, classes], or the likeliest classes where `key` is None:
    float [..., latents classes], with the gradient of the probabilities."""
    found = log_p.argmax(-1) if key is None else jax.random.categorical(key, log_p)
    p = jnp.exp(log_p)
    z = jax.nn.one_hot(found, p.shape[-1]) + p - jax.lax.stop_gradient(p)
    return z.reshape(*z.shape[:-2], -1)


def kl(p: jax.Array, q: jax.Array) -> jax.Array:
    """KL(p || q), float [...], in nats, of log probabilities [..., latents, classes]."""
    return (jnp.exp(p) * (p - q)).sum((-2, -1))


# ---- the world model ---------------------------------------------------------------------------


class WorldModel(nn.Module):
    """The model with its heads. Axes in front of those of one step are free.

    encoder: observation -> float [..., E].
    decoder: latent -> what it makes of it; `decoder.loss(that, obs)` -> float [...].
    heads: name -> how many numbers it gives.
    """

    size: Size
    encoder: nn.Module
    decoder: nn.Module
    heads: tuple[tuple[str, int], ...]

    def setup(self) -> None:
        z = self.size.latents * self.size.classes
        self.memory = Memory(self.size)
        hidden, units, dtype = self.size.hidden, self.size.units, self.size.dtype
        self.before = Head(2, hidden, z, dtype=dtype)
        self.after = Head(1, hidden, z, dtype=dtype)
        self.readers = {name: Head(1, units, out, scale=0.0, dtype=dtype) for name, out in self.heads}

    def embed(self, obs: Any) -> jax.Array:
        return self.encoder(obs)

    def observe(
        self, latent: Latent, action: jax.Array, embedded: jax.Array, key: jax.Array | None
    ) -> Latent:
        """The latent of an observation that came of `action` from `latent`. `key` None takes the
        likeliest one."""
        h = self.memory(latent, within(action))
        return Latent(h, draw(self._posterior(h, embedded), key))

    def beliefs(self, h: jax.Array, embedded: jax.Array) -> Beliefs:
        """What is believed of z in the memory `h`, before and after an observation."""
        return Beliefs(self._beliefs(self.before, h), self._posterior(h, embedded))

    def imagine(self, latent: Latent, action: jax.Array, key: jax.Array) -> Latent:
        """A latent that may come of `action` from `latent`."""
        h = self.memory(latent, within(action))
        return Latent(h, draw(self._beliefs(self.before, h), key))

    def decode(self, latent: Latent) -> Any:
        return self.decoder(latent)

    def read(self, features: jax.Array) -> dict[str, jax.Array]:
        """What each head gives, float [..., out]."""
        return {name: head(features) for name, head in self.readers.items()}

    def everything(self, obs: Any, action: jax.Array) -> Any:
        """Runs all parts once, which makes their parameters."""
        embedded = self.embed(obs)
        latent = self.observe(self.start(), action, embedded, None)
        return self.beliefs(latent.deter, embedded), self.decode(latent), self.read(latent.features)

    def start(self) -> Latent:
        """The latent before the first observation of an episode."""
        return Latent(jnp.zeros(self.size.deter), jnp.zeros(self.size.latents * self.size.classes))

    def _posterior(self, h: jax.Array, embedded: jax.Array) -> jax.Array:
        return self._beliefs(self.after, jnp.concatenate([h, embedded], -1))

    def _beliefs(self, head: nn.Module, x: jax.Array) -> jax.Array:
        logits = head(x)
        return log_probs(logits.reshape(*logits.shape[:-1], self.size.latents, self.size.classes))


def within(action: jax.Array) -> jax.Array:
    """`action` as environments take it, in [-1, 1]. Its gradient does not vanish at the bounds."""
    return action / jax.lax.stop_gradient(jnp.maximum(1.0, jnp.abs(action)))
