"""What every environment and every learner agrees on."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import flax.struct
import jax
import numpy as np

PyTree = Any
Count = jax.Array | np.int32 | int  # a whole number, traced or not
Metrics = dict[str, jax.Array]


@flax.struct.dataclass
class State:
    """One environment after a reset or a step. No batch axis: callers `vmap`.

    physics: pytree, all that the next step needs, the random key included.
    obs: of the state after the step: float [obs_size], or a dict of that, 'vector', and a picture,
        'vision', uint8 [height, width, channels].
    reward: float []. Zero after a reset.
    cost: float [], what the learner constrains: the sum over the episode is held under the limit.
    costs: float [K], one entry for each of `env.cost_names`. Safety Gym's `cost` is the indicator
        of their sum, so `cost` is not always `costs.sum()`.
    terminated: bool [], True if the episode has ended for good: its value from here on is 0.
        Running out of time is not termination; the rollout adds it.
    truncated: bool [], True if the episode ends here all the same, though its value goes on.
    info: dict of float [], whatever else is worth a mean over an episode (`goal_met`, ...).
    """

    physics: PyTree
    obs: Any
    reward: jax.Array
    cost: jax.Array
    costs: jax.Array
    terminated: jax.Array
    info: dict[str, jax.Array]
    truncated: jax.Array | np.bool_ = np.False_

    @property
    def ended(self) -> jax.Array:
        return self.terminated | self.truncated


class Env(Protocol):
    """A constrained Markov decision process as a pair of pure functions.

    Actions are float [action_size]; environments clip them to their own bounds ([-1, 1] here).
    `episode_length` (steps) is the time limit, which the rollout applies.
    """

    @property
    def obs_size(self) -> int: ...

    @property
    def action_size(self) -> int: ...

    @property
    def episode_length(self) -> int: ...

    @property
    def cost_names(self) -> tuple[str, ...]: ...

    def reset(self, key: jax.Array) -> State: ...

    def step(self, state: State, action: jax.Array) -> State: ...


class Policy(NamedTuple):
    """All that evaluation, films, the live view, adapters and `init_from` know of an algorithm.

    `learned` is what `Algorithm.learned` gives: all that the policy is made of.

    init(learned) -> carry, what the policy remembers at the start of an episode: () for a policy
        that only sees the present observation.
    act(learned, carry, obs, key) -> (action [A], carry, extras): one step in one environment, without a
        batch axis. `key` None asks for the mean action. extras is a dict of what a policy reports
        beside its action, as whether a shield overruled it; most report nothing.
    privileged(learned) -> bool: whether `act` takes the environment's `State` for `obs`. The policy
        then looks into the simulator, as a planner with the true dynamics does.
    """

    init: Callable[[PyTree], PyTree]
    act: Callable[[PyTree, PyTree, Any, jax.Array | None], tuple[jax.Array, PyTree, dict[str, Any]]]
    privileged: Callable[[PyTree], bool] = lambda learned: False


class Shared(NamedTuple):
    """What all members of a run share. It has no member axis: `jax.vmap(update, in_axes=(0, None))`.

    iteration: int32 [], updates before this one. The loop owns it; cursors, warm-up and schedules are
        functions of it.
    since: int32 [], the iteration from which on the replay is complete: 0, or that at which a run was
        resumed without its replay.
    data: pytree, a data set.
    """

    iteration: Count
    since: Count = np.int32(0)
    data: PyTree = ()


class Clocks(NamedTuple):
    """What one `update` takes of one seed: environment steps, and gradient steps.

    Gradient steps of passes that stop early count, too. Users know them as `updates`.
    """

    steps: int
    gradient_steps: int


class Algorithm(NamedTuple):
    """A learner of one member, pure; `jax.vmap` makes several of it.

    init(key, cfg, shared) -> ts, a train state: a dataclass whose `config` is `cfg`, with its floats as
        arrays.
    update(ts, shared) -> (ts, metrics).
    policy: see `Policy`.
    learned(ts) -> pytree, all that the policy is made of: networks, normaliser, and `config`, with
        `discount` and `cost_discount`, which evaluation reads. No optimiser and no replay. It is what a
        run folder keeps in policy/, and what another run can start from. See `learn.acting.Learned`.
    task(learned) -> the Env whose observations the policy takes.
    clocks(cfg) -> Clocks. Raises ConfigError for sizes that do not fit each other. Where an update
        takes no environment steps, the algorithm learns from the data set in `Shared`; elsewhere its
        config has `num_envs`.
    """

    init: Callable[[jax.Array, Any, Shared], PyTree]
    update: Callable[[PyTree, Shared], tuple[PyTree, Metrics]]
    policy: Policy
    learned: Callable[[PyTree], PyTree]
    task: Callable[[PyTree], Env]
    clocks: Callable[[Any], Clocks]
