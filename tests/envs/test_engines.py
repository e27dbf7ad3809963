"""Engines agree or refuse with a reason, and environments run under the shared rollout."""
# pyright: reportAttributeAccessIssue=false
# (MuJoCo's bindings come without types)

import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiling import FAST
from mujoco import mjx
from mujoco.mjx._src import forward, math
from tasks import task

from jaxsafe import envs
from jaxsafe.config import ConfigError
from jaxsafe.envs import engines
from jaxsafe.envs.engines.jax import contacts as jax_contacts
from jaxsafe.envs.engines.jax import engine as jax_engine
from jaxsafe.envs.engines.jax import solver as jax_solver
from jaxsafe.envs.safety_gym import recording, scene
from jaxsafe.envs.safety_gym.config import config_from_plain as read_config
from jaxsafe.learn.rollout import collect, init_rollout, memoryless

DATA = Path(__file__).parent.parent / "data"


def test_an_unknown_engine_gets_the_nearest():
    with pytest.raises(ConfigError, match=r"env.engine='wrap'; did you mean 'warp'"):
        envs.make("point_goal0", engine="wrap")


def test_auto_is_the_engine_of_the_device():
    if jax.default_backend() != "cpu":
        pytest.skip("needs a CPU")
    assert envs.make("point_goal0").engine == "c"


def test_the_warp_engine_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(ConfigError, match=r"warp-lang is not installed; pip install 'jaxsafe\[gpu\]'"):
        envs.make("point_goal0", engine="warp")


def test_the_jax_engine_is_silent_where_warp_is_not_installed():
    made = "jaxsafe.make('point_goal0', engine='jax')"
    lines = ["sys.modules['warp'] = None", "import jaxsafe", made]
    command = [sys.executable, "-c", "; ".join(["import sys", *lines])]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout) == (0, "")


def test_on_a_gpu_whose_driver_is_too_old_for_warp_the_engine_is_jax_and_warp_says_why(monkeypatch):
    wp = pytest.importorskip("warp")
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(wp, "get_cuda_toolkit_version", lambda: (13, 4))
    monkeypatch.setattr(wp, "get_cuda_driver_version", lambda: (12, 4))
    monkeypatch.setattr(wp, "is_cuda_available", lambda: False)
    env = envs.make("point_goal0", engine="c")
    assert engines.default_engine() == "jax"
    with pytest.raises(ConfigError, match=r"built for CUDA 13\.4, and the driver is for CUDA 12\.4"):
        engines.make_engine("warp", env.scene.simulation(env.config))
    monkeypatch.setattr(wp, "is_cuda_available", lambda: True)
    assert engines.default_engine() == "warp"


def test_an_engine_that_nobody_knows_is_refused_by_the_maker():
    env = envs.make("point_goal0", engine="c")
    with pytest.raises(ConfigError, match=r"valid: auto, c, jax, warp|did you mean"):
        engines.make_engine("gazebo", env.scene.simulation(env.config))


def agreement(name: str, steps: int, tolerance: float) -> float:
    """In what share of steps engine `jax` goes where `c` goes, each from a state of `c`."""
    c, mjx = task(name), task(name, engine="jax")
    state, good = c.begin(), []
    actions = jax.random.uniform(jax.random.key(7), (steps, 4, c.env.action_size), minval=-1)
    for k, action in enumerate(actions):
        twin = mjx.step(state, action)
        state = c.step(state, action)
        if k == 0 and name.startswith("car"):
            continue  # its wheels start 1e-17 m from the floor: not well-conditioned (docs/fidelity.md)
        pairs = (
            (twin.physics.bodies.qpos, state.physics.bodies.qpos),
            (twin.reward[:, None], state.reward[:, None]),
            (mjx.part(twin, "goal_lidar"), c.part(state, "goal_lidar")),
            (twin.cost[:, None] / tolerance, state.cost[:, None] / tolerance),  # equal
        )
        good.append(np.all([np.abs(a - b).max(1) <= tolerance for a, b in pairs], axis=0))
    return float(np.mean(good))


def test_the_jax_engine_multiplies_matrices_in_full_float32_on_every_device():
    env = envs.make("point_goal0", engine="jax")

    def step(state, action):
        return jax.vmap(env.step)(state, action), None

    def train(state):
        return jax.lax.scan(step, state, jnp.zeros((3, 2, 2)))

    state = jax.eval_shape(jax.vmap(jax.vmap(env.reset)), jax.random.split(jax.random.key(0), (2, 2)))
    program = jax.jit(jax.vmap(train)).lower(state).as_text()
    products = [line for line in program.splitlines() if "dot_general" in line]
    assert len(products) > 10 and all("precision = [HIGHEST, HIGHEST]" in line for line in products)


def test_the_jax_engine_agrees_with_c_where_nothing_touches():
    assert agreement("point_goal0", 4, 1e-4) == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["point_goal1", "point_push1", "car_goal2", "doggo_goal1"])
def test_the_jax_engine_agrees_with_c_among_objects(name):
    """In the share of steps that docs/fidelity.md states; single contacts may fall otherwise."""
    assert agreement(name, 10, 1e-3) >= 0.93


def separated(model: mujoco.MjModel, data: mujoco.MjData, wanted: float) -> np.ndarray:
    """The cylinder's pose, a random one with `wanted` (m) between it and the box; what MuJoCo says of
    the pair: distance, the direction from cylinder to box."""
    direction, low, high = data.qpos[:3] / np.linalg.norm(data.qpos[:3]), 0.0, 1.5
    fromto = np.zeros(6)
    for _ in range(25):
        middle = (low + high) / 2
        data.qpos[:3] = middle * direction
        mujoco.mj_kinematics(model, data)
        distance = mujoco.mj_geomDistance(model, data, 0, 1, 3.0, fromto)
        low, high = (middle, high) if distance < wanted else (low, middle)
    line = fromto[3:] - fromto[:3]
    return np.append(distance, np.sign(distance) * line / np.linalg.norm(line))


@pytest.mark.parametrize(
    "rod", ["cylinder 0.2 0.5", "cylinder 0.05 0.025", "cylinder 0.075 0.1", "capsule 0.04 0.1"]
)
def test_a_rod_and_a_box_are_as_far_apart_as_mujoco_says(rod):
    """Pillar, wheel, torso and leg, against a vase that lies anyhow, or beside one that stands."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_freejoint()
    shape, *size = rod.split()
    kind = getattr(mujoco.mjtGeom, f"mjGEOM_{shape.upper()}")
    body.add_geom(type=kind, size=(*map(float, size), 0), condim=6)
    other = spec.worldbody.add_body()
    other.add_freejoint()
    other.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=(0.1,) * 3, condim=6)
    model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    mjx_model = mjx.put_model(model, impl="jax")
    truth, poses = [], []
    for i in range(200):
        data.qpos[:] = rng.standard_normal(14)
        data.qpos[7:10] = 0
        if i % 2:  # both stand upright
            data.qpos[[4, 5, 11, 12]] = 0
        truth.append(separated(model, data, rng.uniform(-0.005, 0.01)))
        poses.append(data.qpos.copy())
    qpos = jnp.asarray(np.array(poses), jnp.float32)

    @jax.jit
    @jax.vmap
    def contacts(qpos):
        moved = mjx.kinematics(mjx_model, mjx.make_data(mjx_model).replace(qpos=qpos))
        collide = getattr(jax_contacts, f"{shape}_box")
        return collide(mjx_model, moved, None, jnp.array([[0, 1]]))

    dist, _, frame = contacts(qpos)
    truth = np.array(truth)
    error = np.abs(dist.min(1) - truth[:, 0])
    assert np.median(error) < 1e-5 and np.quantile(error, 0.97) < 4e-3  # rims on corners
    certain = np.abs(truth[:, 0]) > 1e-3
    assert np.median((frame[:, 0, 0] * truth[:, 1:])[certain].sum(1)) > 0.999
    beside = (np.arange(200) % 2 == 1) & (np.abs(truth[:, 3]) < 0.1)
    face = np.abs(truth[:, None, 1:] @ axes(qpos[:, 10:14])).max((1, 2)) > 0.9998
    alike = np.abs(dist[:, 0] - dist[:, 1]) < 1e-5  # sides touch at both their ends, edges once
    assert (beside & face).sum() > 10 and alike[beside & face].mean() > 0.9  # an end may meet a corner
    assert (dist[beside & ~face & certain, 1] == 1).all()


@pytest.mark.parametrize("cylinder", [".05 .025", ".075 .1"])
@pytest.mark.parametrize("other", ["sphere .1", "capsule .2 .5", "capsule .032 .07"])
def test_a_wheel_or_torso_is_as_far_from_a_round_shape_as_mujoco_says(other, cylinder):
    """Buttons, pillars and legs; half of them upright with the cylinder's axis level, a wheel's."""
    shape, *size = other.split()
    model = pair(f'type="{shape}" size="{" ".join(size)}"', f'type="cylinder" size="{cylinder}"')
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    mjx_model, poses, truth = mjx.put_model(model, impl="jax"), [], []
    for i in range(100):
        data.qpos[:] = rng.standard_normal(14)
        data.qpos[7:10] = 0
        if i % 2:
            data.qpos[[4, 5]] = 0
            data.qpos[10:14] = data.qpos[[10, 10, 13, 13]]
        truth.append(separated(model, data, rng.uniform(-0.01, 0.01)))
        poses.append(data.qpos.copy())

    @jax.jit
    @jax.vmap
    def contact(qpos):
        moved = mjx.kinematics(mjx_model, mjx.make_data(mjx_model).replace(qpos=qpos))
        return getattr(jax_contacts, f"{shape}_cylinder")(mjx_model, moved, None, jnp.array([[0, 1]]))

    dist, pos, frame = map(np.array, contact(jnp.asarray(np.array(poses), jnp.float32)))
    dist, pos, normal = dist.reshape(-1), pos.reshape(-1, 3), frame.reshape(-1, 3, 3)[:, 0]
    np.testing.assert_allclose(dist, np.array(truth)[:, 0], atol=1e-6)
    certain = np.abs(dist) > 1e-3
    assert (normal * np.array(truth)[:, 1:])[certain].sum(1).min() > 0.9999
    for qpos, distance, place in zip(poses, dist, pos, strict=True):
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        assert data.ncon >= (distance < -1e-6)
        if shape == "sphere" and data.ncon:
            np.testing.assert_allclose(place, data.contact[0].pos, atol=1e-6)


def axes(quats: Any) -> np.ndarray:
    """Of these orientations [count, 4], in columns [count, 3, 3]."""
    return np.array(jax.vmap(lambda q: math.quat_to_mat(math.normalize(q)))(jnp.asarray(quats)))


def pair(first: str, second: str) -> mujoco.MjModel:
    """Two shapes that move freely, or one on a plane."""
    free = "<body><freejoint/>{}</body>"
    bodies = (f"<geom {x}/>" if "plane" in x else free.format(f"<geom {x}/>") for x in (first, second))
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{''.join(bodies)}</worldbody></mujoco>")


def agree_on_contacts(collide: str, model: mujoco.MjModel, poses: np.ndarray) -> np.ndarray:
    """Every contact that MuJoCo finds in these poses, and no other; how many there are in each."""
    mjx_model = mjx.put_model(model, impl="jax")
    data, poses = mujoco.MjData(model), poses.astype(np.float32)

    @jax.jit
    @jax.vmap
    def contacts(qpos):
        moved = mjx.kinematics(mjx_model, mjx.make_data(mjx_model).replace(qpos=qpos))
        return getattr(jax_contacts, collide)(mjx_model, moved, None, jnp.array([[0, 1]]))

    counts = []
    for qpos, dist, pos, frame in zip(poses, *jax.device_get(contacts(poses)), strict=True):
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        counts.append(data.ncon)
        assert (dist < 0).sum() == data.ncon
        for theirs in data.contact:
            ours = np.argmin(np.where(dist < 0, np.linalg.norm(pos - theirs.pos, axis=1), np.inf))
            np.testing.assert_allclose(pos[ours], theirs.pos, atol=1e-4)  # edges that are parallel
            np.testing.assert_allclose(dist[ours], theirs.dist, atol=5e-7)
            np.testing.assert_allclose(frame[ours].ravel(), theirs.frame, atol=1e-5)
    return np.array(counts)


@pytest.mark.parametrize("lie", ["anyhow", "standing", "leaning", "alike", "stacked"])
def test_boxes_touch_where_mujocos_do(lie):
    model = pair('type="box" size=".1 .1 .1"', 'type="box" size=".1 .12 .04"')
    data, rng, poses = mujoco.MjData(model), np.random.default_rng(0), []
    for _ in range(100):
        data.qpos[:] = rng.standard_normal(14)
        data.qpos[7:10] = 0
        if lie != "anyhow":
            data.qpos[[4, 5, 11, 12]] *= {"standing": 0}.get(lie, 1e-3)
            data.qpos[2] *= 0.1
        if lie == "alike":
            data.qpos[3:7] = data.qpos[10:14] + rng.normal(size=4, scale=1e-2)
        if lie == "stacked":
            data.qpos[:2] *= 0.03
            data.qpos[2] = 1
        for turn in (data.qpos[3:7], data.qpos[10:14]):
            turn /= np.linalg.norm(turn)
        separated(model, data, -(10 ** rng.uniform(-5, -2)))
        poses.append(data.qpos.copy())
    counts = agree_on_contacts("box_box", model, np.array(poses))
    assert len(np.unique(counts)) > 1 and counts.max() == (8 if lie == "stacked" else 4)


def test_a_box_touches_the_floor_where_mujocos_does():
    model = pair('type="plane" size="1 1 1"', 'type="box" size=".1 .15 .04"')
    rng = np.random.default_rng(0)
    poses = rng.standard_normal((100, 7))
    poses[50:, 4:6] *= 0.02  # it lies, one side a little higher
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    reach = np.abs(axes(poses[:, 3:])[:, 2]) @ [0.1, 0.15, 0.04]
    poses[:, 2] = reach - rng.uniform(0, 0.01, 100)
    counts = agree_on_contacts("plane_box", model, poses)
    assert set(counts) == {1, 2, 3, 4}


@pytest.mark.parametrize("engine", ["c", "warp"])
def test_one_world_or_many_and_batches_of_batches_are_the_same(engine):
    t = task("point_goal1", engine=engine)
    state = t.begin(6)
    state = t.idle(state)
    action = jax.random.uniform(jax.random.key(3), (6, t.env.action_size), minval=-1)
    many = t.step(state, action)
    split = partial(jax.tree.map, lambda x: x.reshape(2, 3, *x.shape[1:]))
    nested = jax.jit(jax.vmap(jax.vmap(t.env.step)), compiler_options=FAST)(split(state), split(action))
    np.testing.assert_allclose(nested.obs.reshape(many.obs.shape), many.obs, atol=1e-5)
    one = jax.jit(t.env.step, compiler_options=FAST)(jax.tree.map(lambda x: x[4], state), action[4])
    np.testing.assert_allclose(one.obs, many.obs[4], atol=1e-5)
    np.testing.assert_allclose(one.physics.bodies.qpos, many.physics.bodies.qpos[4], atol=1e-6)


def test_reset_and_step_have_the_same_structure():
    for name in ("point_goal2", "car_push2", "doggo_button2", "point_circle"):
        env = envs.make(name, engine="c")
        state = jax.eval_shape(env.reset, jax.random.key(0))
        after = jax.eval_shape(env.step, state, jnp.zeros(env.action_size))
        assert jax.tree.structure(state) == jax.tree.structure(after)
        shapes = [[(x.shape, x.dtype) for x in jax.tree.leaves(s)] for s in (state, after)]
        assert shapes[0] == shapes[1]
        assert (state.obs.shape, state.costs.shape) == ((env.obs_size,), (len(env.cost_names),))


@pytest.fixture(scope="module")
def rollout():
    """17 steps of 3 environments with episodes of 5 steps, and the state they end in."""
    env: Any = task("point_goal0", num_steps=5).env

    def push(obs, key):
        return jax.random.uniform(key, (obs.shape[0], 2), minval=-1), jnp.zeros(obs.shape[0])

    begin = init_rollout(env, jax.random.key(0), 3, False)
    end, traj = jax.jit(partial(collect, env, memoryless(push), horizon=17), compiler_options=FAST)(
        begin, key=jax.random.key(1)
    )
    return env, begin, end, jax.tree.map(np.asarray, traj)


def test_the_time_limit_truncates_and_does_not_terminate(rollout):
    _, _, _, traj = rollout
    np.testing.assert_array_equal(np.flatnonzero(traj.truncated[:, 0]), [4, 9, 14])
    assert not traj.terminated.any()
    np.testing.assert_array_equal(traj.length[traj.ended], 5)


def test_every_episode_has_a_layout_of_its_own(rollout):
    _, _, _, traj = rollout
    starts = traj.obs[::5].reshape(12, -1)
    assert len(np.unique(starts.round(4), axis=0)) == 12


def test_an_observation_after_a_reset_is_that_of_the_new_episode(rollout):
    env, begin, _, traj = rollout
    np.testing.assert_array_equal(traj.obs[0], begin.state.obs)
    np.testing.assert_array_equal(traj.obs[5], begin.pool.obs)  # a fresh reset each, in order
    assert (np.abs(traj.next_obs[4] - traj.obs[5]).max(1) > 1e-3).all()
    np.testing.assert_array_equal(traj.next_obs[:4], traj.obs[1:5])
    # at rest: no speed, and gravity alone
    spec = list(env.observation_spec)
    assert (spec[0], spec[-1]) == ("accelerometer", "velocimeter")
    np.testing.assert_array_equal(traj.obs[::5, :, -3:], 0)
    np.testing.assert_allclose(
        traj.obs[::5, :, :3], np.broadcast_to([0, 0, 9.81], (4, 3, 3)), atol=1e-6
    )
    assert (np.abs(traj.obs[4, :, -3:]) > 0).any()


def test_jax_solves_contacts_as_c_does():
    """MJX's own solver gives up on some of these states, with velocities 0.03 to 0.2 off."""
    record = recording.Recording(DATA / "doggo_goal1.npz")
    config = read_config(record.meta["config"])
    model, mjx_model = (scene.build(config, for_mjx).model for for_mjx in (False, True))
    start = {k: record[f"state.{k}"][record.rows] for k in ("qpos", "qvel", "qacc_warmstart")}
    ctrl = np.clip(record["step.action"], *model.actuator_ctrlrange.T)
    m, d = mjx.put_model(mjx_model, impl="jax"), mjx.make_data(mjx_model, impl="jax")

    @partial(jax.jit, compiler_options=FAST)
    @jax.vmap
    def step(state, ctrl):
        return forward.euler(m, jax_engine.forward_pass(m, d.replace(ctrl=ctrl, **state))).qvel

    data = mujoco.MjData(model)
    for _ in range(3):
        after = {k: np.empty_like(x) for k, x in start.items()}
        for i in range(len(ctrl)):
            for k, x in start.items():
                getattr(data, k)[:] = np.float32(x[i])
            data.ctrl[:] = np.float32(ctrl[i])
            mujoco.mj_step(model, data)
            for k, x in after.items():
                x[i] = getattr(data, k)
        got = step({k: np.float32(x) for k, x in start.items()}, np.float32(ctrl))
        np.testing.assert_allclose(got, after["qvel"], rtol=0, atol=2e-4)
        start = after


@pytest.mark.parametrize("option", ['cone="elliptic"', 'integrator="implicit"'])
def test_the_jax_engine_refuses_what_it_cannot_solve(option, tmp_path):
    text = (Path(scene.__file__).parent / "assets" / "point.xml").read_text()
    robot = tmp_path / "mine.xml"
    robot.write_text(text.replace("<option ", f"<option {option} "))
    assert option in robot.read_text()
    with pytest.raises(ConfigError, match="integrator Euler, implicitfast or RK4 and pyramidal"):
        envs.make("point_goal0", engine="jax", robot_base=str(robot))


def test_dry_friction_that_turns_round_is_not_taken_for_one_piece_of_the_cost():
    """A stiff equality draws one degree of freedom; the other, held by dry friction, stays."""
    least, most = np.array([-np.inf, -1e-4]), np.array([np.inf, 1e-4])
    bounds = jax_solver.Rows(least, most, 1e-8, 0.01, iterations=100, trials=50)
    problem = jax_solver.Problem(
        J=jnp.eye(2),
        D=jnp.array([1e4, 1e4]),
        aref=jnp.array([1000.0, 0]),
        M=jnp.diag(jnp.array([1.0, 1e-3])),
        smooth=jnp.zeros(2),
        guess=jnp.array([0.0, 0.05]),
    )
    solve = jax.jit(partial(jax_solver.minimise, bounds), compiler_options=FAST)
    end = solve(jax.tree.map(lambda x: x[None], problem))
    np.testing.assert_allclose(end.x[0], [1000 * 1e4 / (1e4 + 1), 0], rtol=1e-5, atol=1e-6)


def test_jax_solves_equalities_dry_friction_limits_and_contacts_as_c_does():
    """A chain of two hinges with all of these, its end tied to a cube that lies on the floor."""
    model = mujoco.MjModel.from_xml_string("""
    <mujoco>
      <option cone="pyramidal"/>
      <worldbody>
        <geom type="plane" size="1 1 1" condim="6"/>
        <body pos="0 0 .5">
          <joint type="hinge" axis="0 1 0" range="-20 20" limited="true" frictionloss=".05"/>
          <geom type="capsule" fromto="0 0 0 .2 0 0" size=".03" contype="0"/>
          <body name="hand" pos=".2 0 0">
            <joint type="hinge" axis="0 1 0" range="-20 20" limited="true" frictionloss=".02"/>
            <geom type="capsule" fromto="0 0 0 .2 0 0" size=".03" contype="0"/>
          </body>
        </body>
        <body name="cube" pos=".4 0 .1">
          <freejoint/>
          <geom type="box" size=".1 .1 .1" condim="6" conaffinity="2"/>
        </body>
      </worldbody>
      <equality> <connect body1="hand" body2="cube" anchor=".2 0 0"/> </equality>
    </mujoco>""")
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    model.opt.tolerance = 1e-12
    states, accelerations, kinds = [], [], set()
    for _ in range(64):
        mujoco.mj_resetData(model, data)
        data.qpos += rng.normal(size=model.nq) * np.array([0.4, 0.4] + [0.003] * 7)
        data.qvel[:] = rng.normal(size=model.nv) * 0.01  # MJX lacks what speed squared does to a tie
        state = {k: np.float32(getattr(data, k)) for k in ("qpos", "qvel", "qacc_warmstart")}
        data.qpos[:], data.qvel[:] = state["qpos"], state["qvel"]
        mujoco.mj_forward(model, data)
        states.append(state)
        accelerations.append(data.qacc.copy())
        kinds |= set(data.efc_type)
    assert len(kinds) == 4
    model.opt.tolerance = 1e-8
    m, d = mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax")
    batch = jax.tree.map(lambda *x: np.stack(x), *states)
    forward_pass = jax.vmap(lambda state: jax_engine.forward_pass(m, d.replace(**state)))
    solved = jax.jit(forward_pass, compiler_options=FAST)(batch)
    size = np.abs(accelerations).max(1, keepdims=True)
    np.testing.assert_allclose(solved.qacc / size, accelerations / size, rtol=0, atol=1e-4)
