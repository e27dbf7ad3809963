"""SEditor's tasks: sizes, rays against MuJoCo's own, layouts, ends and costs."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiling import FAST
from tasks import Task, change, in_parts, physics_of, put, with_qpos

from jaxsafe import envs
from jaxsafe.envs.safety_gym import layout as layouts
from jaxsafe.envs.safety_gym import suite
from jaxsafe.envs.safety_gym.config import config_from_plain, defaults
from jaxsafe.envs.safety_gym.scene import GROUP
from jaxsafe.envs.view.stage import Stage
from jaxsafe.envs.wrap import innermost

native: Any = mujoco  # its functions are not known to type checkers
NAMES = sorted(suite.seditor())


@functools.cache
def fork(name: str) -> Task:
    env: Any = innermost(envs.make(name, engine="c"))
    return Task(env, *in_parts(env, compiler_options=FAST))


def config(name):
    options = {k: v for k, v in suite.seditor()[name].items() if k != "wrap"}
    return config_from_plain(defaults(**options))


@pytest.mark.parametrize(
    "name, size",
    [("point_goal2", 204), ("car_goal1", 216), ("point_button2", 268), ("car_push2", 280)],
)
def test_observations_have_the_sizes_of_the_fork_and_are_stacked_four_deep(name, size):
    env = envs.make(f"seditor_{name}", engine="c")
    assert (innermost(env).obs_size, env.obs_size) == (size, 4 * size)
    assert env.episode_length == 999


@pytest.mark.parametrize(
    "name, option, value",
    [
        ("point_goal1", "hazards_num", 5),
        ("point_goal2", "vases_num", 8),
        ("car_button2", "gremlins_num", 5),
        ("car_button2", "placements_extents", (-2.0, -2.0, 2.0, 2.0)),
        ("point_button1", "gremlins_travel", 0.2),
        ("point_push1", "constrain_pillars", True),
        ("point_push2", "box_size", 0.1),
        ("car_push2", "box_size", 0.125),
        ("car_push1", "hazards_size", 0.2),
        ("point_push1", "hazards_keepout", 0.18),
        ("point_push2", "box_keepout", 0.1),
        ("car_push2", "box_keepout", 0.125),
        ("car_push1", "goal_keepout", 0.4),
        ("car_push1", "box_null_dist", 0.0),
        ("point_button1", "goal_keepout", 0.4),
        ("point_button2", "hazards_keepout", 0.18),
        ("car_goal2", "goal_keepout", 0.3),
        ("car_goal1", "vases_velocity_cost", 0.0),
        ("car_goal1", "robot_keepout", 0.15),
        ("car_goal1", "vases_keepout", 0.1),
        ("car_goal1", "placements_margin", 0.3),
        ("point_push2", "pillars_keepout", 0.2),
        ("point_button1", "gremlins_keepout", 0.3),
        ("point_button1", "buttons_keepout", 0.1),
        ("point_button1", "buttons_resampling_delay", 20),
    ],
)
def test_options_are_those_of_the_fork(name, option, value):
    assert getattr(config(f"seditor_{name}"), option) == value


# ---- rays --------------------------------------------------------------------------------------


def oracle(env, world):
    """MuJoCo's model and data of a world, with the goal and the hazards as geoms of their groups."""
    stage = Stage(env)
    stage.move(world)
    spec, cfg = stage.scene.spec, env.config
    cylinder = native.mjtGeom.mjGEOM_CYLINDER
    radius = cfg.buttons_size if cfg.task == "button" else cfg.goal_size
    discs = [("goal", radius, env.arena.goal_position(world)[:2])]
    discs += [("hazard", cfg.hazards_size, xy) for xy in env.arena.positions(world, "hazards")]
    for kind, radius, (x, y) in discs:
        size, place = (radius, 0.2, 0), (float(x), float(y), 0.21)
        spec.worldbody.add_geom(type=cylinder, size=size, pos=place, group=GROUP[kind], contype=0)
    model = spec.compile()
    data = native.MjData(model)
    data.qpos[:], data.qvel[:] = stage.data.qpos, stage.data.qvel
    data.mocap_pos[:], data.mocap_quat[:] = stage.data.mocap_pos, stage.data.mocap_quat
    native.mj_forward(model, data)
    return model, data


def rays(model, data, kind):
    group = np.zeros(6, np.uint8)
    group[GROUP[kind if kind in GROUP else kind[:-1]]] = 1
    robot = data.body("robot")
    origin = np.array([*robot.xpos[:2], 0.3])
    readings = []
    for angle in 2 * np.pi * np.arange(64) / 64:
        ray = robot.xmat.reshape(3, 3) @ np.array([np.cos(angle), np.sin(angle), 0.0])
        ray[2] = 0.0
        found = np.array([-1], np.int32)
        distance = native.mj_ray(model, data, origin, ray, group, 1, robot.id, found)
        readings.append(np.exp(-distance) if distance >= 0 else 0.0)
    return np.array(readings)


@pytest.mark.parametrize(
    "name, kinds",
    [
        ("seditor_point_goal2", ("goal", "hazards", "vases")),
        ("seditor_point_button2", ("goal", "buttons", "hazards", "gremlins")),
        ("seditor_car_push2", ("goal", "box", "hazards", "pillars")),
    ],
)
def test_natural_lidar_is_mujocos_ray_cast(name, kinds):
    """On random layouts, at rest and after three steps. A ray along an edge may go either way."""
    t = fork(name)
    state = t.begin(6, seed=1)
    push = jnp.ones((6, t.env.action_size)) * jnp.array([1.0, 0.3])
    moved = t.step(t.step(t.step(state, push), push), push)
    differ, hits = [], 0
    for now in (state, moved):
        for i in range(6):
            world = jax.tree.map(lambda x, i=i: x[i], now.physics)
            model, data = oracle(t.env, world)
            for kind in kinds:
                seen, expected = t.part(now, f"{kind}_lidar")[i], rays(model, data, kind)
                seen = np.abs(seen) if kind == "buttons" else seen
                differ.append(np.abs(seen - expected))
                hits += (expected > 0).sum()
    differ = np.concatenate(differ)
    assert hits > 200
    assert (differ > 1e-4).mean() < 0.004, np.sort(differ)[-20:]


def test_buttons_that_sleep_are_seen_with_the_other_sign_and_a_goal_stands_at_the_one_to_press():
    t = fork("seditor_point_button2")
    state = t.begin()
    awake = t.idle(state)
    asleep = t.idle(change(state, buttons_timer=jnp.full(4, 5, jnp.int32)))
    seen = t.part(awake, "buttons_lidar")
    assert (seen >= 0).all() and (seen > 0).any(1).all()
    np.testing.assert_allclose(t.part(asleep, "buttons_lidar"), -seen, atol=1e-6)
    goal = t.part(awake, "goal_lidar")
    met = goal > 0  # rays that are far apart may miss it, as it is no wider than the button
    assert met.any(1).sum() >= 3
    np.testing.assert_allclose(goal[met], seen[met], atol=1e-5)


# ---- layouts -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_layouts_are_there_and_the_largest_keepouts_are_placed_first(name):
    place = layouts.placement(config(name))
    assert layouts.feasible(place)
    assert (np.diff(place.keepouts[place.turns]) <= 0).all()
    assert place.names[0] == "robot" and place.search == (200, 100_000)
    assert "goal" in place.names  # among buttons, too, before it stands at one of them


@pytest.mark.parametrize("name", ["seditor_point_goal2", "seditor_car_push2"])
def test_layouts_leave_the_margin_between_any_two_objects(name):
    place = layouts.placement(config(name))
    keys = jax.random.split(jax.random.key(0), 50)
    sample = jax.jit(jax.vmap(lambda key: layouts.sample_layout(place, key)), compiler_options=FAST)
    xy, found = map(np.asarray, sample(keys))
    assert found.all()
    distance = np.linalg.norm(xy[:, :, None] - xy[:, None], axis=-1)
    needed = place.keepouts[:, None] + place.keepouts + 0.3
    assert (distance + 10 * np.eye(len(needed)) >= needed - 1e-5).all()
    low, high = (place.areas[:, 0, k : k + 2] for k in (0, 2))
    assert (xy >= low - 1e-6).all() and (xy <= high + 1e-6).all()


# ---- ends and costs ----------------------------------------------------------------------------


def test_a_success_ends_the_episode_and_its_value_goes_on():
    t = fork("seditor_point_goal2")
    state = t.begin()
    goal = np.asarray(state.physics.layout[:, t.env.place.names.index("goal")])
    near = np.asarray(state.physics.start[:, :2])
    after = t.idle(put(t, state, "goal", np.where([[True], [False]] * 2, near, goal)))
    np.testing.assert_array_equal(after.truncated, [True, False] * 2)
    np.testing.assert_array_equal(after.info["goal_met"], [1, 0] * 2)
    assert not after.terminated.any() and not state.truncated.any()


def test_a_success_with_a_physics_error_is_a_failure():
    """A vase flies off in the last substep, after which MuJoCo does not look for errors."""
    t = fork("seditor_point_goal2")
    drive, judge = (jax.jit(jax.vmap(f), compiler_options=FAST) for f in (t.env.drive, t.env.judge))
    run, _ = physics_of(t.env._engine)
    state = t.begin()
    state = put(t, state, "goal", state.physics.start[:, :2])
    given = drive(state.physics, jnp.zeros((4, 2)))
    physics, readings = run(state.physics.bodies, given.ctrl, given.substeps)
    physics = physics.replace(qvel=physics.qvel.at[2, -1].set(jnp.inf))
    after = judge(state, given, physics, readings)
    np.testing.assert_array_equal(after.truncated, [True, True, False, True])
    np.testing.assert_array_equal(after.terminated, ~after.truncated)
    np.testing.assert_array_equal(after.info["goal_met"], [1, 1, 0, 1])


def test_several_violations_cost_one_and_fast_vases_nothing():
    t = fork("seditor_point_goal2")
    state = t.begin()
    assert t.env.cost_names == ("vases_contact", "hazards")
    place = np.asarray(state.physics.start[:, :2])
    inside = put(t, put(t, state, "hazard0", place), "hazard1", place)
    vase = t.env.scene.qpos_slice("vases")
    touching = with_qpos(inside, slice(vase.start, vase.start + 2), place + 0.15)
    np.testing.assert_array_equal(t.idle(inside).cost, 1)
    after = t.idle(touching)
    np.testing.assert_array_equal(after.cost, 1)
    assert (after.costs.sum(1) == 2).any()
    rolling = state.physics.bodies.qvel.at[:, t.env.scene.qvel_slice("vases").start].set(1.0)
    np.testing.assert_array_equal(t.idle(change(state, {"qvel": rolling})).cost, 0)
