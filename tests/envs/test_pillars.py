"""Contacts of boxes with pillars, on Warp's CPU device and in JAX, against MuJoCo's and by hand."""
# MuJoCo's bindings come without types:
# pyright: reportAttributeAccessIssue=false

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from mujoco.mjx.third_party import mujoco_warp

from jaxsafe import envs
from jaxsafe.config import ConfigError
from jaxsafe.envs.engines.jax import contacts as jax_contacts
from jaxsafe.envs.engines.warp import constraints, touching
from jaxsafe.envs.safety_gym import scene

XML = """
<mujoco>
  <worldbody>
    <body name="upright" mocap="true" pos="0.3 -0.2 0.5"><geom type="cylinder" size="0.2 0.5"/></body>
    <body><freejoint/><geom type="box" size="0.1 0.05 0.08"/></body>
    <body name="leaning" mocap="true" pos="9 9 0.5">
      <geom type="cylinder" size="0.2 0.5" quat="1 0.2 0 0"/>
    </body>
  </worldbody>
</mujoco>
"""
ENGINES = pytest.mark.parametrize("engine", ["warp", "jax"])
FIELDS = ("dist", "pos", "frame", "friction", "solref", "solimp", "dim")


def turned(angle, lean=0.0, about=0.0):
    """The quaternion of a turn about the vertical, then of a lean about a horizontal axis."""
    quat, upright, leaning = np.zeros((3, 4))
    mujoco.mju_axisAngle2Quat(upright, np.array([0.0, 0, 1]), angle)
    mujoco.mju_axisAngle2Quat(leaning, np.array([np.cos(about), np.sin(about), 0]), lean)
    mujoco.mju_mulQuat(quat, leaning, upright)
    return quat


def by_warp(poses):
    """Contacts of a box in these poses [worlds, 7] with the pillar, and the world of each."""
    model = mujoco.MjModel.from_xml_string(XML)
    m = mujoco_warp.put_model(model)
    d = mujoco_warp.make_data(model, nworld=len(poses), naconmax=4 * len(poses), njmax=64)
    found = constraints.adopt(model, m, d, ["upright", "leaning"], limits=False)
    assert found
    kinds = dict(zip(map(tuple, found.geoms.pairs.numpy()), found.geoms.kinds.numpy(), strict=True))
    assert kinds == {(0, 1): touching.PILLAR, (2, 1): touching.NONE}  # the leaning one is MuJoCo Warp's
    d.qpos.assign(poses.astype(np.float32))
    mujoco_warp.kinematics(m, d)
    d.nacon.zero_()
    d.ncollision.zero_()
    found.find(len(poses))
    count = int(d.nacon.numpy()[0])
    return {k: getattr(d.contact, k).numpy()[:count] for k in (*FIELDS, "worldid")}


def by_jax(poses):
    """The same of a capsule, as which the pillar stands there."""
    model = mjx.put_model(
        mujoco.MjModel.from_xml_string(XML.replace("cylinder", "capsule")), impl="jax"
    )

    @jax.jit
    @jax.vmap
    def contacts(qpos):
        moved = mjx.kinematics(model, mjx.make_data(model).replace(qpos=qpos))
        return jax_contacts.capsule_box(model, moved, None, jnp.array([[0, 1]]))

    found = jax.device_get(contacts(jnp.asarray(poses, jnp.float32)))
    touching = found[0] < 0
    return {
        "worldid": np.nonzero(touching)[0],
        **{k: x[touching] for k, x in zip(FIELDS, found, strict=False)},
    }


def contacts(engine, poses):
    """Of a box in these poses [worlds, 7] with the pillar: MuJoCo's, and ours."""
    ours = by_warp(poses) if engine == "warp" else by_jax(poses)
    fields = [k for k in FIELDS if k in ours]
    found = []
    data = mujoco.MjData(model := mujoco.MjModel.from_xml_string(XML))
    for i, pose in enumerate(poses):
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        theirs = [c for c in data.contact if {c.geom1, c.geom2} == {0, 1}]
        theirs = {k: np.array([getattr(c, k) for c in theirs]) for k in fields}  # not views
        mine = {k: ours[k][ours["worldid"] == i] for k in fields}
        mine["frame"] = mine["frame"].reshape(-1, 9)
        upwards = [np.argsort(x["pos"].reshape(-1, 3)[:, 2]) for x in (theirs, mine)]
        found.append(
            [{k: x[k][o] for k in fields} for x, o in zip((theirs, mine), upwards, strict=True)]
        )
    return found


def poses(angle, depth, lean=0.0, seed=0, count=40):
    """Boxes around the pillar whose nearest side, or edge, is turned by `angle` to it."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        way, side = rng.uniform(-np.pi, np.pi), rng.integers(4)
        reach = 0.1 * abs(np.cos(angle)) + 0.05 * abs(np.sin(angle))
        if side % 2:
            reach = 0.1 * abs(np.sin(angle)) + 0.05 * abs(np.cos(angle))
        about = rng.uniform(-np.pi, np.pi)
        quat = turned(way + angle + side * np.pi / 2, lean, about)
        normal = np.array([np.cos(way), np.sin(way)])
        box = np.zeros(9)
        mujoco.mju_quat2Mat(box, quat)
        shadow = box.reshape(3, 3)[:2] * [0.1, 0.05, 0.08]
        along = np.abs(normal @ shadow).sum() if angle == 0 else reach
        across = 0.0
        if angle != 0:  # the corner that is nearest lies on the line to the pillar
            spans = (normal @ shadow)[:2]
            corner = shadow[:, :2] @ np.sign(spans)
            across = normal[0] * corner[1] - normal[1] * corner[0]
        away = normal * (0.2 + along - depth) + across * np.array([-normal[1], normal[0]])
        out.append(np.concatenate([np.array([0.3, -0.2]) - away, [0.3], quat]))
    return np.array(out)


@ENGINES
def test_a_side_that_lies_flat_touches_at_both_ends_as_mujocos(engine):
    for depth in (1e-6, 2e-5, 1e-3, 5e-3):
        for theirs, ours in contacts(engine, poses(0.0, depth)):
            assert len(theirs["dist"]) == len(ours["dist"]) == 2
            np.testing.assert_allclose(ours["dist"], -depth, rtol=1e-3, atol=3e-7)
            np.testing.assert_allclose(ours["dist"], theirs["dist"], rtol=1e-3, atol=5e-7)
            np.testing.assert_allclose(ours["frame"], theirs["frame"], atol=2e-5)
            np.testing.assert_allclose(ours["pos"], theirs["pos"], atol=3e-4)  # MuJoCo's iteration
            for name in set(ours) - {"dist", "pos", "frame"}:
                np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-6)


@ENGINES
def test_a_side_that_leans_touches_less_at_one_end_or_twice_at_the_other(engine):
    twice = 0
    for depth in (1e-4, 2e-3):
        for theirs, ours in contacts(engine, poses(0.0, depth, lean=0.004, seed=1)):
            assert len(theirs["dist"]) == len(ours["dist"]) == 2
            np.testing.assert_allclose(ours["dist"], theirs["dist"], atol=2e-6)
            np.testing.assert_allclose(ours["frame"], theirs["frame"], atol=1e-4)
            twice += theirs["pos"][0, 2] == theirs["pos"][1, 2]
    assert 5 < twice < 75


@ENGINES
def test_a_standing_edge_touches_once(engine):
    """MuJoCo's distances of edges are up to 0.03 mm off near the surface, and 0.4 mm at 1 mm."""
    for angle in (0.4, -0.7):
        for depth in (2e-5, 1e-3):
            for theirs, ours in contacts(engine, poses(angle, depth, seed=2)):
                assert len(ours["dist"]) == 1
                np.testing.assert_allclose(ours["dist"], -depth, rtol=2e-3, atol=5e-7)
                normal = np.array([0.3, -0.2]) - ours["pos"][0, :2]
                normal /= np.linalg.norm(normal)
                np.testing.assert_allclose(ours["frame"].ravel()[:3], [*-normal, 0], atol=1e-5)
                np.testing.assert_allclose(ours["pos"][0, 2], 0.38, atol=1e-6)
                if depth == 2e-5:
                    assert theirs["dist"].min() == pytest.approx(-depth, abs=2e-5)


@ENGINES
def test_boxes_apart_do_not_touch(engine):
    beside = [poses(angle, -2e-6, count=10) for angle in (0.0, 0.5)]
    above = poses(0.0, 0.05, count=5)
    above[:, 2] += 0.8 if engine == "warp" else 1.0  # over the end of the pillar, or the capsule's
    for theirs, ours in contacts(engine, np.concatenate([*beside, above])):
        assert not len(theirs["dist"]) and not len(ours["dist"])


def test_only_pillars_and_boxes_are_taken():
    for task, some in (("car_push2", True), ("car_goal2", False), ("doggo_button2", False)):
        config = envs.make(task).config
        simulation = scene.build(config).simulation(config)
        model = simulation.compile(count=True)
        m = mujoco_warp.put_model(model)
        d = mujoco_warp.make_data(model, nworld=1, naconmax=100, njmax=100)
        found = constraints.adopt(model, m, d, simulation.pillars, limits=False)
        assert found is not None
        pairs = found.geoms.pairs.numpy()
        given = m.nxn_geom_pair_filtered.numpy()  # each pair of the model is there once
        assert sorted(map(sorted, pairs.tolist())) == sorted(map(sorted, given.tolist()))
        taken = pairs[found.geoms.kinds.numpy() == touching.PILLAR]
        assert bool(len(taken)) == some
        bodies = {frozenset(model.body(model.geom_bodyid[g]).name for g in pair) for pair in taken}
        assert all(any("pillar" in name for name in pair) for pair in bodies)
        if some:
            assert {frozenset({"pillar0", "box"}), frozenset({"pillar0", "robot"})} <= bodies


def test_pillars_whose_caps_could_be_touched_are_refused_on_engine_jax():
    def built(name, **options):
        return scene.build(envs.make(name, engine="c", pillars_num=1, **options).config, mjx=True)

    limits = [
        ("point_goal0", {}, 0.1),  # the robot
        ("doggo_goal0", {}, 0.148),
        ("point_goal0", {"vases_num": 1, "vases_size": 0.15}, 0.15),
        ("point_button1", {}, 0.15),  # gremlins hover
        ("point_push1", {}, 0.2),
    ]
    for name, options, limit in limits:
        built(name, pillars_height=limit, **options)
        says = f"env.pillars_height={limit - 0.001:g} .*jax.* expected at least {limit:g}, half of the"
        with pytest.raises(ConfigError, match=says):
            built(name, pillars_height=round(limit - 0.001, 6), **options)
    scene.build(envs.make("point_goal0", engine="c", pillars_height=0.01).config, mjx=True)  # none
    with pytest.raises(ConfigError, match="engines c and warp take lower pillars"):
        envs.make("point_push1", engine="jax", pillars_height=0.01)
