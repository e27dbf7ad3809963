"""Playing a policy: what training, evaluation, films, the live view and adapters have in common."""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from jaxsafe.types import Env, Policy, PyTree, State


@flax.struct.dataclass
class Learned:
    """What acts: `config`, `params`, `dual` and `normaliser` of a train state."""

    config: Any
    params: dict[str, PyTree]
    dual: PyTree
    normaliser: PyTree


def learned_of(ts: Any) -> Learned:
    """What acts, of a train state that has its fields."""
    return Learned(ts.config, ts.params, ts.dual, ts.normaliser)


class Player(NamedTuple):
    """A policy with its parameters, in the environment whose observations it takes."""

    policy: Policy
    params: PyTree
    task: Env

    def begin(self) -> PyTree:
        """The carry at the start of an episode."""
        return self.policy.init(self.params)

    def act(
        self, carry: PyTree, state: State, key: jax.Array | None = None
    ) -> tuple[jax.Array, PyTree]:
        """The action [A] in one `state`, without a batch axis, and the next carry.

        Args:
            key: to sample with; None is the mean action.
        """
        seen = state if self.policy.privileged else state.obs
        action, carry, _ = self.policy.act(self.params, carry, seen, key)
        return action, carry


def reflex(act: Callable[[jax.Array], jax.Array], task: Env) -> Player:
    """A player that remembers nothing, from a function: obs [O] -> action [A]."""
    policy = Policy(lambda params: (), lambda params, carry, obs, key: (act(obs), (), {}))
    return Player(policy, (), task)


def begun_anew(policy: Policy, params: PyTree, carry: PyTree, first: jax.Array) -> PyTree:
    """`carry` [N, ...] with that of a new episode where `first` [N] holds."""
    new = policy.init(params)

    def pick(old: jax.Array, start: jax.Array) -> jax.Array:
        return jnp.where(first.reshape(first.shape + (1,) * (old.ndim - 1)), start, old)

    return jax.tree.map(pick, carry, new)
