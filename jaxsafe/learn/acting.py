"""Playing a policy: what training, evaluation, films, the live view and adapters have in common."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeVar

import flax.struct
import jax
import jax.numpy as jnp

from jaxsafe.learn.batch import select_rows
from jaxsafe.learn.observations import vector_of
from jaxsafe.types import Env, Policy, PyTree, State

T = TypeVar("T")

# action [N, A], carry [N, ...], what is said beside it, float [N] by name
Acted = tuple[jax.Array, PyTree, dict[str, jax.Array]]
# What acts in N environments at once, and begins its carry anew where `first` [N] holds:
# (carry, State of N, first, key) -> Acted
ActInAll = Callable[[PyTree, State, jax.Array, jax.Array], Acted]


@flax.struct.dataclass
class Learned:
    """All that a policy is made of: these fields of a train state. `params` are its networks."""

    config: Any
    params: dict[str, PyTree]
    dual: PyTree
    normaliser: PyTree


def learned_of(ts: Any) -> Learned:
    """What the policy of a train state is made of, for states that have these fields."""
    return Learned(ts.config, ts.params, ts.dual, ts.normaliser)


class Playing(NamedTuple):
    """An episode so far: its state, what the policy remembers, and whether it goes on, bool []."""

    state: State
    carry: PyTree
    alive: jax.Array


class Player(NamedTuple):
    """A policy with what it has learned, in the environment whose observations it takes."""

    policy: Policy
    learned: PyTree
    task: Env

    def begin(self) -> PyTree:
        """The carry at the start of an episode."""
        return self.policy.init(self.learned)

    def start(self, key: jax.Array) -> Playing:
        """The beginning of an episode, whose reset `key` draws."""
        return Playing(self.task.reset(key), self.begin(), jnp.bool_(True))

    def act(
        self, carry: PyTree, state: State, key: jax.Array | None = None
    ) -> tuple[jax.Array, PyTree]:
        """The action [A] in one `state`, without a batch axis, and the next carry.

        Args:
            key: to sample with; None is the mean action.
        """
        action, carry, _ = self.decide(carry, state, key)
        return action, carry

    def decide(
        self, carry: PyTree, state: State, key: jax.Array | None = None
    ) -> tuple[jax.Array, PyTree, dict[str, Any]]:
        """As `act`, and what the policy reports beside its action."""
        obs = state if self.policy.privileged(self.learned) else state.obs
        return self.policy.act(self.learned, carry, obs, key)

    def act_in_all(self, carry: PyTree, state: State, first: jax.Array, key: jax.Array) -> Acted:
        """Sampled actions in N environments: an `ActInAll`."""
        carry = reset_carry(self.policy, self.learned, carry, first)
        action, carry, said = jax.vmap(self.decide)(carry, state, jax.random.split(key, len(first)))
        return action, carry, jax.tree.map(jnp.float32, said)


class Step(NamedTuple):
    """A step of an episode: where it began, what was done there and reported beside it, what the policy
    remembers after it, and where it led."""

    now: Playing
    action: jax.Array
    said: dict[str, Any]
    carry: PyTree
    after: State


def played(
    player: Player, key: jax.Array, seen: Callable[[Step], T], sampled: bool = False, steps: int = 0
) -> tuple[State, T]:
    """An episode, pure: the state in which it begins, and what `seen` makes of each step, [T, ...].

    It goes on after its end, and what comes then may be anything, NaN included.

    Args:
        sampled: whether actions are sampled, or the mean ones. Both begin with the same reset.
        steps: T; 0 is up to the time limit.
    """
    start, times = begun(player, key), jnp.arange(steps or player.task.episode_length)
    return start.state, played_on(player, key, seen, start, times, sampled)[1]


def begun(player: Player, key: jax.Array) -> Playing:
    """The beginning of the episode that `played` plays with this key."""
    return player.start(jax.random.split(key)[0])


def played_on(
    player: Player,
    key: jax.Array,
    seen: Callable[[Step], T],
    now: Playing,
    times: jax.Array,
    sampled: bool = False,
) -> tuple[Playing, T]:
    """A stretch of the episode that `played` plays with this key: where it leads, and what `seen` makes
    of each step.

    Args:
        now: where it begins.
        times: which steps of the episode they are, int [T]: one after the other.
    """
    act_key = jax.random.split(key)[1]

    def step(now: Playing, t: jax.Array) -> tuple[Playing, T]:
        sample_key = jax.random.fold_in(act_key, t) if sampled else None
        action, carry, said = player.decide(now.carry, now.state, sample_key)
        after = player.task.step(now.state, action)
        found = seen(Step(now, action, said, carry, after))
        return Playing(after, carry, now.alive & ~after.ended), found

    return jax.lax.scan(step, now, times)


class Course(NamedTuple):
    """T steps of an episode, [T, ...]. Those after its end are not `alive`: they earn and cost 0.

    alive, terminated: bool. reward, cost: float, and costs: [T, K], of the environment's `cost_names`.
    goal_met: float, NaN where the environment counts no goals. said: by name, what the policy reports
    beside its action.
    """

    alive: jax.Array
    reward: jax.Array
    cost: jax.Array
    costs: jax.Array
    terminated: jax.Array
    goal_met: jax.Array
    said: dict[str, jax.Array]


def course(player: Player, key: jax.Array, sampled: bool = False) -> Course:
    """A whole episode, pure, of mean or of `sampled` actions."""
    return played(player, key, of_course, sampled)[1]


def of_course(step: Step) -> Course:
    """One step of a course, without the axis of time."""
    alive, after = step.now.alive, step.after
    reward, cost, costs, goal_met = (
        jnp.where(alive, x, 0.0)
        for x in (after.reward, after.cost, after.costs, after.info.get("goal_met", jnp.nan))
    )
    return Course(alive, reward, cost, costs, after.terminated & alive, goal_met, step.said)


class Play(Protocol):
    """What plays N whole episodes with each of S policies: learned [S, ...] -> [S, N, T, ...], on the
    device.

    They begin alike, whatever has been learned. Actions are the mean ones, or `sampled`. `about` says
    what they are played for, to who waits.
    """

    def __call__(self, learned: PyTree, sampled: bool, about: str = "") -> Course: ...


def first_carries(policy: Policy, learned: PyTree, num_envs: int) -> PyTree:
    """The carries [N, ...] at the start of N episodes."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (num_envs, *x.shape)), policy.init(learned))


def reset_carry(policy: Policy, learned: PyTree, carry: PyTree, first: jax.Array) -> PyTree:
    """`carry` [N, ...], with that of a new episode where `first` [N] holds."""
    return select_rows(first, policy.init(learned), carry)


def first_actions(policy: Policy, learned: PyTree, obs: PyTree, key: jax.Array | None) -> jax.Array:
    """The actions [..., A] in observations [...], as at the first step of an episode; the mean ones
    where `key` is None."""

    def one(obs: PyTree, key: jax.Array | None) -> jax.Array:
        return policy.act(learned, policy.init(learned), obs, key)[0]

    *batch, _ = vector_of(obs).shape
    if not batch:
        return one(obs, key)
    count = math.prod(batch)
    rows = jax.tree.map(lambda x: x.reshape(count, *x.shape[len(batch) :]), obs)
    keys = None if key is None else jax.random.split(key, count)
    actions = jax.vmap(one, in_axes=(0, None if key is None else 0))(rows, keys)
    return actions.reshape(*batch, actions.shape[-1])
