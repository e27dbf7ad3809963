"""Engine `warp`, on Warp's CPU device: the same kernels and packing as on a GPU, without its graphs."""
# MuJoCo's bindings come without types, and a kernel is Warp's language in Python's syntax:
# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from tasks import task

from jaxsafe import envs
from jaxsafe.config import ConfigError
from jaxsafe.envs.engines import Simulation, make_engine
from jaxsafe.envs.safety_gym import scene, sleeping, suite
from jaxsafe.envs.velocity.config import ROBOTS


def errors(name: str, steps: int = 4, **options) -> dict[str, float]:
    """The largest differences to engine `c` after a step from its states.

    The first step is left out: what rests touches the floor at a distance of 0, give or take a digit.
    """
    c, twin = task(name, **options), task(name, engine="warp", **options)
    state = c.idle(c.begin())
    worst = {"qpos": 0.0, "qvel": 0.0, "obs": 0.0, "reward": 0.0}
    for key in jax.random.split(jax.random.key(7), steps):
        action = jax.random.uniform(key, (4, c.env.action_size), minval=-1)
        ours, state = twin.step(state, action), c.step(state, action)
        np.testing.assert_array_equal(ours.costs, state.costs)
        np.testing.assert_array_equal(ours.info["goal_met"], state.info["goal_met"])
        assert not ours.info["overflow"].any()
        for k, a, b in (
            ("qpos", ours.physics.bodies.qpos, state.physics.bodies.qpos),
            ("qvel", ours.physics.bodies.qvel, state.physics.bodies.qvel),
            ("obs", ours.obs, state.obs),
            ("reward", ours.reward, state.reward),
        ):
            worst[k] = max(worst[k], float(jnp.abs(a - b).max()))
    return worst


def test_it_goes_where_c_goes():
    worst = errors("point_goal1")
    assert worst["qpos"] < 1e-5 and worst["qvel"] < 1e-3 and worst["reward"] < 1e-5
    assert worst["obs"] < 5e-3  # accelerations of rounded forces


def test_dogs_feet_have_the_contact_frames_of_c():
    worst = errors("doggo_goal0", steps=8)
    assert worst["qpos"] < 1e-4 and worst["qvel"] < 1e-2


def test_guides_go_round_and_steps_of_different_length_live_side_by_side():
    options = {"gremlins_num": 2, "frameskip_binom_p": 0.5, "constrain_gremlins": True}
    worst = errors("point_goal0", **options)
    assert worst["qpos"] < 1e-4 and worst["qvel"] < 1e-2
    t = task("point_goal0", engine="warp", **options)
    assert len(set(t.idle(t.begin()).physics.bodies.substeps.tolist())) > 1


GUIDED = """
<mujoco>
  <option timestep="0.01" integrator="RK4"/>
  <worldbody>
    <body name="rests" mocap="true" pos="-2 0 .5"><geom size=".1"/></body>
    <body name="guide" mocap="true" pos="0 -.3 .5"><geom size=".1"/></body>
    <body name="ball" pos="0 0 .5">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0" damping=".1"/>
      <geom size=".1" mass=".1"/>
    </body>
  </worldbody>
</mujoco>
"""


def test_guides_go_round_where_all_passes_are_one_kernel():
    """Of three worlds at different times, in two of which the guide hits the ball."""
    found = {}
    for engine in ("c", "warp"):
        spec = mujoco.MjSpec.from_string(GUIDED)
        made = make_engine(engine, Simulation(spec, substeps=10, orbits=np.array([0, 0.2])))
        run = jax.jit(jax.vmap(lambda physics, made=made: made.run(physics, jnp.zeros(0))[0]))
        physics = jax.tree.map(lambda x: jnp.stack([x] * 3), made.start())
        physics = physics.replace(substeps=jnp.array([0, 50, 100], jnp.int32))
        for _ in range(4):
            physics = run(physics)
        found[engine] = physics
    assert (jnp.abs(found["c"].qvel).max(1) > 0.1).tolist() == [True, True, False]
    for name in ("qpos", "qvel", "mocap_pos"):
        np.testing.assert_allclose(getattr(found["warp"], name), getattr(found["c"], name), atol=1e-5)


def test_poses_that_a_task_asks_for_come_along():
    worst = errors("point_goal1", lidar_type="natural", reward_orientation=True)
    assert worst["obs"] < 5e-3 and worst["reward"] < 1e-5


def test_sensors_of_what_the_dynamics_do_not_write():
    sensors = ("velocimeter", "subtreelinvel", "subtreeangmom")
    assert errors("car_goal0", sensors_obs=sensors)["obs"] < 1e-3


def test_contacts_without_room_are_counted():
    t = task("point_goal1", engine="warp", contact_room=0.01)
    assert (t.idle(t.begin(64)).info["overflow"] == 1).all()
    with pytest.raises(ConfigError, match=r"env.contact_room=0.0: expected a number between 0.01 and"):
        envs.make("point_goal1", contact_room=0.0)


BALL = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body pos="0 0 .099"><joint type="slide" axis="0 0 1"/><geom size=".1"/></body>
  </worldbody>
  <sensor/>
</mujoco>
"""


ROOM = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 .1">
      <freejoint/><geom type="box" size=".1 .1 .1" condim="6" friction="1 .01 .01"/>
    </body>
    <body pos=".03 .02 .32">
      <freejoint/><geom type="box" size=".1 .1 .1" condim="4"/>
    </body>
    <body pos="0 1 .1">
      <freejoint/><geom type="sphere" size=".1" condim="1" priority="1"/>
    </body>
    <body pos="1 0 1">
      <joint name="a" axis="0 1 0" frictionloss=".5" limited="true" range="-20 20"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".05"/>
      <body pos=".5 0 0">
        <joint name="b" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".05"/>
      </body>
    </body>
    <body pos="-1 0 1">
      <joint name="c" axis="0 1 0" frictionloss=".01"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".05"/>
    </body>
  </worldbody>
  <equality><joint joint1="b" joint2="c" polycoef="0 .5 0 0 0"/></equality>
</mujoco>
"""


def compiled(xml: str):
    return mujoco.MjSpec.from_string(xml).compile()


@pytest.fixture(params=[1, 16, 32])
def lanes(request, monkeypatch):
    """One lane, as on a CPU, or half or all of those of a GPU's warp, which take turns."""
    import warp as wp

    from jaxsafe.envs.engines.warp import solver

    monkeypatch.setattr(wp.config, "enable_cpu_blocks", request.param > 1)
    if request.param == 16:
        monkeypatch.setattr(solver, "shape_of", lambda nv, d: (16, 1))
    return request.param


def test_the_solver_finds_what_mujocos_finds(lanes):
    """Contacts, limits, equalities and dry friction, from the states on the way of 30 steps."""
    from mujoco.mjx.third_party import mujoco_warp

    from jaxsafe.envs.engines.warp import engine, solver

    assert engine.solver.solve is solver.solve
    assert engine.constraint.make_constraint is solver.make_constraint
    model = compiled(ROOM)
    m, worlds = mujoco_warp.put_model(model), 16
    d = mujoco_warp.make_data(model, nworld=worlds, nconmax=40, njmax=160)
    assert solver.adopt(model, m, d)
    rng = np.random.default_rng(0)
    d.qpos.assign(np.tile(model.qpos0, (worlds, 1)) + np.r_[0, 0, 0.05, np.zeros(18), 0.3, 0.3, 0.3])
    d.qvel.assign(rng.normal(size=(worlds, model.nv)))
    kinds, most = set(), 0
    for _ in range(30):
        mujoco_warp.step(m, d)
        mujoco_warp.forward(m, d)
        found = {}
        for make, solve in (
            (solver.their_constraints, solver.theirs),
            (solver.make_constraint, solver.solve),
        ):
            make(m, d)
            if solve is solver.theirs:
                kinds |= {
                    int(k)
                    for row, n in zip(d.efc.type.numpy(), d.nefc.numpy(), strict=True)
                    for k in row[:n]
                }
                rows = d.nefc.numpy().copy()
            np.testing.assert_array_equal(d.nefc.numpy(), rows)
            solve(m, d)
            for name, x in (("qacc", d.qacc), ("qfrc", d.qfrc_constraint), ("Ma", d.efc.Ma)):
                found.setdefault(name, []).append(x.numpy().copy())
            given = np.arange(d.njmax) < d.nefc.numpy()[:, None]
            found.setdefault("force", []).append(np.where(given, d.efc.force.numpy(), 0))
            found.setdefault("iterations", []).append(d.solver_niter.numpy().copy())
        for name, (theirs, ours) in found.items():
            if name == "iterations":
                assert (ours <= np.maximum(theirs, 1) + 2).all()
                most = max(most, ours.max())
            else:
                scale = np.abs(theirs).max(axis=1, keepdims=True)
                assert (np.abs(ours - theirs) < 2e-4 * (1 + scale)).all(), name
    assert len(kinds) == 5 and most > 2, (kinds, most)


def simulated(name: str, worlds: int, **options):
    """Model and working data of a task's scene, its sleepers but two left out."""
    from mujoco.mjx.third_party import mujoco_warp

    env = task(name, **options).env
    small = scene.build(sleeping.small_config(env.config, 2))
    model = small.simulation(env.config).compile(count=True)
    m = mujoco_warp.put_model(model)
    contacts, rows = small.room()
    data = [
        mujoco_warp.make_data(model, nworld=worlds, naconmax=contacts * worlds, njmax=rows)
        for _ in range(2)
    ]
    return model, m, *data


@pytest.mark.parametrize(
    ("name", "theirs"),
    [
        ("point_goal1", 0),
        ("car_push1", 3),
        ("car_button2", 4),
        ("doggo_goal1", 3),
        ("halfcheetah_velocity", 0),
        ("ant_velocity", 0),
    ],
)
@pytest.mark.parametrize("many", [False, True])
def test_a_physics_step_takes_few_kernels(name, theirs, many, monkeypatch):
    """Of few worlds their number sets the pace: it is one. With many, or where MuJoCo Warp's are among
    them, it is four of ours for each pass, and MuJoCo Warp's, which are recorded."""
    import warp as wp
    from mujoco.mjx.third_party import mujoco_warp

    from jaxsafe.envs.engines.warp import dynamics

    if many:
        monkeypatch.setattr(dynamics.solver, "MANY", 0)
    together = not theirs and not many
    if name.endswith("velocity"):
        model = envs.make(name, engine="warp").model
        m, d = mujoco_warp.put_model(model), mujoco_warp.make_data(model, nworld=2)
    else:
        model, m, d, _ = simulated(name, 2)
    assert dynamics.adopt(model, m, d)
    launched = []

    def counted(launch):
        def call(kernel, dim, *args, **settings):
            if np.prod(dim):  # else nothing is launched
                launched.append(kernel.key)
            return launch(kernel, *args, dim=dim, **settings)

        return call

    for name in ("launch", "launch_tiled"):
        monkeypatch.setattr(wp, name, counted(getattr(wp, name)))
    dynamics.step(m, d)
    passes = 1 if d.dynamics.euler else 4
    assert len(launched) == (1 if together else 4 * passes), launched
    recorded = [x for x in (d.dynamics.plain_rows, d.dynamics.constraints.others) if x]
    assert sum(len(x.launches) + len(x.zeros) for x in recorded) == theirs
    launched.clear()
    dynamics.forward(m, d)  # and one for all sensors
    assert len(launched) == (1 if together else 4) + bool(model.nsensor), launched
    if together:
        launched.clear()
        dynamics.forward(m, d, 5)
        assert len(launched) == 1 + bool(model.nsensor), launched


@pytest.mark.parametrize(("bodies", "together"), [(250, True), (340, False)])
def test_all_passes_are_one_kernel_where_shared_memory_has_room_for_all_parts(bodies, together):
    """A multiprocessor gives a block 48 KiB. 340 bodies leave too little for the solver."""
    from mujoco.mjx.third_party import mujoco_warp

    from jaxsafe.envs.engines.warp import dynamics

    one = '<body pos="0 5 0"><geom size=".1" contype="0"/></body>'
    model = compiled(LIMITS.replace("</worldbody>", f"{bodies * one}</worldbody>"))
    m, d = mujoco_warp.put_model(model), mujoco_warp.make_data(model, njmax=8)
    assert dynamics.adopt(model, m, d) and bool(d.dynamics.lists) == together
    assert d.dynamics.system.contacts == d.naconmax  # beyond it a world is flagged


SENSED = """
<mujoco>
  <option magnetic="1 2 3"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="trunk" pos="0 0 .3">
      <freejoint/><geom type="box" size=".2 .1 .1"/><site name="chest" pos=".1 0 .05" euler="10 20 30"/>
      <body name="leg" pos="0 0 -.1">
        <joint name="knee" type="ball"/><geom type="capsule" fromto="0 0 0 0 .1 -.1" size=".05"/>
        <body name="foot" pos="0 .1 -.1">
          <joint name="ankle" axis="1 0 0"/><geom type="sphere" size=".1" condim="CONDIM"/>
          <site name="sole" pos="0 0 -.05" type="sphere" size=".06"/>
          <site name="heel" pos="0 .2 0" type="box" size=".06 .06 .06"/>
        </body>
      </body>
    </body>
  </worldbody>
  <sensor>
    <jointpos joint="ankle"/><jointvel joint="ankle"/><ballquat joint="knee"/><ballangvel joint="knee"/>
    <velocimeter site="chest"/><gyro site="sole"/><magnetometer site="chest"/>
    <accelerometer site="sole"/><accelerometer site="chest"/><touch site="sole"/><touch site="heel"/>
    <contact body1="trunk" body2="world" data="found"/>
  </sensor>
</mujoco>
"""


@pytest.mark.parametrize("condim", [1, 4])
def test_sensors_read_what_mujocos_read(condim):
    """Of a robot that falls on its foot, which is pressed, turns and slides."""
    from mujoco.mjx.third_party import mujoco_warp

    from jaxsafe.envs.engines.warp import dynamics

    spec = mujoco.MjSpec.from_string(SENSED.replace("CONDIM", str(condim)))
    contact = spec.sensors[-1]
    contact.objtype, contact.reftype = mujoco.mjtObj.mjOBJ_XBODY, mujoco.mjtObj.mjOBJ_BODY
    model = spec.compile()
    m, d = mujoco_warp.put_model(model), mujoco_warp.make_data(model, nworld=2, nconmax=20, njmax=80)
    assert dynamics.adopt(model, m, d) and d.dynamics.sensors
    c, touched = mujoco.MjData(model), np.zeros(3)
    c.qvel[:] = np.random.default_rng(1).normal(size=model.nv)
    for _ in range(250):
        mujoco.mj_step(model, c)
        for k in ("qpos", "qvel", "qacc_warmstart"):
            getattr(d, k).assign(np.tile(getattr(c, k), (2, 1)))
        mujoco.mj_forward(model, c)
        dynamics.forward(m, d)
        found, right = d.sensordata.numpy()[1], c.sensordata
        np.testing.assert_allclose(found, right, rtol=2e-3, atol=2e-3 * (1 + np.abs(right).max()))
        touched = np.maximum(touched, right[-3:])
    assert touched[0] > 1 and touched[1] == 0 and touched[2] >= 1


CUBES = """
<mujoco>
  <worldbody>
    <body><freejoint/><geom type="box" size=".1 .1 .1"/></body>
    <body><freejoint/><geom type="box" size=".05 .05 .05"/></body>
  </worldbody>
</mujoco>
"""


def test_there_is_a_formula_for_all_kinds_of_geoms_that_have_one_in_mujoco_warp():
    """Where a new MuJoCo Warp has one more: write it in touching.py, or say here why not."""
    from mujoco.mjx.third_party.mujoco_warp._src import collision_primitive

    from jaxsafe.envs.engines.warp import constraints

    theirs = set(collision_primitive._PRIMITIVE_COLLISIONS)
    assert set(constraints.FORMULAS) == theirs - {constraints.MESH}


def test_two_boxes_touch_where_mujocos_do():
    """At the same points. For 44 of these 200 pairs MuJoCo Warp by default finds another number."""
    from mujoco.mjx.third_party import mujoco_warp

    from jaxsafe.envs.engines.warp import constraints

    model, rng, worlds = compiled(CUBES), np.random.default_rng(0), 200
    qpos = np.zeros((worlds, 14))
    way = rng.normal(size=(worlds, 3))
    qpos[:, 7:10] = way / np.abs(way).max(1, keepdims=True) * rng.uniform(0.14, 0.16, (worlds, 1))
    qpos[:, [3, 10]] = 1
    qpos[::2, 13] = rng.normal(size=worlds // 2) * 0.3  # half of them stand upright
    qpos[1::2, 10:] = rng.normal(size=(worlds // 2, 4))
    qpos[:, 10:] /= np.linalg.norm(qpos[:, 10:], axis=1, keepdims=True)
    m = mujoco_warp.put_model(model)
    d = mujoco_warp.make_data(model, nworld=worlds, naconmax=8 * worlds, njmax=32)
    found = constraints.adopt(model, m, d, (), limits=False)
    assert found and not found.others.launches
    d.qpos.assign(qpos)
    mujoco_warp.kinematics(m, d)
    found.find(worlds)
    world, c, counts = d.contact.worldid.numpy()[: d.nacon.numpy()[0]], mujoco.MjData(model), set()
    for i in range(worlds):
        c.qpos[:] = qpos[i]
        mujoco.mj_forward(model, c)
        counts.add(c.ncon)
        assert (world == i).sum() == c.ncon
        for name in ("dist", "pos") if c.ncon else ():
            ours = getattr(d.contact, name).numpy()[: len(world)][world == i].reshape(c.ncon, -1)
            theirs = getattr(c.contact, name).reshape(c.ncon, -1)
            near = [np.abs(x - theirs).max(1).min() for x in ours]  # in any order
            assert max(near, default=0) < 1e-6, name
    assert {0, 1, 2, 4} <= counts


@pytest.mark.parametrize(("name", "pairs"), [("car_push1", 20), ("point_goal1", 0)])
def test_convex_collisions_have_room_for_every_pair_of_a_kind_and_no_more(name, pairs):
    """Kinds follow each other, so they share it."""
    from mujoco.mjx.third_party import mujoco_warp

    from jaxsafe.envs.engines.warp import dynamics

    model, m, d, _ = simulated(name, 3)
    assert dynamics.adopt(model, m, d)
    kinds = [tuple(sorted(model.geom_type[list(pair)])) for pair in m.nxn_geom_pair_filtered.numpy()]
    cylinder, box = mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_BOX
    assert kinds.count((cylinder, box)) == pairs >= kinds.count((cylinder, cylinder))
    assert d.naccdmax == 3 * pairs
    dynamics.step(m, d)
    assert not (d.overflow.numpy() & int(mujoco_warp.OverflowType.CCD)).any()


LIMITS = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body pos="0 0 1">
      <joint name="a" axis="0 1 0" limited="true" range="-20 30" solreflimit=".03 1"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".05" contype="0" conaffinity="0"/>
      <body pos=".3 0 0">
        <joint name="b" type="slide" axis="1 0 0" limited="true" range="-.1 .02" margin=".01"/>
        <joint name="c" axis="0 1 0" limited="true" range="-40 40" solimplimit=".8 .95 .01 .5 2"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".05" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def test_joints_stop_at_their_limits_as_mujocos(lanes):
    from mujoco.mjx.third_party import mujoco_warp

    from jaxsafe.envs.engines.warp import dynamics

    model = compiled(LIMITS)
    m, d = mujoco_warp.put_model(model), mujoco_warp.make_data(model, nworld=3, njmax=8)
    assert dynamics.adopt(model, m, d) and not d.dynamics.plain_rows
    rng, counts = np.random.default_rng(0), set()
    states = [mujoco.MjData(model) for _ in range(3)]
    for _ in range(20):
        for c in states:
            c.qpos[:], c.qvel[:] = rng.uniform(-0.9, 0.9, 3), rng.normal(size=3)
            c.qpos[1] /= 5
            mujoco.mj_forward(model, c)
        d.qpos.assign(np.array([c.qpos for c in states]))
        d.qvel.assign(np.array([c.qvel for c in states]))
        dynamics.forward(m, d)
        for world, c in enumerate(states):
            rows = d.nefc.numpy()[world]
            assert rows == c.nefc == d.nl.numpy()[world]
            counts.add(int(rows))
            if not rows:
                continue
            dofs = np.abs(d.efc.J.numpy()[world, :rows]).argmax(1)  # in any order
            theirs = np.abs(c.efc_J.reshape(rows, 3)).argmax(1)
            for k in ("D", "aref", "J"):
                right = getattr(c, f"efc_{k}").reshape(rows, -1)[theirs.argsort()]
                found = getattr(d.efc, k).numpy()[world, :rows].reshape(rows, -1)[dofs.argsort()]
                np.testing.assert_allclose(found[:, : right.shape[1]], right, rtol=1e-4, atol=1e-5)
            scale = 1e-3 * (1 + np.abs(c.qacc).max())
            np.testing.assert_allclose(d.qacc.numpy()[world], c.qacc, atol=scale)
    assert counts == {0, 1, 2, 3}


WRITTEN = (  # by the dynamics, for what comes after them
    "xpos", "xquat", "xmat", "geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cinert", "cvel",
    "cdof", "cdof_dot", "M", "qfrc_smooth", "subtree_com",
)  # fmt: skip


@pytest.mark.parametrize("name", ["point_push1", "car_goal1", "doggo_button2"])
def test_the_dynamics_are_mujocos(name, lanes):
    """All that the dynamics write, and steps, from states on the way of one that tumbles."""
    from mujoco.mjx.third_party import mujoco_warp

    from jaxsafe.envs.engines.warp import dynamics

    worlds = 9  # not a multiple of those that share a block
    boxes = int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)  # theirs with MuJoCo's formula for two boxes
    model, m, theirs, ours = simulated(name, worlds)
    assert dynamics.adopt(model, m, ours) and dynamics.solver.adopt(model, m, theirs)
    formula = dataclasses.replace(m, opt=dataclasses.replace(m.opt, disableflags=boxes))
    rng = np.random.default_rng(0)
    theirs.qvel.assign(rng.normal(size=(worlds, model.nv)))
    roots = np.unique(model.body_rootid[1:])
    for step in range(6):
        theirs.ctrl.assign(rng.uniform(-1.5, 1.5, size=(worlds, model.nu)))
        if model.nmocap:
            theirs.mocap_pos.assign(rng.normal(size=(worlds, model.nmocap, 3)))
        for k in ("qpos", "qvel", "qacc_warmstart", "ctrl", "mocap_pos"):
            getattr(ours, k).assign(getattr(theirs, k).numpy().copy())
        mujoco_warp.forward(formula, theirs)
        dynamics.forward(m, ours)
        for k in WRITTEN:
            a, b = getattr(ours, k).numpy(), getattr(theirs, k).numpy()
            if k in ("cinert", "cvel", "subtree_com"):  # others' are not written
                a, b = (x[:, roots if k == "subtree_com" else slice(1, None)] for x in (a, b))
            assert np.abs(a - b).max() < 2e-6 * np.abs(b).max(), k
        assert np.abs(ours.sensordata.numpy() - theirs.sensordata.numpy()).max() < 0.01 * (
            1 + np.abs(theirs.sensordata.numpy()).max()
        )
        # Euler's step
        begin = {k: getattr(ours, k).numpy().astype(float) for k in ("qpos", "qvel")}
        dynamics.step(m, ours)
        for world in range(worlds):
            qpos, qvel = begin["qpos"][world], begin["qvel"][world]
            damping = model.opt.timestep * np.diag(model.dof_damping)
            rate = ours.qacc.numpy()[world].astype(float)
            if damping.any():
                rate = np.linalg.solve(mass(model, qpos) + damping, ours.efc.Ma.numpy()[world])
            qvel += model.opt.timestep * rate
            mujoco.mj_integratePos(model, qpos, qvel, model.opt.timestep)
            for k, b in (("qpos", qpos), ("qvel", qvel)):
                assert np.abs(getattr(ours, k).numpy()[world] - b).max() < 1e-5 * np.abs(b).max(), k
        np.testing.assert_array_equal(ours.qacc_warmstart.numpy(), ours.qacc.numpy())
        np.testing.assert_allclose(ours.time.numpy(), (step + 1) * model.opt.timestep, rtol=1e-6)
        mujoco_warp.step(formula, theirs)


def mass(model, qpos):
    """M at a state, by MuJoCo."""
    data, full = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, full)
    return full


def test_the_dynamics_are_for_every_task():
    from mujoco.mjx.third_party import mujoco_warp

    from jaxsafe.envs.engines.warp import dynamics

    for name in (f"{robot}_{kind}2" for robot in suite.ROBOTS for kind in ("goal", "button", "push")):
        model, m, ours, _ = simulated(name, 1)
        assert dynamics.adopt(model, m, ours), name
    for robot in ROBOTS:
        model = envs.make(f"{robot}_velocity", engine="warp").model
        m, d = mujoco_warp.put_model(model), mujoco_warp.make_data(model)
        assert not dynamics.uncovered(model, m, d), robot


ARM = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="a" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .5 0 0" size=".05"/>
      <body name="lower" pos=".5 0 0">
        <joint name="b" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".05"/>
        <site name="hand" pos=".4 0 0"/>
      </body>
    </body>
    <body name="other" pos="1.2 0 1">
      <joint name="c" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 .1" size=".05"/>
    </body>
  </worldbody>
  <equality/>
  <actuator/>
  <sensor/>
</mujoco>
"""


def beside_c(xml: str, steps: int = 20, worlds: int = 2, **options):
    """(adopted, our data, MuJoCo's) after steps that do not read sensors and a pass that does."""
    from mujoco.mjx.third_party import mujoco_warp

    from jaxsafe.envs.engines.warp import dynamics

    model = compiled(xml)
    m, off = mujoco_warp.put_model(model), int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    blind = dataclasses.replace(m, opt=dataclasses.replace(m.opt, disableflags=off))
    d = mujoco_warp.make_data(model, nworld=worlds, nconmax=40, njmax=160)
    adopted = dynamics.adopt(model, m, d)
    c = mujoco.MjData(model)
    if model.nu:
        c.ctrl[:] = 0.5
        d.ctrl.fill_(0.5)
    for _ in range(steps):
        dynamics.step(blind, d)
        mujoco.mj_step(model, c)
    dynamics.forward(m, d)
    mujoco.mj_forward(model, c)
    return adopted, d, c


@pytest.mark.parametrize(
    ("where", "what"),
    [
        ("actuator", '<motor joint="a" gear="3"/>'),
        ("actuator", '<motor joint="a" damping="2"/>'),
        ("actuator", '<general joint="a" gainprm="1" biasprm="5 -10 -1"/>'),  # of no bias
        ("actuator", '<position joint="b" kp="3"/><velocity joint="a" kv="2" forcerange="-.1 .1"/>'),
        ("actuator", '<general site="hand" gear="1 0 2 0 1 0"/>'),
        ("equality", '<connect body1="lower" body2="other" anchor=".4 0 0"/>'),
        ("equality", '<weld body1="lower" body2="other"/>'),
        ("sensor", '<subtreelinvel body="upper"/><framepos objtype="body" objname="lower"/>'),
        ("sensor", '<actuatorfrc actuator="m"/><jointactuatorfrc joint="a"/>'),
    ],
)
def test_the_dynamics_go_where_c_goes(where, what):
    """Motors, thrusters, equalities, and sensors of what the dynamics do not write."""
    motor = '<motor name="m" joint="a" gear="3"/>' if "actuator=" in what else ""
    xml = ARM.replace("<actuator/>", f"<actuator>{motor}</actuator>" if motor else "<actuator/>")
    adopted, d, c = beside_c(xml.replace(f"<{where}/>", f"<{where}>{what}</{where}>"))
    assert adopted
    np.testing.assert_allclose(d.qpos.numpy()[1], c.qpos, atol=1e-4)
    np.testing.assert_allclose(d.qvel.numpy()[1], c.qvel, atol=2e-3)
    np.testing.assert_allclose(d.sensordata.numpy()[1], c.sensordata, atol=2e-3)


LOOSE = (
    '<body pos="3 0 1"><freejoint/><geom type="ellipsoid" size=".1 .2 .3" pos=".1 0 0"/>'
    '<body pos=".5 0 0"><joint type="ball" damping=".1"/><geom type="box" size=".2 .1 .05"/></body>'
    "</body>"
)


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_integrators_and_fluids_go_where_c_goes(integrator):
    """In a wind that turns boxes, with free, ball and hinge joints and a damper."""
    fluid = f'integrator="{integrator}" density="30" viscosity="0.5" wind="3 1 .5"'
    xml = ARM.replace('timestep="0.01"', f'timestep="0.01" {fluid}')
    xml = xml.replace("</worldbody>", f"{LOOSE}</worldbody>").replace("<actuator/>", "")
    adopted, d, c = beside_c(xml)
    assert adopted
    still = beside_c(xml.replace('density="30" viscosity="0.5"', ""))[2]
    assert np.abs(still.qvel - c.qvel).max() > 0.2
    np.testing.assert_allclose(d.qpos.numpy()[1], c.qpos, atol=1e-5)
    np.testing.assert_allclose(d.qvel.numpy()[1], c.qvel, atol=1e-4)


@pytest.mark.parametrize(
    "change",
    [
        ('timestep="0.01"', 'timestep="0.01" integrator="implicitfast"'),
        (
            'timestep="0.01"/>',
            'timestep="0.01" density="9"/><default><geom fluidshape="ellipsoid"/></default>',
        ),
        ('<body name="upper"', '<body name="upper" gravcomp="1"'),
        ('<joint name="b" axis="0 1 0"/>', '<joint name="b" type="ball" stiffness="1"/>'),
        ("<actuator/>", '<actuator><muscle joint="a" lengthrange="0 1"/></actuator>'),
        ("<actuator/>", '<actuator><intvelocity joint="a" actrange="-1 1"/></actuator>'),
        ("<equality/>", "<!-- 400 bodies more, for which shared memory has no room -->"),
    ],
)
def test_models_that_the_dynamics_are_not_for_keep_mujocos(change):
    xml = ARM.replace(*change)
    if "400" in change[1]:
        bodies = "".join(f'<body pos="{k} 5 0"><geom size=".1"/></body>' for k in range(400))
        xml = xml.replace("</worldbody>", f"{bodies}</worldbody>")
    adopted, d, c = beside_c(xml, steps=3)
    assert not adopted
    np.testing.assert_allclose(d.qpos.numpy()[1], c.qpos, atol=1e-4)


def test_a_world_without_constraints_forgets_its_warmstart():
    from mujoco.mjx.third_party import mujoco_warp

    from jaxsafe.envs.engines.warp import dynamics

    model = compiled(ARM)
    m, d = mujoco_warp.put_model(model), mujoco_warp.make_data(model, nworld=3, nconmax=40, njmax=160)
    assert dynamics.adopt(model, m, d)
    warmstart = np.zeros((3, model.nv))
    warmstart[1], warmstart[2] = np.nan, 1e6
    d.qacc_warmstart.assign(warmstart)
    dynamics.forward(m, d)
    c = mujoco.MjData(model)
    mujoco.mj_forward(model, c)
    np.testing.assert_allclose(d.qacc.numpy(), np.tile(c.qacc, (3, 1)), rtol=1e-4)


@pytest.mark.parametrize("many", [False, True])
def test_contacts_may_be_switched_off_later(many, monkeypatch):
    from mujoco.mjx.third_party import mujoco_warp

    from jaxsafe.envs.engines.warp import dynamics, solver

    if many:
        monkeypatch.setattr(solver, "MANY", 0)
    model = compiled(BALL)
    m, d = mujoco_warp.put_model(model), mujoco_warp.make_data(model, nworld=2, naconmax=20, njmax=32)
    assert dynamics.adopt(model, m, d) and bool(d.dynamics.lists) != many
    off = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    without = dataclasses.replace(m, opt=dataclasses.replace(m.opt, disableflags=off))
    for of, contacts in ((m, 1), (without, 0), (m, 1)):
        dynamics.forward(of, d)
        assert d.newton.count.numpy().tolist() == [contacts] * 2
        assert (d.qacc.numpy() < -9).all() == (contacts == 0)


@pytest.mark.parametrize("gap", [True, False])
def test_contacts_without_rows_take_no_room_from_others(gap):
    """Eight points of each of five boxes above the floor: within a gap, or asked for by a sensor."""
    from mujoco.mjx.third_party import mujoco_warp

    from jaxsafe.envs.engines.warp import dynamics

    box = """
    <body pos="K 1 .3"><joint type="slide" axis="0 0 1"/>
      <geom name="K" type="box" size=".1 .1 .1"/></body></worldbody>"""
    sensor = '<distance geom1="K" geom2="floor" cutoff="5"/></sensor>'
    xml = BALL.replace("<sensor/>", "<sensor></sensor>")
    for k in range(5):
        xml = xml.replace("</worldbody>", box.replace("K", str(k)))
        xml = xml if gap else xml.replace("</sensor>", sensor.replace("K", str(k)))
    model = compiled(xml.replace('name="floor"', 'name="floor" gap="1"') if gap else xml)
    m, d = mujoco_warp.put_model(model), mujoco_warp.make_data(model, nworld=2, naconmax=100, njmax=32)
    assert dynamics.adopt(model, m, d)
    dynamics.step(m, d)
    assert not d.overflow.numpy().any() and d.newton.count.numpy().tolist() == [1, 1]
    assert (d.qvel.numpy()[:, 0] > 0).all()  # of the ball, which the floor pushes out


def test_models_that_the_solver_is_not_for_keep_mujocos():
    from mujoco.mjx.third_party import mujoco_warp

    from jaxsafe.envs.engines.warp import solver

    model = compiled(ROOM.replace("<option", '<option cone="elliptic"'))
    m, d = mujoco_warp.put_model(model), mujoco_warp.make_data(model, nconmax=40, njmax=160)
    assert not solver.adopt(model, m, d)
    mujoco_warp.forward(m, d)
    assert np.isfinite(d.qacc.numpy()).all() and d.solver_niter.numpy()[0] > 0


def test_the_solver_stops_where_numbers_have_ended():
    from mujoco.mjx.third_party import mujoco_warp

    from jaxsafe.envs.engines.warp import solver

    model = compiled(ROOM)
    m, d = mujoco_warp.put_model(model), mujoco_warp.make_data(model, nworld=2, nconmax=40, njmax=160)
    assert solver.adopt(model, m, d)
    mujoco_warp.forward(m, d)
    right = d.qacc.numpy().copy()
    d.qfrc_smooth.assign(np.stack([np.full(model.nv, np.nan), d.qfrc_smooth.numpy()[1]]))
    solver.solve(m, d)
    assert np.isnan(d.qacc.numpy()[0]).any() and d.solver_niter.numpy()[0] < 3
    np.testing.assert_allclose(d.qacc.numpy()[1], right[1], rtol=1e-3, atol=1e-3)


def test_a_recording_repeats_what_was_launched_on_zeros_and_leaves_other_threads_alone():
    import threading

    import warp as wp

    from jaxsafe.envs.engines.warp.recording import Recording

    @wp.kernel
    def add(given: wp.array[float], total: wp.array[float]):
        i = wp.tid()
        total[i] = total[i] + given[i]

    given, beside, found = wp.ones(3, dtype=float), wp.zeros(3, dtype=float), []

    def call():
        total = wp.zeros(3, dtype=float)
        found.append(total)
        for _ in range(2):
            wp.launch(add, 3, inputs=[given], outputs=[total])
        wp.launch(add, 0, inputs=[given], outputs=[total])
        other = threading.Thread(target=wp.launch, args=(add, 3, [given], [beside]))
        other.start()
        other.join()

    launch = wp.launch
    recording = Recording(call)
    assert wp.launch is launch and len(recording.launches) == 2 and len(recording.zeros) == 1
    assert found[0].numpy().tolist() == [0, 0, 0] and beside.numpy().tolist() == [1, 1, 1]
    for _ in range(3):
        recording.repeat()
    assert found[0].numpy().tolist() == [2, 2, 2]
