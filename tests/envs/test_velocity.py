"""The velocity tasks: models, steps and resets against Gymnasium's environments of version 4, on each
engine, and the rule of the cost by hand."""
# pyright: reportAttributeAccessIssue=false
# (MuJoCo's bindings come without types)

import csv
import functools
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiling import FAST
from scipy import stats

from jaxsafe import envs
from jaxsafe.config import ConfigError
from jaxsafe.envs.velocity.suite import NAMES
from jaxsafe.envs.velocity.task import Velocity, World
from jaxsafe.envs.wrap import ActionRepeat, FrameStack
from jaxsafe.types import State

DATA = Path(__file__).parent.parent / "data"
ROBOTS = list(NAMES)
THEIRS = {"halfcheetah": "half_cheetah"}  # their files, where named otherwise
FLYING = ("ant", "humanoid")  # robots whose speed counts in x and y
EQUAL = [
    "body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat", "body_parentid",
    "body_jntadr", "body_jntnum", "body_geomadr", "body_geomnum", "body_invweight0", "geom_type",
    "geom_bodyid", "geom_size", "geom_pos", "geom_quat", "geom_friction", "geom_contype",
    "geom_conaffinity", "geom_condim", "geom_margin", "geom_gap", "geom_solmix", "geom_priority",
    "geom_solref", "geom_solimp", "jnt_type", "jnt_axis", "jnt_pos", "jnt_range", "jnt_limited",
    "jnt_stiffness", "jnt_margin", "jnt_solref", "jnt_solimp", "dof_damping", "dof_armature",
    "dof_frictionloss", "dof_invweight0", "actuator_gear", "actuator_ctrlrange",
    "actuator_ctrllimited", "actuator_forcelimited", "actuator_trnid", "actuator_trntype",
    "actuator_gainprm", "actuator_biasprm", "actuator_dyntype", "qpos0", "qpos_spring",
]  # fmt: skip
OPTIONS = [
    "timestep", "integrator", "solver", "iterations", "tolerance", "ls_iterations", "cone", "jacobian",
    "density", "viscosity", "wind", "gravity", "impratio", "disableflags", "enableflags",
]  # fmt: skip


class Made(NamedTuple):
    env: Velocity
    reset: Any
    step: Any


@functools.cache
def made(robot: str, engine: str = "c", **options: Any) -> Made:
    """An environment, and its reset and step over a batch."""
    env = envs.make(f"{robot}_velocity", engine=engine, **options)
    reset, step = (jax.jit(jax.vmap(f), compiler_options=FAST) for f in (env.reset, env.step))
    return Made(env, reset, step)


def begin(m: Made, count: int, seed: int = 0) -> State:
    return m.reset(jax.random.split(jax.random.key(seed), count))


def theirs(robot: str) -> Any:
    return gymnasium.make(f"{NAMES[robot]}-v4").unwrapped


# ---- models ------------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_model_is_gymnasium_s_number_by_number(robot):
    folder = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
    their = mujoco.MjModel.from_xml_path(str(folder / f"{THEIRS.get(robot, robot)}.xml"))
    ours = made(robot).env.model
    assert (ours.nq, ours.nv, ours.nu, ours.neq) == (their.nq, their.nv, their.nu, their.neq)
    for name in EQUAL:
        np.testing.assert_allclose(getattr(ours, name), getattr(their, name), 0, 1e-12, err_msg=name)
    for name in OPTIONS:
        if robot == "humanoid" and name in ("solver", "iterations"):
            assert ours.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON  # theirs is PGS with 50
        elif name != "disableflags":  # engine c ends bad states itself
            np.testing.assert_array_equal(getattr(ours.opt, name), getattr(their.opt, name), name)
    assert ours.ntendon == 0  # Humanoid's two have no force


@pytest.mark.parametrize(
    "robot, sizes",
    {
        "ant": (27, 8, 0.05),
        "halfcheetah": (17, 6, 0.05),
        "hopper": (11, 3, 0.008),
        "walker2d": (17, 6, 0.008),
        "swimmer": (8, 2, 0.04),
        "humanoid": (376, 17, 0.015),
    }.items(),
)
def test_sizes_are_those_of_the_original(robot, sizes):
    env = made(robot).env
    assert (env.obs_size, env.action_size) == sizes[:2] and env.step_seconds == pytest.approx(sizes[2])
    assert env.episode_length == 1000 and env.cost_names == ("velocity",)
    assert sum(size for (size,) in env.observation_spec.values()) == env.obs_size


# ---- steps -------------------------------------------------------------------------------------


class Step(NamedTuple):
    """Steps of Gymnasium's from states given in float32, and what it makes of them, each [count, ...].

    obs, velocity: at the state in which the step ends. lagging: the velocity that Gymnasium pays for.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    warmstart: np.ndarray
    action: np.ndarray
    place: np.ndarray
    after: np.ndarray  # qpos
    obs: np.ndarray
    velocity: np.ndarray
    lagging: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray


class Start(NamedTuple):
    """A state in float32 and the action there, each [...]."""

    qpos: np.ndarray
    qvel: np.ndarray
    warmstart: np.ndarray
    action: np.ndarray


def taken(env: Any, robot: str, start: Start) -> Step:
    """One step of Gymnasium's, [...] each."""
    data = env.data

    def place() -> np.ndarray:
        if robot == "humanoid":
            return data.subtree_com[1, :2].copy()
        return np.array([data.qpos[0], data.qpos[1] if robot in ("ant", "swimmer") else 0.0])

    env.set_state(start.qpos.astype(float), start.qvel.astype(float))
    data.qacc_warmstart[:] = start.warmstart
    before = place()
    _, reward, terminated, _, info = env.step(start.action * env.action_space.high.astype(float))
    lagging = np.array([info["x_velocity"], info.get("y_velocity", 0.0)])
    if robot in FLYING:
        mujoco.mj_forward(env.model, data)
        mujoco.mj_rnePostConstraint(env.model, data)
    after, obs, velocity = data.qpos.copy(), env._get_obs(), (place() - before) / env.dt
    return Step(*start, before, after, obs, velocity, lagging, reward, terminated)


def stacked(steps: list[Step]) -> Step:
    return Step(*(np.stack(x) for x in zip(*steps, strict=True)))


@functools.cache
def recorded(robot: str, count: int) -> Step:
    """Steps of random actions, some of them beyond the limits."""
    env, rng = theirs(robot), np.random.default_rng(0)
    data = env.data
    steps: list[Step] = []
    env.reset(seed=0)
    while len(steps) < count:
        action = rng.uniform(-1.2, 1.2, env.model.nu)
        now = (data.qpos, data.qvel, data.qacc_warmstart, action)
        steps.append(taken(env, robot, Start(*(x.astype(np.float32) for x in now))))
        if steps[-1].terminated or len(steps) % 50 == 0:
            env.reset(seed=len(steps))
    return stacked(steps)


@functools.cache
def gait(robot: str) -> Step:
    """Steps of a trained policy, see tests/data/README.md."""
    env = theirs(robot)
    env.reset(seed=0)
    with np.load(DATA / "velocity" / "gaits.npz") as file:
        starts = zip(*(file[f"{robot}.{name}"] for name in Start._fields), strict=True)
        return stacked([taken(env, robot, Start(*start)) for start in starts])


def forced(m: Made, steps: Step) -> State:
    """Our steps from the same states."""
    state = begin(m, len(steps.qpos))
    physics = state.physics.physics.replace(
        qpos=jnp.asarray(steps.qpos),
        qvel=jnp.asarray(steps.qvel),
        warmstart=jnp.asarray(steps.warmstart),
    )
    world = World(physics, jnp.asarray(steps.place, jnp.float32))
    return jax.device_get(m.step(state.replace(physics=world), jnp.asarray(steps.action)))


def compare(robot: str, engine: str, steps: Step) -> dict[str, np.ndarray]:
    """Absolute errors of each step, [count]; of forces on Humanoid's bodies relative to 1000 N.
    `differs`: whether any bit of positions and observations is another than theirs in float32."""
    m = made(robot, engine)
    state = forced(m, steps)
    weight, v = m.env.config.forward_reward_weight, steps.velocity
    reward = steps.reward + weight * (v - steps.lagging)[:, 0]
    speed = np.linalg.norm(v, axis=1) if robot in FLYING else v[:, 0]
    cost = speed > m.env.robot.thresholds["v1"]
    np.testing.assert_array_equal(state.terminated, steps.terminated)
    np.testing.assert_array_equal(state.cost, cost)
    np.testing.assert_array_equal(state.costs[:, 0], state.cost)
    assert not state.info["exception"].any() and not state.info["overflow"].any()
    scale = np.ones(m.env.obs_size)
    if robot == "humanoid":
        scale[-84:] = 1000
    found = ((state.physics.physics.qpos, steps.after), (state.obs, steps.obs))
    errors = {
        "differs": np.any([(x != y.astype(np.float32)).any(1) for x, y in found], axis=0),
        "qpos": abs(state.physics.physics.qpos - steps.after).max(1),
        "obs": (abs(state.obs - steps.obs) / np.maximum(1, abs(steps.obs)) / scale).max(1),
        "reward": abs(state.reward - reward),
        "velocity": abs(state.info["velocity"] - speed),
    }
    return {name: np.asarray(error) for name, error in errors.items()}


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_step_of_engine_c_is_gymnasium_s_to_the_rounding_of_float32(robot):
    """In float64 inside: what is left is that states, rewards and observations are float32. Those of
    all but Humanoid, which has another solver, are Gymnasium's in float32 bit for bit."""
    errors = compare(robot, "c", recorded(robot, 200))
    assert robot == "humanoid" or not errors["differs"].any()
    eps = np.finfo(np.float32).eps
    assert errors["qpos"].max() < 2 * eps
    assert errors["obs"].max() < (2 * eps if robot != "humanoid" else 1e-4)  # Newton's solver and PGS
    assert errors["reward"].max() < 1e-5 and errors["velocity"].max() < 1e-5


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_step_of_a_trained_gait_is_gymnasium_s_too_and_costs_above_the_threshold(robot):
    """Places are float32: what they are rounded by, divided by the time of a step, is in the velocity.
    Humanoid's gait is too slow for a cost."""
    env, steps = made(robot).env, gait(robot)
    errors = compare(robot, "c", steps)
    assert robot == "humanoid" or not errors["differs"].any()
    rounding = np.finfo(np.float32).eps * max(1, abs(steps.after).max())
    assert errors["qpos"].max() < 2 * rounding
    assert errors["obs"].max() < (2 * rounding if robot != "humanoid" else 1e-4)
    weight, dt = env.config.forward_reward_weight, theirs(robot).dt
    assert errors["velocity"].max() < 1e-5 + rounding / dt
    assert errors["reward"].max() < 1e-5 + weight * rounding / dt
    speed = np.linalg.norm(steps.velocity, axis=1) if robot in FLYING else steps.velocity[:, 0]
    fast = speed > env.robot.thresholds["v1"]
    assert fast.any() == (robot != "humanoid") and not fast.all()


def test_the_velocity_of_the_last_stage_is_near_that_of_the_end():
    """What Gymnasium pays Ant and Humanoid for; the other robots' velocity is that of the end."""
    for robot in ROBOTS:
        steps = recorded(robot, 200)
        off = abs(steps.lagging - steps.velocity)[:, 0]
        assert off.max() < ({"ant": 0.1, "humanoid": 0.01}.get(robot, 1e-9))
        assert np.median(off) < 2e-3


# float32, median and 99%: reference figures of MJX are 2e-7 and 4e-6 for qpos
WITHIN = {"qpos": (1e-6, 1e-5), "obs": (1e-5, 2e-3), "reward": (1e-4, 5e-3), "velocity": (1e-4, 5e-3)}


def within(errors: dict[str, np.ndarray]) -> None:
    for name, (middle, most) in WITHIN.items():
        found = np.percentile(errors[name], (50, 99))
        assert found[0] < middle and found[1] < most, (name, found)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["jax", "warp"])
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_step_of_the_other_engines_is_gymnasium_s_in_float32(robot, engine):
    within(compare(robot, engine, recorded(robot, 200)))


@pytest.mark.parametrize("engine", ["jax", "warp"])
def test_a_step_of_hopper_on_the_other_engines_is_gymnasium_s_in_float32(engine):
    within(compare("hopper", engine, recorded("hopper", 40)))


# ---- cost, reward, termination ------------------------------------------------------------------

THRESHOLDS = {  # m/s: v1, v0
    "ant": (2.6222, 2.5745),
    "halfcheetah": (3.2096, 2.8795),
    "hopper": (0.7402, 0.37315),
    "walker2d": (2.3415, 1.7075),
    "swimmer": (0.2282, 0.04845),
    "humanoid": (1.4149, 2.3475),
}


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("version", ["v1", "v0"])
def test_a_step_costs_1_above_the_threshold(robot, version):
    env = envs.make(f"Safety{NAMES[robot]}Velocity-{version}", engine="c")
    limit = THRESHOLDS[robot][version == "v0"]
    assert (env.threshold, env.config.thresholds) == (limit, version)

    def cost(x: float, y: float = 0.0) -> float:
        return float(env.cost(jnp.array([x, y], jnp.float32)))

    assert cost(limit - 1e-6) == 0 and cost(limit + 1e-6) == 1
    sideways = robot in FLYING or (robot, version) == ("swimmer", "v0")
    assert cost(-2 * limit) == sideways  # backwards
    assert cost(0.0, 2 * limit) == cost(0.0, -2 * limit) == sideways
    assert cost(0.8 * limit, 0.8 * limit) == sideways


def test_velocities_cost_what_they_cost_in_safety_gymnasium():
    """Twelve around each threshold, see tests/data/README.md."""
    with (DATA / "velocity" / "costs.csv").open() as file:
        rows = list(csv.DictReader(file))
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    assert len(tasks) == 2 * len(ROBOTS) and len(rows) == 12 * len(tasks)
    for name in tasks:
        here = [row for row in rows if row["task"] == name]
        vx, vy, cost = (np.array([float(row[k]) for row in here]) for k in ("vx", "vy", "cost"))
        ours = jax.vmap(envs.make(name, engine="c").cost)(jnp.stack([vx, vy], -1))
        np.testing.assert_array_equal(ours, cost, name)


def test_a_threshold_of_one_s_own_counts():
    still = envs.make("hopper_velocity", engine="c", velocity_threshold=0.0)
    assert still.threshold == 0
    env = envs.make("hopper_velocity", engine="c", velocity_threshold=0.5)
    assert env.threshold == 0.5 and float(env.cost(jnp.array([0.6, 0.0]))) == 1
    assert float(env.cost(jnp.array([0.5, 0.0]))) == 0  # at the threshold


@pytest.mark.parametrize(
    "robot, height, fallen",
    [("ant", 2, 1.1), ("hopper", 1, 0.65), ("walker2d", 1, 0.75), ("humanoid", 2, 2.05)],
)
def test_the_step_in_which_a_robot_falls_ends_the_episode_and_is_paid(robot, height, fallen):
    """The healthy reward is paid on the last step, too, as in version 4."""
    for ends in (True, False):
        m = made(robot, terminate_when_unhealthy=ends)
        state = begin(m, 2)
        physics = state.physics.physics
        qpos = physics.qpos.at[1, height].set(fallen)
        state = state.replace(physics=state.physics.replace(physics=physics.replace(qpos=qpos)))
        after = m.step(state, jnp.zeros((2, m.env.action_size)))
        assert after.terminated.tolist() == [False, ends]
        cfg = m.env.config
        place, old = after.physics.place[:, 0], state.physics.place[:, 0]
        paid = after.reward - cfg.forward_reward_weight * (place - old) / m.env.step_seconds
        np.testing.assert_allclose(paid, [cfg.healthy_reward, cfg.healthy_reward * ends], atol=1e-3)


def test_a_height_is_healthy_within_its_range():
    for robot, (low, high) in {
        "ant": (0.2, 1.0),
        "humanoid": (1.0, 2.0),
        "walker2d": (0.8, 2.0),
    }.items():
        m = made(robot)
        physics = jax.tree.map(lambda x: x[0], begin(m, 1).physics.physics)
        for z, healthy in ((low - 1e-3, 0), (low + 1e-3, 1), (high - 1e-3, 1), (high + 1e-3, 0)):
            qpos = physics.qpos.at[m.env.robot.height].set(z)
            assert m.env.healthy(qpos, physics.qvel) == healthy


@pytest.mark.parametrize("robot, limit", [("hopper", 0.2), ("walker2d", 1.0)])
def test_a_pitch_is_healthy_within_its_range(robot, limit):
    env = made(robot).env
    upright = jnp.asarray(env.model.qpos0, jnp.float32)
    for pitch in (limit, -limit):
        for share, healthy in ((0.99, True), (1.01, False)):
            qpos = upright.at[2].set(share * pitch)
            assert env.healthy(qpos, jnp.zeros(env.model.nv)) == healthy


@pytest.mark.parametrize(
    "robot, options",
    [
        ("ant", {}),
        ("hopper", {}),
        ("walker2d", {}),
        ("humanoid", {}),
        ("hopper", {"healthy_state_range": (-3.0, 3.0)}),  # its speeds are observed up to 10
    ],
)
def test_the_observation_tells_whether_the_episode_has_ended(robot, options):
    m = made(robot, **options)
    end: Any = m.env.observed_end
    state, falls = begin(m, 32), 0
    for t in range(60):
        action = jax.random.uniform(jax.random.key(t), (32, m.env.action_size), minval=-1.0)
        state = m.step(state, action)
        np.testing.assert_array_equal(end(state.obs), state.terminated)
        falls += state.terminated.sum()
    assert falls > 0


def test_wrappers_tell_the_end_of_the_newest_step():
    env: Any = FrameStack(ActionRepeat(made("hopper").env, 3), 2)
    step = jax.jit(jax.vmap(env.step), compiler_options=FAST)
    state, falls = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 32)), 0
    for t in range(12):
        action = jax.random.uniform(jax.random.key(t), (32, env.action_size), minval=-1.0)
        state = step(state, action)
        np.testing.assert_array_equal(env.observed_end(state.obs), state.terminated)
        falls += state.terminated.sum()
    assert falls > 0


def test_a_task_without_an_end_tells_none():
    assert made("halfcheetah").env.observed_end is None
    assert made("ant", terminate_when_unhealthy=False).env.observed_end is None
    assert FrameStack(envs.make("point_goal1"), 2).observed_end is None


def test_hopper_is_healthy_wherever_it_is_and_by_its_joints_and_speeds():
    env = made("hopper").env
    qpos, qvel = jnp.array([500.0, 1.25, 0.0, 0.0, 0.0, 0.0]), jnp.zeros(6)
    assert env.healthy(qpos, qvel)
    assert not env.healthy(qpos.at[3].set(-101.0), qvel)
    assert not env.healthy(qpos, qvel.at[5].set(101.0))


@pytest.mark.parametrize("change", [{"pitch": 0.25}, {"speed": 101.0}, {"speed": -101.0}, {}])
def test_hopper_falls_by_its_pitch_and_by_any_speed_out_of_range(change):
    m = made("hopper")
    state = begin(m, 1)
    physics = state.physics.physics
    if "pitch" in change:
        physics = physics.replace(qpos=physics.qpos.at[0, 2].set(change["pitch"]))
    if "speed" in change:
        physics = physics.replace(qvel=physics.qvel.at[0, 0].set(change["speed"]))
    after = m.step(state.replace(physics=World(physics, state.physics.place)), jnp.zeros((1, 3)))
    assert after.terminated[0] == bool(change)
    if "speed" in change:  # what is observed is clipped
        sign = np.sign(change["speed"])
        assert after.obs[0, 5] == 10 * sign and sign * after.physics.physics.qvel[0, 0] > 100


def test_an_action_beyond_the_limits_does_no_more_and_is_paid_for():
    m = made("ant")
    state = begin(m, 2)
    state = jax.tree.map(lambda x: jnp.stack([x[0], x[0]]), state)
    after = m.step(state, jnp.stack([jnp.ones(8), 2 * jnp.ones(8)]))
    np.testing.assert_array_equal(after.obs[0], after.obs[1])
    np.testing.assert_allclose(after.reward[0] - after.reward[1], 0.5 * 8 * (4 - 1), rtol=1e-5)


def test_a_world_that_is_not_finite_ends_in_its_last_good_state_and_leaves_the_others():
    m = made("halfcheetah")
    state = begin(m, 3)
    action = jnp.zeros((3, 6)).at[1].set(jnp.nan)
    after = m.step(state, action)
    assert after.terminated.tolist() == [False, True, False]
    assert after.info["exception"].tolist() == [0, 1, 0]
    np.testing.assert_array_equal(after.obs[1], state.obs[1])
    assert after.reward[1] == 0 and after.cost[1] == 0 and jnp.isfinite(after.obs).all()


# ---- resets and episodes ------------------------------------------------------------------------

NOISE = {
    "ant": 0.1,
    "halfcheetah": 0.1,
    "hopper": 0.005,
    "walker2d": 0.005,
    "swimmer": 0.1,
    "humanoid": 0.01,
}


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_reset_draws_as_gymnasium_s(robot):
    """Kolmogorov's and Smirnov's test of each coordinate; a quaternion's are not normalised."""
    m, width = made(robot), NOISE[robot]
    state = begin(m, 1000)
    physics = state.physics.physics
    drawn = {
        "uniform": np.asarray(physics.qpos - m.env.model.qpos0).T,
        "velocity": np.asarray(physics.qvel).T,
    }
    gaussian = robot in ("ant", "halfcheetah")
    speeds = stats.norm(0, width) if gaussian else stats.uniform(-width, 2 * width)
    for columns, law in (
        (drawn["uniform"], stats.uniform(-width, 2 * width)),
        (drawn["velocity"], speeds),
    ):
        for column in columns:
            assert stats.kstest(column, law.cdf).pvalue > 1e-4
    columns = np.concatenate([*drawn.values()])
    assert abs(np.corrcoef(columns) - np.eye(len(columns))).max() < 0.16  # 5 standard errors
    env = theirs(robot)
    env.set_state(np.asarray(physics.qpos[0], float), np.asarray(physics.qvel[0], float))
    np.testing.assert_allclose(state.obs[0], env._get_obs(), rtol=1e-4, atol=1e-5)
    assert state.reward[0] == 0 and not state.terminated.any()


RANDOM = {  # return and its deviation, cost, length: 20 episodes of Gymnasium's
    "ant": (-38, 81, 1.3, 129),
    "halfcheetah": (-265, 59, 0, 1000),
    "hopper": (19, 10, 0, 24),
    "walker2d": (3.4, 5, 0, 19),
    "swimmer": (-1.1, 14, 256, 1000),
    "humanoid": (115, 32, 0, 23),
}


def random_episodes(robot: str, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return, cost and length of each of `count` episodes of uniform actions."""
    m = made(robot)
    state, alive = begin(m, count), np.ones(count, bool)
    sums = np.zeros((3, count))
    for t in range(m.env.episode_length):
        action = jax.random.uniform(jax.random.key(t), (count, m.env.action_size), minval=-1.0)
        state = m.step(state, action)
        sums += alive * np.stack([state.reward, state.cost, np.ones(count)])
        alive &= ~np.asarray(state.terminated)
        if not alive.any():
            break
    return sums[0], sums[1], sums[2]


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_random_policy_makes_what_it_makes_in_gymnasium(robot):
    ret, cost, length = random_episodes(robot, 200)
    mean, deviation, theirs_cost, theirs_length = RANDOM[robot]
    either = np.sqrt(1 / 20 + 1 / 200)  # both are samples
    assert abs(ret.mean() - mean) < 3 * either * max(deviation, ret.std())
    assert abs(cost.mean() - theirs_cost) <= 3 * either * cost.std() + 0.05
    assert abs(length.mean() - theirs_length) <= 3 * either * length.std() + 0.5


def test_the_safe_ceiling_is_what_a_run_at_the_threshold_earns():
    """An agent that never costs cannot earn more: T (w threshold + healthy)."""
    ceilings = [3622, 3210, 1740, 2342 + 1000, 228, 6769]
    assert [round(made(robot).env.ceiling) for robot in ROBOTS] == ceilings


# ---- options -----------------------------------------------------------------------------------


def test_options_that_mean_nothing_for_a_robot_are_refused():
    for options, says in (
        ({"robot": "bee"}, "env.robot='bee'"),
        ({"healthy_z_range": (2.0, 1.0)}, r"healthy_z_range=\[2.0, 1.0\]: expected \[min, max\]"),
        ({"frame_skip": 0}, "env.frame_skip=0: expected a whole number between 1 and 1000"),
        ({"hazards_num": 3}, "unknown option env.hazards_num"),
    ):
        with pytest.raises(ConfigError, match=says):
            envs.make("hopper_velocity", engine="c", **options)
    with pytest.raises(ConfigError, match="swimmer has no height: expected null"):
        envs.make("swimmer_velocity", engine="c", healthy_z_range=(0.0, 1.0))
    with pytest.raises(ConfigError, match="ant has no pitch"):
        envs.make("ant_velocity", engine="c", healthy_angle_range=(0.0, 1.0))


@pytest.mark.parametrize("factor, room", [(1.0, (11, 38)), (2.0, (22, 76)), (0.01, (1, 1))])
def test_the_room_for_contacts_is_a_multiple_of_the_estimate_and_never_none(factor, room):
    env = envs.make("hopper_velocity", engine="c", contact_room=factor)
    assert env.simulation.room == room


def test_an_environment_of_one_s_own_is_made_of_a_config():
    cfg = envs.VelocityConfig(robot="swimmer", frame_skip=2, velocity_threshold=0.1)
    env = envs.make(cfg, engine="c", num_steps=10)
    assert env.name == "custom" and env.episode_length == 10 and env.step_seconds == pytest.approx(0.02)
    envs.register("slow_swimmer", env)
    assert envs.env_defaults("slow_swimmer")["velocity_threshold"] == 0.1
    assert envs.make("slow_swimmer", engine="c").config == env.config
    del envs.ENVS["slow_swimmer"]
