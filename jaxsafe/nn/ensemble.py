"""An ensemble of networks with Gaussian outputs: M models as one network with a leading axis.

    h_0 = (x - mean) / std,   h_l+1 = swish(h_l W_l + b_l),   (mu, v) = h_L W_L + b_L
    log sigma^2 = low + softplus(u - low),   u = high - softplus(high - v)

`low` and `high` are learned, one pair for each output of each model.

Source: Chua et al. (2018), "Deep Reinforcement Learning in a Handful of Trials using Probabilistic
    Dynamics Models", arXiv:1805.12114, and the authors' code.
"""

import flax.struct
import jax
import jax.numpy as jnp

from jaxsafe.nn import drawn
from jaxsafe.nn.gaussian import Gaussian, sample

FIRST_LOG_VAR = (-10.0, 0.5)  # low and high before training, as in the authors' code
PRESSURE = 0.01  # on the sum of high - low, likewise


@flax.struct.dataclass
class Layer:
    """weight: float [M, I, O]. bias: float [M, O]."""

    weight: jax.Array
    bias: jax.Array


@flax.struct.dataclass
class Ensemble:
    """What training moves. low, high: float [M, K], bounds of the log variances of K outputs."""

    layers: tuple[Layer, ...]
    low: jax.Array
    high: jax.Array


@flax.struct.dataclass
class Scale:
    """Of the inputs, float [I]: they are standardised before they enter the networks."""

    mean: jax.Array
    std: jax.Array


def init_ensemble(
    key: jax.Array, models: int, inputs: int, hidden: tuple[int, ...], outputs: int
) -> Ensemble:
    """Weights are N(0, 1 / (4 fan_in)), cut off at two standard deviations; biases are 0."""
    sizes = [inputs, *hidden, 2 * outputs]
    keys, layers = jax.random.split(key, len(sizes) - 1), []
    for layer_key, fan_in, fan_out in zip(keys, sizes[:-1], sizes[1:], strict=True):
        draw = jax.random.truncated_normal(layer_key, -2.0, 2.0, (models, fan_in, fan_out))
        layers.append(Layer(draw / (2 * fan_in**0.5), jnp.zeros((models, fan_out))))
    low, high = (jnp.full((models, outputs), x) for x in FIRST_LOG_VAR)
    return Ensemble(tuple(layers), low, high)


def unscaled(inputs: int) -> Scale:
    return Scale(jnp.zeros(inputs), jnp.ones(inputs))


def outputs_of(
    ensemble: Ensemble, scale: Scale, x: jax.Array, hidden_dtype: str = "float32"
) -> Gaussian:
    """What each model says of its own inputs `x` [M, ..., I]: mean and log std [M, ..., K].

    Args:
        hidden_dtype: of what the hidden layers give. Sums of products are float32 all the same, and so
            are the outputs.
    """

    def spaced(per_model: jax.Array) -> jax.Array:
        """[M, K] with axes of size 1 between, so that it broadcasts against [M, ..., K]."""
        return per_model.reshape(len(per_model), *(1,) * (x.ndim - 2), -1)

    def linear(layer: Layer, h: jax.Array, dtype: str) -> jax.Array:
        weight, bias = layer.weight.astype(h.dtype), spaced(layer.bias).astype(dtype)
        return jnp.einsum("m...i,mio->m...o", h, weight, preferred_element_type=dtype) + bias

    h = ((x - scale.mean) / scale.std).astype(hidden_dtype)
    for layer in ensemble.layers[:-1]:
        h = jax.nn.swish(linear(layer, h, hidden_dtype))
    mean, v = jnp.split(linear(ensemble.layers[-1], h, "float32"), 2, axis=-1)
    low, high = spaced(ensemble.low), spaced(ensemble.high)
    log_var = low + jax.nn.softplus(high - jax.nn.softplus(high - v) - low)
    return Gaussian(mean, log_var / 2)


def draw(
    ensemble: Ensemble, scale: Scale, x: jax.Array, key: jax.Array, hidden_dtype: str = "float32"
) -> tuple[jax.Array, jax.Array]:
    """One draw from each model at its own inputs `x` [M, ..., I], and the length of the vector of
    standard deviations there: [M, ..., K] and [M, ...].

    In bfloat16 a Hopper GPU does it in one kernel, with other random numbers for the same key
    (`drawn`).
    """
    weights, biases = ([getattr(x, name) for x in ensemble.layers] for name in ("weight", "bias"))
    if hidden_dtype == "bfloat16" and drawn.serves(*drawn.widths(weights)):
        x = (x - scale.mean) / scale.std
        return drawn.draw(weights, biases, ensemble.low, ensemble.high, x, key)
    dist = outputs_of(ensemble, scale, x, hidden_dtype)
    return sample(dist, key), jnp.linalg.norm(jnp.exp(dist.log_std), axis=-1)


def ensemble_loss(
    ensemble: Ensemble,
    scale: Scale,
    x: jax.Array,
    y: jax.Array,
    weight_decay: jax.Array | float,
    hidden_dtype: str = "float32",
) -> jax.Array:
    """The sum over models of

        mean[(mu - y)^2 / sigma^2 + log sigma^2] + sum_l decay_l / 2 |W_l|^2 + 0.01 sum_k (high - low)

    for inputs `x` [M, B, I] and targets `y` [M, B, K]. decay_l is `weight_decay` times 1/4, 1/2, 3/4,
    and 3/4 again for each further layer but the last, whose share is 1.
    """
    dist = outputs_of(ensemble, scale, x, hidden_dtype)
    errors = (dist.mean - y) ** 2 * jnp.exp(-2 * dist.log_std) + 2 * dist.log_std
    loss = errors.mean((1, 2)).sum() + PRESSURE * (ensemble.high - ensemble.low).sum()
    shares = [min(0.25 * (i + 1), 0.75) for i in range(len(ensemble.layers) - 1)] + [1.0]
    for share, layer in zip(shares, ensemble.layers, strict=True):
        loss += weight_decay * share / 2 * (layer.weight**2).sum()
    return loss
