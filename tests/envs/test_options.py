"""Every option does something, or is named here as one that nothing reads."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiling import FAST
from tasks import ROBOT_AT_ORIGIN, change, in_parts, task

from jaxsafe import envs
from jaxsafe.config import ConfigError
from jaxsafe.envs import SafetyGym, SafetyGymConfig
from jaxsafe.envs.safety_gym.scene import built_in

native: Any = mujoco  # its functions are not known to type checkers

# Point at the origin in a goal and a hazard, touching a vase, a pillar, a gremlin and a button.
AMID: dict[str, Any] = {
    **ROBOT_AT_ORIGIN,
    "goal_locations": ((0.1, 0.0),),
    **{f"constrain_{k}": True for k in ("hazards", "vases", "pillars", "gremlins", "buttons")},
    **{f"{k}_keepout": 0.0 for k in ("goal", "hazards", "vases", "pillars", "gremlins", "buttons")},
    **{f"{k}_num": 2 for k in ("hazards", "vases", "pillars", "gremlins", "buttons")},
    "constrain_indicator": False,
    "hazards_locations": ((0.05, 0.0),),
    "vases_locations": ((0.19, 0.0),),
    "pillars_locations": ((0.0, 0.29),),
    "gremlins_locations": ((-0.19, 0.0),),
    "buttons_locations": ((0.0, -0.19),),
    "vases_displace_cost": 1.0,
}
BASES: dict[str, tuple[str, dict[str, Any]]] = {
    "amid": ("point_goal0", AMID),
    "plain": ("point_goal0", {}),
    "push": ("point_push0", {}),
    "button": ("point_button0", {}),
    "pressed": (
        "point_button0",
        {
            **ROBOT_AT_ORIGIN,
            "buttons_num": 1,
            "buttons_locations": ((0.19, 0.0),),
            "buttons_keepout": 0.0,
        },
    ),
    "run": ("point_run", {}),
    "rise": ("doggo_run", {"task": "z"}),
    "circle": ("point_circle", {}),
    "car": ("car_goal0", {"reward_orientation": True}),
    "exponential": ("point_goal0", {"lidar_max_dist": None}),
    "wall": ("point_goal0", {"walls_num": 1}),
    "compass": ("point_goal0", {"observe_goal_comp": True}),
    "lines": ("point_goal0", {"bounds_num": 2, "bounds": 1e-3, "constrain_indicator": False}),
}
RECTANGLE = ((-0.9, -0.9, 0.9, 0.8),)
READ: dict[str, tuple[str, Any]] = {  # option: base, and a value other than the base's
    "rules": ("button", "safety_gymnasium"),
    "num_steps": ("plain", 7),
    "action_noise": ("plain", 5.0),
    "placements_extents": ("plain", (-2.0, -1.0, 1.0, 1.0)),
    "placements_margin": ("plain", 0.1),
    "robot_placements": ("plain", RECTANGLE),
    "robot_locations": ("plain", ((0.1, 0.2),)),
    "robot_keepout": ("plain", 0.3),
    "robot_base": ("plain", "xmls/doggo.xml"),
    "robot_rot": ("plain", 0.5),
    "randomize_layout": ("plain", False),
    "continue_goal": ("amid", False),
    "observation": ("plain", "coordinates"),
    "observation_flatten": ("plain", False),
    "observe_sensors": ("plain", False),
    **{f"observe_{k}": ("plain", True) for k in ("goal_dist", "goal_comp", "hazards", "vases")},
    **{f"observe_{k}": ("plain", True) for k in ("remaining", "qpos", "qvel", "ctrl", "com")},
    **{f"observe_{k}": ("amid", True) for k in ("pillars", "buttons", "gremlins")},
    "observe_goal_lidar": ("plain", False),
    "observe_box_comp": ("push", True),
    "observe_box_lidar": ("push", False),
    "observe_circle": ("circle", False),
    "observe_walls": ("wall", True),
    "observe_freejoint": ("car", True),
    "lidar_num_bins": ("plain", 12),
    "lidar_max_dist": ("plain", 4.0),
    "lidar_exp_gain": ("exponential", 0.5),
    "lidar_type": ("plain", "natural"),
    "lidar_alias": ("plain", False),
    "compass_shape": ("compass", 3),
    "task": ("plain", "none"),
    "goal_placements": ("plain", RECTANGLE),
    "goal_locations": ("plain", ((0.5, 0.2),)),
    "goal_keepout": ("plain", 0.2),
    "goal_size": ("amid", 0.05),
    "box_placements": ("push", RECTANGLE),
    "box_locations": ("push", ((0.5, 0.2),)),
    "box_keepout": ("push", 0.1),
    "box_size": ("push", 0.15),
    "box_density": ("push", 0.002),
    "box_null_dist": ("push", 90.0),
    "reward_distance": ("plain", 2.0),
    "reward_goal": ("amid", 2.0),
    "reward_box_dist": ("push", 2.0),
    "reward_box_goal": ("push", 2.0),
    "reward_orientation": ("plain", True),
    "reward_orientation_scale": ("car", 0.1),
    "reward_orientation_body": ("car", "left"),
    "reward_x": ("run", 2.0),
    "reward_z": ("rise", 2.0),
    "reward_circle": ("circle", 2.0),
    "reward_clip": ("plain", 1e-6),
    **{f"{k}_num": ("amid", 1) for k in ("buttons", "hazards", "vases", "pillars", "gremlins")},
    **{
        f"{k}_placements": ("amid", RECTANGLE)
        for k in ("buttons", "hazards", "vases", "pillars", "gremlins")
    },
    **{
        f"{k}_locations": ("amid", ((0.2, 0.2),))
        for k in ("buttons", "hazards", "vases", "pillars", "gremlins")
    },
    **{f"{k}_keepout": ("amid", 0.01) for k in ("buttons", "hazards", "vases", "pillars", "gremlins")},
    **{f"{k}_size": ("amid", 0.12) for k in ("buttons", "hazards", "vases", "pillars", "gremlins")},
    **{f"{k}_cost": ("amid", 2.0) for k in ("buttons", "hazards", "pillars", "gremlins_contact")},
    **{
        f"constrain_{k}": ("amid", False)
        for k in ("buttons", "hazards", "vases", "pillars", "gremlins")
    },
    "constrain_indicator": ("amid", True),
    "buttons_resampling_delay": ("pressed", 4),
    "circle_radius": ("circle", 1.0),
    "bounds_num": ("plain", 2),
    "bounds": ("lines", 5.0),
    "bounds_cost": ("lines", 2.0),
    "sensors_obs": ("plain", ("gyro",)),
    "sensors_angle_components": ("car", False),
    "walls_num": ("plain", 1),
    "walls_placements": ("wall", RECTANGLE),
    "walls_locations": ("wall", ((0.2, 0.2),)),
    "walls_keepout": ("wall", 0.1),
    "walls_size": ("wall", 0.2),
    "vases_density": ("amid", 0.002),
    "vases_sink": ("amid", 1e-3),
    "vases_contact_cost": ("amid", 2.0),
    "vases_displace_cost": ("amid", 2.0),
    "vases_displace_threshold": ("amid", 1.0),
    "vases_velocity_cost": ("amid", 2.0),
    "vases_velocity_threshold": ("amid", 50.0),
    "pillars_height": ("amid", 0.3),
    "gremlins_travel": ("amid", 0.1),
    "gremlins_density": ("amid", 0.002),
    "frameskip_binom_n": ("plain", 7),
    "frameskip_binom_p": ("plain", 0.3),
}
NEVER_READ = {
    "build_resample": False,
    "sensors_hinge_joints": False,
    "sensors_ball_joints": False,
    "gremlins_dist_threshold": 0.9,
    "gremlins_dist_cost": 5.0,
}
RENDERING = {
    "floor_display_mode": True,
    "render_labels": True,
    "render_lidar_markers": False,
    "render_lidar_radius": 0.3,
    "render_lidar_size": 0.1,
    "render_lidar_offset_init": 0.1,
    "render_lidar_offset_delta": 0.2,
    "vision_size": (32, 24),
    "vision_render": False,
    "vision_render_size": (64, 48),
    "vision_camera": "track",
}
TESTED_ALONE = {
    "reward_exception",
    "observe_vision",
    "terminate_resample_failure",
    "_seed",
    "contact_room",
    "awake",
}  # the third and fourth with layouts, the fifth with engine warp, the last with sleepers


def facts(env: SafetyGym) -> tuple:
    """What is fixed before an episode: the model, the placement, what is observed and what costs."""
    model = env.scene.model
    image = np.zeros(native.mj_sizeModel(model), np.uint8)
    native.mj_saveModel(model, None, image)
    place = env.place
    return (
        image.tobytes(),
        (
            place.names,
            place.margin,
            *(x.tobytes() for x in (place.areas, place.weights, place.keepouts)),
        ),
        list(env.observation_spec.items()),
        env.config.observation_flatten,
        (env.cost_names, env.episode_length, env.step_seconds, env.scene.orbit.tolist()),
    )


def outcome(env: SafetyGym) -> list[np.ndarray]:
    """All that a reset and three steps show."""
    reset, step = in_parts(env, compiler_options=FAST)
    states = [reset(jax.random.split(jax.random.key(4), 1))]
    for _ in range(3):
        states.append(step(states[-1], jnp.ones((1, env.action_size))))
    shown = [(s.obs, s.reward, s.cost, s.costs, s.terminated, s.info) for s in states]
    world: Any = states[-1].physics
    kept = world.bodies, world.layout, world.buttons_timer
    return [np.asarray(x) for x in jax.tree.leaves((shown, kept))]


def build(base: str, **changes: Any) -> SafetyGym:
    name, options = BASES[base]
    return envs.make(name, engine="c", **options | changes)


@functools.cache
def unchanged(base: str) -> SafetyGym:
    return build(base)


@functools.cache
def base_facts(base: str) -> tuple:
    return facts(unchanged(base))


@functools.cache
def base_outcome(base: str) -> list[np.ndarray]:
    return outcome(unchanged(base))


def same(a: list[np.ndarray], b: list[np.ndarray]) -> bool:
    return len(a) == len(b) and all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("option", sorted(READ))
def test_an_option_changes_something(option):
    base, value = READ[option]
    env = build(base, **{option: value})
    assert getattr(env.config, option) != getattr(unchanged(base).config, option)
    if facts(env) == base_facts(base):
        assert not same(outcome(env), base_outcome(base))


def test_every_option_is_covered():
    names = {f.name for f in dataclasses.fields(SafetyGymConfig)}
    groups = [set(READ), set(NEVER_READ), set(RENDERING), TESTED_ALONE]
    assert set().union(*groups) == names and sum(map(len, groups)) == len(names)


@pytest.mark.parametrize("options", [NEVER_READ, RENDERING], ids=["never read", "rendering"])
def test_an_option_that_no_step_reads_changes_no_step(options):
    env = build("amid", **options)
    config = unchanged("amid").config
    assert all(getattr(env.config, k) == v != getattr(config, k) for k, v in options.items())
    assert same(outcome(env), base_outcome("amid"))


def test_all_of_amid_costs():
    """The base of the contract above is a place where every constraint can be violated."""
    t = task("point_goal0", **AMID)
    state = t.step(t.begin(), jnp.ones((4, 2)))
    assert t.env.cost_names == (
        "vases_contact",
        "pillars",
        "buttons",
        "gremlins",
        "vases_displace",
        "vases_velocity",
        "hazards",
    )
    assert (state.costs > 0).any(0).all() and (state.costs > 0).all(1).any()
    np.testing.assert_allclose(state.cost, state.costs.sum(1), rtol=1e-6)


@pytest.mark.parametrize(
    "options, says",
    [
        ({"hazard_num": 3}, "unknown option env.hazard_num; did you mean 'hazards_num'"),
        ({"observe_hazard": True}, "did you mean 'observe_hazards'"),
        ({"hazards_num": "many"}, "env.hazards_num='many': expected a whole number"),
        ({"hazards_num": 2.5}, "env.hazards_num=2.5: expected a whole number"),
        ({"hazards_num": True}, "expected a whole number"),
        ({"continue_goal": 1}, "expected true or false"),
        ({"goal_size": None}, "env.goal_size=None: expected a number"),
        ({"placements_extents": (0.0, 1.0)}, "env.placements_extents"),
        ({"hazards_locations": (1.0, 2.0)}, "env.hazards_locations"),
        ({"task": "gaol"}, "did you mean 'goal'"),
        ({"lidar_type": "radar"}, "env.lidar_type='radar'"),
        ({"compass_shape": 4}, "env.compass_shape=4"),
        ({"robot_base": "xmls/cat.xml"}, "did you mean 'car'"),
        ({"sensors_obs": ("gyros",)}, "no sensor 'gyros'; did you mean 'gyro'"),
        ({"observe_freejoint": True}, "no free joint"),
        ({"reward_orientation": True, "reward_orientation_body": "robt"}, "did you mean 'robot'"),
        ({"frameskip_binom_p": 1.5}, "expected a number between 0 and 1"),
        ({"frameskip_binom_n": 0}, "expected a whole number between 1 and"),
        ({"num_steps": 0}, "expected a whole number between 1 and"),
        ({"action_noise": -1.0}, "expected a number between 0 and"),
        ({"goal_size": 0.0}, "env.goal_size=0.0: expected a number between 0.0001 and"),
        ({"lidar_max_dist": 0.0}, "expected a number between 0.0001 and"),
        ({"task": "button"}, "needs at least 1"),
        ({"task": "x"}, "no goal to observe"),
        ({"engine": "jacks"}, "env.engine='jacks'; did you mean 'jax'"),
        ({"engine": 3}, "env.engine=3; valid: auto, c, jax, warp"),
    ],
    ids=lambda x: None if isinstance(x, str) else ",".join(f"{k}={v}" for k, v in x.items()),
)
def test_a_wrong_option_is_refused_in_a_line_that_helps(options, says):
    with pytest.raises(ConfigError) as error:
        envs.make("point_goal0", **{"engine": "c"} | options)
    assert says in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "name", ["point_goal0", "halfcheetah_velocity", "car_racing0", "pendulum_tilt", "pendulum_swing"]
)
def test_an_action_of_another_size_is_refused_and_not_spread_over_the_motors(name):
    env = envs.make(name)
    state, size = jax.eval_shape(env.reset, jax.random.key(0)), env.action_size
    assert jax.eval_shape(env.step, state, jnp.zeros(size)).reward.shape == ()
    for shape in ((), (size + 1,), (size - 1,), (4, size)):
        with pytest.raises(ConfigError) as error:
            jax.eval_shape(env.step, state, jnp.zeros(shape))
        assert f"the action is {[*shape]}, expected [{size}]" in str(error.value)
        assert ("jax.vmap" in str(error.value)) == (len(shape) == 2)


def test_a_robot_whose_actions_have_no_bounds_is_refused(tmp_path):
    bounded = 'ctrlrange="-1 1" ctrllimited="true"'
    path = built_in("point")
    assert path is not None
    text = path.read_text()
    assert bounded in text
    (tmp_path / "wild.xml").write_text(text.replace(bounded, 'ctrllimited="false"'))
    with pytest.raises(ConfigError, match=r"wild\.xml'?: actuator 'x' has no ctrlrange$"):
        envs.make("point_goal0", engine="c", robot_base=str(tmp_path / "wild.xml"))


SLIDES = '<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>'
HINGE = '<joint name="z" type="hinge" axis="0 0 1"/>'
SENSORS = "".join(
    f'<{kind} name="{kind}" site="robot"/>'
    for kind in ("accelerometer", "velocimeter", "gyro", "magnetometer")
)


def puck(joints=SLIDES + HINGE, body='pos="0 0 0.1"', more="", sensors="") -> str:
    return f"""<mujoco><worldbody>{more}
        <body name="robot" {body}>{joints}
        <geom type="cylinder" size="0.1 0.08"/><site name="robot"/></body></worldbody>
        <actuator><motor joint="x" ctrlrange="-1 1"/></actuator>
        <sensor>{SENSORS}{sensors}</sensor></mujoco>"""


OTHER = '<body pos="1 1 1"><freejoint name="o"/><geom size="0.1"/></body>'
UP = '<joint name="up" type="slide" axis="0 0 1"/>'
BASE = '<body name="base" pos="0 0 0.1"><freejoint/><geom size="0.1"/>'
ALONE = r"expected of body 'robot' free, or slide \(1 0 0\), slide \(0 1 0\), hinge \(0 0 1\) alone"
OFF = {
    "off": (puck(body='pos="0.5 0 0.1"'), {}, "x, y of body 'robot' = 0.5 0: expected 0 0"),
    "turned": (puck(body='pos="0 0 0.1" euler="0 0 180"'), {}, "= 0 0 0 1: expected 1 0 0 0"),
    "inside": (
        puck().replace("<body", '<body name="a" pos="1 0 0"><body').replace("</body>", "</body>" * 2),
        {},
        "is in body 'a': expected",
    ),
    "ref": (
        puck(SLIDES.replace("/>", ' ref="0.3"/>', 1) + HINGE),
        {},
        "ref of .* = 0.3 0 0: expected 0 0 0",
    ),
    "beside": (
        puck(SLIDES + HINGE.replace("/>", ' pos="0.1 0 0"/>')),
        {},
        "x, y of its hinge = 0.1 0: expected",
    ),
    "order": (puck(HINGE + SLIDES), {}, rf"its joints are hinge \(0 0 1\), .*: {ALONE}"),
    "two": (puck(SLIDES), {}, rf"its joints are slide \(1 0 0\), slide \(0 1 0\): {ALONE}"),
    "height": (puck(SLIDES + UP + HINGE), {}, rf"slide \(0 0 1\), hinge \(0 0 1\): {ALONE}"),
    "fourth": (puck(SLIDES + HINGE + UP), {}, rf"hinge \(0 0 1\), slide \(0 0 1\): {ALONE}"),
    "none": (puck("").replace('joint="x"', 'site="robot"'), {}, f"its joints are none: {ALONE}"),
    "carried": (
        puck("")
        .replace('joint="x"', 'site="robot"')
        .replace("<body", BASE + "<body")
        .replace("</body>", "</body>" * 2),
        {},
        f"free of 'base': {ALONE}",
    ),
    "other": (puck(more=OTHER), {}, "joint 'o' is of another body"),
    "floor": (puck(more='<geom name="floor" type="plane" size="1 1 1"/>'), {}, "leave out its floor"),
    "mocap": (puck(more='<body name="m" mocap="true"/>'), {}, "body 'm' is a mocap body"),
    "named": (
        puck(more='<geom name="pillar0" size="0.1"/>'),
        {"pillars_num": 1},
        "repeated name 'pillar0' in geom",
    ),
    "egg": (
        puck().replace(
            "<site", '<body name="egg"><geom type="ellipsoid" size="0.1 0.1 0.2"/></body><site'
        ),
        {"lidar_type": "natural"},
        "a geom of group 0, which a lidar observes, is of type ellipsoid: expected plane, sphere",
    ),
    "run": (puck(), {"task": "x"}, "no sensor 'subtreecom', which env.task=x"),
    "circle": (puck(), {"task": "circle"}, "no sensor 'subtreecom', which env.task=circle"),
    "com": (puck(), {"observe_com": True}, "it has no sensor 'subtreecom'"),
}


@pytest.mark.parametrize("name", OFF)
def test_a_robot_that_moves_otherwise_than_tasks_take_it_is_refused_in_one_line(name, tmp_path):
    text, options, says = OFF[name]
    (tmp_path / "own.xml").write_text(text)
    with pytest.raises(ConfigError, match=says) as error:
        envs.make("point_goal0", engine="c", robot_base=str(tmp_path / "own.xml"), **options)
    assert "\n" not in str(error.value)


def test_every_named_sensor_of_a_joint_is_observed(tmp_path):
    (tmp_path / "own.xml").write_text(puck(sensors='<jointpos name="heading" joint="z"/>'))
    env = envs.make("point_goal0", engine="c", robot_base=str(tmp_path / "own.xml"))
    assert "heading" in env.observation_spec


def test_the_reward_of_an_exception_is_an_option_and_its_cost_is_none(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT
    t = task("point_goal1", reward_exception=-3.0, constrain_indicator=False, hazards_size=9.0)
    state = t.begin()
    after = t.idle(change(state, {"qvel": state.physics.bodies.qvel.at[1].set(jnp.inf)}))
    np.testing.assert_array_equal(after.reward == -3, [False, True, False, False])
    np.testing.assert_array_equal(after.cost > 0, [True, False, True, True])
    assert after.cost[1] == 0 and (after.costs[1] == 0).all()


def test_frames_are_skipped_at_random():
    """Substeps ~ Binomial(10, 0.3): mean 3, variance 2.1; and always 10 when p is 1."""
    t = task("point_goal0", frameskip_binom_p=0.3)
    counts = np.asarray(t.idle(t.begin(512)).physics.bodies.substeps)
    assert abs(counts.mean() - 3) < 4 * np.sqrt(2.1 / 512) and abs(counts.var() - 2.1) < 0.6
    t = task("point_goal0")
    state = t.idle(t.idle(t.begin()))
    np.testing.assert_array_equal(state.physics.bodies.substeps, 20)


def test_a_step_of_no_frames_changes_no_pose():
    t = task("point_goal0", frameskip_binom_p=0.0)
    state = t.begin()
    after = t.step(state, jnp.ones((4, 2)))
    np.testing.assert_array_equal(after.physics.bodies.qpos, state.physics.bodies.qpos)
    np.testing.assert_array_equal(after.reward, 0)


def test_noise_is_added_after_the_clip_and_drawn_anew():
    t = task("point_goal0", action_noise=0.5, observe_ctrl=True)
    state = t.begin(512)
    state = t.step(state, jnp.full((512, 2), 9.0))
    first = t.part(state, "ctrl")
    np.testing.assert_allclose(first.mean(0), 1.0, atol=0.1)
    np.testing.assert_allclose(first.std(0), 0.5, rtol=0.15)
    second = t.part(t.step(state, jnp.full((512, 2), 9.0)), "ctrl")
    assert abs(np.corrcoef(first[:, 0], second[:, 0])[0, 1]) < 0.2


def test_an_unflattened_observation_is_a_dict_of_the_same_numbers():
    flat, parts = task("car_goal0"), task("car_goal0", observation_flatten=False)
    named: Any = parts.begin().obs
    state = flat.begin()
    assert list(named) == list(flat.env.observation_spec)
    for name, value in named.items():
        assert value.shape[1:] == flat.env.observation_spec[name]
        np.testing.assert_array_equal(value.reshape(4, -1), flat.part(state, name))
