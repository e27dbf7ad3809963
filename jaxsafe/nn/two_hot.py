"""Numbers of any size as distributions over fixed values, so that a loss never depends on their scale.

A head gives 255 logits. They belong to the values b_k = symexp(20 (k - 127) / 127). A target between
two neighbouring values is a mixture of both, whose mean is the target.

    symlog(x) = sign(x) log(1 + |x|),   symexp(x) = sign(x) (exp|x| - 1)

Source: Hafner et al. (2025), "Mastering Diverse Control Tasks through World Models", Nature 640;
    the values' spacing and the summation are from the authors' code.
"""

import jax
import jax.numpy as jnp
import numpy as np

HALF = 127  # values on each side of 0
BINS = 2 * HALF + 1
LARGEST = np.expm1(20 * np.arange(1, HALF + 1) / HALF).astype(np.float32)  # b_k above 0
VALUES = np.concatenate([-LARGEST[::-1], np.zeros(1, np.float32), LARGEST])


def symlog(x: jax.Array) -> jax.Array:
    return jnp.sign(x) * jnp.log1p(jnp.abs(x))


def symexp(x: jax.Array) -> jax.Array:
    return jnp.sign(x) * jnp.expm1(jnp.abs(x))


def two_hot(x: jax.Array) -> jax.Array:
    """The distribution, float [..., 255], whose mean is `x` [...] and that has two neighbours alone."""
    below = jnp.clip((x[..., None] >= VALUES).sum(-1) - 1, 0, BINS - 2)
    low, high = jnp.asarray(VALUES)[below], jnp.asarray(VALUES)[below + 1]
    share = jnp.clip((x - low) / (high - low), 0.0, 1.0)[..., None]
    return (1 - share) * jax.nn.one_hot(below, BINS) + share * jax.nn.one_hot(below + 1, BINS)


def two_hot_mean(logits: jax.Array) -> jax.Array:
    """The mean, float [...], of `logits` [..., 255]. Opposite values are paired before they are summed,
    so that equal logits give exactly 0."""
    p = jax.nn.softmax(logits)
    return ((p[..., HALF + 1 :] - p[..., :HALF][..., ::-1]) * LARGEST).sum(-1)


def two_hot_loss(logits: jax.Array, x: jax.Array) -> jax.Array:
    """-log p(x), float [...], of `logits` [..., 255]: the cross-entropy with `two_hot(x)`."""
    return -(two_hot(x) * jax.nn.log_softmax(logits)).sum(-1)
