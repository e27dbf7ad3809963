"""Wrappers, by hand and composed, from Python and as options."""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Arriving, Corridor, Ticker

from jaxsafe import envs
from jaxsafe.config import ConfigError
from jaxsafe.envs.check import check_env
from jaxsafe.envs.wrap import (
    ActionRepeat,
    ActionScale,
    FrameStack,
    TimeLimit,
    innermost,
    raw_steps,
)
from jaxsafe.learn.rollout import collect, init_rollout
from jaxsafe.run.arguments import compose
from jaxsafe.run.choice import choose_env
from jaxsafe.run.programs import build
from jaxsafe.run.settings import make_env, settings_from_config
from jaxsafe.types import Env, State


@dataclass(frozen=True)
class Echo:
    """Observes the last action, which it does not clip."""

    obs_size: int = 2
    action_size: int = 2
    episode_length: int = 9
    cost_names: tuple[str, ...] = ()

    def reset(self, key: jax.Array) -> State:
        return self.step(None, jnp.zeros(2))

    def step(self, state: State | None, action: jax.Array) -> State:
        zero = jnp.zeros(())
        return State((), action, zero, zero, jnp.zeros(0), jnp.bool_(False), {})


def steps(env: Env, actions: Any, seed: int = 0) -> list[State]:
    """The state of a reset, and of each step."""
    states = [env.reset(jax.random.key(seed))]
    for action in actions:
        states.append(env.step(states[-1], jnp.asarray(action, jnp.float32)))
    return states


def test_actions_are_stretched_over_the_bounds_and_clipped():
    env = ActionScale(Echo(), low=(0.0, -2.0), high=(1.0, 4.0))
    _, *after = steps(env, [[-1, -1], [0, 0], [1, 0.5], [5, -7]])
    np.testing.assert_allclose([s.obs for s in after], [[0, -2], [0.5, 1], [1, 2.5], [1, -2]])
    _, half = steps(ActionScale(Echo(), -3.0, 3.0), [[0.5, -0.5]])
    np.testing.assert_allclose(half.obs, [1.5, -1.5])


def test_a_repeated_action_earns_and_costs_the_sums_and_stops_at_the_end():
    """Of five steps of life, at reward 1 and cost 2 each, the third row has one."""
    env = ActionRepeat(Ticker(lives=(5, 5), episode_length=7), 2)
    _, *after = steps(env, [[0.0]] * 3)
    np.testing.assert_array_equal([s.reward for s in after], [2, 2, 1])
    np.testing.assert_array_equal([s.cost for s in after], [4, 4, 2])
    np.testing.assert_array_equal([s.costs for s in after], [[1, 3], [1, 3], [0.5, 1.5]])
    np.testing.assert_array_equal([s.info["ticks"] for s in after], [2, 2, 1])
    np.testing.assert_array_equal([s.terminated for s in after], [False, False, True])
    assert after[-1].obs[1] == 5 and env.episode_length == 3  # 7 raw steps hold 3 whole rows
    _, *after = steps(ActionRepeat(Arriving(lives=(5, 5)), 2), [[0.0]] * 3)
    np.testing.assert_array_equal([s.reward for s in after], [2, 2, 1])
    np.testing.assert_array_equal([s.truncated for s in after], [False, False, True])


def test_frames_are_stacked_newest_first():
    env = FrameStack(Ticker(lives=(9, 9)), 3)
    clocks = [np.asarray(s.obs).reshape(3, 3)[:, 1] for s in steps(env, [[0.0]] * 4)]
    np.testing.assert_array_equal(clocks, [[0, 0, 0], [1, 0, 0], [2, 1, 0], [3, 2, 1], [4, 3, 2]])
    assert env.obs_size == 9


def test_pixels_are_stacked_by_channel():
    @dataclass(frozen=True)
    class Camera(Ticker):
        def reset(self, key: jax.Array) -> State:
            state = super().reset(key)
            return replace(state, obs={"vision": jnp.zeros((4, 5, 3), jnp.uint8)})

        def step(self, state: State, action: jax.Array) -> State:
            seen: Any = state.obs
            return replace(state, obs={"vision": seen["vision"] + jnp.uint8(1)})

    vision: Any = steps(FrameStack(Camera(), 2), [[0.0]] * 3)[-1].obs
    assert vision["vision"].shape == (4, 5, 6) and vision["vision"].dtype == jnp.uint8
    np.testing.assert_array_equal(vision["vision"][0, 0], [3, 3, 3, 2, 2, 2])


def test_a_time_limit_truncates_and_frames_do_not_leak_into_the_next_episode():
    env = FrameStack(TimeLimit(Ticker(), 3), 2)
    rollout = init_rollout(env, jax.random.key(0), 2, False)

    def act(carry: Any, state: State, first: jax.Array, key: jax.Array) -> Any:
        return jnp.zeros((2, 1)), carry, {"log_prob": jnp.zeros(2)}

    _, traj = jax.jit(lambda r: collect(env, act, r, jax.random.key(1), 7))(rollout)
    np.testing.assert_array_equal(np.flatnonzero(traj.truncated[:, 0]), [2, 5])
    assert not traj.terminated.any()
    clocks = np.asarray(traj.obs).reshape(7, 2, 2, 3)[:, 0, :, 1]
    np.testing.assert_array_equal(clocks, [[0, 0], [1, 0], [2, 1]] * 2 + [[0, 0]])


def test_composed_wrappers_do_what_each_does_alone():
    """Two rows of three raw steps of a corridor, against the corridor stepped by hand."""
    inside = Corridor(half_width=0.0)
    scaled = ActionScale(inside, -0.5, 1.0)
    env = FrameStack(ActionRepeat(TimeLimit(scaled, 10), 3), 2)
    actions = [[1.0, -1.0], [0.0, 0.25]]
    states = jax.jit(lambda: steps(env, actions))()
    raw = [inside.reset(jax.random.key(0))]
    for action in np.repeat([[1.0, -0.5], [0.25, 0.4375]], 3, axis=0):
        raw.append(inside.step(raw[-1], jnp.asarray(action, jnp.float32)))
    for row, state in enumerate(states):
        three = raw[max(3 * row - 2, 0) : 3 * row + 1]
        newest, older = raw[3 * row], raw[max(3 * row - 3, 0)]
        np.testing.assert_allclose(state.obs, np.concatenate([newest.obs, older.obs]), rtol=1e-6)
        for name in ("reward", "cost"):
            total = sum(float(getattr(s, name)) for s in three)
            np.testing.assert_allclose(getattr(state, name), total, rtol=1e-6)
        np.testing.assert_allclose(state.physics, newest.physics, rtol=1e-6)  # no state of its own
    assert (env.obs_size, env.episode_length, raw_steps(env)) == (8, 3, 3)
    assert (env.action_size, env.cost_names, innermost(env)) == (2, ("wall",), inside)
    assert raw_steps(ActionRepeat(env, 2)) == 6 and raw_steps(inside) == 1
    assert check_env(env, "corridor") is env
    assert len({env, FrameStack(ActionRepeat(TimeLimit(scaled, 10), 3), 2)}) == 1  # values, hashable


@pytest.fixture
def hall():
    envs.register("hall", Corridor)
    yield
    del envs.ENVS["hall"]


def test_every_environment_has_wrappers_as_options(hall):
    wrap = {"action_bounds": (-0.5, 1.0), "time_limit": 10, "action_repeat": 3, "frame_stack": 2}
    by_hand = FrameStack(ActionRepeat(TimeLimit(ActionScale(Corridor(), -0.5, 1.0), 10), 3), 2)
    assert envs.make("hall", wrap=wrap) == by_hand
    made: Any = envs.make("point_goal0", engine="c", wrap={"action_repeat": 2})
    assert raw_steps(made) == 2 and made.episode_length == 500
    plain = envs.make("point_goal0", engine="c", wrap={"frame_stack": 1})
    assert isinstance(plain, envs.SafetyGym)
    envs.register("halls", envs.env_defaults("point_goal0") | {"wrap": {"frame_stack": 2}})
    assert envs.env_defaults("halls")["wrap"]["frame_stack"] == 2
    stacked: Any = envs.make("halls", engine="c", wrap={"action_repeat": 2})
    assert (stacked.obs_size, raw_steps(stacked)) == (56, 2)
    del envs.ENVS["halls"]


def test_wrappers_are_set_on_the_command_line(hall):
    texts = ["env=hall", "algo=ppo", "env.wrap.time_limit=10", "env.wrap.frame_stack=2"]
    made = make_env(compose(texts))
    assert made == FrameStack(TimeLimit(Corridor(), 10), 2)
    with pytest.raises(ConfigError, match=r"did you mean 'wrap\.frame_stack'"):
        compose([*texts, "env.wrap.frame_stak=2"])


def test_settings_of_a_run_that_knew_no_wrappers_are_read(hall):
    saved = compose(["env=hall", "algo=ppo"]).plain()
    del saved["env"]["wrap"]
    assert make_env(settings_from_config(saved)) == Corridor()


@pytest.mark.parametrize(
    "wrap, says",
    [
        ({"action_repeat": 0}, "env.wrap.action_repeat=0: expected a whole number between 1 and"),
        ({"action_repeat": 21}, "expected 1 to 20, the steps of an episode"),
        ({"frame_stack": 0}, "env.wrap.frame_stack=0: expected a whole number between 1 and"),
        ({"time_limit": 0}, "env.wrap.time_limit=0: expected a whole number between 1 and"),
        ({"action_bounds": (1.0, 1.0)}, "env.wrap.action_bounds=[1.0, 1.0]: expected low < high"),
        (
            {"action_bounds": (0.0, float("inf"))},
            "env.wrap.action_bounds[1]=inf: expected a number",
        ),
        ({"action_repat": 2}, "unknown option env.wrap.action_repat; did you mean 'action_repeat'"),
        ({"action_repeat": 1.5}, "env.wrap.action_repeat=1.5: expected a whole number"),
        (3, "env.wrap=3: set its parts"),
    ],
)
def test_a_wrapper_that_cannot_be_is_one_line(hall, wrap, says):
    with pytest.raises(ConfigError) as error:
        envs.make("hall", wrap=wrap)
    assert says in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "wrapper, values, says",
    [
        (ActionScale, ((0.0, 0.0, 0.0), 1.0), "3 bounds for actions with 2 components"),
        (ActionScale, (0.0, (1.0, 1.0, 1.0)), "3 bounds for actions with 2 components"),
        (ActionScale, (0.0, float("inf")), "low=0.0 and high=inf: expected low < high"),
        (ActionScale, ((0.0, 1.0), 1.0), "expected low < high"),
        (ActionRepeat, (0,), "repeat=0: expected 1 to 20"),
        (FrameStack, (0,), "frames=0: expected at least 1"),
        (TimeLimit, (0,), "steps=0: expected at least 1"),
    ],
)
def test_a_wrapper_made_in_python_is_refused_like_an_option(wrapper, values, says):
    with pytest.raises(ConfigError, match=says):
        wrapper(Corridor(), *values)


def test_options_called_wrap_or_name_are_refused():
    for name, odd in (("wrap", lambda wrap=3: Corridor()), ("name", lambda name="a": Corridor())):
        envs.register("odd", odd)
        with pytest.raises(ConfigError, match=f"'{name}' is what every environment has: rename"):
            envs.env_defaults("odd")
    del envs.ENVS["odd"]


def test_steps_of_a_run_are_raw_steps(hall):
    """Two environments, eight rows an update, three raw steps a row."""
    texts = ["env=hall", "algo=ppo", "num_envs=2", "algo.horizon=8", "env.wrap.action_repeat=3"]
    settings = compose(texts)
    program = build(make_env(settings), settings.row.make, settings.configs, settings.train)
    assert program.clocks.steps == 2 * 8 * 3


def test_a_wrapped_task_given_from_python_is_recorded_with_its_wrappers():
    wrap = {"time_limit": 500, "action_repeat": 2, "frame_stack": 3}
    env = envs.make("point_goal0", engine="c", hazards_num=2, wrap=wrap)
    chosen, objects = choose_env(env)
    assert chosen["env"] == "point_goal0" and not objects
    assert chosen["env.hazards_num"] == 2
    assert {k: v for k, v in chosen.items() if k.startswith("env.wrap.")} == {
        f"env.wrap.{name}": value for name, value in wrap.items()
    }


def test_wrappers_in_another_order_are_the_callers_object_with_all_fields_on_record():
    inner = envs.make("point_goal0", engine="c", hazards_num=2)
    chosen, objects = choose_env(ActionRepeat(FrameStack(inner, 3), 2))
    assert chosen["env"] == "point_goal0"
    (entry,) = objects.values()
    assert entry.defaults["repeat"] == 2 and entry.defaults["inner"]["frames"] == 3
    assert entry.defaults["inner"]["inner"]["hazards_num"] == 2
