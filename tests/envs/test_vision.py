"""Pictures for policies, against MuJoCo's own rays, kinematics and OpenGL."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiling import FAST
from tasks import in_parts

from jaxsafe import envs
from jaxsafe.config import ConfigError
from jaxsafe.envs.safety_gym.sight import drawn_model
from jaxsafe.envs.view.render import GAP, Renderer
from jaxsafe.envs.vision.eye import make_eye
from jaxsafe.envs.vision.poses import kinematics
from jaxsafe.envs.vision.rays import SHAPES
from jaxsafe.envs.vision.surface import Checker, checkered
from jaxsafe.learn.rollout import collect, init_rollout, memoryless

native: Any = mujoco  # its functions are not known to type checkers
ASSETS = Path(envs.__file__).parent
SIZE = (60, 40)


def compiled(f: Callable) -> Callable:
    return jax.jit(f, compiler_options=FAST)


def seeing(name: str, **options: Any) -> Any:
    return envs.make(name, engine="c", observe_vision=True, **options)


@pytest.mark.parametrize("kind", ["plane", "sphere", "capsule", "cylinder", "box"])
def test_rays_enter_a_shape_where_those_of_mujoco_do(kind):
    model = native.MjModel.from_xml_string(
        f"<mujoco><worldbody><geom type='{kind}' size='.3 .5 .4'/></worldbody></mujoco>"
    )
    data = native.MjData(model)
    native.mj_forward(model, data)
    rng = np.random.default_rng(0)
    origin = np.array([0.9, -0.7, 1.1])
    direction = rng.uniform(-0.7, 0.7, (400, 3)) - origin  # past the shape or at it
    shape: Any = SHAPES[int(model.geom_type[0])]
    size = tuple(model.geom_size[0].tolist())
    found = jax.jit(lambda d: shape(size, tuple(origin), tuple(d.T)))(direction)
    there, geom = [], np.zeros(1, np.int32)
    for d in direction:
        far = native.mj_ray(model, data, origin, d, None, 1, -1, geom)
        there.append(np.inf if far < 0 else far)
    np.testing.assert_allclose(found.distance, there, rtol=1e-4)
    hit = np.isfinite(there)
    assert 50 < hit.sum() < 380
    normal = np.stack([np.broadcast_to(x, hit.shape) for x in found.normal], -1)[hit]
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, rtol=1e-4)
    assert ((normal * direction[hit]).sum(1) < 0).all()  # outwards
    if kind != "plane":  # from within a shape nothing of it is seen
        within = jax.jit(lambda d: shape(size, (0.0, 0.0, 0.0), tuple(d.T)))(direction)
        assert (np.asarray(within.distance) <= 0).all() | np.isinf(within.distance).all()


def test_bodies_are_where_mujoco_has_them():
    models = [drawn_model(seeing(name).arena) for name in ("car_push1", "doggo_button1")]
    models += [native.MjModel.from_xml_path(str(ASSETS / "velocity" / "assets" / "humanoid.xml"))]
    rng = np.random.default_rng(0)
    for model in models:
        data = native.MjData(model)
        native.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 1.0)
        data.mocap_pos[:] = rng.normal(size=data.mocap_pos.shape)
        native.mj_forward(model, data)
        at = jax.jit(kinematics(model))(data.qpos, data.mocap_pos, data.mocap_quat)
        np.testing.assert_allclose(at.position, data.xpos, atol=2e-5)
        np.testing.assert_allclose(at.rotation.reshape(-1, 9), data.xmat, atol=2e-5)


def test_a_checker_is_sharp_from_near_and_grey_from_afar():
    checker = Checker((1.0, 1.0, 1.0), (0.0, 0.5, 0.0), (0.35, 0.35))
    x = jnp.array([0.1, 0.45, 0.1, -0.1, 0.35])
    y = jnp.array([0.1, 0.1, 0.45, 0.1, 0.1])
    sharp, _, _ = checkered(checker, x, y, jnp.float32(1e-3))
    np.testing.assert_allclose(sharp, [1, 0, 0, 0, 0.5], atol=1e-3)  # the last one is on a line
    _, grey, _ = checkered(checker, x, y, jnp.float32(1.4))
    np.testing.assert_allclose(grey, 0.75, atol=1e-3)


def spread(frame: np.ndarray) -> np.ndarray:
    """How far apart a pixel and its neighbours are, [H, W]."""
    near = [np.roll(frame, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    return np.ptp(near, axis=0).max(-1)


# gremlins' guides, walls and the cameras of Safety-Gymnasium, too
SCENES = {
    "point_goal2": {"walls_num": 1, "walls_size": 0.2, "walls_locations": ((1.5, 1.5),)},
    "car_push2": {"vision_camera": "vision_back"},
    "doggo_button2": {"hazards_num": 0},
    "car_circle1": {"rules": "safety_gymnasium"},
}


@pytest.mark.parametrize("name", SCENES)
def test_pictures_are_those_of_opengl(display, monkeypatch, name):
    options = {"vision_size": SIZE, "vision_render": False, "render_lidar_markers": False}
    env = seeing(name, **options, **SCENES[name])
    if name.startswith("doggo"):  # a film marks the button to press
        monkeypatch.setattr("jaxsafe.envs.view.stage.Stage.mark", lambda *args: None)
    renderer = Renderer(env, *SIZE, env.config.vision_camera)
    reset, _ = in_parts(env, compiler_options=FAST)
    states = jax.device_get(reset(jax.random.split(jax.random.key(1), 20)))
    for i in range(20):
        ours = states.obs["vision"][i].astype(int)
        theirs = renderer.frame(jax.tree.map(lambda x, i=i: x[i], states)).astype(int)
        assert ours.shape == theirs.shape == (40, 60, 3)
        apart = np.abs(ours - theirs)
        assert apart.mean() <= 3
        inner = spread(ours) <= 10  # OpenGL smooths edges
        assert inner.mean() > 0.5 and (apart.max(-1)[inner] <= 10).mean() >= 0.99
        for shifted in (np.roll(ours, s, axis) for s in (1, -1) for axis in (0, 1)):
            assert np.abs(shifted - theirs).mean() > 1.2 * apart.mean()
    env.config = replace(env.config, vision_render=True, vision_render_size=(120, 80))
    film = Renderer(env, *SIZE).frame(jax.tree.map(lambda x: x[0], states), overruled=True)
    assert film.shape == (80, 60 + GAP + 120, 3)
    assert (film[6, 54] == [220, 30, 30]).all()  # the light of a shield, in the scene
    np.testing.assert_array_equal(film[::2, -120::2], states.obs["vision"][0])


def test_the_picture_belongs_to_the_state_and_each_world_has_its_own():
    env = seeing("point_goal1", vision_size=(24, 16), num_steps=3, hazards_num=2, vases_num=0)
    picture = compiled(jax.vmap(env._picture))

    def still(obs: Any, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jnp.ones((4, 2)), jnp.zeros(4)

    def play(key: jax.Array) -> Any:
        rollout = init_rollout(env, key, 4, stagger=True)
        return collect(env, memoryless(still), rollout, key, 5)

    rollout, traj = compiled(play)(jax.random.key(0))
    assert traj.obs["vision"].shape == (5, 4, 16, 24, 3) and traj.obs["vision"].dtype == jnp.uint8
    assert traj.obs["vector"].shape == (5, 4, env.obs_size)
    assert traj.done[-1].any() and not traj.done[-1].all()  # the last pictures are of resets, too
    close = {"atol": 1.001, "rtol": 0}  # the order of float operations may differ
    seen = rollout.state.obs["vision"].astype(int)
    np.testing.assert_allclose(seen, picture(rollout.state.physics).astype(int), **close)
    before, after = (x["vision"].astype(int) for x in (traj.obs, traj.next_obs))
    kept = ~np.array(traj.done[:-1])
    np.testing.assert_allclose(before[1:][kept], after[:-1][kept], **close)
    assert (np.abs(before[1:] - after[:-1]).mean((2, 3, 4))[~kept] > 2).all()  # a new layout
    alike = picture(jax.tree.map(lambda x: x[jnp.array([1, 1, 1, 1])], rollout.state.physics))
    np.testing.assert_allclose(alike[0].astype(int), seen[1], **close)


def test_the_goal_is_seen_where_it_is_and_hazards_and_the_box_before_and_behind_it():
    env = seeing(
        "point_push1", vision_size=(31, 21), robot_locations=((0.0, 0.0),), robot_rot=0.0, pillars_num=0
    )
    state = compiled(env.reset)(jax.random.key(0))
    picture = compiled(env._picture)
    rows = {name: env.place.names.index(name) for name in ("goal", "hazard0", "hazard1")}
    box = env.scene.qpos_slice("box")

    def seen(goal: Any, box_x: float = -3.0) -> np.ndarray:
        layout = state.physics.layout.at[rows["goal"]].set(jnp.array(goal))
        layout = layout.at[jnp.array([rows["hazard0"], rows["hazard1"]])].set(-3.0)
        bodies = state.physics.bodies
        qpos = bodies.qpos.at[box].set(jnp.array([box_x, 0, 0.2, 1, 0, 0, 0]))
        world = state.physics.replace(layout=layout, bodies=bodies.replace(qpos=qpos))
        return np.array(picture(world)).astype(int)

    def centre(frame: np.ndarray) -> tuple[float, float]:
        rows, columns = np.nonzero(frame[..., 1] - np.maximum(frame[..., 0], frame[..., 2]) > 20)
        return rows.mean(), columns.mean()

    # The camera is 0.25 m up, looks down by atan(0.4) and has 90 degrees from top to bottom.
    across = 10.5 / np.cos(np.arctan(0.4))  # pixels a unit of tan of the angle to the side
    for y in (0.6, 0.0, -0.6):
        frame = seen((1.5, y))
        assert abs(centre(frame)[1] - (15 - across * y / 1.5)) < 1.5
    row, _ = centre(seen((1.5, 0.0)))
    pitch = np.arctan2(0.25 - 0.16, 1.5) - np.arctan(0.4)
    assert abs(row - (10 + 10.5 * np.tan(pitch))) < 1
    free, hidden, behind = (seen((1.5, 0.0), x)[6, 15] for x in (-3.0, 0.9, 2.1))
    assert free[1] > free[0] + 20 and free[2] > 50  # translucent green on grey
    assert hidden[0] > 100 and hidden[2] == 0  # the box, yellow and opaque
    assert behind[1] > behind[0] > 50 and behind[2] < free[2] - 20  # the box through the goal


def test_what_cannot_be_drawn_is_refused_in_one_line(tmp_path):
    with pytest.raises(ConfigError, match=r"env.vision_camera='viison'; did you mean 'vision'"):
        seeing("point_goal1", vision_camera="viison")
    robot = tmp_path / "egg.xml"
    text = (ASSETS / "safety_gym" / "assets" / "point.xml").read_text()
    robot.write_text(text.replace('type="sphere" size="0.1"', 'type="ellipsoid" size=".1 .1 .2"'))
    with pytest.raises(ConfigError, match="geom robot: expected a plane, sphere, capsule"):
        seeing("point_goal1", robot_base=str(robot))
    with pytest.raises(ConfigError, match=r"env.vision_size\[0\]=0"):
        seeing("point_goal1", vision_size=(0, 40))


def middle(asset: str, geom: str, light: str = "") -> list[int]:
    """The colour of a sphere where it faces the camera, whose light is half of full there."""
    spec = native.MjSpec.from_string(
        f"<mujoco><asset>{asset}</asset><worldbody>{light}<geom size='.5' {geom}/>"
        "<camera name='c' pos='0 -2 0' xyaxes='1 0 0 0 0 1'/></worldbody></mujoco>"
    )
    spec.visual.headlight.ambient[:] = 0.1
    spec.visual.headlight.diffuse[:] = 0.4
    spec.visual.headlight.specular[:] = 0
    eye = make_eye(spec.compile(), "c", (5, 5))
    return jax.jit(eye)(jnp.zeros(0), jnp.zeros((0, 3)), jnp.zeros((0, 4)))[2, 2].tolist()


def test_a_geom_has_its_own_colour_before_its_material_s_and_the_material_s_glow():
    red = "<material name='m' rgba='1 0 0 1' emission='{}'/>"
    assert middle("", "rgba='0 1 0 1'") == [0, 128, 0]
    assert middle(red.format(0), "material='m'") == [128, 0, 0]
    assert middle(red.format(0), "material='m' rgba='0 1 0 1'") == [0, 128, 0]
    assert middle(red.format(0.3), "material='m'") == [204, 0, 0]


def test_a_light_that_is_off_does_not_shine():
    light = "<light type='directional' dir='0 1 0' diffuse='.3 .3 .3' specular='0 0 0' active='{}'/>"
    assert middle("", "rgba='0 1 0 1'", light.format("true")) == [0, 204, 0]  # 0.1 + 0.4 + 0.3
    assert middle("", "rgba='0 1 0 1'", light.format("false")) == [0, 128, 0]


def test_a_light_or_a_texture_of_another_kind_is_refused():
    scene = "<mujoco><asset>{}</asset><worldbody>{}<camera name='c'/></worldbody></mujoco>"
    for asset, body, reason in [
        ("", "<light pos='0 0 1'/>", "expected directional lights"),
        ("", "<light type='directional' specular='1 1 1'/>", "without highlights"),
        (
            "<texture name='t' type='2d' builtin='gradient' rgb1='1 0 0' rgb2='0 1 0' width='8' "
            "height='8'/><material name='m' texture='t'/>",
            "<geom type='plane' size='1 1 1' material='m'/>",
            "expected a checker",
        ),
    ]:
        spec = native.MjSpec.from_string(scene.format(asset, body))
        spec.visual.headlight.specular[:] = 0
        with pytest.raises(ValueError, match=reason):
            make_eye(spec.compile(), "c", (4, 4))


@pytest.mark.parametrize(
    "attributes, reason",
    [
        ("mode='targetbody' target='t'", "expected one that is fixed to its body"),
        ("projection='orthographic'", "expected a perspective one with fovy"),
        ("sensorsize='.03 .02' focal='.03 .03' resolution='60 40'", "without sensorsize"),
    ],
)
def test_a_camera_of_another_kind_is_refused(attributes, reason):
    spec = native.MjSpec.from_string(
        f"<mujoco><worldbody><body name='t'/><camera name='c' {attributes}/></worldbody></mujoco>"
    )
    spec.visual.headlight.specular[:] = 0
    with pytest.raises(ValueError, match=f"camera c: .*{reason}"):
        make_eye(spec.compile(), "c", (4, 4))
