"""What planning algorithms observe of Goal: by hand, and the cost that follows from it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tasks import ROBOT_AT_ORIGIN, task

from jaxsafe import envs
from jaxsafe.config import ConfigError
from jaxsafe.envs.engines import Readings
from jaxsafe.envs.safety_gym import observe
from jaxsafe.envs.wrap import ActionRepeat, FrameStack


@pytest.mark.parametrize("robot", ["point", "car"])
def test_goal1_has_29_numbers_and_goal0_13(robot):
    sizes = [envs.make(f"{robot}_goal{i}", observation="coordinates").obs_size for i in (1, 0)]
    assert sizes == [29, 13]


def test_the_coordinates_by_hand():
    """The robot looks along +y from (0, 0): what lies there is ahead; along -x is to its left."""
    t = task(
        "point_goal1",
        **ROBOT_AT_ORIGIN | {"robot_rot": np.pi / 2},
        observation="coordinates",
        hazards_num=2,
        hazards_locations=((0.0, 1.0), (-0.5, 0.0)),
        goal_locations=((1.0, 1.0),),
    )
    state = t.begin(1)
    expected = [1.0, -1.0, 1.0, 0.0, 0.0, 0.5, 0.0, -1.0, 0.0, 0.0]  # goal, hazards, heading, position
    np.testing.assert_allclose(state.obs[0, 7:], expected, atol=1e-5)
    assert t.env.observation_spec["hazards"] == (2, 2) and state.obs.shape == (1, 17)


def test_of_each_sensor_the_coordinates_that_a_planar_robot_moves_in_are_kept():
    """Two of the velocity, the acceleration ahead, the turn about the vertical, and the compass."""
    env = envs.make("point_goal0", engine="c", observation="coordinates")
    arena = env.arena
    world = arena.at_rest(jnp.zeros((2, 2)), jnp.zeros(2), jax.random.key(0))
    sensors = jnp.zeros(env.scene.model.nsensordata)
    for i, name in enumerate(("velocimeter", "accelerometer", "gyro", "magnetometer")):
        sensors = sensors.at[arena.sensors[name][0]].set(3.0 * i + jnp.arange(3))
    readings = Readings(sensors, jnp.zeros(0), {}, jnp.zeros(()))
    seen = observe.observe(arena, world, readings, jnp.zeros(2))
    assert seen[:7].tolist() == [0, 1, 3, 8, 9, 10, 11]


def test_the_cost_that_follows_is_a_depth_where_costs_are_no_indicators():
    """Of hazards of 0.2 m, 0.05 m and 0.1 m from the robot, at 3 for a metre."""
    options = {"hazards_num": 3, "hazards_cost": 3.0, "constrain_indicator": False}
    env = envs.make("point_goal1", engine="c", observation="coordinates", **options)
    assert env.obs_size == 19
    obs = jnp.zeros(19).at[9:15].set(jnp.array([0.05, 0.0, 0.0, -0.1, 1.0, 1.0]))
    assert env.observed_cost(obs) == pytest.approx(3 * (0.15 + 0.1))


def test_the_cost_follows_from_the_coordinates_and_of_a_repeated_step_from_the_last_of_it():
    t = task("point_goal1", observation="coordinates", placements_extents=(-0.9, -0.9, 0.9, 0.9))
    charged: Any = t.env.observed_cost
    state = t.begin(16)
    for i in range(40):
        action = jax.random.uniform(jax.random.key(i), (16, 2), minval=-1.0, maxval=1.0)
        state = t.step(state, action.at[:, 0].set(1.0))
        np.testing.assert_array_equal(charged(state.obs), state.cost)
        if 0 < state.cost.sum() < 16:
            break
    assert 0 < state.cost.sum() < 16
    repeated: Any = FrameStack(ActionRepeat(t.env, 5), 2)
    frames = jnp.concatenate([state.obs, jnp.zeros_like(state.obs)], -1)  # the newest first
    np.testing.assert_array_equal(repeated.observed_cost(frames), 5 * state.cost)


def test_an_observation_that_does_not_tell_the_cost_says_so():
    assert envs.make("point_goal1").observed_cost is None
    assert ActionRepeat(envs.make("point_goal2", observation="coordinates"), 2).observed_cost is None
    free = envs.make("point_goal0", observation="coordinates")
    assert free.observed_cost(jnp.ones((3, 13))).tolist() == [0, 0, 0]
    with pytest.raises(ConfigError, match=r"expected env\.task=goal, not push"):
        envs.make("point_push1", observation="coordinates")
