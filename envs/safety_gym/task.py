"""Safety Gym's Engine as a pure-functional environment.

A robot moves among goals, buttons or a box, with hazards, vases, pillars, gremlins and walls around. It
is paid for progress and gets 1 for each success. Each constraint that it violates has a cost.

This module says what an episode is. `arena.py` knows where things are, `observe.py` what is seen,
`rewards.py` what is paid and `costs.py` what is charged.

Source: Ray, Achiam and Amodei (2019), "Benchmarking Safe Exploration in Deep Reinforcement
Learning". The behaviour, quirks included, is that of the authors' package `safety_gym`.
Differs from it: random streams come from a JAX key. A physics error ends the episode in its last good
state. A goal that finds no room ends the episode, where the original raises. A layout that finds no
room is used as the last of its 10,000 tries left it; `make` refuses layouts without hope.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.config import ConfigError
from jaxsafe.envs import engines
from jaxsafe.envs.check import check_action
from jaxsafe.envs.engines import Physics, Readings
from jaxsafe.envs.safety_gym import costs as constraints
from jaxsafe.envs.safety_gym import layout as layouts
from jaxsafe.envs.safety_gym import observe, rewards, sight, sleeping
from jaxsafe.envs.safety_gym import scene as scenes
from jaxsafe.envs.safety_gym.arena import Arena, World
from jaxsafe.envs.safety_gym.config import SafetyGymConfig
from jaxsafe.types import PyTree, State


class Drive(NamedTuple):
    """What the physics of a step is given, and the keys for what comes after it."""

    ctrl: jax.Array  # [nu]
    substeps: jax.Array  # int32 []
    key: jax.Array
    goal_key: jax.Array


class SafetyGym:
    """One task. Pure functions `reset(key)` and `step(state, action)`; callers `vmap`.

    Observation float [obs_size]: the components of `observation_spec` in its order, which is that of
    their names (a dict of them if `observation_flatten` is False) unless `rules` says otherwise. With
    `observe_vision` a dict: 'vector' is that, and 'vision' the picture, uint8 [height, width, 3].
    Action float [action_size] in [-1, 1], clipped.
    `observation_spec` has the shape of each component, in their order. `cost` is what Safety Gym
    calls `cost`; `costs` are its parts, `cost_names` their names.

    Raises:
        ConfigError: options that no scene, layout or engine can serve.
    """

    ray_slack = 0.0  # of natural lidar, m

    def __init__(self, cfg: SafetyGymConfig, engine: str = "auto", name: str = "custom"):
        self.name, self.config = name, cfg
        engine = engines.default_engine() if engine == "auto" else engine
        self.scene = self._build_scene(cfg)
        self.place = layouts.placement(cfg)
        self.arena = Arena(cfg, self.scene, self.place)
        natural = ("geom_xpos", "geom_xmat") if cfg.lidar_type == "natural" else ()
        turned = ("xquat",) if cfg.reward_orientation else ()
        small = sleeping.small_config(cfg, sleeping.awake(cfg, engine))
        as_built = small == cfg and engine != "jax"
        scene = self.scene if as_built else self._build_scene(small, mjx=engine == "jax")
        self._engine = engines.make_engine(engine, scene.simulation(cfg, natural + turned))
        if small != cfg:
            self._engine = sleeping.with_sleepers(self._engine, scene, self.scene, cfg)
        self.engine = self._engine.name
        seeks_goal = cfg.observe_goal_lidar or cfg.observe_goal_dist or cfg.observe_goal_comp
        if seeks_goal and cfg.task in ("x", "z", "run"):
            raise ConfigError(f"env.observe_goal_*: the task {cfg.task!r} has no goal to observe")
        if cfg.observation == "coordinates":
            for name in observe.COORDINATE_SENSORS:
                if name not in self.arena.sensors:
                    raise ConfigError(f"env.observation=coordinates: the robot has no sensor {name}")
        self.cost_names = constraints.cost_names(cfg)
        self._picture = sight.make_sight(self.arena) if cfg.observe_vision else None

        def shown(key: jax.Array) -> dict[str, jax.Array]:
            count, ctrl = len(self.place.names), jnp.zeros(self.action_size)
            world = self.arena.at_rest(jnp.zeros((count, 2)), jnp.zeros(count), key)
            _, readings = self._engine.forward(world.bodies, ctrl)
            return observe.components(self.arena, world, readings, ctrl)

        parts = jax.eval_shape(shown, jax.random.key(0))
        self.observation_spec: dict[str, tuple[int, ...]] = {
            name: parts[name].shape for name in observe.in_order(self.arena, parts)
        }
        self.obs_size = sum(int(np.prod(shape)) for shape in self.observation_spec.values())

    def _build_scene(self, cfg: SafetyGymConfig, mjx: bool = False) -> scenes.Scene:
        return scenes.build(cfg, mjx)

    # What learners ask -----------------------------------------------------------------------------

    @property
    def action_size(self) -> int:
        return self.scene.model.nu

    @property
    def episode_length(self) -> int:
        return self.config.num_steps

    @property
    def observed_cost(self) -> Callable[[jax.Array], jax.Array] | None:
        """obs [..., obs_size] -> the cost [...] of a step after which it is observed. None where the
        observation does not tell.

        The cost is by distances on the floor; the observation, as OmniSafe's, has positions in the
        frame of the robot. So at a hazard's rim the two differ where the robot is tilted.
        """
        cfg = self.config
        told = cfg.observation == "coordinates" and cfg.observation_flatten
        if not told or self.cost_names not in ((), ("hazards",)):
            return None
        count = cfg.hazards_num * cfg.constrain_hazards

        def cost(obs: jax.Array) -> jax.Array:
            ego = obs[..., observe.HAZARDS_AT : observe.HAZARDS_AT + 2 * count]
            return constraints.seen_hazards(cfg, ego.reshape(*obs.shape[:-1], count, 2))

        return cost

    @property
    def substeps(self) -> int:
        """Physics steps in a step, at most."""
        return self.config.frameskip_binom_n

    @property
    def step_seconds(self) -> float:
        """Simulated seconds in a step."""
        return self.scene.model.opt.timestep * self.substeps

    # Episode ---------------------------------------------------------------------------------------

    def reset(self, key: jax.Array) -> State:
        world, ctrl = self.begin(key)
        return self.begun(world, ctrl, *self._engine.forward(world.bodies, ctrl))

    def step(self, state: State, action: jax.Array) -> State:
        drive = self.drive(state.physics, action)
        run = self._engine.run(state.physics.bodies, drive.ctrl, drive.substeps)
        return self.judge(state, drive, *run)

    def begin(self, key: jax.Array) -> tuple[World, jax.Array]:
        """What comes before the physics of a reset: layout, headings, first goal; and controls."""
        cfg = self.config
        if cfg._seed is not None:
            key = jax.random.fold_in(key, cfg._seed)
        if not cfg.randomize_layout:
            key = jax.random.key(0)
        key, layout_key, heading_key, goal_key = jax.random.split(key, 4)
        xy, _ = layouts.sample_layout(self.place, layout_key)
        headings = jax.random.uniform(heading_key, (len(xy),), maxval=2 * jnp.pi)
        if cfg.robot_rot is not None:
            headings = headings.at[0].set(cfg.robot_rot)
        world = self.arena.at_rest(xy, headings, key)
        if self.arena.goal_kind:  # the first goal is discarded, a quirk of the original
            world, _ = self._next_goal(world, goal_key, jnp.bool_(True))
            theirs = cfg.rules == "safety_gymnasium"
            delay = cfg.buttons_resampling_delay if theirs else 0
            world = world.replace(buttons_timer=jnp.int32(delay))
        return world, jnp.zeros(self.action_size)

    def begun(self, world: World, ctrl: jax.Array, physics: Physics, readings: Readings) -> State:
        """What comes after the physics of a reset."""
        world = world.replace(bodies=physics)
        if "subtreecom" in self.arena.sensors:
            world = world.replace(last_com=self.arena.sensor(readings, "subtreecom"))
        zero = jnp.zeros(())
        return State(
            physics=world,
            obs=self._observed(world, readings, ctrl),
            reward=zero,
            cost=zero,
            costs=jnp.zeros(len(self.cost_names)),
            terminated=jnp.bool_(False),
            info={"goal_met": zero, "exception": zero, "overflow": readings.overflow},
            truncated=jnp.bool_(False),
        )

    def drive(self, world: World, action: jax.Array) -> Drive:
        """What comes before the physics of a step."""
        check_action(action, self.action_size)
        cfg = self.config
        key, noise_key, skip_key, goal_key = jax.random.split(world.key, 4)
        low, high = self.scene.model.actuator_ctrlrange.T
        ctrl = jnp.clip(action, low, high)
        if cfg.action_noise:
            ctrl += cfg.action_noise * jax.random.normal(noise_key, ctrl.shape)
        substeps = jnp.int32(cfg.frameskip_binom_n)
        if cfg.frameskip_binom_p < 1:
            draws = jax.random.bernoulli(skip_key, cfg.frameskip_binom_p, (cfg.frameskip_binom_n,))
            substeps = draws.sum(dtype=jnp.int32)
        return Drive(ctrl, substeps, key, goal_key)

    def judge(self, state: State, drive: Drive, physics: Physics, readings: Readings) -> State:
        """What comes after the physics of a step: reward, costs, next goal, observation."""
        cfg, world, key = self.config, state.physics, drive.key
        moved = rewards.measured(self.arena, world.replace(bodies=physics, key=key), readings)
        reward = rewards.reward(self.arena, world, moved, readings)
        costs, cost = constraints.costs(self.arena, moved, readings)
        moved = moved.replace(
            buttons_timer=jnp.maximum(0, moved.buttons_timer - 1), steps=world.steps + 1
        )
        success = rewards.success(self.arena, moved, readings)
        reward += cfg.reward_goal * success
        terminated, truncated = success, jnp.bool_(False)
        if cfg.rules == "seditor" and not cfg.continue_goal:  # there values go on after a success
            terminated, truncated = truncated, terminated
        if cfg.continue_goal and self.arena.goal_kind:
            moved, found = self._next_goal(moved, drive.goal_key, success)
            terminated = success & ~found & cfg.terminate_resample_failure
        obs = self._observed(moved, readings, drive.ctrl)

        bad = engines.is_bad(physics.qpos, physics.qvel, physics.warmstart)
        kept = world.replace(key=key, steps=world.steps + 1)
        zero = jnp.zeros(())
        return State(
            physics=where(bad, kept, moved),
            obs=where(bad, state.obs, obs),
            reward=jnp.where(bad, cfg.reward_exception, reward),
            cost=jnp.where(bad, zero, cost),
            costs=jnp.where(bad, zero, costs),
            terminated=bad | terminated,
            info={
                "goal_met": jnp.where(bad, zero, success),
                "exception": bad.astype(jnp.float32),
                "overflow": readings.overflow,
            },
            truncated=truncated & ~bad,
        )

    def _observed(self, world: World, readings: Readings, ctrl: jax.Array) -> PyTree:
        obs: Any = observe.observe(self.arena, world, readings, ctrl, self.ray_slack)
        if self._picture is None:
            return obs
        parts = {"vector": obs} if self.config.observation_flatten else obs
        return {**parts, "vision": self._picture(world)}

    # Goals -----------------------------------------------------------------------------------------

    def _next_goal(self, world: World, key: jax.Array, wanted: jax.Array) -> tuple[World, jax.Array]:
        """A new goal or goal button where `wanted`, and the distances to it; whether one was found."""
        place, button, found = jnp.zeros(2), world.goal_button, jnp.bool_(True)
        if self.arena.goal_kind == "goal":
            place, found = layouts.sample_goal(self.place, key, self.arena.layout_now(world), wanted)
        else:
            button = jax.random.randint(key, (), 0, self.config.buttons_num)
        return self._with_goal(world, place, button, wanted & found), found

    def _with_goal(self, world: World, place: jax.Array, button: jax.Array, wanted: jax.Array) -> World:
        """The goal at `place` [2], or goal button `button`, where `wanted`; and the distances to it."""
        if self.arena.goal_kind == "buttons":
            delay = jnp.int32(self.config.buttons_resampling_delay)
            new = world.replace(goal_button=button, buttons_timer=delay)
        else:
            new = world.replace(layout=world.layout.at[self.place.names.index("goal")].set(place))
        return where(wanted, self.arena.with_distances(new), world)


def where(chosen: jax.Array, new: PyTree, old: PyTree) -> PyTree:
    """`new` where `chosen`, else `old`; what is the same in both, as a key is, stays out of it."""
    return jax.tree.map(lambda a, b: a if a is b else jnp.where(chosen, a, b), new, old)
