"""What a method adds to the loops with a replay or a data set: a `Learner`, and the policy it makes."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from jaxsafe.learn.acting import Learned
from jaxsafe.learn.normalise import normalise
from jaxsafe.learn.replay import Transitions
from jaxsafe.types import Metrics, Policy, PyTree


class Fit(NamedTuple):
    """What gradient steps move."""

    params: dict[str, PyTree]
    opt_state: dict[str, PyTree]


class Turn(NamedTuple):
    """Of one gradient step: how many were due before it, int32 []; what share of training is left,
    float []; a key, this device's own."""

    count: jax.Array
    left: jax.Array
    key: jax.Array


class Learner(NamedTuple):
    """What a method adds to the loop. Observations are normalised before they come here.

    init(key, obs_size, action_size, cfg) -> Fit.
    act(params, obs [..., O], key, cfg) -> action [..., A], the mean one where key is None.
    explore(params, obs [N, O], key, cfg) -> action [N, A], how training acts.
    step(fit, batch, turn, cfg, axis_name) -> (Fit, metrics), one gradient step. The weights of `batch`
        sum to 1 over a device's share, on average over devices: a mean is `pmean((weight * x).sum())`.
    """

    init: Callable[[jax.Array, int, int, Any], Fit]
    act: Callable[[PyTree, jax.Array, jax.Array | None, Any], jax.Array]
    explore: Callable[[PyTree, jax.Array, jax.Array, Any], jax.Array]
    step: Callable[[Fit, Transitions, Turn, Any, str | None], tuple[Fit, Metrics]]


def policy_by(learner: Learner) -> Policy:
    """The policy of a learner: it remembers nothing."""

    def act(
        learned: Learned, carry: PyTree, obs: jax.Array, key: jax.Array | None
    ) -> tuple[jax.Array, PyTree, dict[str, Any]]:
        now = seen(learned.normaliser, obs, learned.config)
        return learner.act(learned.params, now, key, learned.config), carry, {}

    return Policy(init=lambda learned: (), act=act)


def seen(normaliser: PyTree, obs: jax.Array, cfg: Any) -> jax.Array:
    """`obs` [..., O] as the networks see it."""
    return normalise(normaliser, obs) if cfg.obs_normalize else obs
