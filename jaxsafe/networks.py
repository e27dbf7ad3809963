"""The on-policy networks: a Gaussian policy, and a critic each for reward and for cost."""

import math
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxsafe.gaussian import Gaussian
from jaxsafe.types import PyTree


class MLP(nn.Module):
    """Tanh layers and a linear one, float [..., I] -> [..., out].

    weights 'orthogonal': gain sqrt(2), `gain` for the last layer, zero biases (Andrychowicz et al.,
    2021, "What Matters in On-Policy Reinforcement Learning?"). 'torch': weights and biases uniform
    in +-1 / sqrt(fan in), PyTorch's default, OmniSafe's kaiming_uniform with a = sqrt(5).
    """

    hidden: tuple[int, ...]
    out: int
    weights: str
    gain: float = 1.0

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for size in self.hidden:
            x = nn.tanh(self._dense(size, math.sqrt(2.0), x.shape[-1])(x))
        return self._dense(self.out, self.gain, x.shape[-1])(x)

    def _dense(self, size: int, gain: float, fan_in: int) -> nn.Dense:
        kernel, bias = INITS[self.weights](gain, fan_in)
        # full float32: on a GPU the default rounds products to 10 bits, too few for KLs of 1e-2
        return nn.Dense(size, precision=jax.lax.Precision.HIGHEST, kernel_init=kernel, bias_init=bias)


def torch_uniform(fan_in: int) -> Callable[..., jax.Array]:
    def init(key: jax.Array, shape: Any, dtype: Any = jnp.float32) -> jax.Array:
        return jax.random.uniform(key, shape, dtype, -1 / math.sqrt(fan_in), 1 / math.sqrt(fan_in))

    return init


INITS = {  # name -> (gain, fan in) -> initialisers of weights and of biases
    "orthogonal": lambda gain, fan_in: (nn.initializers.orthogonal(gain), nn.initializers.zeros),
    "torch": lambda gain, fan_in: (torch_uniform(fan_in), torch_uniform(fan_in)),
}


def init_params(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> dict[str, PyTree]:
    """{'actor': {'mean', 'log_std' [A]}, 'critic_r', 'critic_c'}; the std depends on no state."""
    keys, obs = jax.random.split(key, 3), jnp.zeros(obs_size)
    actor = {
        "mean": MLP(cfg.hidden, action_size, cfg.init, gain=0.01).init(keys[0], obs),
        "log_std": jnp.full(action_size, cfg.init_log_std, jnp.float32),
    }
    critic_r, critic_c = (MLP(cfg.hidden, 1, cfg.init).init(key, obs) for key in keys[1:])
    return {"actor": actor, "critic_r": critic_r, "critic_c": critic_c}


def policy(actor: PyTree, obs: jax.Array, cfg: Any) -> Gaussian:
    """The policy's action distribution for `obs` [..., O]; its mean and log std are [..., A]."""
    mean: Any = MLP(cfg.hidden, actor["log_std"].shape[-1], cfg.init).apply(actor["mean"], obs)
    return Gaussian(mean, jnp.broadcast_to(actor["log_std"], mean.shape))


def value(critic: PyTree, obs: jax.Array, cfg: Any) -> jax.Array:
    """A critic's estimate for `obs` [..., O], float [...], in units of reward or of cost."""
    out: Any = MLP(cfg.hidden, 1, cfg.init).apply(critic, obs)
    return out[..., 0]
