"""Gymnasium's and Safety-Gymnasium's interface to our environments."""

import functools
import importlib
import itertools
import sys
import types
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from toys import Corridor, Patch, Ticker

from jaxsafe import envs
from jaxsafe.config import ConfigError
from jaxsafe.interop.gymnasium import GymEnv, GymVectorEnv, SixTuple, SixTupleVector

UNBOUNDED = "ignore:.*Box observation space .* value is -?infinity"


def walk(env, steps: int = 5, seed: int | None = 7) -> list:
    """Observations, then rewards, of a few steps after a reset."""
    first, _ = env.reset(seed=seed)
    env.action_space.seed(0)
    rest = [env.step(env.action_space.sample()) for _ in range(steps)]
    return [first, *(row[0] for row in rest), np.array([row[1] for row in rest])]


@pytest.mark.filterwarnings("error", UNBOUNDED)
def test_gymnasium_s_checker_finds_nothing():
    check_env(GymEnv(Corridor()), skip_render_check=True)
    check_env(GymEnv(Ticker(lives=(2, 4))), skip_render_check=True)


@pytest.mark.filterwarnings("error", UNBOUNDED)
def test_point_goal1_is_made_by_its_id_and_passes_the_checker_with_its_pictures():
    env = gymnasium.make("jaxsafe.interop.gymnasium:jaxsafe/point_goal1", render_mode="rgb_array")
    check_env(env.unwrapped)
    obs, info = env.reset(seed=0)
    assert env.observation_space.contains(obs) and info["cost_hazards"] == 0
    frame = env.render()
    assert isinstance(frame, np.ndarray) and frame.shape == (480, 640, 3) and frame.std() > 10


def test_every_environment_of_the_suite_has_an_id():
    ids = {key for key in gymnasium.registry if key.startswith("jaxsafe/")}
    original = {alias.removeprefix("Safexp-") for alias in envs.ALIASES}
    parts = itertools.product(("Point", "Car"), ("Goal", "Button", "Push"), "012")
    theirs = {f"Safety{robot}{task}{level}-v0" for robot, task, level in parts}
    assert ids >= {f"jaxsafe/{name}" for name in {*envs.ALIASES.values(), *original, *theirs}}
    kwargs = [gymnasium.spec(f"jaxsafe/{name}").kwargs for name in ("point_goal1", "PointGoal1-v0")]
    assert kwargs == [{"env": "point_goal1"}] * 2
    ruled = gymnasium.spec("jaxsafe/SafetyCarPush2-v0").kwargs
    assert ruled == {"env": "car_push2", "rules": "safety_gymnasium"}
    older = gymnasium.spec("jaxsafe/SafetyAntVelocity-v0").kwargs
    assert older == {"env": "ant_velocity", "thresholds": "v0"}
    seeing = gymnasium.spec("jaxsafe/SafetyCarPush2Vision-v0").kwargs
    assert seeing == ruled | {"observe_vision": True, "vision_size": (256, 256)}
    assert gymnasium.spec("jaxsafe/PointGoal1Vision-v0").kwargs == kwargs[0] | {"observe_vision": True}


@pytest.mark.filterwarnings("error")
def test_a_vector_of_point_goal1_is_one_program():
    vector = gymnasium.make_vec(
        "jaxsafe/point_goal1", num_envs=3, vectorization_mode="vector_entry_point", num_steps=2
    )
    assert isinstance(vector, GymVectorEnv)
    assert vector.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    obs, _ = vector.reset(seed=0)
    assert vector.observation_space.contains(obs)
    assert len(np.unique(obs, axis=0)) == 3  # layouts of their own
    for last in (False, True):
        obs, *_, truncated, info = vector.step(vector.action_space.sample())
        np.testing.assert_array_equal(truncated, [last] * 3)
        assert ("final_obs" in info) == last


def test_a_seed_repeats_and_no_seed_goes_on():
    for env in (GymEnv(Corridor()), GymVectorEnv(Corridor(episode_length=2), 3)):
        one, two, other = walk(env), walk(env, seed=None), walk(env)
        assert not np.array_equal(one[0], two[0])
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a, b)
    assert not np.array_equal(walk(env, seed=8)[0], one[0])


def test_time_runs_out_or_the_episode_ends():
    env = GymEnv(Ticker(episode_length=2))
    env.reset(seed=0)
    assert [env.step(np.zeros(1))[2:4] for _ in range(2)] == [(False, False), (False, True)]
    env = GymEnv(Ticker(episode_length=2, lives=(2, 2)))
    env.reset(seed=0)
    assert [env.step(np.zeros(1))[2:4] for _ in range(2)] == [(False, False), (True, False)]


def shapes(infos: dict) -> dict:
    """Names with types and shapes."""
    return {k: shapes(x) if isinstance(x, dict) else (x.dtype, x.shape) for k, x in infos.items()}


def test_a_vector_gives_what_gymnasium_s_own_gives():
    clock = Ticker(lives=(3, 3))
    theirs = SyncVectorEnv([lambda: GymEnv(clock)] * 2, autoreset_mode=AutoresetMode.SAME_STEP)
    ours = GymVectorEnv(clock, 2)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert shapes(ours.reset(seed=0)[1]) == shapes(theirs.reset(seed=0)[1])
    for t in range(1, 8):
        a, b = ours.step(np.zeros((2, 1))), theirs.step(np.zeros((2, 1)))
        np.testing.assert_array_equal(a[0][:, 1:], b[0][:, 1:])  # all but the name of the episode
        for x, y in zip(a[1:4], b[1:4], strict=True):
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y)
        assert shapes(a[4]) == shapes(b[4])
        if t % 3:
            np.testing.assert_array_equal(a[4]["cost"], b[4]["cost"])
        else:
            np.testing.assert_array_equal([x[1] for x in a[4]["final_obs"]], [3, 3])
            for name in ("cost", "cost_b", "ticks"):
                np.testing.assert_array_equal(a[4]["final_info"][name], b[4]["final_info"][name])


def test_only_those_that_ended_have_a_last_observation():
    vector = GymVectorEnv(Ticker(lives=(1, 2)), 8)
    first, _ = vector.reset(seed=0)
    obs, _, terminated, _, info = vector.step(np.zeros((8, 1)))
    np.testing.assert_array_equal(terminated, first[:, 2] == 1)
    assert 0 < terminated.sum() < 8
    np.testing.assert_array_equal(info["_final_obs"], terminated)
    np.testing.assert_array_equal(info["final_info"]["cost"], 2 * terminated)
    np.testing.assert_array_equal(info["cost"], [2] * 8)
    for i, final in enumerate(info["final_obs"]):
        assert (final is not None) == terminated[i]
        assert obs[i, 1] == (0 if terminated[i] else 1)


def test_six_tuples_have_the_cost_beside_the_reward():
    one, several = SixTuple(GymEnv(Ticker())), SixTupleVector(GymVectorEnv(Ticker(episode_length=1), 2))
    one.reset(seed=0)
    several.reset(seed=0)
    _, reward, cost, terminated, truncated, info = one.step(np.zeros(1))
    assert (reward, cost, terminated, truncated, info["cost_a"]) == (1, 2, False, False, 0.5)
    _, _, costs, _, truncated, _ = several.step(np.zeros((2, 1)))
    np.testing.assert_array_equal(costs, [2, 2])
    assert truncated.all()


def test_the_time_limit_stands_in_the_spec_and_no_wrapper_adds_another():
    made = gymnasium.make("jaxsafe/PointGoal1-v0", num_steps=2)
    assert made.spec is not None and made.spec.max_episode_steps == 2
    made.reset(seed=0)
    ends = [made.step(made.action_space.sample())[3] for _ in range(2)]
    assert ends == [False, True]
    vector = gymnasium.make_vec(
        "jaxsafe/point_goal1", num_envs=2, vectorization_mode="vector_entry_point", num_steps=3
    )
    assert vector.spec is not None and vector.spec.max_episode_steps == 3


def test_a_vector_is_made_again_from_its_spec_and_takes_a_shorter_time_limit():
    def made(id: Any, **options: Any) -> gymnasium.vector.VectorEnv:
        return gymnasium.make_vec(id, num_envs=2, **options)

    vector = made("jaxsafe/pendulum_upright", num_steps=3)
    np.testing.assert_array_equal(*(env.reset(seed=1)[0] for env in (vector, made(vector.spec))))
    for limit, steps in ((2, 2), (9, 3)):
        vector = made("jaxsafe/pendulum_upright", num_steps=3, max_episode_steps=limit)
        assert vector.spec is not None and vector.spec.max_episode_steps == steps
        vector.reset(seed=1)
        ends = [vector.step(vector.action_space.sample())[3].all() for _ in range(steps)]
        assert ends == [False] * (steps - 1) + [True]


def test_a_six_tuple_that_begins_anew_keeps_the_last_observation():
    env = SixTuple(GymEnv(Ticker(episode_length=2)), autoreset=True)
    env.reset(seed=0)
    _, _, _, _, truncated, info = env.step(np.zeros(1))
    assert not truncated and "final_observation" not in info
    obs, _, cost, _, truncated, info = env.step(np.zeros(1))
    assert truncated and cost == 2 and (obs[1], info["final_observation"][1]) == (0, 2)
    assert info["final_info"]["cost"] == 2 and info["cost"] == 0


@pytest.mark.parametrize("num_envs", [1, 4])
def test_omnisafe_finds_what_its_wrappers_read(num_envs):
    """`SafetyGymnasiumEnv` and `ObsNormalize` of OmniSafe 0.5 read these; see the slow test, too."""
    clock = Ticker(episode_length=4, lives=(2, 9))
    env = SixTuple(GymEnv(clock), autoreset=True) if num_envs == 1 else None
    env = env or SixTupleVector(GymVectorEnv(clock, num_envs))
    obs, _ = env.reset(seed=0)
    size, ended = obs.shape[-1], 0
    action = np.zeros(1 if num_envs == 1 else (num_envs, 1))
    for _ in range(8):
        obs, reward, cost, terminated, truncated, info = env.step(action)
        for x in (reward, cost, terminated, truncated):
            assert np.shape(x) == (() if num_envs == 1 else (num_envs,))
        done = np.logical_or(terminated, truncated)
        assert ("final_observation" in info) == bool(np.any(done))
        if np.any(done):
            rows = [np.zeros(size) if x is None else x for x in info["final_observation"]]
            final = np.array(rows, np.float32)
            assert final.shape == obs.shape
            which = slice(None) if num_envs == 1 else info["_final_observation"]
            ended += final[which].reshape(-1, size).shape[0]
            if num_envs > 1:
                np.testing.assert_array_equal(done, which)
    assert ended >= 2


@pytest.fixture
def omnisafe(monkeypatch) -> Any:
    """OmniSafe with our environments in place of Safety-Gymnasium, which needs an old Gymnasium."""

    def make(id: str, autoreset: bool = False, **kwargs: Any) -> SixTuple:
        return SixTuple(gymnasium.make(f"jaxsafe/{id}", num_steps=100), autoreset)

    def make_vec(env_id: str, num_envs: int, **kwargs: Any) -> SixTupleVector:
        kind: Any = "vector_entry_point"
        made = gymnasium.make_vec(f"jaxsafe/{env_id}", num_envs, kind, num_steps=100)
        return SixTupleVector(made)

    stand_in: Any = types.ModuleType("safety_gymnasium")
    stand_in.make, stand_in.vector = make, types.SimpleNamespace(make=make_vec)
    monkeypatch.setitem(sys.modules, "safety_gymnasium", stand_in)
    return pytest.importorskip("omnisafe", reason="needs omnisafe 0.5, installed with --no-deps")


@pytest.mark.slow
@pytest.mark.parametrize("num_envs", [1, 2])
def test_omnisafe_s_own_ppo_lag_trains_on_our_six_tuple(num_envs, omnisafe, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    custom = {
        "train_cfgs": {"total_steps": 800, "vector_env_nums": num_envs, "device": "cpu"},
        "algo_cfgs": {"steps_per_epoch": 400, "update_iters": 2},
        "logger_cfgs": {"use_wandb": False, "use_tensorboard": False},
    }
    agent = omnisafe.Agent("PPOLag", "SafetyPointGoal1-v0", custom_cfgs=custom)
    ret, cost, length = agent.learn()
    assert np.isfinite([ret, cost]).all() and length == 100


def test_in_a_forked_process_there_is_one_line(monkeypatch):
    monkeypatch.setattr("jaxsafe.interop.gymnasium.PROCESS", 0)
    with pytest.raises(ConfigError, match=r"forked process: give AsyncVectorEnv\(.*context='spawn'"):
        GymEnv(Ticker())


def test_processes_that_are_spawned_step_side_by_side():
    """One worker is enough: it is a new Python, which imports JAX."""
    several = AsyncVectorEnv(
        [functools.partial(GymEnv, Ticker())], context="spawn", shared_memory=False
    )
    try:
        obs, _ = several.reset(seed=0)
        obs, rewards, *_ = several.step(np.zeros((1, 1)))
        assert obs.shape == (1, 3) and rewards.shape == (1,)
    finally:
        several.close()


def test_bad_input_is_one_line():
    with pytest.raises(ConfigError, match="did you mean 'hazards_num'"):
        GymEnv("point_goal1", hazard_num=3)
    with pytest.raises(ConfigError, match="options are for a name"):
        GymEnv(Ticker(), lives=(1, 1))
    with pytest.raises(ConfigError, match="expected 'rgb_array'"):
        GymVectorEnv(Ticker(), render_mode="human")
    with pytest.raises(
        ConfigError, match="only Safety Gym's environments, velocity and racing tasks can be drawn"
    ):
        GymEnv(Ticker(), render_mode="rgb_array")


def test_without_gymnasium_there_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "jaxsafe.interop.gymnasium")
    with pytest.raises(ConfigError, match=r"pip install 'jaxsafe\[gymnasium\]'"):
        importlib.import_module("jaxsafe.interop.gymnasium")


def test_pictures_have_a_space_and_stay_whole():
    env: Any = GymEnv(Patch())
    assert env.observation_space["vision"] == gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8)
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs)
    assert env.observation_space.contains(env.step(env.action_space.sample())[0])
    several = GymVectorEnv(Patch(), num_envs=2)
    seen, _ = several.reset(seed=0)
    assert several.observation_space.contains(seen)
    for _ in range(Patch.episode_length):
        seen, *_, info = several.step(several.action_space.sample())
    last = info["final_obs"][1]
    assert last["vision"].shape == (8, 8, 3) and last["vector"] == 0 and seen["vector"][1] == 1
