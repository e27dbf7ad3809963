"""What a method adds to the loops with a replay or a data set: a `Learner`, and the policy it makes."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from jaxsafe.learn.acting import Learned
from jaxsafe.learn.normalise import network_inputs
from jaxsafe.learn.steps import Trainable
from jaxsafe.types import Metrics, Policy, PyTree


class GradientStep(NamedTuple):
    """What a gradient step knows of the moment in which it is taken.

    number: int32 [], gradient steps of the run that were due before this one.
    remaining: float [], the share of training that is left: 1 at first, 0 at the end.
    key: a random key, for this step on this device.
    dual: the state of the treatment of the constraint, () without one.
    first_obs: of a data set, float [B, O]: observations at which its episodes begin, normalised; ()
        where none is known.
    """

    number: jax.Array
    remaining: jax.Array
    key: jax.Array
    dual: PyTree = ()
    first_obs: PyTree = ()


class Learner(NamedTuple):
    """What a method adds to the loop. Observations are normalised before they come here.

    init(key, obs_size, action_size, cfg) -> Trainable.
    act(learned, obs [..., O], key) -> action [..., A], the mean one where key is None. `learned` holds
        networks, `params`, the treatment's state, `dual`, and `config`.
    step(nets, batch, at, cfg, axis_name) -> (Trainable, metrics), one gradient step on Transitions or
        on what `replayed` gives. The weights of `batch` sum to 1 over a device's share, on average over
        devices: a mean is `pmean((weight * x).sum())`.
    explore(learned, obs [N, O], key) -> action [N, A], how training acts; None: as `act`.
    replayed(key, ring, span, normaliser, rows, cfg, axis_name) -> (batch, number dropped), what a
        gradient step takes of a replay, from so many rows. None: Transitions.
    """

    init: Callable[[jax.Array, int, int, Any], Trainable]
    act: Callable[[Learned, jax.Array, jax.Array | None], jax.Array]
    step: Callable[[Trainable, Any, GradientStep, Any, str | None], tuple[Trainable, Metrics]]
    explore: Callable[[Learned, jax.Array, jax.Array], jax.Array] | None = None
    replayed: Callable[..., tuple[Any, jax.Array]] | None = None


def policy_by(learner: Learner) -> Policy:
    """The policy of a learner: it remembers nothing."""

    def act(
        learned: Learned, carry: PyTree, obs: jax.Array, key: jax.Array | None
    ) -> tuple[jax.Array, PyTree, dict[str, Any]]:
        inputs = network_inputs(learned.normaliser, obs)
        return learner.act(learned, inputs, key), carry, {}

    return Policy(init=lambda learned: (), act=act)
