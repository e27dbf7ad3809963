"""How weights and biases are drawn."""

import math
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

# (key, shape, dtype) -> array
Initializer = Callable[..., jax.Array]


def orthogonal(gain: float = 1.0) -> Initializer:
    """Flax's, one matrix at a time under `vmap`.

    XLA spreads a batch of factorisations over the same threads of the CPU that run its programs. Where
    the layers of several networks and members are factorised at once, all threads wait for each other
    and the program never ends: on two cores always with two members of 9 layers of 64 units (jaxlib
    0.10.2).
    """
    draw = nn.initializers.orthogonal(gain)

    def init(key: jax.Array, shape: Any, dtype: Any = jnp.float32) -> jax.Array:
        return jax.custom_batching.sequential_vmap(lambda key: draw(key, shape, dtype))(key)

    return init


def torch_uniform(fan_in: int) -> Initializer:
    def init(key: jax.Array, shape: Any, dtype: Any = jnp.float32) -> jax.Array:
        return jax.random.uniform(key, shape, dtype, -1 / math.sqrt(fan_in), 1 / math.sqrt(fan_in))

    return init


# name -> (gain, fan in) -> of weights and of biases
INITS: dict[str, Callable[[float, int], tuple[Initializer, Initializer]]] = {
    "orthogonal": lambda gain, fan_in: (orthogonal(gain), nn.initializers.zeros),
    "torch": lambda gain, fan_in: (torch_uniform(fan_in), torch_uniform(fan_in)),
    "fan_in": lambda gain, fan_in: (torch_uniform(fan_in), nn.initializers.zeros),
    "xavier": lambda gain, fan_in: (nn.initializers.xavier_uniform(), nn.initializers.zeros),
}
