"""Wrappers: an environment with other actions, steps or observations, as an `Env` again.

    env = FrameStack(ActionRepeat(TimeLimit(env, 500), 2), 3)

A wrapper keeps no state of its own. `State.physics` stays that of the innermost environment, so
whatever draws or inspects it works on a wrapped environment too.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.config import Amount, Bounds, ConfigError, Real, check_values
from jaxsafe.types import Env, State

Bound = float | tuple[float, ...]


@dataclass(frozen=True)
class Wrapper:
    """The environment inside, unchanged."""

    env: Env

    @property
    def obs_size(self) -> int:
        return self.env.obs_size

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def episode_length(self) -> int:
        return self.env.episode_length

    @property
    def cost_names(self) -> tuple[str, ...]:
        return self.env.cost_names

    @property
    def observed_cost(self) -> Callable[[jax.Array], jax.Array] | None:
        """See SafetyGym."""
        return getattr(self.env, "observed_cost", None)

    @property
    def observed_end(self) -> Callable[[jax.Array], jax.Array] | None:
        """See Velocity."""
        return getattr(self.env, "observed_end", None)

    @property
    def barrier(self) -> Callable[[jax.Array], jax.Array] | None:
        """At most 1 where an observation is safe, if the environment says: see Pendulum."""
        return getattr(self.env, "barrier", None)

    def reset(self, key: jax.Array) -> State:
        return self.env.reset(key)

    def step(self, state: State, action: jax.Array) -> State:
        return self.env.step(state, action)


@dataclass(frozen=True)
class ActionScale(Wrapper):
    """Actions in [-1, 1], for an environment whose actions lie between `low` and `high`.

        inner action = low + (action + 1) / 2 * (high - low),   action clipped to [-1, 1]

    low, high: a number for all components, or one for each.
    """

    low: Bound = -1.0
    high: Bound = 1.0

    def __post_init__(self) -> None:
        low, high = np.asarray(self.low, float), np.asarray(self.high, float)
        for bound in (low, high):
            if bound.shape not in ((), (self.env.action_size,)):
                found, size = bound.shape[0], self.env.action_size
                raise ConfigError(f"ActionScale: {found} bounds for actions with {size} components")
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
            raise ConfigError(f"ActionScale: low={self.low} and high={self.high}: expected low < high")

    def step(self, state: State, action: jax.Array) -> State:
        low, high = jnp.asarray(self.low, jnp.float32), jnp.asarray(self.high, jnp.float32)
        return self.env.step(state, low + (jnp.clip(action, -1.0, 1.0) + 1) / 2 * (high - low))


@dataclass(frozen=True)
class ActionRepeat(Wrapper):
    """Each action is taken `repeat` times. Rewards, costs and info are sums over these raw steps.

    A raw step that ends the episode is the last that counts. An episode has as many whole
    repetitions as fit into the time limit of the environment inside.
    """

    repeat: int = 2

    def __post_init__(self) -> None:
        if not 1 <= self.repeat <= self.env.episode_length:
            raise ConfigError(
                f"ActionRepeat: repeat={self.repeat}: expected 1 to {self.env.episode_length}, "
                "the steps of an episode"
            )

    @property
    def episode_length(self) -> int:
        return self.env.episode_length // self.repeat

    @property
    def observed_cost(self) -> Callable[[jax.Array], jax.Array] | None:
        """As if every raw step cost as much as the last one, which alone is observed."""
        last = super().observed_cost
        return None if last is None else lambda obs: self.repeat * last(obs)

    def step(self, state: State, action: jax.Array) -> State:
        def again(total: State, _: None) -> tuple[State, None]:
            new = self.env.step(total, action)
            new = new.replace(
                reward=total.reward + new.reward,
                cost=total.cost + new.cost,
                costs=total.costs + new.costs,
                info=jax.tree.map(jnp.add, total.info, new.info),
            )
            kept = jax.tree.map(lambda old, x: jnp.where(total.ended, old, x), total, new)
            return kept, None

        first = self.env.step(state, action)
        return jax.lax.scan(again, first, length=self.repeat - 1)[0]


@dataclass(frozen=True)
class FrameStack(Wrapper):
    """Observations of the last `frames` steps, the newest first, side by side along the last axis.

    After a reset all frames are the first observation.
    """

    frames: int = 3

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise ConfigError(f"FrameStack: frames={self.frames}: expected at least 1")

    @property
    def obs_size(self) -> int:
        return self.frames * self.env.obs_size

    @property
    def observed_cost(self) -> Callable[[jax.Array], jax.Array] | None:
        return self.of_newest(super().observed_cost)

    @property
    def observed_end(self) -> Callable[[jax.Array], jax.Array] | None:
        return self.of_newest(super().observed_end)

    @property
    def barrier(self) -> Callable[[jax.Array], jax.Array] | None:
        return self.of_newest(super().barrier)

    def of_newest(self, told: Callable[[jax.Array], jax.Array] | None) -> Any:
        return None if told is None else lambda obs: told(obs[..., : self.env.obs_size])

    def reset(self, key: jax.Array) -> State:
        state = self.env.reset(key)
        return state.replace(
            obs=jax.tree.map(lambda x: jnp.concatenate([x] * self.frames, -1), state.obs)
        )

    def step(self, state: State, action: jax.Array) -> State:
        def width(x: jax.Array) -> int:
            return x.shape[-1] // self.frames

        newest = jax.tree.map(lambda x: x[..., : width(x)], state.obs)
        new = self.env.step(state.replace(obs=newest), action)
        older = jax.tree.map(lambda x: x[..., : x.shape[-1] - width(x)], state.obs)
        return new.replace(obs=jax.tree.map(lambda *x: jnp.concatenate(x, -1), new.obs, older))


@dataclass(frozen=True)
class TimeLimit(Wrapper):
    """Episodes of `steps` steps. They are truncated there, not terminated."""

    steps: int = 1000

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ConfigError(f"TimeLimit: steps={self.steps}: expected at least 1")

    @property
    def episode_length(self) -> int:
        return self.steps


def raw_steps(env: Env) -> int:
    """Steps of the innermost environment in one step of `env`."""
    count = 1
    while isinstance(env, Wrapper):
        count *= env.repeat if isinstance(env, ActionRepeat) else 1
        env = env.env
    return count


def innermost(env: Env) -> Env:
    """`env` without its wrappers."""
    while isinstance(env, Wrapper):
        env = env.env
    return env


@dataclass(frozen=True, kw_only=True)
class WrapConfig:
    """Wrappers as options of every environment, `env.wrap.action_repeat=2` and so on.

    The first is the innermost. The defaults change nothing.
    """

    action_bounds: tuple[Real, Real] | None = None  # the environment's own, if not [-1, 1]
    time_limit: Amount | None = None  # raw steps; null: the environment's own
    action_repeat: Annotated[int, Bounds(1, 1000)] = 1  # raw steps in a step
    frame_stack: Annotated[int, Bounds(1, 1000)] = 1  # observations side by side

    def __post_init__(self) -> None:
        check_values(self, "env.wrap.")
        if (bounds := self.action_bounds) is not None and not bounds[0] < bounds[1]:
            raise ConfigError(f"env.wrap.action_bounds={[*bounds]}: expected low < high")


def wrapped(env: Env, cfg: WrapConfig) -> Env:
    """`env` in the wrappers that `cfg` asks for, or `env` itself.

    Raises:
        ConfigError: a value out of bounds.
    """
    try:
        if cfg.action_bounds is not None:
            env = ActionScale(env, *cfg.action_bounds)
        if cfg.time_limit is not None:
            env = TimeLimit(env, cfg.time_limit)
        if cfg.action_repeat != 1:
            env = ActionRepeat(env, cfg.action_repeat)
        if cfg.frame_stack != 1:
            env = FrameStack(env, cfg.frame_stack)
    except ConfigError as error:
        raise ConfigError(f"env.wrap: {error}") from None
    return env


def wrap_config_of(env: Env) -> WrapConfig | None:
    """The config with which `wrapped` makes `env` of what is innermost; None if there is none, as where
    wrappers stand in another order or have values that the config does not take."""
    found: dict[str, Any] = {}
    inside = env
    while isinstance(inside, Wrapper):
        if isinstance(inside, FrameStack):
            found["frame_stack"] = inside.frames
        elif isinstance(inside, ActionRepeat):
            found["action_repeat"] = inside.repeat
        elif isinstance(inside, TimeLimit):
            found["time_limit"] = inside.steps
        elif isinstance(inside, ActionScale):
            found["action_bounds"] = (inside.low, inside.high)
        inside = inside.env
    try:
        cfg = WrapConfig(**found)
    except ConfigError:
        return None
    return cfg if wrapped(inside, cfg) == env else None
