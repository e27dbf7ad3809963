"""The policy of the on-policy algorithms: a Gaussian, with or without a memory, and its networks."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxsafe.learn.acting import Learned
from jaxsafe.learn.constraints import Names
from jaxsafe.learn.normalise import network_inputs
from jaxsafe.learn.steps import Trainable, adam
from jaxsafe.nn.gaussian import Gaussian, sample
from jaxsafe.nn.networks import (
    action_dist,
    init_params,
    init_recurrent,
    recurrent_step,
    share_trunk,
    stack_critics,
)
from jaxsafe.types import Policy, PyTree


def init_nets(key: jax.Array, obs: PyTree, action_size: int, names: Names, cfg: Any) -> Trainable:
    """All networks, for observations like `obs`, and the critics' optimiser: () where they share the
    policy's trunk."""
    sizes = obs, action_size
    if cfg.trunk == "gru":
        return Trainable(init_recurrent(key, *sizes, 1 + (len(names) or 1), cfg), ())
    params = init_params(key, *sizes, cfg)
    if names:
        keys = jax.random.split(jax.random.fold_in(key, 1), len(names))
        params |= {"critic_c": jax.vmap(lambda key: init_params(key, *sizes, cfg)["critic_c"])(keys)}
    if cfg.trunk == "shared":
        return Trainable(share_trunk(params, cfg), ())
    return Trainable(params, jax.vmap(adam(cfg.critic_lr, cfg).init)(stack_critics(params)))


def decide(learned: Learned, carry: PyTree, obs: PyTree) -> tuple[Gaussian, PyTree]:
    """The action distribution for `obs` [..., O] as the environment gives it, and the next carry."""
    actor, cfg = learned.params["actor"], learned.config
    inputs = network_inputs(learned.normaliser, obs)
    if cfg.trunk == "gru":
        carry, dist, _ = recurrent_step(actor, carry, inputs, cfg)
        return dist, carry
    return action_dist(actor, inputs, cfg), carry


def initial_carry(learned: Learned) -> PyTree:
    """What the policy remembers at the start of an episode."""
    return jnp.zeros(learned.config.hidden[-1]) if learned.config.trunk == "gru" else ()


def act(
    learned: Learned, carry: PyTree, obs: PyTree, key: jax.Array | None
) -> tuple[jax.Array, PyTree, dict[str, Any]]:
    dist, carry = decide(learned, carry, obs)
    return (dist.mean if key is None else sample(dist, key)), carry, {}


gaussian_policy = Policy(init=initial_carry, act=act)
