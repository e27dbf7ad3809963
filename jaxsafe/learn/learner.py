"""What a method adds to the loops with a replay or a data set: a `Learner`, and the policy it makes."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxsafe.learn.acting import Learned
from jaxsafe.learn.constraints import Costs
from jaxsafe.learn.next_step_rollout import Stepping, arrival_record
from jaxsafe.learn.normalise import network_inputs
from jaxsafe.learn.replay import Record, Source, Transitions, draw, transitions, usable
from jaxsafe.learn.steps import Trainable
from jaxsafe.types import Env, Metrics, Policy, PyTree, Shared


class GradientStep(NamedTuple):
    """What a gradient step knows of the moment in which it is taken.

    number: int32 [], gradient steps of the run that were due before this one.
    remaining: float [], the share of training that is left: 1 at first, 0 at the end.
    key: a random key, for this step on this device.
    dual: the state of the treatment of the constraint, () without one.
    first_obs: of a data set, float [B, O]: observations at which its episodes begin, normalised; ()
        where none is known.
    ranges: of a data set, (low, high) for reward and for cost, between which values lie; () elsewhere.
    """

    number: jax.Array
    remaining: jax.Array
    key: jax.Array
    dual: PyTree = ()
    first_obs: PyTree = ()
    ranges: PyTree = ()


def drawn_transitions(
    key: jax.Array, source: Source, cfg: Any, axis_name: str | None
) -> tuple[Transitions, jax.Array]:
    """A batch of transitions with normalised observations, and how many of them are not finite."""
    index = draw(key, source.ring, source.span, source.rows)
    discounts = {"discount": cfg.discount, "cost_discount": cfg.cost_discount}
    found = transitions(source.ring, source.span, index, n_step=source.n_step, **discounts)
    batch, dropped = usable(found, axis_name)
    obs, next_obs = (network_inputs(source.normaliser, x) for x in (batch.obs, batch.next_obs))
    return batch._replace(obs=obs, next_obs=next_obs), dropped


def by_policy(learned: Learned, obs: jax.Array, key: jax.Array | None) -> jax.Array:
    raise TypeError("this learner acts by its policy")


class Learner(NamedTuple):
    """What a method adds to the loop.

    `step`, `act` and `explore` see normalised observations; `policy`, `record` and `refit` see them as
    the environment gives them.

    init(key, obs_size, action_size, cfg) -> Trainable.
    step(nets, batch, at, cfg, axis_name) -> (Trainable, metrics), one gradient step on Transitions or
        on what `replayed` gives. The weights of `batch` sum to 1 over a device's share, on average over
        devices: a mean is `pmean((weight * x).sum())`.
    act(learned, obs [..., O], key) -> action [..., A], the mean one where key is None. `learned` holds
        networks, `params`, the treatment's state, `dual`, and `config`.
    explore(learned, obs [N, O], key, remaining []) -> action [N, A], how training acts while a share
        `remaining` of it is left; None: as `act`.
    random_start(learned) -> bool [], whether actions are random during the warm-up.
    policy: for methods that remember something, or that look into the simulator. They act and explore
        by this policy. `act` and `explore` are then not used.
    refit(nets, replay, shared, key, cfg, axis_name) -> (Trainable, metrics), after the rounds of an
        iteration; None where there is nothing to refit.
    record(cfg) -> what makes a row of the replay: (stepping, action [N, A]) -> Record.
    replayed(key, source, cfg, axis_name) -> (batch, number dropped), what a gradient step draws from a
        replay.
    counted(env, steps [T, N], cfg) -> {name: bool [T, N]}, real steps that metrics count.
    """

    init: Callable[[jax.Array, int, int, Any], Trainable]
    step: Callable[[Trainable, PyTree, GradientStep, Any, str | None], tuple[Trainable, Metrics]]
    act: Callable[[Learned, jax.Array, jax.Array | None], jax.Array] = by_policy
    explore: Callable[[Learned, jax.Array, jax.Array, jax.Array], jax.Array] | None = None
    random_start: Callable[[Learned], jax.Array] = lambda learned: jnp.bool_(True)
    policy: Policy | None = None
    refit: (
        Callable[[Trainable, PyTree, Shared, jax.Array, Any, str | None], tuple[Trainable, Metrics]]
        | None
    ) = None
    record: Callable[[Any], Callable[[Stepping, jax.Array], Record]] = lambda cfg: arrival_record
    replayed: Callable[[jax.Array, Source, Any, str | None], tuple[PyTree, jax.Array]] = (
        drawn_transitions
    )
    counted: Callable[[Env, Costs, Any], dict[str, jax.Array]] = lambda env, steps, cfg: {}


def policy_by(learner: Learner) -> Policy:
    """The policy of a learner: its own, or else one that remembers nothing."""
    if learner.policy is not None:
        return learner.policy

    def act(
        learned: Learned, carry: PyTree, obs: jax.Array, key: jax.Array | None
    ) -> tuple[jax.Array, PyTree, dict[str, Any]]:
        inputs = network_inputs(learned.normaliser, obs)
        return learner.act(learned, inputs, key), carry, {}

    return Policy(init=lambda learned: (), act=act)
