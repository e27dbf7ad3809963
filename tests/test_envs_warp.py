"""Engine `warp`, on Warp's CPU device: the same kernels and packing as on a GPU, without its graphs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tasks import task

from jaxsafe import envs


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
            ("qpos", ours.physics.physics.qpos, state.physics.physics.qpos),
            ("qvel", ours.physics.physics.qvel, state.physics.physics.qvel),
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
    assert len(set(t.idle(t.begin()).physics.physics.substeps.tolist())) > 1


def test_poses_that_a_task_asks_for_come_along():
    worst = errors("point_goal1", lidar_type="natural", reward_orientation=True)
    assert worst["obs"] < 5e-3 and worst["reward"] < 1e-5


def test_contacts_without_room_are_counted():
    t = task("point_goal1", engine="warp", contact_room=0.01)
    assert (t.idle(t.begin(64)).info["overflow"] == 1).all()
    with pytest.raises(envs.ConfigError, match=r"env.contact_room=0.0: expected above 0"):
        envs.make("point_goal1", contact_room=0.0)
