"""Brax and MuJoCo Playground: our environments for their trainers, theirs for our learners.

    to_brax(env), to_playground(env)   reset(rng) and step(state, action) around any `Env`
    from_brax(env)                     the `Env` around any environment of either that has a cost

None of them has a batch axis.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import brax.envs
import flax.struct
import jax
import jax.numpy as jnp

from jaxsafe.config import ConfigError, nearest
from jaxsafe.learn.observations import observation_like
from jaxsafe.types import Env, Metrics, PyTree, State

Costs = Sequence[str] | Mapping[str, Callable[[Any], jax.Array]]
WRAPPERS = {  # what the wrappers that they train with leave in `info`
    "truncation": "EpisodeWrapper",
    "first_pipeline_state": "AutoResetWrapper",
    "AutoResetWrapper_first_data": "BraxAutoResetWrapper",
}


@flax.struct.dataclass
class PlaygroundState:
    """The fields of Playground's `mjx_env.State`."""

    data: PyTree
    obs: PyTree
    reward: jax.Array
    done: jax.Array
    metrics: Metrics
    info: dict[str, Any]


def to_brax(env: Env) -> "BraxEnv":
    """`env` for Brax's trainers and wrappers."""
    return BraxEnv(env, brax.envs.State, "pipeline_state")


def to_playground(env: Env) -> "BraxEnv":
    """`env` for Playground's `wrap_for_brax_training`, which reads `state.data`."""
    return BraxEnv(env, PlaygroundState, "data")


def mend_brax() -> None:
    """Give JAX back `device_put_replicated`, if it has dropped it: the trainers of Brax 0.14.2 call it.

    It put a copy on each device along a new first axis; here `pmap` spreads the copies when it meets
    them. Source: github.com/google/brax/issues/671.
    """
    if "device_put_replicated" in vars(jax):
        return

    def replicated(tree: PyTree, devices: Sequence[Any]) -> PyTree:
        return jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)

    jax.device_put_replicated = replicated  # type: ignore[attr-defined]


class BraxEnv(brax.envs.Env):
    """An `Env` with the interface of Brax: one environment, no time limit.

    `done` is 1 where the environment ends the episode. Brax cannot be told that the value goes on
    there, so an end by `State.truncated` looks like termination. The trainer is told the time limit
    (`episode_length=env.episode_length`) and keeps it.

    `info['cost']` is the cost of the step. `metrics`, which Brax sums over episodes, has 'cost',
    'cost_<name>' for each of `env.cost_names`, and the environment's own info.

    Args:
        env: any `Env`.
        kind: the class of states, and `held`, its field for what the next step needs.
    """

    def __init__(self, env: Env, kind: type, held: str):
        self.env, self._kind, self._held = env, kind, held

    @property
    def observation_size(self) -> Any:
        like = observation_like(self.env)
        return {name: x.shape for name, x in like.items()} if isinstance(like, dict) else like.shape[0]

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def backend(self) -> str:
        return "jaxsafe"

    def reset(self, rng: jax.Array) -> Any:
        """`rng` is a key of JAX, of either style."""
        typed = jnp.issubdtype(rng.dtype, jax.dtypes.prng_key)
        state = self.env.reset(rng if typed else jax.random.wrap_key_data(rng))
        return self._kind(**self._fields(state))

    def step(self, state: Any, action: jax.Array) -> Any:
        new = self._fields(self.env.step(getattr(state, self._held), action))
        for name in ("metrics", "info"):  # wrappers keep things of their own there
            new[name] = getattr(state, name) | new[name]
        return state.replace(**new)

    def _fields(self, state: State) -> dict[str, Any]:
        costs = {f"cost_{name}": state.costs[k] for k, name in enumerate(self.env.cost_names)}
        return {
            self._held: state,
            "obs": state.obs,
            "reward": state.reward,
            "done": jnp.float32(state.ended),
            "metrics": {"cost": state.cost, **costs, **state.info},
            "info": {"cost": state.cost},
        }


def from_brax(
    env: Any, costs: Costs = ("cost",), episode_length: int = 1000, obs: str = "state"
) -> "FromBrax":
    """The `Env` around an environment of Brax or Playground.

    Args:
        env: the environment itself, without the wrappers that it is trained in.
        costs: entries of its `info` or `metrics`, by name; or name -> function of its state after a
            step that gives a scalar. `cost` is their sum.
        episode_length: the time limit, in steps.
        obs: the entry that the learner observes, where observations are a dict.
    Raises:
        ConfigError: no such cost or observation, or an environment that batches or resets itself.
    """
    return FromBrax(env, costs, episode_length, obs)


class FromBrax:
    """See `from_brax`. Their `done` terminates; their scalar `metrics` are our `info`; actions are
    clipped to [-1, 1], which is what their policies give."""

    engine: str | None = None  # what computes the physics, where the caller names it

    def __init__(self, env: Any, costs: Costs, episode_length: int, obs: str):
        self.env, self.episode_length, self._part = env, episode_length, obs
        name = type(env.unwrapped).__name__
        first = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
        found = [wrapper for key, wrapper in WRAPPERS.items() if key in first.info]
        if found or first.reward.shape:
            raise ConfigError(
                f"{name} comes in {', '.join(found) or 'a VmapWrapper'}: expected it without, as of "
                "brax.envs.get_environment or registry.load"
            )
        self.cost_names = tuple(costs)
        for cost in self.cost_names if not isinstance(costs, Mapping) else ():
            if cost not in first.info and cost not in first.metrics:
                has = ", ".join([*first.info, *first.metrics]) or "nothing"
                raise ConfigError(
                    f"{name} has no {cost!r} in its info or metrics, which hold {has}: choose with "
                    "costs=[name], or give from_brax(env, costs={name: function of the state})"
                )
        self._costs = costs
        if isinstance(first.obs, Mapping) and obs not in first.obs:
            raise ConfigError(f"{name} has no observation {obs!r}{nearest(obs, first.obs)}")
        self.obs_size: int = math.prod(self._seen(first.obs).shape)
        self.action_size: int = env.action_size
        self._counted = [k for k, x in first.metrics.items() if not x.shape and k not in costs]

    def reset(self, key: jax.Array) -> State:
        state = self._state(self.env.reset(jax.random.key_data(key)))  # they expect the older style
        zero = jnp.zeros_like
        return dataclasses.replace(
            state,
            reward=zero(state.reward),
            cost=zero(state.cost),
            costs=zero(state.costs),
            terminated=jnp.bool_(False),
            info=jax.tree.map(zero, state.info),
        )

    def step(self, state: State, action: jax.Array) -> State:
        old = jax.tree.map(lambda x: x, state.physics)  # a copy: some write into `info`
        new = self.env.step(old, jnp.clip(action, -1.0, 1.0))
        # some give a Python float where reset gave an array
        return self._state(jax.tree.map(lambda x, was: jnp.asarray(x, was.dtype), new, state.physics))

    def _state(self, foreign: Any) -> State:
        costs = [jnp.float32(self._cost(foreign, name)) for name in self.cost_names]
        costs = jnp.stack(costs) if costs else jnp.zeros(0)
        return State(
            physics=foreign,
            obs=jnp.float32(self._seen(foreign.obs).reshape(-1)),
            reward=jnp.float32(foreign.reward),
            cost=costs.sum(),
            costs=costs,
            terminated=foreign.done > 0,
            info={name: jnp.float32(foreign.metrics[name]) for name in self._counted},
        )

    def _seen(self, obs: Any) -> jax.Array:
        return obs[self._part] if isinstance(obs, Mapping) else obs

    def _cost(self, foreign: Any, name: str) -> jax.Array:
        if isinstance(self._costs, Mapping):
            return self._costs[name](foreign)
        return foreign.info[name] if name in foreign.info else foreign.metrics[name]
