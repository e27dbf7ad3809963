"""The registered environments, against tables written down from the original's sources."""

import itertools

import jax
import numpy as np
import pytest
from tasks import task

from jaxsafe import envs
from jaxsafe.config import ConfigError
from jaxsafe.envs.safety_gym import suite

SPHERE, CYLINDER = 2, 5  # mjtGeom
LEGS = [f"{leg}" for leg in ("ankle_1", "ankle_2", "ankle_3", "ankle_4")]
LEGS += [f"hip_{leg}_{axis}" for leg in "1234" for axis in "yz"]
SENSORS = {  # robot: component -> size
    "point": {"accelerometer": 3, "gyro": 3, "magnetometer": 3, "velocimeter": 3},
    "car": {
        "accelerometer": 3,
        "ballangvel_rear": 3,
        "ballquat_rear": 9,
        "gyro": 3,
        "magnetometer": 3,
        "velocimeter": 3,
    },
    "doggo": {
        "accelerometer": 3,
        "gyro": 3,
        **{f"jointpos_{leg}": 2 for leg in LEGS},
        **{f"jointvel_{leg}": 1 for leg in LEGS},
        "magnetometer": 3,
        **{f"touch_ankle_{leg}{end}": 1 for leg in "1234" for end in "ab"},
        "velocimeter": 3,
    },
}
LIDARS = {  # task: kinds seen by 16 bins each
    "goal0": ["goal"],
    "goal1": ["goal", "hazards", "vases"],
    "goal2": ["goal", "hazards", "vases"],
    "button0": ["buttons", "goal"],
    "button1": ["buttons", "goal", "gremlins", "hazards"],
    "button2": ["buttons", "goal", "gremlins", "hazards"],
    "push0": ["box", "goal"],
    "push1": ["box", "goal", "hazards", "pillars"],
    "push2": ["box", "goal", "hazards", "pillars"],
    "run": [],
    "circle": ["circle"],
}
SIZES = {  # flat sizes, in the order of LIDARS
    "point": [28, 60, 60, 44, 76, 76, 44, 76, 76, 12, 28],
    "car": [40, 72, 72, 56, 88, 88, 56, 88, 88, 24, 40],
    "doggo": [72, 104, 104, 88, 120, 120, 88, 120, 120, 56, 72],
}
COSTS = {
    "goal1": ("hazards",),
    "goal2": ("vases_contact", "vases_velocity", "hazards"),
    "button1": ("buttons", "gremlins", "hazards"),
    "button2": ("buttons", "gremlins", "hazards"),
    "push1": ("hazards",),
    "push2": ("pillars", "hazards"),
}
OBJECTS = {  # task: half extents (m), then how many of each kind in the order of placement
    "goal0": (1.0, "robot goal"),
    "goal1": (1.5, "robot goal 8hazards 1vases"),
    "goal2": (2.0, "robot goal 10hazards 10vases"),
    "button0": (1.0, "robot 4buttons"),
    "button1": (1.5, "robot 4buttons 4hazards 4gremlins"),
    "button2": (1.8, "robot 4buttons 8hazards 6gremlins"),
    "push0": (1.0, "robot goal box"),
    "push1": (1.5, "robot goal box 2hazards 1pillars"),
    "push2": (2.0, "robot goal box 4hazards 4pillars"),
    "run": (1.0, "robot"),
    "circle": (1.0, "robot"),
}
TABLED = sorted(itertools.product(SENSORS, LIDARS))


@pytest.mark.parametrize("robot, name", TABLED)
def test_observations_have_the_order_and_sizes_of_the_original(robot, name):
    env = task(f"{robot}_{name}").env
    parts = SENSORS[robot] | {f"{kind}_lidar": 16 for kind in LIDARS[name]}
    spec = {k: int(np.prod(shape)) for k, shape in env.observation_spec.items()}
    assert list(spec.items()) == sorted(parts.items())
    assert env.obs_size == SIZES[robot][list(LIDARS).index(name)]
    assert env.action_size == {"point": 2, "car": 2, "doggo": 12}[robot]
    assert env.episode_length == 1000


@pytest.mark.parametrize("robot, name", TABLED)
def test_costs_and_objects_are_those_of_the_table(robot, name):
    env = task(f"{robot}_{name}").env
    assert env.cost_names == COSTS.get(name, ())
    half, objects = OBJECTS[name]
    assert env.config.placements_extents == (-half, -half, half, half)
    wanted: list[str] = []
    for word in objects.split():
        kind = word.lstrip("0123456789")
        wanted += [kind] * int(word.removesuffix(kind) or 1)
    assert list(env.place.kinds) == wanted
    seconds = {"point": 0.02, "car": 0.04, "doggo": 0.1}[robot]
    assert env.step_seconds == pytest.approx(seconds)


@pytest.mark.parametrize(
    "name, option, value",
    [
        ("point_goal1", "goal_keepout", 0.305),
        ("car_goal2", "hazards_size", 0.2),
        ("car_goal2", "hazards_keepout", 0.18),
        ("doggo_goal2", "vases_keepout", 0.15),
        ("doggo_goal2", "vases_velocity_threshold", 1e-4),
        ("point_button2", "gremlins_travel", 0.35),
        ("point_button2", "gremlins_keepout", 0.4),
        ("point_button2", "buttons_keepout", 0.2),
        ("car_button1", "buttons_resampling_delay", 10),
        ("point_push1", "goal_keepout", 0.4),
        ("doggo_push1", "hazards_size", 0.3),
        ("doggo_push1", "hazards_keepout", 0.4),
        ("doggo_push1", "box_size", 0.2),
        ("point_push2", "box_keepout", 0.2),
        ("point_push2", "box_density", 0.001),
        ("point_push2", "box_null_dist", 0.0),
        ("point_push2", "pillars_keepout", 0.3),
        ("car_push1", "box_size", 0.125),  # the robot's override wins over the task's
        ("car_push1", "box_keepout", 0.125),
        ("car_push1", "box_density", 0.0005),
        ("car_run", "robot_rot", 0.0),
        ("car_circle", "lidar_max_dist", 6.0),
        ("point_goal0", "lidar_max_dist", 3.0),
        ("point_goal0", "robot_keepout", 0.4),
        ("doggo_grid2", "lidar_max_dist", 10.0),
        ("doggo_grid2", "hazards_locations", ((-0.5, 2.0), (0.5, 4.0))),
        ("point_gridwall", "hazards_num", 42),
        ("point_grid0", "continue_goal", False),
        ("point_grid4", "goal_locations", ((0.0, 10.0),)),
        ("car_grid1", "goal_size", 0.5),
        ("car_grid1", "hazards_size", 1.0),
        ("car_grid1", "lidar_num_bins", 10),
        ("car_grid1", "robot_placements", ((-1.0, -1.0, 1.0, 1.0),)),
        ("point_circle0", "lidar_max_dist", 6.0),
        ("point_circle0", "lidar_num_bins", 16),
    ],
)
def test_options_are_those_of_the_table(name, option, value):
    assert getattr(task(name).env.config, option) == value
    assert envs.env_defaults(name)[option] == value


def test_the_walls_of_the_grid_are_two_sides_and_two_rows_around_its_posts():
    posts = {(-0.5, 2.0), (0.5, 4.0), (-0.5, 6.0), (0.5, 8.0)}
    sides = {(x, float(y)) for x in (-2.0, 2.0) for y in range(-1, 13)}
    rows = {(float(x), y) for x in range(-2, 3) for y in (-2.0, 13.0)}
    assert {*suite.WALL} == posts | sides | rows and len(suite.WALL) == 42


def test_27_tasks_and_the_others_are_registered_for_each_robot():
    named = {f"{r}_{t}{i}" for r in SENSORS for t in ("goal", "button", "push") for i in "012"}
    assert len(named) == 27 and named < set(envs.ENVS)
    extra = 3 * 2 + 3 * 5 + 6 + 2 + 4  # run and circle, grids, velocity tasks, racing, pendulums
    assert len(envs.ENVS) == 27 + extra + 2 * 4 + 12  # Safety-Gymnasium's circles and run, SEditor's


@pytest.mark.parametrize(
    "name, identity",
    [
        ("car_push1", "Safexp-CarPush1-v0"),
        ("doggo_button2", "Safexp-DoggoButton2-v0"),
        ("point_run", "Safexp-PointRun-v0"),
        ("car_circle", "Safexp-CarCircle-v0"),
        ("point_grid0", "Testing-PointGrid0-v0"),
        ("car_gridwall", "Testing-CarGridWall-v0"),
    ],
)
def test_the_original_ids_name_the_same_environments(name, identity):
    assert envs.canonical(identity) == name == envs.canonical(name)
    assert envs.ALIASES[identity] == name
    assert envs.make(identity, engine="c").config == task(name).env.config


def test_every_name_has_an_alias():
    named = {name for name in envs.ENVS if not name.startswith("seditor_")}
    assert set(envs.ALIASES.values()) == named
    assert not set(envs.ALIASES) & set(envs.ENVS)


def test_an_unknown_name_gets_the_nearest():
    for wrong, near in (("car_posh1", "car_push1"), ("Safexp-CarPsh1-v0", "Safexp-CarPush1-v0")):
        with pytest.raises(ConfigError, match=f"did you mean '{near}'"):
            envs.make(wrong)


def test_env_defaults_build_the_same_environment():
    options = envs.env_defaults("car_push2")
    assert options.pop("engine") == "auto"
    assert (
        envs.make("car_push2", engine="c", **options).config
        == envs.make("car_push2", engine="c").config
    )


def test_a_config_can_be_made_and_overridden():
    config = task("point_goal1").env.config
    env = envs.make(config, engine="c", hazards_num=3)
    assert (env.name, env.place.kinds.count("hazards")) == ("custom", 3)


def test_only_what_the_original_senses_is_sensed():
    doggo, car = (task(f"{r}_goal0").env.scene.model for r in ("doggo", "car"))
    waist = [doggo.joint(i).name for i in range(doggo.njnt)]
    sensed = {doggo.sensor(i).name.removeprefix("jointpos_") for i in range(doggo.nsensor)}
    driven = {doggo.joint(i).name for i in doggo.actuator_trnid[:, 0]}
    assert len(set(waist) - sensed - driven) == 2  # the free joint and the waist
    names = {car.sensor(i).name for i in range(car.nsensor)}
    assert not any("left" in name or "right" in name for name in names)


@pytest.mark.parametrize(
    "name, half, mass", [("point_push1", 0.2, 1.28e-4), ("car_push1", 0.125, 1.5625e-5)]
)
def test_the_box_has_four_corner_posts_and_their_mass_counts(name, half, mass):
    model = task(name).env.scene.model
    body = model.body("box")
    assert body.mass[0] == pytest.approx(mass)
    geoms = np.flatnonzero(model.geom_bodyid == body.id)
    np.testing.assert_allclose(model.geom_size[geoms[0]], [half] * 3)
    np.testing.assert_allclose(model.geom_size[geoms[1:]], [[half / 2, half / 2, half]] * 4)
    corners = {tuple(np.round(p / half, 6)) for p in model.geom_pos[geoms[1:]]}
    assert corners == {(x, y, 0.0) for x in (-1, 1) for y in (-1, 1)}


def test_objects_weigh_and_rub_as_in_the_original():
    model = envs.make("point_button2", engine="c", vases_num=1, pillars_num=1).scene.model
    for name in ("vase0", "gremlin5obj"):
        assert model.body(name).mass[0] == pytest.approx(8e-6)
    for name in ("vase0", "gremlin0obj", "pillar0", "button3", "floor"):
        geom = model.geom(name)
        np.testing.assert_allclose(geom.friction, [1, 0.005, 0.0001])
        assert (geom.condim[0], geom.contype[0], geom.conaffinity[0]) == (6, 1, 1)
    assert model.geom("pillar0").type[0] == CYLINDER
    np.testing.assert_allclose(model.geom("pillar0").size[:2], [0.2, 0.5])
    assert model.geom("button0").type[0] == SPHERE
    np.testing.assert_allclose(model.eq_solref, [[0.02, 1.5]] * 6)


@pytest.mark.parametrize("robot", sorted(SENSORS))
def test_an_episode_starts_at_rest_at_nominal_heights(robot):
    t = task(f"{robot}_goal1")
    state = t.begin()
    physics = state.physics.bodies
    heights = {"point": 0.1, "car": 0.1, "doggo": 0.22}
    position, _ = jax.vmap(t.env.arena.robot_pose)(state.physics)
    np.testing.assert_allclose(position[:, 2], heights[robot], rtol=1e-6)
    vases = physics.qpos[:, t.env.scene.qpos_slice("vases")]
    np.testing.assert_allclose(vases[:, 2], 0.1 - 4e-5, rtol=1e-6)
    np.testing.assert_array_equal(physics.qvel, 0)
    np.testing.assert_array_equal(physics.substeps, 0)
    np.testing.assert_array_equal(state.cost, 0)


def test_a_resting_point_reads_gravity():
    t = task("point_goal1")
    np.testing.assert_allclose(t.part(t.begin(), "accelerometer"), [[0, 0, 9.81]] * 4, atol=1e-6)
    np.testing.assert_allclose(
        t.part(t.idle(t.begin()), "accelerometer"), [[0, 0, 9.81]] * 4, atol=1e-5
    )
