"""`rules=safety_gymnasium`: each difference from Safety Gym, worked out by hand."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tasks import ROBOT_AT_ORIGIN, change, task, with_qpos

from jaxsafe import envs
from jaxsafe.config import ConfigError
from jaxsafe.envs.engines import Readings
from jaxsafe.envs.safety_gym import costs

THEIRS: dict[str, Any] = {"rules": "safety_gymnasium"}
TOUCHED: dict[str, Any] = {  # Point at the origin, which touches button 0
    **ROBOT_AT_ORIGIN,
    "constrain_buttons": True,
    "buttons_num": 2,
    "buttons_keepout": 0.0,
    "goal_keepout": 0.0,
    "buttons_locations": ((0.19, 0.0), (-0.9, 0.9)),
}


def test_the_buttons_of_a_new_episode_are_not_seen_and_cost_nothing_for_ten_steps():
    """Observations 0 to 9 and the costs of steps 1 to 10, as after a success; in Safety Gym none."""
    for rules, delay in ((THEIRS, 10), ({}, 0)):
        t = task("point_button0", **TOUCHED, **rules)
        state = t.begin()
        state = change(state, goal_button=jnp.ones(4, jnp.int32))
        touching = {k: getattr(state.physics.bodies, k) for k in ("qpos", "qvel", "warmstart")}
        seen, costs = [], []
        for _ in range(12):
            seen.append(bool(t.part(state, "buttons_lidar").any()))
            state = t.idle(change(state, touching))
            costs.append(float(state.cost[0]))
        assert seen == [i >= delay for i in range(12)]
        assert costs == [float(i >= delay) for i in range(12)]


def test_a_mark_of_the_goal_lies_among_the_buttons_and_keeps_its_distance():
    """Keepouts: 0.4 m, like the robot's and the gremlins'; a button's 0.2 m, a hazard's 0.18 m."""
    theirs = task("point_button1", **THEIRS)
    assert theirs.env.place.names == (
        "robot",
        *(f"button{i}" for i in range(4)),
        "goal",
        *(f"hazard{i}" for i in range(4)),
        *(f"gremlin{i}" for i in range(4)),
    )
    layout = np.asarray(theirs.begin().physics.layout)
    distance = np.linalg.norm(layout - layout[:, 5:6], axis=-1)
    nearest = np.array([0.8, *[0.6] * 4, 0.0, *[0.58] * 4, *[0.8] * 4])
    assert (distance >= nearest - 1e-6).all()
    assert "goal" not in task("point_button1").env.place.names


def test_the_goal_seen_is_the_button_to_press_and_not_the_mark():
    t = task("point_button1", **THEIRS)
    world = jax.tree.map(lambda x: x[0], t.begin().physics)
    button = world.layout[t.env.place.slice("buttons")][world.goal_button]
    np.testing.assert_allclose(t.env.arena.goal_position(world)[:2], button)


def test_the_box_is_placed_last():
    names = envs.make("point_push2", engine="c", **THEIRS).place.kinds
    assert names == ("robot", "goal", *["hazards"] * 4, *["pillars"] * 4, "box")
    names = envs.make("point_push2", engine="c").place.kinds
    assert names == ("robot", "goal", "box", *["hazards"] * 4, *["pillars"] * 4)


@pytest.mark.parametrize(
    "name, parts",
    [
        ("car_goal2", "ballangvel_rear ballquat_rear goal_lidar hazards_lidar vases_lidar"),
        ("point_button2", "buttons_lidar goal_lidar hazards_lidar gremlins_lidar"),
        ("point_push1", "goal_lidar hazards_lidar pillars_lidar box_lidar"),
    ],
)
def test_observations_are_in_the_order_of_adding(name, parts):
    env = envs.make(name, engine="c", **THEIRS)
    order = ["accelerometer", "velocimeter", "gyro", "magnetometer", *parts.split()]
    assert list(env.observation_spec) == order
    assert env.obs_size == envs.make(name, engine="c").obs_size


def test_the_flat_observation_has_the_components_in_that_order():
    t, plain = task("point_button0", **TOUCHED, **THEIRS), task("point_button0", **TOUCHED)
    state, ours = t.idle(t.begin()), plain.idle(plain.begin())
    for name in ("accelerometer", "velocimeter", "gyro", "magnetometer"):
        np.testing.assert_allclose(t.part(state, name), plain.part(ours, name), atol=1e-5)


@pytest.mark.parametrize(
    "name, options",
    [
        ("doggo_goal1", {}),
        ("point_circle", {}),
        ("point_run", {}),
        ("point_goal1", {"lidar_type": "natural"}),
        ("point_goal1", {"walls_num": 1}),
        ("point_goal1", {"observe_remaining": True}),
    ],
)
def test_what_is_not_theirs_or_not_followed_is_refused(name, options):
    with pytest.raises(ConfigError, match=r"env\.\w+=.* with env.rules=safety_gymnasium: "):
        envs.make(name, engine="c", **THEIRS, **options)


def test_their_ids_lead_to_the_rules():
    env = envs.make("SafetyCarPush2-v0", engine="c")
    assert env.config == envs.make("car_push2", engine="c", **THEIRS).config
    assert envs.env_defaults("SafetyCarPush2-v0")["rules"] == "safety_gymnasium"
    own = envs.make("SafetyCarPush2-v0", engine="c", rules="safety_gym")
    assert own.config == envs.make("car_push2", engine="c").config
    with pytest.raises(ConfigError, match="did you mean"):
        envs.make("SafetyDoggoGoal1-v0")


def test_an_id_that_is_registered_anew_implies_no_rules():
    envs.register("SafetyCarGoal1-v0", envs.ENVS["car_goal1"])
    assert envs.env_defaults("SafetyCarGoal1-v0")["rules"] == "safety_gym"
    assert envs.make("SafetyCarGoal1-v0", engine="c").config.rules == "safety_gym"


# ---- Circle and Run ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "identity, size, costs",
    [
        ("SafetyPointCircle0-v0", 28, ()),
        ("SafetyCarCircle2-v0", 40, ("out_of_bounds",)),
        ("SafetyPointRun0-v0", 12, ("out_of_bounds",)),
        ("SafetyCarRun0-v0", 24, ("out_of_bounds",)),
    ],
)
def test_circle_and_run_go_by_their_ids_and_have_their_sizes(identity, size, costs):
    env = envs.make(identity, engine="c")
    assert (env.obs_size, env.cost_names, env.episode_length) == (size, costs, 500)


def test_their_circle_is_paid_at_the_bodys_origin_and_its_lines_cost():
    """0.1 (v x - u y) / r / (1 + |r - 1.5|) with x, y of the body; a cost beyond |y| = 1.125."""
    t = task("point_circle2")
    state = t.begin()
    start = np.asarray(state.physics.start)
    assert (np.abs(start[:, :2]) <= 0.8).all() and len({*start[:, 2]}) == 4
    places = np.array([[1.2, 0.3, 0.5], [0.3, -1.2, 0.5], [1.1, 1.1, 0.5], [-1.0, 0.5, 0.5]])
    state = change(with_qpos(state, slice(0, 3), places), {"qvel": jnp.array([[0.3, 0.4, 0.0]] * 4)})
    after = t.idle(state)
    bodies = after.physics.bodies
    (x, y), (u, v) = np.asarray(bodies.qpos, float)[:, :2].T, np.asarray(bodies.qvel, float)[:, :2].T
    r = np.hypot(x, y)
    expected = 0.1 * (v * x - u * y) / r / (1 + abs(r - 1.5))
    np.testing.assert_allclose(after.reward, expected, rtol=1e-4)
    np.testing.assert_array_equal(after.cost, [1, 1, 0, 0])
    one = task("point_circle1")
    again = one.idle(change(with_qpos(one.begin(), slice(0, 3), places)))
    np.testing.assert_array_equal(again.cost, [1, 0, 0, 0])


def test_a_corner_beyond_two_lines_costs_as_much_as_one():
    env = envs.make("point_circle2", engine="c", constrain_indicator=False, bounds_cost=2.0)
    none = Readings(jnp.zeros(0), jnp.zeros(0), {}, jnp.zeros(()))
    for place, expected in (((1.2, -1.2), 2), ((0.0, -1.2), 2), ((-1.2, 0.0), 2), ((1.1, 1.1), 0)):
        world = env.arena.at_rest(jnp.array([place]), jnp.zeros(1), jax.random.key(0))
        parts, total = costs.costs(env.arena, world, none)
        assert parts.tolist() == [expected] and total == expected


def test_their_run_is_paid_for_nearing_a_point_a_kilometre_away():
    t = task("point_run0")
    state = t.begin()
    start = np.asarray(state.physics.start)
    assert (np.abs(start[:, 0]) <= 0.2).all() and (start[:, 1] == 16.5).all()
    state = with_qpos(state, slice(0, 1), [[0.0], [0.45], [0.6], [-0.6]])
    state = change(state, {"qvel": jnp.array([[0.5, -1.0, 0.0]] * 4)})
    after = t.idle(state)
    old, new = (np.asarray(x.physics.bodies.qpos, float)[:, :2] for x in (state, after))
    near = [np.hypot(x[:, 0], x[:, 1] + 1000) for x in (old, new)]
    np.testing.assert_allclose(after.reward, 60 * (near[0] - near[1]), rtol=1e-4)
    assert (after.reward > 0.5).all()
    np.testing.assert_array_equal(after.cost, np.abs(new[:, 0]) > 0.5)
    assert 0 < after.cost.sum() < 4
