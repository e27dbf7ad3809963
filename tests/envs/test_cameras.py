"""Cameras on robots: where they are, what their pictures show where, and what is learnt from these."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiling import FAST

from jaxsafe import envs
from jaxsafe.envs.safety_gym.sight import drawn_model

native: Any = mujoco  # its functions are not known to type checkers
WIDTH, HEIGHT = 60, 40


class Camera(NamedTuple):
    """A camera in the frame of its body, m. right, up: axes of the picture. fovy: degrees from top to
    bottom."""

    at: tuple[float, float, float]
    right: tuple[float, float, float]
    up: tuple[float, float, float]
    fovy: float

    @property
    def axes(self) -> np.ndarray:
        """Right, up and back, [3, 3], in columns."""
        right, up = (np.array(x) / np.linalg.norm(x) for x in (self.right, self.up))
        return np.stack([right, up, np.cross(right, up)], 1)


# Safety Gym's, which SEditor's rules keep. The two that look back and THEIR_CAR are Safety-Gymnasium's.
POINT = Camera((0, 0, 0.15), (0, -1, 0), (0.4, 0, 1), 90)
POINT_BACK = Camera((0, 0, 0.15), (0, 1, 0), (0, 0, 1), 90)
CAR = Camera((0, 0.1, 0.2), (-1, 0, 0), (0, -0.4, 1), 45)
THEIR_CAR = Camera((0, 0, 0.2), (-1, 0, 0), (0, -0.4, 1), 90)
CAR_BACK = Camera((0, 0, 0.2), (1, 0, 0), (0, 0, 1), 90)
DOGGO = Camera((0.125, 0, 0.2), (0, -1, 0), (0.4, 0, 1), 100)
OUTSIDE = {  # of every scene
    "fixednear": Camera((0, -2, 2), (1, 0, 0), (0, 1, 1), 45),
    "fixedfar": Camera((0, -5, 5), (1, 0, 0), (0, 1, 1), 45),
    "track": Camera((0, -2, 2), (1, 0, 0), (0, 1, 1), 45),
}
ON_ROBOTS = {
    ("point", "safety_gym"): {"vision": POINT, "vision_back": POINT_BACK},
    ("point", "safety_gymnasium"): {"vision": POINT, "vision_back": POINT_BACK},
    ("point", "seditor"): {"vision": POINT, "vision_back": POINT_BACK},
    ("car", "safety_gym"): {"vision": CAR, "vision_back": CAR_BACK},
    ("car", "safety_gymnasium"): {"vision": THEIR_CAR, "vision_back": CAR_BACK},
    ("car", "seditor"): {"vision": CAR, "vision_back": CAR_BACK},
    ("doggo", "safety_gym"): {"vision": DOGGO},
}


@pytest.mark.parametrize("robot, rules", ON_ROBOTS)
def test_cameras_are_where_the_originals_have_them(robot, rules):
    model = drawn_model(envs.make(f"{robot}_goal0", engine="c", rules=rules).arena)
    expected = OUTSIDE | ON_ROBOTS[robot, rules]
    assert {model.camera(i).name for i in range(model.ncam)} == expected.keys()
    for name, camera in expected.items():
        found, axes = model.camera(name), np.zeros(9)
        native.mju_quat2Mat(axes, found.quat)
        np.testing.assert_allclose(found.pos, camera.at, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(axes.reshape(3, 3), camera.axes, atol=1e-6, err_msg=name)
        assert found.fovy == camera.fovy, name
        body = "world" if name.startswith("fixed") else "robot"
        assert model.body(found.bodyid[0]).name == body, name
        modes = native.mjtCamLight
        assert found.mode == (modes.mjCAMLIGHT_TRACK if name == "track" else modes.mjCAMLIGHT_FIXED)


def colour_of(pixel: np.ndarray) -> str:
    """What it shows: a goal, green; a hazard, blue; a vase, blue and green; or something else."""
    red, green, blue = pixel.astype(int)
    if green > 20 + max(red, blue):
        return "goal"
    if blue > 20 + max(red, green):
        return "hazard"
    return "vase" if min(green, blue) > 60 and red < 10 else "else"


HEIGHTS = {"goal": 0.16, "hazard": 0.02, "vase": 0.1}  # of the centres, m
EACH = 16  # worlds for each of them
SEEING = [
    ("point", "safety_gym", "vision"),
    ("point", "safety_gym", "vision_back"),
    ("car", "safety_gym", "vision"),
    ("car", "safety_gymnasium", "vision"),
    ("doggo", "safety_gym", "vision"),
]


@pytest.mark.parametrize("robot, rules, name", SEEING)
def test_what_a_camera_sees_is_in_the_pixel_on_the_line_to_it(robot, rules, name):
    """Robots stand anywhere, turned anywhere. One object is before the camera, the others behind it."""
    camera = ON_ROBOTS[robot, rules][name]
    env = envs.make(
        f"{robot}_goal0",
        engine="c",
        rules=rules,
        hazards_num=1,
        vases_num=1,
        observe_vision=True,
        vision_size=(WIDTH, HEIGHT),
        vision_camera=name,
    )
    rng, count = np.random.default_rng(0), EACH * len(HEIGHTS)
    pixel = 2 * np.tan(np.radians(camera.fovy) / 2) / HEIGHT  # its side, 1 m before the camera
    heading = rng.uniform(0, 2 * np.pi, count)
    zero, one = np.zeros(count), np.ones(count)
    cos, sin = np.cos(heading), np.sin(heading)
    turn = np.array([[cos, -sin, zero], [sin, cos, zero], [zero, zero, one]]).transpose(2, 0, 1)
    robots = np.append(rng.uniform(-0.5, 0.5, (count, 2)), env.scene.robot_height * one[:, None], 1)
    eyes, axes = robots + turn @ camera.at, turn @ camera.axes
    ahead = -axes[:, :2, 2] / np.linalg.norm(axes[:, :2, 2], axis=1, keepdims=True)
    aside = rng.uniform(-0.8, 0.8, (count, 1)) * pixel * WIDTH / 2 * axes[:, :2, 0]
    places = eyes[:, :2] + rng.uniform(0.9, 1.4, (count, 1)) * (ahead + aside)
    xy = np.repeat((eyes[:, :2] - 2 * ahead)[:, None], len(env.place.names), 1)
    xy[:, 0] = robots[:, :2]
    objects = np.repeat(list(HEIGHTS), EACH)
    kinds = [{"hazards": "hazard", "vases": "vase"}.get(kind, kind) for kind in env.place.kinds]
    xy[np.arange(count), [kinds.index(kind) for kind in objects]] = places

    def draw(xy: jax.Array, heading: jax.Array) -> jax.Array:
        assert env._picture
        return env._picture(env.arena.at_rest(xy, jnp.full(len(xy), heading), jax.random.key(0)))

    pictures = jax.jit(jax.vmap(draw), compiler_options=FAST)(xy, heading)
    centres = np.append(places, [[HEIGHTS[kind]] for kind in objects], 1)
    right, up, back = ((centres - eyes)[:, None] @ axes)[:, 0].T
    columns = np.rint((WIDTH - 1) / 2 + right / -back / pixel).astype(int)
    rows = np.rint((HEIGHT - 1) / 2 - up / -back / pixel).astype(int)
    seen = [colour_of(x) for x in np.asarray(pictures)[np.arange(count), rows, columns]]
    assert seen == objects.tolist()
    assert columns.min() < WIDTH / 4 and columns.max() > 3 * WIDTH / 4


# Each robot with each kind of task. What engines simulate differs: warp not every gremlin at once, jax
# pillars of another shape. What is drawn does not.
TRACED = {
    "c": (
        *("point_button1", "point_run", "point_circle", "point_grid1"),
        *("car_goal1", "car_button1", "car_run", "car_circle", "car_gridwall"),
        *("doggo_goal1", "doggo_push1", "doggo_run", "doggo_circle", "doggo_grid1"),
    ),
    "warp": ("point_goal1", "car_push1", "doggo_button1"),
    "jax": ("point_push1",),
}


@pytest.mark.parametrize("engine", TRACED)
def test_each_kind_of_task_shows_rows_and_columns_of_bytes(engine):
    if engine == "warp":
        pytest.importorskip("warp")
    for name in TRACED[engine]:
        env = envs.make(name, engine=engine, observe_vision=True)
        picture: Any = jax.eval_shape(env.reset, jax.random.key(0)).obs["vision"]
        assert env.engine == engine and env.config.vision_size == (60, 40)
        assert (picture.shape, picture.dtype) == ((40, 60, 3), jnp.uint8), name


def fit(x: np.ndarray, y: np.ndarray, x_new: np.ndarray, penalty: float = 1.0) -> np.ndarray:
    """Ridge regression of `y` [n, k] on `x` [n, d], at `x_new`.

    W = (X' X + penalty)^-1 X' Y, of what is centred
    """
    centre, target = x.mean(0), y.mean(0)
    gram = (x - centre).T @ (x - centre) + penalty * np.eye(x.shape[1])
    return (x_new - centre) @ np.linalg.solve(gram, (x - centre).T @ (y - target)) + target


def test_a_linear_probe_tells_the_goals_bearing_from_pictures_and_not_from_shuffled_ones():
    """Sine and cosine of the bearing, on 1,000 states held out of 5,000.

    The states are resets of Point Goal 1, hazards and a vase included. The robot is turned so that the
    goal's centre is at most 0.9 rad to its side, which is within the picture: of a goal behind it a
    picture tells nothing.
    """
    count, held_out, side, size = 5000, 1000, 0.9, (24, 16)
    assert np.tan(side) / np.cos(np.arctan(0.4)) < size[0] / size[1]  # half the width, 1 m ahead
    env = envs.make("point_goal1", engine="c", observe_vision=True, vision_size=size)

    def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        reset_key, bearing_key = jax.random.split(key)
        world, _ = env.begin(reset_key)
        bearing = jax.random.uniform(bearing_key, minval=-side, maxval=side)
        x, y = env.arena.goal_position(world)[:2] - world.start[:2]
        qpos = world.bodies.qpos.at[2].set(jnp.arctan2(y, x) - bearing)
        return env._picture(world.replace(bodies=world.bodies.replace(qpos=qpos))), bearing

    keys = jax.random.split(jax.random.key(0), count)
    drawn = jax.jit(lambda keys: jax.lax.map(draw, keys, batch_size=250), compiler_options=FAST)
    pictures, bearings = (np.asarray(x, np.float64) for x in drawn(keys))
    pixels = pictures.reshape(count, -1) / 255
    targets = np.stack([np.sin(bearings), np.cos(bearings)], 1)

    def score(pixels: np.ndarray) -> np.ndarray:
        """R^2 of both."""
        learnt, new = slice(held_out, None), slice(held_out)
        missed = targets[new] - fit(pixels[learnt], targets[learnt], pixels[new])
        return 1 - np.square(missed).mean(0) / targets[new].var(0)

    assert (score(pixels) > 0.9).all()
    assert (score(np.random.default_rng(0).permutation(pixels)) < 0.1).all()
