"""What every environment and every learner agrees on."""

from typing import Any, Protocol

import flax.struct
import jax

PyTree = Any
Metrics = dict[str, jax.Array]


@flax.struct.dataclass
class State:
    """One environment after a reset or a step. No batch axis: callers `vmap`.

    physics: pytree, all that the next step needs, the random key included.
    obs: float [obs_size], of the state after the step.
    reward: float []. Zero after a reset.
    cost: float [], what the learner constrains: the sum over the episode is held under the limit.
    costs: float [K], one entry for each of `env.cost_names`. Safety Gym's `cost` is the indicator
        of their sum, so `cost` is not always `costs.sum()`.
    terminated: bool [], True if the episode has ended for good: its value from here on is 0.
        Running out of time is not termination; `Rollout` adds it.
    info: dict of float [], whatever else is worth a mean over an episode (`goal_met`, ...).
    """

    physics: PyTree
    obs: jax.Array
    reward: jax.Array
    cost: jax.Array
    costs: jax.Array
    terminated: jax.Array
    info: dict[str, jax.Array]


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
