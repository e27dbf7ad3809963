"""Recordings of the original engine, replayed step by step.

A recording (format `safety-gym-golden/1`, an .npz file) holds states, and steps between them. Each
step is replayed on its own: set the recorded state, apply the recorded action, compare what follows.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.config import ConfigError
from jaxsafe.envs.engines import Physics, Readings
from jaxsafe.envs.safety_gym import scene as scenes
from jaxsafe.envs.safety_gym.arena import World
from jaxsafe.envs.safety_gym.config import SafetyGymConfig, config_from_plain
from jaxsafe.envs.safety_gym.task import Drive, SafetyGym
from jaxsafe.types import State

# Velocities and poses of a well-conditioned step agree this well (m and rad, per s).
POSE_TOLERANCE = {"Point": 1e-5, "Car": 1e-4, "Doggo": 1e-4}
VELOCITY_TOLERANCE = {"Point": 1e-3, "Car": 5e-3, "Doggo": 1e-2}
WELL_CONDITIONED = 1e-5  # largest recorded spread of the robot's pose over versions and rounding
SPREADS = 4.0  # a component may differ by so many times its own recorded spread
UNDECIDED = 0.002  # share of steps whose events may differ without a mark in the recording
GRAZE = 1e-3  # m: lidar readings that change when shapes grow or shrink so much hang on rounding
BATCH = 512  # steps replayed at once


class Recording:
    """One file: `arrays` by key, and `meta`."""

    def __init__(self, path: str | Path):
        self.name = Path(path).stem
        try:
            with np.load(path, allow_pickle=False) as file:
                self.arrays = {key: file[key] for key in file.files}
            self.meta: dict[str, Any] = json.loads(str(self.arrays.pop("meta")))
            self.rows = self.arrays["step.state"]
        except (OSError, ValueError, KeyError) as error:
            raise ConfigError(f"{path}: not a recording ({error})") from None
        segments = np.repeat(np.arange(len(self["seg.n_steps"])), self["seg.n_steps"])
        self.segments = segments  # of each step

    def __getitem__(self, key: str) -> np.ndarray:
        return self.arrays[key]

    def get(self, key: str, default: Any) -> np.ndarray:
        return self.arrays.get(key, np.full(len(self.rows), default))


class NextGoal(NamedTuple):
    """The goal that followed the recorded step. The environment would draw it."""

    goal: Any  # [2], m
    button: Any  # int32 []


class Replay(SafetyGym):
    """The environment as it was recorded: the next goal is given instead of drawn, and the welds of
    gremlins are those of MuJoCo 3.17. Its costs are amounts, of which a recording has those, too."""

    def __init__(self, recording: Recording, engine: str = "auto", awake: int | None = None):
        self._given = jnp.zeros(2), jnp.int32(0)  # traced already when the shapes are found
        amounts = {"constrain_indicator": False}
        config = config_from_plain(recording.meta["config"] | amounts | {"awake": awake})
        super().__init__(config, engine, recording.name)

    def _build_scene(self, cfg: SafetyGymConfig, mjx: bool = False) -> scenes.Scene:
        return scenes.with_soft_gremlins(super()._build_scene(cfg, mjx))

    def after(
        self, world: World, given: NextGoal, drive: Drive, moved: Physics, readings: Readings
    ) -> State:
        """The state after a step whose physics made `moved` and `readings`."""
        self._given = given.goal, given.button
        zero = jnp.zeros(())
        obs = jnp.zeros(self.obs_size)  # `compare` refuses dicts
        costs = jnp.zeros(len(self.cost_names))
        info = {"goal_met": zero, "exception": zero, "overflow": zero}
        before = State(world, obs, zero, zero, costs, jnp.bool_(False), info)
        return self.judge(before, drive, moved, readings)

    def _next_goal(self, world: World, key: jax.Array, wanted: jax.Array) -> tuple[World, jax.Array]:
        place, button = self._given
        return self._with_goal(world, place, button, wanted), jnp.bool_(True)


def worlds(env: SafetyGym, recording: Recording) -> World:
    """The recorded state before each step, as a batch of worlds (numpy arrays)."""
    rows, segments, meta = recording.rows, recording.segments, recording.meta
    bodies = {name: i for i, name in enumerate(meta["body_names"])}
    state = {k: recording[f"state.{k}"][rows] for k in ("qpos", "qvel", "qacc_warmstart", "time")}
    start = np.concatenate([recording["seg.robot_xy0"], recording["seg.robot_rot0"][:, None]], 1)[
        segments
    ]
    if env.scene.planar:
        state = to_world(state, start)
    columns = [
        meta["layout_names"].index(n) if n in meta["layout_names"] else -1 for n in env.place.names
    ]
    layout = recording["seg.layout"][segments][:, columns]
    if "goal" in env.place.names:
        layout[:, env.place.names.index("goal")] = recording["state.goal_pos"][rows][:, :2]
    body_pos, body_quat = recording["seg.body_pos"][segments], recording["seg.body_quat"][segments]
    qpos0 = recording["seg.qpos0"][segments]
    positions, turns = [], []
    for i in range(env.scene.mocaps["gremlins"]):
        adr = env.scene.qpos_slice("gremlins").start + 7 * i
        lift = np.array([0, 0, env.config.gremlins_size])
        positions.append(qpos0[:, adr : adr + 3] + lift)
        turns.append(qpos0[:, adr + 3 : adr + 7])
    for kind in scenes.MOCAPS[1:]:
        for i in range(env.scene.mocaps[kind]):
            positions.append(body_pos[:, bodies[f"{kind[:-1]}{i}"]])
            turns.append(body_quat[:, bodies[f"{kind[:-1]}{i}"]])
    count = len(rows)
    last = {
        k: np.zeros(count) if np.isnan(recording[f"state.{k}"]).all() else recording[f"state.{k}"][rows]
        for k in ("last_dist_goal", "last_dist_box", "last_box_goal")  # NaN: not of this task
    }
    com = recording.arrays.get("state.last_robot_com")
    timestep = env.scene.model.opt.timestep
    return World(
        bodies=Physics(
            qpos=f32(state["qpos"]),
            qvel=f32(state["qvel"]),
            warmstart=f32(state["qacc_warmstart"]),
            mocap_pos=f32(np.stack(positions, 1) if positions else np.zeros((count, 0, 3))),
            mocap_quat=f32(np.stack(turns, 1) if turns else np.zeros((count, 0, 4))),
            substeps=i32(np.round(state["time"] / timestep)),
        ),
        layout=f32(layout),
        start=f32(start),
        goal_button=i32(np.maximum(recording["state.goal_button"][rows], 0)),
        buttons_timer=i32(np.maximum(recording["state.buttons_timer"][rows], 0)),
        last_dist_goal=f32(last["last_dist_goal"]),
        last_dist_box=f32(last["last_dist_box"]),
        last_box_goal=f32(last["last_box_goal"]),
        last_com=f32(com[rows] if com is not None else np.zeros((count, 3))),
        steps=i32(recording["state.episode_step"][rows]),
        key=f32(np.zeros(count)),  # replaced: a replay draws nothing
    )


def f32(x: np.ndarray) -> Any:
    """A numpy array where a field says JAX's; `jit` takes both."""
    return np.asarray(x, np.float32)


def i32(x: np.ndarray) -> Any:
    return np.asarray(x, np.int32)


def turn(vectors: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotate the first two columns by `angle` (rad), row by row."""
    c, s = np.cos(angle), np.sin(angle)
    out = np.array(vectors, np.float64)
    out[:, 0] = c * vectors[:, 0] - s * vectors[:, 1]
    out[:, 1] = s * vectors[:, 0] + c * vectors[:, 1]
    return out


def to_world(state: dict[str, np.ndarray], start: np.ndarray) -> dict[str, np.ndarray]:
    """Point's recorded coordinates are relative to its start pose; ours are the world's."""
    state = state | {k: turn(state[k], start[:, 2]) for k in ("qpos", "qvel", "qacc_warmstart")}
    state["qpos"][:, :3] += start
    return state


def from_world(qpos: np.ndarray, qvel: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    qpos = np.array(qpos, np.float64)
    qpos[:, :3] -= start
    return turn(qpos, -start[:, 2]), turn(np.asarray(qvel, np.float64), -start[:, 2])


@dataclass
class Comparison:
    """Errors of a replay: per component [steps], and events that differ [steps]."""

    name: str
    engine: str
    errors: dict[str, np.ndarray]
    mismatches: dict[str, np.ndarray]
    strict: np.ndarray  # steps on which errors are bounded
    undecided: np.ndarray  # steps whose events MuJoCo's own versions dispute
    tolerances: dict[str, np.ndarray]  # per component, [steps]

    def past(self, name: str) -> np.ndarray:
        """Strict steps on which a component is past its tolerance, bool [steps]."""
        return self.strict & ~(self.errors[name] <= self.tolerances[name])

    def failures(self) -> list[str]:
        """What is past its tolerance, a line each."""
        lines = []
        for name, error in self.errors.items():
            over = self.past(name)
            if over.any():
                worst = np.argmax(np.where(over, error, -1))
                lines.append(
                    f"{name}: {over.sum()} steps past the tolerance, "
                    f"worst {error[worst]:.2g} at step {worst}"
                )
        allowed = int(np.ceil(UNDECIDED * len(self.strict)))
        for name, differs in self.mismatches.items():
            if (differs & ~self.undecided).sum() > allowed:
                lines.append(
                    f"{name}: {(differs & ~self.undecided).sum()} events differ, {allowed} may"
                )
        return lines


def compare(recording: Recording, engine: str = "auto", awake: int | None = None) -> Comparison:
    """Replay every step of a recording and compare it with what was recorded."""
    env = Replay(recording, engine, awake)
    if not env.config.observation_flatten:
        raise ConfigError(f"{recording.name}: observation_flatten=false cannot be replayed")
    before = worlds(env, recording)
    after = replay(env, recording, before)
    grazing = np.zeros(after.obs.shape, bool)
    if env.config.lidar_type == "natural":
        for slack in (-GRAZE, GRAZE):
            env.ray_slack = slack
            grazing |= np.abs(replay(env, recording, before).obs - after.obs) > GRAZE
    return compare_states(recording, env, before, after, grazing)


def replay(env: Replay, recording: Recording, before: World) -> State:
    """The states after each recorded step (numpy arrays)."""
    rows = recording.rows + 1
    goal = f32(recording["state.goal_pos"][rows][:, :2])
    button = i32(np.maximum(recording["state.goal_button"][rows], 0))

    # in parts around the physics: JAX's compilation cache keeps no program with a host callback
    @jax.jit
    @jax.vmap
    def drive(world: World, action: jax.Array) -> Drive:
        return env.drive(world.replace(key=jax.random.key(0)), action)

    @jax.jit
    @jax.vmap
    def state_after(
        world: World, given: NextGoal, drive: Drive, moved: Physics, readings: Readings
    ) -> State:
        after = env.after(world, given, drive, moved, readings)
        return after.replace(physics=after.physics.replace(key=world.key))

    run = jax.vmap(env._engine.run)
    run = run if env.engine == "c" else jax.jit(run)  # a callback alone is not compiled

    def step(world: World, action: jax.Array, given: NextGoal) -> State:
        driven = drive(world, action)
        return state_after(world, given, driven, *run(world.bodies, driven.ctrl, driven.substeps))

    inputs = (before, f32(recording["step.action"]), NextGoal(goal, button))
    count = len(rows)
    padding = -count % BATCH
    inputs = jax.tree.map(lambda x: np.concatenate([x, np.repeat(x[-1:], padding, 0)]), inputs)
    starts = range(0, count, BATCH)
    chunks = [
        jax.device_get(step(*jax.tree.map(lambda x, i=i: x[i : i + BATCH], inputs))) for i in starts
    ]
    return jax.tree.map(lambda *x: np.concatenate(x)[:count], *chunks)


def compare_states(
    recording: Recording, env: SafetyGym, before: World, result: State, grazing: np.ndarray
) -> Comparison:
    """Set the states after each step beside the recorded ones; grazing lidar bins are left out."""
    robot, after = recording.meta["robot"], recording.rows + 1
    world, physics = result.physics, result.physics.bodies
    nq, nv = recording.meta["robot_nq"], recording.meta["robot_nv"]
    qpos, qvel = np.asarray(physics.qpos, np.float64), np.asarray(physics.qvel, np.float64)
    if env.scene.planar:
        qpos, qvel = from_world(qpos, qvel, np.asarray(before.start, np.float64))
    want_qpos, want_qvel = recording["state.qpos"][after], recording["state.qvel"][after]

    def largest(a: Any, b: np.ndarray) -> np.ndarray:
        return np.abs(a - b).reshape(len(a), -1).max(1, initial=0)

    errors = {
        "robot pose": largest(qpos[:, :nq], want_qpos[:, :nq]),
        "robot velocity": largest(qvel[:, :nv], want_qvel[:, :nv]),
        "object pose": largest(qpos[:, nq:], want_qpos[:, nq:]),
        "object velocity": largest(qvel[:, nv:], want_qvel[:, nv:]),
        "reward": largest(result.reward, recording["step.reward"]),
    }
    spread = np.maximum(
        recording.get("spread.version_robot_qpos", 0), recording.get("spread.f32_robot_qpos", 0)
    )
    strict = spread < WELL_CONDITIONED
    if robot == "Car":
        strict &= before.steps > 0
    pose, velocity = POSE_TOLERANCE[robot], VELOCITY_TOLERANCE[robot]
    tolerances = {
        "robot pose": pose,
        "robot velocity": velocity,
        "object pose": np.inf,
        "object velocity": np.inf,
        "reward": 3 * pose,
    }
    for part in recording.meta["obs_flat_order"]:
        columns = slice(part["start"], part["stop"])
        want = recording["obs_flat"][after][:, columns]
        got = np.where(grazing[:, columns], want, result.obs[:, columns])
        errors[part["name"]] = largest(got, want)
        tolerances[part["name"]] = obs_tolerance(part["name"], pose, velocity)
    mismatches: dict[str, Any] = {
        "goal_met": result.info["goal_met"].astype(bool) != recording["step.goal_met"]
    }
    costs = {f"cost_{k}": cost for k, cost in zip(env.cost_names, result.costs.T, strict=True)}
    tolerances |= {k: amount_tolerance(env, k, pose, velocity) for k in costs}
    for name, cost in {**costs, "cost": result.cost}.items():
        mismatches[name] = differs = (cost > 0) != (recording[f"step.{name}"] > 0)
        errors[name] = np.where(differs, 0.0, np.abs(cost - recording[f"step.raw_{name}"]))
    if env.config.task == "button":
        mismatches["buttons_timer"] = world.buttons_timer != recording["state.buttons_timer"][after]
    done = result.terminated | (world.steps >= env.config.num_steps)
    mismatches["done"] = done != recording["step.done"]
    undecided = np.zeros(len(after), bool)
    for key in ("version_cost", "f32_cost", "version_goal", "f32_goal"):
        undecided |= recording.get(f"spread.{key}_mismatch", False).astype(bool)
    tolerances = {k: np.maximum(v, SPREADS * spread_of(recording, k)) for k, v in tolerances.items()}
    tolerances["cost"] = sum((tolerances[k] for k in costs), np.zeros(len(after)))
    return Comparison(recording.name, env.engine, errors, mismatches, strict, undecided, tolerances)


def spread_of(recording: Recording, name: str) -> np.ndarray:
    """How far MuJoCo versions and float32 rounding move this component of each step."""
    names = {"robot pose": "robot_qpos", "robot velocity": "robot_qvel", "reward": "reward"}
    names |= {"object pose": "obj_qpos", "object velocity": "obj_qvel"}
    names |= {"cost_vases_displace": "obj_qpos", "cost_vases_velocity": "obj_qvel"}
    names |= {"cost_hazards": "robot_qpos"}  # what else touches shows in the observed forces
    key = names.get(name, "obs")
    versions, rounding = (recording.get(f"spread.{kind}_{key}", 0.0) for kind in ("version", "f32"))
    return np.nan_to_num(np.maximum(versions, rounding))  # nan where the goal changed: no spread known


def obs_tolerance(name: str, pose: float, velocity: float) -> float:
    """Positions are seen as well as the pose, speeds as the velocity, forces less well."""
    if name in ("velocimeter", "gyro") or name.startswith(("jointvel", "ballangvel", "qvel")):
        return velocity
    if name == "accelerometer" or name.startswith("touch"):
        return 10 * velocity
    return 10 * pose


def amount_tolerance(env: SafetyGym, name: str, pose: float, velocity: float) -> float:
    """Of a cost's amount. Where MuJoCo itself moves the objects, they move and touch as recorded."""
    cfg = env.config
    if name == "cost_hazards":
        return 3 * pose * cfg.hazards_cost
    if env.engine != "c":
        return np.inf
    if name == "cost_vases_displace":
        return 3 * pose * cfg.vases_displace_cost
    if name == "cost_vases_velocity":
        return velocity * cfg.vases_velocity_cost
    return 1e-6  # a number of contact points, times the cost of one
