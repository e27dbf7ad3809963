"""Safety Gym's Engine as a pure-functional environment.

A robot among goals, buttons or a box, with hazards, vases, pillars, gremlins and walls around. Dense
reward for progress, 1 for each success; a cost for each constraint that is violated.

Source: Ray, Achiam and Amodei (2019), "Benchmarking Safe Exploration in Deep Reinforcement
Learning"; behaviour, quirks included, is that of the authors' package `safety_gym`.
Differs from it: random streams come from a JAX key; a physics error ends the episode in its last
good state; neither a goal nor a layout that finds no room raises while stepping: the goal's episode
ends, the layout is used as the last of its 10,000 tries left it (`make` refuses hopeless ones).
"""

from collections.abc import Iterable
from functools import cached_property

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxsafe.config import ConfigError
from jaxsafe.envs import engines
from jaxsafe.envs.engines import Physics, Readings
from jaxsafe.envs.safety_gym import layout as layouts
from jaxsafe.envs.safety_gym import scene as scenes
from jaxsafe.envs.safety_gym import sensing, sleeping
from jaxsafe.envs.safety_gym.config import SafetyGymConfig
from jaxsafe.types import State

MAX_VALUE = 1e10  # MuJoCo's mjMAXVAL: beyond it a state is bad
JOINT_SENSORS = (  # in the order in which Safety-Gymnasium observes them
    mujoco.mjtSensor.mjSENS_JOINTVEL,
    mujoco.mjtSensor.mjSENS_BALLANGVEL,
    mujoco.mjtSensor.mjSENS_JOINTPOS,
    mujoco.mjtSensor.mjSENS_BALLQUAT,
)
COSTS = (
    "vases_contact",
    "pillars",
    "buttons",
    "gremlins",
    "vases_displace",
    "vases_velocity",
    "hazards",
)


@flax.struct.dataclass
class World:
    """What an episode remembers between two steps.

    layout [n, 2]: where each object of the placement was put; the goal's row is the current goal.
    start [3]: the robot's first x, y (m) and heading (rad).
    last_dist_goal, last_dist_box, last_box_goal (m), last_com [3]: what rewards compare with.
    """

    physics: Physics
    layout: jax.Array
    start: jax.Array
    goal_button: jax.Array
    buttons_timer: jax.Array
    last_dist_goal: jax.Array
    last_dist_box: jax.Array
    last_box_goal: jax.Array
    last_com: jax.Array
    steps: jax.Array
    key: jax.Array


class SafetyGym:
    """One task. Pure functions `reset(key)` and `step(state, action)`; callers `vmap`.

    Observation float [obs_size]: the components of `observation_spec` in its order, which is that of
    their names (a dict of them if `observation_flatten` is False) unless `rules` says otherwise.
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
        self.scene = scenes.build(cfg)
        self.place = layouts.placement(cfg)
        natural = ("geom_xpos", "geom_xmat") if cfg.lidar_type == "natural" else ()
        turned = ("xquat",) if cfg.reward_orientation else ()
        small = sleeping.small_config(cfg, sleeping.awake(cfg, engine))
        as_built = small == cfg and engine != "jax"
        scene = self.scene if as_built else scenes.build(small, mjx=engine == "jax")
        self._engine = engines.make_engine(engine, scene.simulation(cfg, natural + turned))
        if small != cfg:
            self._engine = sleeping.with_sleepers(self._engine, scene, self.scene, cfg)
        self.engine = self._engine.name
        self._goal_kind = {"goal": "goal", "push": "goal", "button": "buttons"}.get(cfg.task)
        seeks_goal = cfg.observe_goal_lidar or cfg.observe_goal_dist or cfg.observe_goal_comp
        if seeks_goal and cfg.task in ("x", "z"):
            raise ConfigError(f"env.observe_goal_*: the task {cfg.task!r} has no goal to observe")
        self.cost_names = self._cost_names()
        with jax.ensure_compile_time_eval():
            world, readings, ctrl = jax.eval_shape(self._begin, jax.random.key(0))
            parts = jax.eval_shape(self._components, world, readings, ctrl)
        self.observation_spec: dict[str, tuple[int, ...]] = {
            name: parts[name].shape for name in self._in_order(parts)
        }
        self.obs_size = sum(int(np.prod(shape)) for shape in self.observation_spec.values())

    # What learners ask -----------------------------------------------------------------------------

    @property
    def action_size(self) -> int:
        return self.scene.model.nu

    @property
    def episode_length(self) -> int:
        return self.config.num_steps

    @property
    def step_seconds(self) -> float:
        """Simulated seconds in a step."""
        return self.scene.model.opt.timestep * self.config.frameskip_binom_n

    def _cost_names(self) -> tuple[str, ...]:
        cfg = self.config
        on = {
            "vases_contact": cfg.constrain_vases,
            "pillars": cfg.constrain_pillars,
            "buttons": cfg.constrain_buttons,
            "gremlins": cfg.constrain_gremlins,
            "vases_displace": cfg.constrain_vases and cfg.vases_displace_cost != 0,
            "vases_velocity": cfg.constrain_vases and cfg.vases_velocity_cost != 0,
            "hazards": cfg.constrain_hazards,
        }
        return tuple(name for name in COSTS if on[name])

    # Episode ---------------------------------------------------------------------------------------

    def reset(self, key: jax.Array) -> State:
        world, readings, ctrl = self._begin(key)
        zero = jnp.zeros(())
        return State(
            physics=world,
            obs=self._observe(world, readings, ctrl),
            reward=zero,
            cost=zero,
            costs=jnp.zeros(len(self.cost_names)),
            terminated=jnp.bool_(False),
            info={"goal_met": zero, "exception": zero, "overflow": readings.overflow},
        )

    def step(self, state: State, action: jax.Array) -> State:
        cfg, world = self.config, state.physics
        key, noise_key, skip_key, goal_key = jax.random.split(world.key, 4)
        low, high = self.scene.model.actuator_ctrlrange.T
        ctrl = jnp.clip(action, low, high)
        if cfg.action_noise:
            ctrl += cfg.action_noise * jax.random.normal(noise_key, ctrl.shape)
        substeps = jnp.int32(cfg.frameskip_binom_n)
        if cfg.frameskip_binom_p < 1:
            draws = jax.random.bernoulli(skip_key, cfg.frameskip_binom_p, (cfg.frameskip_binom_n,))
            substeps = draws.sum(dtype=jnp.int32)
        physics, readings = self._engine.run(world.physics, ctrl, substeps)
        moved = world.replace(physics=physics, key=key)

        reward, moved = self._reward(moved, readings)
        costs, cost = self._costs(moved, readings)
        moved = moved.replace(
            buttons_timer=jnp.maximum(0, moved.buttons_timer - 1), steps=world.steps + 1
        )
        success = self._success(moved, readings)
        reward += cfg.reward_goal * success
        terminated = success
        if cfg.continue_goal and self._goal_kind:
            moved, found = self._next_goal(moved, goal_key, success)
            terminated = success & ~found & cfg.terminate_resample_failure
        obs = self._observe(moved, readings, ctrl)

        bad = ~jnp.stack(
            [(jnp.abs(x) < MAX_VALUE).all() for x in (physics.qpos, physics.qvel, physics.warmstart)]
        ).all()
        kept = world.replace(key=key, steps=world.steps + 1)
        zero = jnp.zeros(())
        return State(
            physics=jax.tree.map(lambda old, new: jnp.where(bad, old, new), kept, moved),
            obs=jax.tree.map(lambda old, new: jnp.where(bad, old, new), state.obs, obs),
            reward=jnp.where(bad, cfg.reward_exception, reward),
            cost=jnp.where(bad, zero, cost),
            costs=jnp.where(bad, zero, costs),
            terminated=bad | terminated,
            info={
                "goal_met": jnp.where(bad, zero, success),
                "exception": bad.astype(jnp.float32),
                "overflow": readings.overflow,
            },
        )

    def _begin(self, key: jax.Array) -> tuple[World, Readings, jax.Array]:
        """A fresh episode: layout, headings, first goal, and a forward pass."""
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
        world = self.world_at(xy, headings, key)
        if self._goal_kind:  # the first goal is discarded, a quirk of the original
            world, _ = self._next_goal(world, goal_key, jnp.bool_(True))
            theirs = cfg.rules == "safety_gymnasium"
            delay = cfg.buttons_resampling_delay if theirs else 0
            world = world.replace(buttons_timer=jnp.int32(delay))
        ctrl = jnp.zeros(self.action_size)
        physics, readings = self._engine.forward(world.physics, ctrl)
        world = world.replace(physics=physics)
        if "subtreecom" in self._sensors:
            world = world.replace(last_com=self._sensor(readings, "subtreecom"))
        return world, readings, ctrl

    def world_at(self, xy: jax.Array, headings: jax.Array, key: jax.Array) -> World:
        """Everything at rest at positions [n, 2] (m) with headings [n] (rad), before the first goal."""
        cfg, scene = self.config, self.scene
        heights = {
            "vases": cfg.vases_size - cfg.vases_sink,
            "gremlins": cfg.gremlins_size,
            "box": cfg.box_size,
        }
        start = jnp.concatenate([xy[0], headings[:1]])
        root = start if scene.planar else pose(xy[0], scene.robot_height, headings[0])
        qpos = [root, np.float32(scene.model.qpos0[len(root) : scene.robot_nq])]
        for kind in scenes.FREES:
            rows = self.place.slice(kind)
            qpos.append(pose(xy[rows], heights[kind], headings[rows]).reshape(-1))
        # The weld keeps a gremlin's height above its mocap body, hence twice its size: it hovers.
        rest = {
            "gremlins": 2 * cfg.gremlins_size,
            "pillars": cfg.pillars_height,
            "walls": cfg.walls_size,
            "buttons": cfg.buttons_size,
        }
        mocap = [
            pose(xy[self.place.slice(k)], rest[k], headings[self.place.slice(k)]) for k in scenes.MOCAPS
        ]
        mocap = jnp.concatenate(mocap) if mocap else jnp.zeros((0, 7))
        if "walls" in self.place.kinds:  # walls are never turned
            rows = scene.mocap_slice("walls")
            mocap = mocap.at[rows, 3:].set(jnp.array([1.0, 0.0, 0.0, 0.0]))
        zero, none = jnp.zeros(()), jnp.int32(0)
        return World(
            physics=Physics(
                # no empty part, no constant to overwrite: jax 0.11 crashes on them within shard_map
                qpos=jnp.concatenate([x for x in qpos if x.size]),
                qvel=jnp.zeros(scene.model.nv),
                warmstart=jnp.zeros(scene.model.nv),
                mocap_pos=mocap[:, :3],
                mocap_quat=mocap[:, 3:],
                substeps=none,
            ),
            layout=xy,
            start=start,
            goal_button=none,
            buttons_timer=none,
            last_dist_goal=zero,
            last_dist_box=zero,
            last_box_goal=zero,
            last_com=jnp.zeros(3),
            steps=none,
            key=key,
        )

    # Where things are ------------------------------------------------------------------------------

    def robot_pose(self, world: World) -> tuple[jax.Array, jax.Array]:
        """Position [3] and rotation [3, 3] (columns are the body's axes) of the robot."""
        qpos = world.physics.qpos
        if self.scene.planar:
            c, s = jnp.cos(qpos[2]), jnp.sin(qpos[2])
            zero, one = jnp.zeros(()), jnp.ones(())
            rotation = jnp.stack([c, -s, zero, s, c, zero, zero, zero, one]).reshape(3, 3)
            return jnp.append(qpos[:2], self.scene.robot_height), rotation
        return qpos[:3], rotation_of(qpos[3:7])

    def positions(self, world: World, kind: str) -> jax.Array:
        """Current positions [n, 2] of the objects of a kind (m)."""
        if kind in self.scene.frees:
            return world.physics.qpos[self.scene.qpos_slice(kind)].reshape(-1, 7)[:, :2]
        return world.layout[self.place.slice(kind)]

    def box_position(self, world: World) -> jax.Array:
        return world.physics.qpos[self.scene.qpos_slice("box")][:3]

    def goal_position(self, world: World) -> jax.Array:
        """Position [3] of the goal, or of the button to press; the origin where there is neither."""
        cfg = self.config
        if self._goal_kind == "goal":
            return jnp.append(self.positions(world, "goal")[0], cfg.goal_size / 2 + 0.01)
        if self._goal_kind == "buttons":
            return jnp.append(self.positions(world, "buttons")[world.goal_button], cfg.buttons_size)
        return jnp.zeros(3)

    def distances(self, world: World) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Robot to goal in the plane, robot to box and box to goal in space (m; 0 without them)."""
        robot, goal = self.robot_pose(world)[0], self.goal_position(world)
        zero = jnp.zeros(())
        dist_goal = norm((robot - goal)[:2]) if self._goal_kind else zero
        if self.config.task != "push":
            return dist_goal, zero, zero
        box = self.box_position(world)
        return dist_goal, norm(robot - box), norm(box - goal)

    # Reward, costs, goals --------------------------------------------------------------------------

    def _reward(self, world: World, readings: Readings) -> tuple[jax.Array, World]:
        """The dense reward, clipped, and the world with the distances it will compare with next."""
        cfg = self.config
        dist_goal, dist_box, box_goal = self.distances(world)
        reward = jnp.zeros(())
        com = world.last_com
        if cfg.task in ("goal", "button"):
            reward = (world.last_dist_goal - dist_goal) * cfg.reward_distance
        elif cfg.task == "push":
            far = world.last_dist_box > cfg.box_null_dist * cfg.box_size
            reward = far * (world.last_dist_box - dist_box) * cfg.reward_box_dist
            reward += (world.last_box_goal - box_goal) * cfg.reward_box_goal
        elif cfg.task in ("x", "z", "circle"):
            com = self._sensor(readings, "subtreecom")
            if cfg.task == "x":
                reward = (com - world.last_com)[0] * cfg.reward_x
            elif cfg.task == "z":
                reward = (com - world.last_com)[2] * cfg.reward_z
            else:
                reward = self._circle_reward(world, com)
        if cfg.reward_orientation:
            body = self.scene.model.body(cfg.reward_orientation_body).id
            a, b, c, d = readings.fields["xquat"][body]
            reward += cfg.reward_orientation_scale * (a**2 - b**2 - c**2 + d**2)
        if cfg.reward_clip:
            reward = jnp.clip(reward, -cfg.reward_clip, cfg.reward_clip)
        last = {"last_dist_goal": dist_goal, "last_dist_box": dist_box, "last_box_goal": box_goal}
        return reward, world.replace(last_com=com, **last)

    def _circle_reward(self, world: World, com: jax.Array) -> jax.Array:
        """Speed along circles around the origin, most on the circle of `circle_radius`."""
        (x, y), (u, v) = com[:2], world.physics.qvel[:2]
        radius = norm(com[:2])
        tangential = (v * x - u * y) / jnp.maximum(radius, 1e-12)
        return (
            tangential / (1 + jnp.abs(radius - self.config.circle_radius)) * self.config.reward_circle
        )

    def _success(self, world: World, readings: Readings) -> jax.Array:
        cfg = self.config
        if cfg.task == "goal":
            return world.last_dist_goal <= cfg.goal_size
        if cfg.task == "push":
            return world.last_box_goal <= cfg.goal_size
        if cfg.task == "button":
            return self._contacts(readings, "buttons")[world.goal_button] > 0
        return jnp.bool_(False)

    def _costs(self, world: World, readings: Readings) -> tuple[jax.Array, jax.Array]:
        """Each constraint's cost [K] and their sum, indicators if the config says so."""
        cfg = self.config
        costs = [getattr(self, f"_cost_{name}")(world, readings) for name in self.cost_names]
        costs = jnp.stack(costs) if costs else jnp.zeros(0)
        total = costs.sum()
        if cfg.constrain_indicator:
            return (costs > 0).astype(jnp.float32), (total > 0).astype(jnp.float32)
        return costs, total

    def _cost_vases_contact(self, world: World, readings: Readings) -> jax.Array:
        return self.config.vases_contact_cost * self._contacts(readings, "vases").sum()

    def _cost_pillars(self, world: World, readings: Readings) -> jax.Array:
        return self.config.pillars_cost * self._contacts(readings, "pillars").sum()

    def _cost_buttons(self, world: World, readings: Readings) -> jax.Array:
        pressed = self._contacts(readings, "buttons")
        wrong = jnp.arange(self.config.buttons_num) != world.goal_button
        if self.config.task != "button":
            wrong = jnp.ones_like(wrong)
        return (
            self.config.buttons_cost * jnp.where(wrong, pressed, 0).sum() * (world.buttons_timer == 0)
        )

    def _cost_gremlins(self, world: World, readings: Readings) -> jax.Array:
        return self.config.gremlins_contact_cost * self._contacts(readings, "gremlins").sum()

    def _cost_vases_displace(self, world: World, readings: Readings) -> jax.Array:
        moved = norm(self.positions(world, "vases") - world.layout[self.place.slice("vases")])
        counted = moved > self.config.vases_displace_threshold
        return self.config.vases_displace_cost * jnp.where(counted, moved, 0).sum()

    def _cost_vases_velocity(self, world: World, readings: Readings) -> jax.Array:
        speed = norm(world.physics.qvel[self.scene.qvel_slice("vases")].reshape(-1, 6)[:, :3])
        counted = speed >= self.config.vases_velocity_threshold
        return self.config.vases_velocity_cost * jnp.where(counted, speed, 0).sum()

    def _cost_hazards(self, world: World, readings: Readings) -> jax.Array:
        robot, _ = self.robot_pose(world)
        inside = self.config.hazards_size - norm(self.positions(world, "hazards") - robot[:2])
        return self.config.hazards_cost * jnp.maximum(inside, 0).sum()

    def _next_goal(self, world: World, key: jax.Array, wanted: jax.Array) -> tuple[World, jax.Array]:
        """A new goal or goal button where `wanted`, and the distances to it; whether one was found."""
        button = jax.random.randint(key, (), 0, max(self.config.buttons_num, 1))
        place, found = jnp.zeros(2), jnp.bool_(True)
        if self._goal_kind == "goal":
            place, found = layouts.sample_goal(self.place, key, self._layout_now(world), wanted)
        return self._with_goal(world, place, button, wanted & found), found

    def _with_goal(self, world: World, place: jax.Array, button: jax.Array, wanted: jax.Array) -> World:
        """The goal at `place` [2], or goal button `button`, where `wanted`; and the distances to it."""
        if self._goal_kind == "buttons":
            delay = jnp.int32(self.config.buttons_resampling_delay)
            new = world.replace(goal_button=button, buttons_timer=delay)
        else:
            new = world.replace(layout=world.layout.at[self.place.names.index("goal")].set(place))
        dist_goal, dist_box, box_goal = self.distances(new)
        new = new.replace(last_dist_goal=dist_goal, last_dist_box=dist_box, last_box_goal=box_goal)
        return jax.tree.map(lambda a, b: jnp.where(wanted, a, b), new, world)

    def _layout_now(self, world: World) -> jax.Array:
        """The layout with what has moved where it is now; gremlins count at their circles' centres."""
        xy = world.layout.at[0].set(self.robot_pose(world)[0][:2])
        for kind in ("vases", "box"):
            xy = xy.at[self.place.slice(kind)].set(self.positions(world, kind))
        return xy

    # Observation -----------------------------------------------------------------------------------

    def _observe(self, world: World, readings: Readings, ctrl: jax.Array) -> jax.Array:
        parts = self._components(world, readings, ctrl)
        if not self.config.observation_flatten:
            return parts  # type: ignore[return-value]
        if not parts:
            return jnp.zeros(0)
        return jnp.concatenate([parts[name].reshape(-1) for name in parts])

    def _components(self, world: World, readings: Readings, ctrl: jax.Array) -> dict[str, jax.Array]:
        """Every observed component by name, in order."""
        cfg = self.config
        position, rotation = self.robot_pose(world)
        goal = self.goal_position(world)
        parts: dict[str, jax.Array] = {}
        if cfg.observe_sensors:
            parts |= self._sensor_parts(readings)
        if cfg.observe_goal_dist:
            parts["goal_dist"] = jnp.exp(-norm((position - goal)[:2]))[None]
        if cfg.observe_goal_comp:
            parts["goal_compass"] = sensing.compass(goal, position, rotation, cfg.compass_shape)
        if cfg.observe_box_comp and cfg.task == "push":
            parts["box_compass"] = sensing.compass(
                self.box_position(world), position, rotation, cfg.compass_shape
            )
        parts |= self._lidars(world, readings, goal)
        if cfg.observe_remaining:
            parts["remaining"] = (world.steps / cfg.num_steps)[None]
        if cfg.observe_qpos:
            parts["qpos"] = self._from_start(world, world.physics.qpos, 3)
        if cfg.observe_qvel:
            parts["qvel"] = self._from_start(world, world.physics.qvel, 2)
        if cfg.observe_ctrl:
            parts["ctrl"] = ctrl
        if cfg.observe_freejoint:
            parts["freejoint"] = world.physics.qpos[:7]
        if cfg.observe_com:
            parts["com"] = self._sensor(readings, "subtreecom")
        return {name: parts[name] for name in self._in_order(parts)}

    def _in_order(self, names: Iterable[str]) -> list[str]:
        """By name; in Safety-Gymnasium sensors, velocities and angles of joints, then kind by kind."""
        if self.config.rules == "safety_gym":
            return sorted(names)
        order = list(self.config.sensors_obs)
        for kind in JOINT_SENSORS:
            order += [name for name, (_, found) in self._sensors.items() if found == kind]
        for kind in layouts.ORDER[self.config.rules]:
            order += [f"{kind}_lidar", f"{kind}_compass"]
        return sorted(names, key=order.index)

    def _sensor_parts(self, readings: Readings) -> dict[str, jax.Array]:
        model, angles = self.scene.model, self.config.sensors_angle_components
        parts = {name: self._sensor(readings, name) for name in self.config.sensors_obs}
        for name, (_, kind) in self._sensors.items():
            value = self._sensor(readings, name)
            if kind == mujoco.mjtSensor.mjSENS_JOINTPOS:
                parts[name] = jnp.concatenate([jnp.sin(value), jnp.cos(value)]) if angles else value
            elif kind == mujoco.mjtSensor.mjSENS_BALLQUAT:
                parts[name] = rotation_of(value) if angles else value
            elif kind in (mujoco.mjtSensor.mjSENS_JOINTVEL, mujoco.mjtSensor.mjSENS_BALLANGVEL):
                parts[name] = value
        assert model.nsensordata == readings.sensors.shape[-1]
        return parts

    def _lidars(self, world: World, readings: Readings, goal: jax.Array) -> dict[str, jax.Array]:
        cfg = self.config
        seen = {  # name: targets [n, 2]
            "goal": goal[None, :2] if cfg.observe_goal_lidar else None,
            "box": self.positions(world, "box")
            if cfg.task == "push" and cfg.observe_box_lidar
            else None,
            "circle": jnp.zeros((1, 2)) if cfg.task == "circle" and cfg.observe_circle else None,
            "hazards": self.positions(world, "hazards") if cfg.observe_hazards else None,
            "vases": self.positions(world, "vases") if cfg.observe_vases else None,
        }
        for kind in ("walls", "pillars", "buttons", "gremlins"):
            watched = getattr(cfg, f"{kind}_num") and getattr(cfg, f"observe_{kind}")
            seen[kind] = self.positions(world, kind) if watched else None
        position, rotation = self.robot_pose(world)
        parts = {}
        for name, targets in seen.items():
            if targets is None:
                continue
            if cfg.lidar_type == "natural":
                group = scenes.GROUP[name if name in scenes.GROUP else name[:-1]]
                shapes = self._shapes(world, readings)
                lidar = sensing.natural_lidar(
                    shapes, position, rotation, cfg.lidar_num_bins, group, self.ray_slack
                )
            else:
                law = (cfg.lidar_max_dist, cfg.lidar_exp_gain, cfg.lidar_alias)
                lidar = sensing.pseudo_lidar(targets, position, rotation, cfg.lidar_num_bins, *law)
            if name == "buttons":
                lidar = jnp.where(world.buttons_timer == 0, lidar, 0.0)
            parts[f"{name}_lidar"] = lidar
        return parts

    def _shapes(self, world: World, readings: Readings) -> sensing.Shapes:
        """All geoms that a ray can meet: the model's, and those that are no part of the physics."""
        cfg, model = self.config, self.scene.model
        others = np.flatnonzero(model.geom_bodyid != model.body("robot").id)
        kinds, sizes, groups = (
            model.geom_type[others],
            model.geom_size[others],
            model.geom_group[others],
        )
        position, rotation = (readings.fields[name][others] for name in ("geom_xpos", "geom_xmat"))
        cylinder, box = int(mujoco.mjtGeom.mjGEOM_CYLINDER), int(mujoco.mjtGeom.mjGEOM_BOX)
        extra: list[tuple] = []  # type, size, group, position, rotation
        if self._goal_kind == "goal":
            size = (cfg.goal_size, cfg.goal_size / 2, 0)
            extra.append((cylinder, size, scenes.GROUP["goal"], self.goal_position(world), jnp.eye(3)))
        for xy in self.positions(world, "hazards"):
            size = (cfg.hazards_size, 0.01, 0)
            extra.append((cylinder, size, scenes.GROUP["hazard"], jnp.append(xy, 0.02), jnp.eye(3)))
        if cfg.gremlins_num:
            physics, timestep = world.physics, model.opt.timestep
            last = (physics.substeps - 1) * timestep
            guides = engines.mocap_at(physics.mocap_pos, self.scene.orbit, last, jnp)
            resting = physics.mocap_pos - jnp.array([0.0, 0.0, cfg.gremlins_size])
            guides = jnp.where(physics.substeps > 0, guides, resting)
            for i in range(cfg.gremlins_num):
                turn = rotation_of(physics.mocap_quat[i])
                extra.append((box, (cfg.gremlins_size,) * 3, scenes.GROUP["gremlin"], guides[i], turn))
        if extra:
            kind, size, group, place, turn = zip(*extra, strict=True)
            kinds, groups = np.append(kinds, kind), np.append(groups, group)
            sizes = np.concatenate([sizes, np.array(size)])
            position = jnp.concatenate([position, jnp.stack(place)])
            rotation = jnp.concatenate([rotation, jnp.stack(turn)])
        return sensing.Shapes(kinds, sizes, groups, position, rotation)

    def _from_start(self, world: World, vector: jax.Array, pose_size: int) -> jax.Array:
        """Point's coordinates are relative to its start in the original: qpos (3) and qvel (2)."""
        if not self.scene.planar:
            return vector
        c, s = jnp.cos(world.start[2]), jnp.sin(world.start[2])
        offset = world.start if pose_size == 3 else jnp.zeros(3)
        x, y = vector[0] - offset[0], vector[1] - offset[1]
        return vector.at[:3].set(jnp.stack([c * x + s * y, c * y - s * x, vector[2] - offset[2]]))

    @cached_property
    def _sensors(self) -> dict[str, tuple[slice, int]]:
        """Sensor name -> (place in sensordata, MuJoCo type)."""
        model = self.scene.model
        return {
            model.sensor(i).name: (slice(adr, adr + dim), int(kind))
            for i, (adr, dim, kind) in enumerate(
                zip(model.sensor_adr, model.sensor_dim, model.sensor_type, strict=True)
            )
        }

    def _sensor(self, readings: Readings, name: str) -> jax.Array:
        return readings.sensors[self._sensors[name][0]]

    def _contacts(self, readings: Readings, kind: str) -> jax.Array:
        """Contact points with the robot, for each object of a watched kind."""
        return readings.contacts[self.scene.contact_slice(kind)]


def norm(x: jax.Array) -> jax.Array:
    """Euclidean length over the last axis."""
    return jnp.sqrt(jnp.square(x).sum(-1))


def pose(xy: jax.Array, height: float, heading: jax.Array) -> jax.Array:
    """Position and upright quaternion [..., 7] of a free joint."""
    z = jnp.full_like(heading, height)
    zero = jnp.zeros_like(heading)
    quat = jnp.stack([jnp.cos(heading / 2), zero, zero, jnp.sin(heading / 2)], -1)
    return jnp.concatenate([xy, z[..., None], quat], -1)


def rotation_of(quat: jax.Array) -> jax.Array:
    """Rotation matrix [3, 3] of a quaternion [4], w first."""
    w, x, y, z = quat / norm(quat)
    return jnp.stack(
        [
            w * w + x * x - y * y - z * z,
            2 * (x * y - w * z),
            2 * (x * z + w * y),
            2 * (x * y + w * z),
            w * w - x * x + y * y - z * z,
            2 * (y * z - w * x),
            2 * (x * z - w * y),
            2 * (y * z + w * x),
            w * w - x * x - y * y + z * z,
        ]
    ).reshape(3, 3)
