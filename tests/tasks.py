"""Environments with their compiled functions, shared by the tests of the environments."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from compiling import FAST

from jaxsafe.envs import SafetyGym, make
from jaxsafe.envs.safety_gym.task import in_parts
from jaxsafe.types import State

ROBOT_AT_ORIGIN = {
    "robot_locations": ((0.0, 0.0),),
    "robot_keepout": 0.0,
    "robot_rot": 0.0,
}  # robot at the origin


@dataclasses.dataclass(frozen=True)
class Task:
    """An environment, and its reset and step over a batch."""

    env: SafetyGym
    reset: Callable[[jax.Array], State]
    step: Callable[[State, jax.Array], State]

    def begin(self, count: int = 4, seed: int = 0) -> State:
        return self.reset(jax.random.split(jax.random.key(seed), count))

    def idle(self, state: State) -> State:
        """One step without any force."""
        return self.step(state, jnp.zeros((len(state.reward), self.env.action_size)))

    def part(self, state: State, name: str) -> np.ndarray:
        """A component of the flat observations [n, size]."""
        spec = self.env.observation_spec
        sizes = {k: int(np.prod(shape)) for k, shape in spec.items()}
        start = sum(sizes[k] for k in list(spec)[: list(spec).index(name)])
        return np.asarray(state.obs[:, start : start + sizes[name]])


@functools.cache
def task(name: str, engine: str = "c", **overrides: Any) -> Task:
    env = make(name, engine=engine, **overrides)
    return Task(env, *in_parts(env, compiler_options=FAST))


def change(state: State, physics: dict[str, Any] | None = None, **world: Any) -> State:
    """`state` with fields of its world, and of the physics in it, replaced."""
    new = state.physics.replace(bodies=state.physics.bodies.replace(**physics or {}), **world)
    return state.replace(physics=new)  # type: ignore[attr-defined]


def with_qpos(state: State, columns: slice, values: Any) -> State:
    """`state` with some columns of qpos [n, nq] replaced."""
    return change(state, {"qpos": state.physics.bodies.qpos.at[:, columns].set(jnp.asarray(values))})


def put(t: Task, state: State, name: str, xy: Any) -> State:
    """`state` with one thing of the layout, that is no body (goal, hazard0), put elsewhere."""
    return change(
        state, layout=state.physics.layout.at[:, t.env.place.names.index(name)].set(jnp.asarray(xy))
    )
