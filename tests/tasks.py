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
from jaxsafe.envs.engines import Engine
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


def in_parts(env: SafetyGym, **options: Any) -> tuple[Callable, Callable]:
    """`reset` and `step` over a batch, each compiled in two parts around the physics.

    JAX keeps no program with a host callback in its compilation cache, and engine c is one. It keeps
    these parts, so that a second process that needs them starts at once.

    Args:
        options: of `jax.jit`.
    """

    def compiled(f: Callable) -> Callable:
        return jax.jit(jax.vmap(f), **options)

    begin, begun, drive, judge = map(compiled, (env.begin, env.begun, env.drive, env.judge))
    run, forward = physics_of(env._engine, **options)

    def reset(keys: jax.Array) -> State:
        world, ctrl = begin(keys)
        return begun(world, ctrl, *forward(world.bodies, ctrl))

    def step(state: State, action: jax.Array) -> State:
        given = drive(state.physics, action)
        return judge(state, given, *run(state.physics.bodies, given.ctrl, given.substeps))

    return reset, step


def physics_of(engine: Engine, **options: Any) -> tuple[Callable, Callable]:
    """`engine.run` and `engine.forward` over a batch; a callback alone is not compiled."""
    both = jax.vmap(engine.run), jax.vmap(engine.forward)
    if engine.name == "c":
        return both
    run, forward = (jax.jit(f, **options) for f in both)
    return run, forward


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
