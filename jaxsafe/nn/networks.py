"""The on-policy networks: a Gaussian policy, and a critic each for reward and for cost.

`trunk` 'separate': each is a network of its own. 'shared': they are one, with common hidden layers.
'gru': they are one with a memory, in whose hidden layers the last is a gated recurrent unit.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxsafe.nn.cnn import CNN
from jaxsafe.nn.gaussian import Gaussian
from jaxsafe.nn.initializers import INITS
from jaxsafe.nn.recurrent import Recurrent, Sequences, unroll
from jaxsafe.types import PyTree

# range of a std that depends on the state; Haarnoja et al. (2018), the code of "Soft Actor-Critic"
LOG_STD = (-20.0, 2.0)
ALIGNED = 8  # numbers, of at least 2 bytes each
ALIGNED_FROM = 128  # smaller matrices gain nothing


class MLP(nn.Module):
    """Layers of `activation` and a linear one, float [..., I] -> [..., out].

    Of an observation with a picture, a dict, a `CNN` first makes a vector.

    weights 'orthogonal': gain sqrt(2), `gain` for the last layer, zero biases (Andrychowicz et al.,
    2021, "What Matters in On-Policy Reinforcement Learning?"). 'torch': weights and biases uniform
    in +-1 / sqrt(fan in), PyTorch's default, OmniSafe's kaiming_uniform with a = sqrt(5). 'fan_in': the
    same weights, zero biases. 'xavier': uniform in +-sqrt(6 / (fan in + fan out)), zero biases (Glorot
    and Bengio, 2010).

    layer_norm: normalise what each hidden layer gives to its activation (Ba et al., 2016), without
        their gain and bias: the gradients of these are sums over the batch, slow on a GPU.
    precision: of the products. On a GPU JAX's default rounds them to 10 bits, too few for KLs of
        1e-2.
    hidden_dtype: of the hidden layers' products and outputs. Weights, sums within a layer norm and the
        last layer are float32 all the same.
    """

    hidden: tuple[int, ...]
    out: int
    weights: str
    activation: str
    gain: float = 1.0
    layer_norm: bool = False
    precision: jax.lax.Precision = jax.lax.Precision.HIGHEST
    hidden_dtype: str = "float32"

    @nn.compact
    def __call__(self, x: PyTree) -> jax.Array:
        if isinstance(x, dict):
            x = CNN(self.precision, name="encoder")(x)
        for size in self.hidden:
            x = self._dense(size, math.sqrt(2.0), x.shape[-1], self.hidden_dtype)(x)
            if self.layer_norm:
                x = nn.LayerNorm(use_scale=False, use_bias=False, dtype=self.hidden_dtype)(x)
            x = ACTIVATIONS[self.activation](x)
        return self._dense(self.out, self.gain, x.shape[-1], "float32")(x)

    def _dense(self, size: int, gain: float, fan_in: int, dtype: str) -> nn.Dense:
        kernel, bias = INITS[self.weights](gain, fan_in)
        coarse = self.precision != jax.lax.Precision.HIGHEST
        return nn.Dense(
            size,
            precision=self.precision,
            dtype=dtype,
            kernel_init=kernel,
            bias_init=bias,
            dot_general=aligned_dot if coarse and jax.default_backend() != "cpu" else None,
        )


def aligned_dot(x: jax.Array, weight: jax.Array, *args: Any, **kwargs: Any) -> jax.Array:
    """`dot_general` of `x` [..., I] and `weight` [I, O], whose large I and O are filled up with zeros.

    A GPU's matrix units want rows of whole 16 bytes. Rows of 750 numbers are none: their product takes
    three times as long as that of 752 (docs/performance.md).
    """
    inputs, outputs = (-n % ALIGNED if n > ALIGNED_FROM else 0 for n in weight.shape)
    x = jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, inputs)])
    filled = jnp.pad(weight, ((0, inputs), (0, outputs)))
    return jax.lax.dot_general(x, filled, *args, **kwargs)[..., : weight.shape[1]]


ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {"tanh": nn.tanh, "relu": nn.relu}


def mlp(cfg: Any, out: int, gain: float = 1.0) -> MLP:
    return MLP(cfg.hidden, out, cfg.init, cfg.activation, gain)


def coarse_mlp(cfg: Any, out: int, layer_norm: bool = False) -> MLP:
    """With products in the device's own precision (TensorFloat-32 on a GPU), or in that of
    `hidden_dtype`: enough for Q-learning and imitation, which bound no KL."""
    return MLP(
        cfg.hidden,
        out,
        cfg.init,
        cfg.activation,
        layer_norm=layer_norm,
        precision=jax.lax.Precision.DEFAULT,
        hidden_dtype=cfg.hidden_dtype,
    )


def initial_log_std(action_size: int, cfg: Any) -> jax.Array:
    """log(exp(init_log_std) - min_std) [A], so that the deviation starts at exp(init_log_std)."""
    learned = cfg.init_log_std + jnp.log1p(-cfg.min_std * jnp.exp(-cfg.init_log_std))
    return jnp.full(action_size, learned, jnp.float32)


def policy_outputs(action_size: int, cfg: Any) -> int:
    return 2 * action_size if cfg.std == "state" else action_size


def init_params(key: jax.Array, obs: PyTree, action_size: int, cfg: Any) -> dict[str, PyTree]:
    """{'actor': {'mean', 'log_std' [A]}, 'critic_r', 'critic_c'}, for observations like `obs`.

    'mean' is the policy's network. With `std` 'state' the second half of its outputs is added to
    log_std; on a common trunk the last outputs are values.
    """
    keys = jax.random.split(key, 3)
    actor = {
        "mean": mlp(cfg, policy_outputs(action_size, cfg), gain=0.01).init(keys[0], obs),
        "log_std": initial_log_std(action_size, cfg),
    }
    critic_r, critic_c = (mlp(cfg, 1).init(key, obs) for key in keys[1:])
    return {"actor": actor, "critic_r": critic_r, "critic_c": critic_c}


def stack(of_reward: jax.Array, of_cost: jax.Array) -> jax.Array:
    """[1 + K, ...] of [...] and [K, ...]; or [2, ...] of two alike."""
    return jnp.concatenate([of_reward[None], of_cost.reshape(-1, *of_reward.shape)])


def stack_critics(params: dict[str, PyTree]) -> PyTree:
    """All critics in one tree, [2, ...] or [1 + K, ...], so that they train in one program."""
    return jax.tree.map(stack, params["critic_r"], params["critic_c"])


def share_trunk(params: dict[str, PyTree], cfg: Any) -> dict[str, PyTree]:
    """{'actor'} alone: the policy's hidden layers, with the critics' outputs after its own."""
    layers, last = params["actor"]["mean"]["params"], f"Dense_{len(cfg.hidden)}"
    joined = jax.tree.map(
        lambda policy, critics: jnp.concatenate([policy, jnp.moveaxis(critics[..., 0], 0, -1)], -1),
        layers[last],
        stack_critics(params)["params"][last],
    )
    return {"actor": params["actor"] | {"mean": {"params": layers | {last: joined}}}}


def recurrent(cfg: Any, action_size: int, critics: int) -> Recurrent:
    """The network of `trunk` 'gru': hidden layers, of which the last is the unit, then two heads."""
    *before, size = cfg.hidden
    encoder = (
        MLP(tuple(before[:-1]), before[-1], cfg.init, cfg.activation, math.sqrt(2)) if before else None
    )
    heads = [(policy_outputs(action_size, cfg), 0.01), (critics, 1.0)]
    linear = tuple(MLP((), out, cfg.init, cfg.activation, gain) for out, gain in heads)
    return Recurrent(encoder, ACTIVATIONS[cfg.activation], size, linear)


def init_recurrent(
    key: jax.Array, obs: jax.Array, action_size: int, critics: int, cfg: Any
) -> dict[str, PyTree]:
    """{'actor': {'mean', 'log_std' [A]}} alone; the critics are in 'mean', too."""
    net = recurrent(cfg, action_size, critics)
    return {
        "actor": {
            "mean": net.init(key, jnp.zeros(cfg.hidden[-1]), obs),
            "log_std": initial_log_std(action_size, cfg),
        }
    }


def net_of(actor: PyTree, cfg: Any) -> Recurrent:
    """The network that has the parameters `actor`."""
    critics = actor["mean"]["params"]["heads_1"]["Dense_0"]["bias"].shape[-1]
    return recurrent(cfg, actor["log_std"].shape[-1], critics)


def outputs(actor: PyTree, inputs: Any, cfg: Any) -> tuple[jax.Array, jax.Array]:
    """What the actor's network gives: the policy's outputs and, of a common trunk, the critics' values
    of reward and of each cost, float [..., 1 + K].

    Args:
        inputs: observations [..., O] or, for a recurrent network, `Sequences`.
    """
    size = policy_outputs(actor["log_std"].shape[-1], cfg)
    if cfg.trunk == "gru":
        out: Any = unroll(net_of(actor, cfg), actor["mean"], inputs)[1]
    else:
        last = actor["mean"]["params"][f"Dense_{len(cfg.hidden)}"]
        out = mlp(cfg, last["bias"].shape[-1]).apply(actor["mean"], inputs)
    return out[..., :size], out[..., size:]


def action_dist(actor: PyTree, inputs: Any, cfg: Any) -> Gaussian:
    """The policy's action distribution; its mean and log std are [..., A].

    Args:
        inputs: observations [..., O] or, for a recurrent network, `Sequences`.
    """
    return distribution(actor, outputs(actor, inputs, cfg)[0], cfg)


def recurrent_step(
    actor: PyTree, carry: jax.Array, obs: jax.Array, cfg: Any
) -> tuple[jax.Array, Gaussian, jax.Array]:
    """One step of a recurrent network: what it remembers [..., H], the action distribution, values."""
    size = policy_outputs(actor["log_std"].shape[-1], cfg)
    found: Any = net_of(actor, cfg).apply(actor["mean"], carry, obs)
    carry, out = found
    return carry, distribution(actor, out[..., :size], cfg), out[..., size:]


def distribution(actor: PyTree, out: jax.Array, cfg: Any) -> Gaussian:
    """The Gaussian of a policy's outputs, of standard deviation

        min_std + exp(log_std)

    `log_std` is a parameter or, with `std` 'state', the sum of a parameter and an output. Samples,
    entropy and KLs are those of the whole deviation.

    A maximum in place of the sum would have no gradient below the floor: a deviation that sank there
    could never rise again. With the sum log_std has a share (std - min_std) / std of the gradient, and
    the square of that share of the Fisher information. Near the floor this is small beside the damping
    of a trust region.

    Source: Freeman et al. (2021), "Brax - A Differentiable Physics Engine for Large Scale Rigid Body
        Simulation", arXiv:2106.13281, the authors' code, for the sum.
    """
    mean, log_std = out, actor["log_std"]
    if cfg.std == "state":
        mean, change = jnp.split(out, 2, axis=-1)
        log_std = jnp.clip(log_std + change, *LOG_STD)
    log_std = jnp.logaddexp(log_std, jnp.log(cfg.min_std))
    return Gaussian(mean, jnp.broadcast_to(log_std, mean.shape))


def value(critic: PyTree, obs: PyTree, cfg: Any) -> jax.Array:
    """A critic's estimate for `obs` [..., O], float [...], in units of reward or of cost."""
    out: Any = mlp(cfg, 1).apply(critic, obs)
    return out[..., 0]


def values(params: dict[str, PyTree], obs: PyTree, cfg: Any) -> jax.Array:
    """The values of reward and of each cost, float [..., 1 + K], of a network without memory."""
    if cfg.trunk == "shared":
        return outputs(params["actor"], obs, cfg)[1]
    return jax.vmap(lambda critic: value(critic, obs, cfg), out_axes=-1)(stack_critics(params))


class RolloutOutputs(NamedTuple):
    """What the networks give for a rollout of T steps in N environments.

    inputs: what `policy` takes to compute `dist` anew: observations [T, N, O], or `Sequences` of N.
    dist: the action distribution [T, N, A].
    value, next_value: float [T, N, 1 + K], of the observation before and after each step.
    """

    inputs: Any
    dist: Gaussian
    value: jax.Array
    next_value: jax.Array


def apply_to_rollout(
    params: dict[str, PyTree],
    obs: PyTree,
    next_obs: PyTree,
    first: jax.Array,
    carry: PyTree,
    cfg: Any,
) -> RolloutOutputs:
    """The networks' outputs for a rollout.

    Args:
        obs, next_obs: [T, N, ...], before and after each step, before any reset.
        first: bool [T, N], where an episode begins.
        carry: what the policy remembered before the rollout: [N, H], or () without a memory.
    """
    actor = params["actor"]
    if cfg.trunk != "gru":

        def of_step(seen: PyTree, after: PyTree) -> tuple[Gaussian, jax.Array, jax.Array]:
            return action_dist(actor, seen, cfg), values(params, seen, cfg), values(params, after, cfg)

        if isinstance(obs, dict):  # pictures of one step at a time, to save memory
            return RolloutOutputs(obs, *jax.lax.map(lambda x: of_step(*x), (obs, next_obs)))
        return RolloutOutputs(obs, *of_step(obs, next_obs))
    inputs = Sequences(jnp.swapaxes(obs, 0, 1), jnp.swapaxes(first, 0, 1), carry)
    h, out = unroll(net_of(actor, cfg), actor["mean"], inputs)
    h, out = jnp.swapaxes(h, 0, 1), jnp.swapaxes(out, 0, 1)
    size = policy_outputs(actor["log_std"].shape[-1], cfg)
    _, _, next_v = recurrent_step(actor, h, next_obs, cfg)
    return RolloutOutputs(inputs, distribution(actor, out[..., :size], cfg), out[..., size:], next_v)
