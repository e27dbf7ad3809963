"""The pendulum tasks, held against Gymnasium's pendulum and MuJoCo's cart."""

import dataclasses
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiling import FAST

from jaxsafe import envs
from jaxsafe.config import ConfigError


def flown(env, actions):
    """Observations [T, O], rewards, costs and ends of an episode with these actions [T, A]."""

    def step(state, action):
        after = env.step(state, action)
        return after, (after.obs, after.reward, after.cost, after.terminated)

    start = env.reset(jax.random.key(0))
    run = jax.jit(lambda actions: jax.lax.scan(step, start, actions)[1], compiler_options=FAST)
    return [np.asarray(x) for x in run(actions)]


def test_the_cart_moves_as_in_mujoco():
    mj: Any = mujoco
    model = mj.MjModel.from_xml_path(
        str(Path(gymnasium.__file__).parent / "envs/mujoco/assets/inverted_pendulum.xml")
    )
    data = mj.MjData(model)
    actions = np.random.default_rng(0).uniform(-1.2, 1.2, (8, 1))
    obs, reward, _, _ = flown(envs.make("pendulum_swing"), jnp.asarray(actions, jnp.float32))
    for action, seen in zip(actions, obs, strict=True):
        data.ctrl[:] = np.clip(action, -1, 1)
        mj.mj_step(model, data, nstep=2)
        np.testing.assert_allclose(seen, np.concatenate([data.qpos, data.qvel]), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(reward, obs[:, 1] ** 2, rtol=1e-6)
    assert np.abs(obs[:, 1]).max() > 0.1


def test_the_pendulum_moves_as_in_gymnasium():
    theirs: Any = gymnasium.make("Pendulum-v1").unwrapped
    theirs.reset()
    theirs.state, theirs.last_u = np.array([0.3, -0.9]), None
    actions = np.random.default_rng(0).uniform(-1.2, 1.2, (20, 1))
    obs, reward, _, _ = flown(envs.make("pendulum_tilt"), jnp.asarray(actions, jnp.float32))
    before = 0.3
    for action, seen, paid in zip(actions, obs, reward, strict=True):
        theirs.step(2 * np.clip(action, -1, 1))
        wrapped = (theirs.state[0] + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(seen, [wrapped, theirs.state[1]], rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(paid, -((before + 0.41151684) ** 2), rtol=1e-3, atol=1e-4)
        before = wrapped


@pytest.mark.parametrize("side", [1, -1])
def test_a_pendulum_turns_by_8_rad_a_second_at_most(side):
    theirs: Any = gymnasium.make("Pendulum-v1").unwrapped
    theirs.reset()
    theirs.state = side * np.array([0.5, 7.9])
    theirs.step(side * np.array([2.0]))
    env = envs.make("pendulum_upright")
    start = env.reset(jax.random.key(0))
    fast = env.step(start.replace(physics=side * jnp.array([0.5, 7.9])), side * jnp.ones(1))
    np.testing.assert_allclose(fast.obs, theirs.state, rtol=1e-6)
    assert fast.obs[1] == side * 8.0  # 7.9 and 0.05 (15 sin(0.5) + 6) are more


@pytest.mark.parametrize(
    "name", ["pendulum_upright", "pendulum_tilt", "pendulum_move", "pendulum_swing"]
)
def test_a_step_is_unsafe_where_the_barrier_is_above_1_and_ends_the_episode(name):
    env = envs.make(name)
    obs, _, cost, ended = flown(env, jnp.ones((60, 1)))
    above = np.asarray(env.barrier(jnp.asarray(obs))) > 1
    assert (above == (cost == 1)).all() and (above == ended).all()
    assert above.any() and not above[0]
    assert env.barrier(env.reset(jax.random.key(1)).obs) < 0.1


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(
    "name, near",
    [
        ("pendulum_upright", (1.49, 1.0)),
        ("pendulum_swing", (0.0, 1.49, 0.0, 1.0)),
        ("pendulum_swing", (0.89, 0.0, 1.0, 0.0)),
    ],
)
def test_the_safe_set_ends_on_either_side_of_angles_and_rail(name, near, side):
    env = envs.make(name)
    state = env.reset(jax.random.key(0)).replace(physics=side * jnp.array(near))
    after = env.step(state, jnp.zeros(1))
    assert env.barrier(state.physics) < 1 < env.barrier(after.obs)
    assert after.terminated and after.cost == 1


def test_a_pendulum_that_swings_past_the_bottom_is_unsafe():
    """From 2.95 rad at 7 rad/s to 3.32 rad, which is -2.97 rad from upright."""
    env = envs.make("pendulum_upright", threshold=3.0)
    state = env.reset(jax.random.key(0)).replace(physics=jnp.array([2.95, 7.0]))
    after = env.step(state, jnp.ones(1))
    assert after.obs[0] == pytest.approx(-2.968, abs=0.01)
    assert after.cost == 1 and after.terminated


def test_the_mean_pole_stays_up_and_the_start_is_never_random():
    """Without a push it leans to the side of its centre, 1/600 rad, and falls that way."""
    env = envs.make("pendulum_move")
    obs, _, cost, _ = flown(env, jnp.zeros((40, 1)))
    first = int(np.argmax(cost))
    assert obs[first, 1] > 0.2 and first > 5
    starts = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 3)).obs
    assert (starts == 0).all()


@pytest.mark.parametrize(
    "task, expected",
    [
        ("upright", lambda x: -(x[:, 1] ** 2)),
        ("move", lambda x: x[:, 0] ** 2),
        ("swing", lambda x: x[:, 1] ** 2),
    ],
)
def test_an_unsafe_step_of_the_cart_costs_10(task, expected):
    obs, reward, cost, _ = flown(envs.make("pendulum_move", task=task), jnp.ones((20, 1)))
    np.testing.assert_allclose(reward, expected(obs) - 10 * cost, rtol=1e-5)
    assert 0 < cost.sum() < 20


def test_their_ids_work_and_wrong_options_are_refused():
    assert envs.make("SafeInvertedPendulumSwing-v2") == envs.make("pendulum_swing")
    assert envs.make("MyPendulumTilt-v0") == envs.make("pendulum_tilt")
    assert dataclasses.asdict(envs.make("pendulum_swing"))["threshold"] == 1.5
    with pytest.raises(ConfigError, match="did you mean 'swing'"):
        envs.make("pendulum_swing", task="swings")
    with pytest.raises(ConfigError, match="threshold=2"):
        envs.make("pendulum_move", threshold=2.0)


def test_a_barrier_is_that_of_the_newest_frame():
    env = envs.make("pendulum_move", wrap={"frame_stack": 2})
    obs = jnp.concatenate([jnp.zeros(4), jnp.ones(4)])
    assert env.barrier(obs) == 0 and env.barrier(obs[::-1]) > 1
