"""Our environments in Brax's and Playground's interface, and theirs in ours."""

import importlib
import sys
from typing import Any

import brax.envs
import brax.envs.fast
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.fast import ObservationMode
from brax.envs.wrappers import training
from brax.training.agents.ppo import train as ppo
from compiling import FAST
from shell import SCRIPTS
from toys import START, Corridor, Patch, Ticker

import jaxsafe
from jaxsafe import algos, envs
from jaxsafe.config import ConfigError
from jaxsafe.envs.check import check_env
from jaxsafe.interop.brax import from_brax, mend_brax, to_brax, to_playground
from jaxsafe.learn.rollout import collect, init_rollout, memoryless
from jaxsafe.run.arguments import compose
from jaxsafe.run.settings import make_env
from jaxsafe.types import Shared


class Fast(brax.envs.fast.Fast):
    """Brax's own test environment, which ends after three steps.

    With a cost in `info` and one in `metrics`, and a Python float where reset gave an array.
    """

    def reset(self, rng) -> Any:
        zero = jnp.zeros(())
        first: Any = super().reset(rng)
        return first.replace(info={"cost": zero}, metrics={"heat": zero, "steps": zero})

    def step(self, state, action) -> Any:
        state.info["cost"] += 1.0  # in place, as many environments do
        steps = state.metrics["steps"] + 1
        metrics = {"heat": jnp.abs(action).sum(), "steps": steps}
        done = jnp.float32(steps >= 3)
        new: Any = super().step(state, action)
        return new.replace(reward=1.0, done=done, metrics=metrics)


def test_in_brax_s_wrappers_a_time_limit_truncates_and_an_end_does_not():
    def run(lives: tuple[int, int]):
        env = training.wrap(to_brax(Ticker(lives=lives)), episode_length=3)

        def step(state, _):
            state = env.step(state, jnp.zeros((2, 1)))
            return state, (state, 1 - state.done)

        first = env.reset(jax.random.split(jax.random.PRNGKey(0), 2))
        return jax.lax.scan(step, first, None, 4)[1]

    states, discount = jax.jit(run, static_argnums=0)((2, 2))
    np.testing.assert_array_equal(discount[:, 0], [1, 0, 1, 0])
    np.testing.assert_array_equal(states.info["truncation"], np.zeros((4, 2)))
    np.testing.assert_array_equal(states.info["cost"], np.full((4, 2), 2.0))
    np.testing.assert_array_equal(states.info["episode_metrics"]["cost"][:, 0], [2, 4, 2, 4])
    np.testing.assert_array_equal(states.metrics["cost_b"], np.full((4, 2), 1.5))
    np.testing.assert_array_equal(states.obs[:, 0, 1], [1, 0, 1, 0])  # reset in the step it ends
    states, discount = jax.jit(run, static_argnums=0)((99, 99))
    np.testing.assert_array_equal(discount[:, 0], [1, 1, 0, 1])
    np.testing.assert_array_equal(states.info["truncation"][:, 0], [0, 0, 1, 0])


@pytest.mark.parametrize("adapt", [to_brax, to_playground])
def test_either_state_steps_alike_and_keeps_what_wrappers_add(adapt):
    env, key = adapt(Ticker()), jax.random.key(3)
    assert (env.observation_size, env.action_size) == (3, 1)
    assert adapt(Patch()).observation_size == {"vector": (1,), "vision": (8, 8, 3)}
    first = env.reset(key)
    old = env.reset(jax.random.key_data(key))  # Brax's style of keys
    np.testing.assert_array_equal(first.obs, old.obs)
    first.info["mine"], first.metrics["reward"] = jnp.ones(()), jnp.ones(())
    after = env.step(first, jnp.zeros(1))
    assert {"mine", "cost"} == after.info.keys() and "reward" in after.metrics
    assert (after.obs[1], after.reward, after.done, after.info["cost"]) == (1, 1, 0, 2)


def test_point_goal1_steps_in_brax_as_it_does_here():
    ours = envs.make("point_goal1", engine="c")
    wrapped = training.wrap(to_brax(ours), episode_length=1000)
    action = jnp.array([[1.0, 0.5], [-1.0, 0.2]])

    def episode(reset, step, keys):
        def advance(state, _):
            state = step(state, action)
            return state, state

        return jax.lax.scan(advance, reset(keys), None, 5)[1]

    def both(keys):
        here = episode(jax.vmap(ours.reset), jax.vmap(ours.step), keys)
        return episode(wrapped.reset, wrapped.step, jax.random.key_data(keys)), here

    run = jax.jit(both, compiler_options=FAST)
    there, here = run(jax.random.split(jax.random.key(0), 2))
    np.testing.assert_allclose(there.obs, here.obs, atol=1e-5)
    np.testing.assert_allclose(there.reward, here.reward, atol=1e-6)
    np.testing.assert_array_equal(there.info["cost"], here.cost)
    np.testing.assert_array_equal(there.metrics["cost_hazards"], here.costs[..., 0])
    assert there.reward.any() and "goal_met" in there.metrics


def test_a_foreign_environment_rolls_out_with_its_costs():
    costs = {"cost": lambda s: s.info["cost"], "heat": lambda s: s.metrics["heat"]}
    for given in (["cost", "heat"], costs):
        env = check_env(from_brax(Fast(), given, episode_length=5), "fast")
        assert env.cost_names == ("cost", "heat")
    rollout = init_rollout(env, jax.random.key(0), 2, stagger=False)
    assert not rollout.state.cost.any() and not rollout.pool.reward.any()
    wide = jnp.full((2, env.action_size), 9.0)  # clipped to 1
    run = jax.jit(
        lambda r: collect(env, memoryless(lambda obs, key: (wide, obs[:, 0])), r, jax.random.key(1), 4)
    )
    _, traj = run(rollout)
    np.testing.assert_array_equal(traj.costs[:, 0], [[1, 1], [2, 1], [3, 1], [1, 1]])
    np.testing.assert_array_equal(traj.cost, traj.costs.sum(-1))
    np.testing.assert_array_equal(traj.terminated[:, 0], [False, False, True, False])
    np.testing.assert_array_equal(traj.episode.ret[:, 0], [1, 2, 3, 1])
    np.testing.assert_array_equal(traj.episode.info["steps"][:, 0], [1, 3, 6, 1])


def test_a_foreign_environment_is_left_as_it_was():
    env = from_brax(Fast())
    state = env.reset(jax.random.key(0))
    env.step(state, jnp.zeros(env.action_size))
    assert state.physics.info["cost"] == 0


BAD = {
    "its info or metrics, which hold cost, heat, steps": lambda: from_brax(Fast(), ["kost"]),
    "Fast has no 'cost'": lambda: from_brax(brax.envs.get_environment("fast")),
    "which hold nothing": lambda: from_brax(brax.envs.get_environment("fast")),
    "comes in EpisodeWrapper, AutoResetWrapper": lambda: from_brax(brax.envs.create("fast")),
    "comes in a VmapWrapper": lambda: from_brax(training.VmapWrapper(Fast(), 2)),
    "from_brax": lambda: envs.register("raw", Fast()),
}


@pytest.mark.parametrize("message", BAD)
def test_what_cannot_be_adapted_is_one_line(message):
    with pytest.raises(ConfigError, match=message) as error:
        BAD[message]()
    assert "\n" not in str(error.value)


def test_only_the_named_part_of_a_dict_is_observed():
    both = Fast(obs_mode=ObservationMode.DICT_STATE, asymmetric_obs=True)
    assert from_brax(both).obs_size == 2
    assert from_brax(both, obs="privileged_state").obs_size == 4
    with pytest.raises(ConfigError, match="no observation 'stat'; did you mean 'state'"):
        from_brax(both, obs="stat")


def train(env: Any, iterations: int, **options: Any) -> dict[str, np.ndarray]:
    """Metrics of each update, [iterations], of PPO-Lagrangian."""
    config, make, *_ = algos.ALGOS["ppo_lag"]
    algo = make(env)
    cfg = config(num_envs=64, horizon=50, **options)
    ts = jax.jit(algo.init)(jax.random.key(0), cfg, START)
    update = jax.jit(algo.update)
    rows = []
    for iteration in range(iterations):
        ts, metrics = update(ts, Shared(np.int32(iteration)))
        rows.append(jax.device_get(metrics))
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


@pytest.mark.slow
def test_brax_s_own_ppo_learns_to_reach_the_goals_of_point_goal1():
    rewards, costs = [], []

    def note(step, metrics):
        rewards.append(metrics["eval/episode_reward"])
        costs.append(metrics["eval/episode_cost"])

    mend_brax()
    ppo.train(
        to_brax(envs.make("point_goal1", engine="c")),
        num_timesteps=360_000,
        episode_length=1000,
        num_envs=128,
        unroll_length=20,
        batch_size=128,
        num_minibatches=16,
        num_updates_per_batch=8,
        learning_rate=1e-3,
        discounting=0.99,
        normalize_observations=True,
        num_evals=2,
        num_eval_envs=32,
        progress_fn=note,
    )
    assert rewards[0] < 3 and rewards[-1] > 10
    assert all(cost > 5 for cost in costs)


@pytest.mark.slow
def test_brax_s_pendulum_learns_to_stand_within_a_limit_on_its_cost():
    class Charged(brax.envs.Wrapper):
        """A cost in `metrics`: 1 where the cart is more than 10 cm from the middle."""

        def reset(self, rng):
            state = self.env.reset(rng)
            state.metrics["cost"] = jnp.zeros(())
            return state

        def step(self, state: Any, action):
            state = self.env.step(state, action)
            state.metrics["cost"] = jnp.float32(jnp.abs(state.obs[0]) > 0.1)
            return state

    pendulum = Charged(brax.envs.get_environment("inverted_pendulum"))
    metrics = train(from_brax(pendulum, episode_length=200), 70, cost_limit=20.0)
    assert metrics["train/return"][0] < 20 and metrics["train/cost"].max() > 60
    assert metrics["train/return"][-20:].mean() > 190  # of at most 200
    assert metrics["train/cost"][-20:].mean() < 20


@pytest.mark.slow  # needs playground
def test_playground_s_cartpole_trains_within_a_limit_on_its_cost():
    registry = pytest.importorskip("mujoco_playground").registry

    cartpole = from_brax(
        registry.load("CartpoleBalance", config_overrides={"impl": "jax"}),
        costs={"far": lambda state: jnp.abs(state.data.qpos[0]) > 0.1},
        episode_length=200,
    )
    metrics = train(check_env(cartpole, "cartpole"), 40, cost_limit=5.0)
    assert metrics["train/cost_estimate"][:5].mean() > 10
    assert metrics["train/cost_estimate"][-5:].mean() < 5
    assert metrics["train/return_estimate"][-5:].mean() > 100  # of at most 200
    assert metrics["train/nonfinite"].sum() == 0


@pytest.mark.slow  # needs playground
def test_ours_step_in_playground_s_wrappers():
    wrapper = pytest.importorskip("mujoco_playground._src.wrapper")

    ours: Any = to_playground(Corridor())
    env = wrapper.wrap_for_brax_training(ours, episode_length=3, full_reset=True)
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 2))
    for done in (0, 0, 1, 0):
        state = jax.jit(env.step)(state, jnp.ones((2, 2)))
        np.testing.assert_array_equal(state.done, done)


# ---- scripts/brax_sac.py -----------------------------------------------------------------------


def brax_sac_with(monkeypatch, *words: str) -> tuple[int, list[Any]]:
    """The exit status, and what would be trained: task, algorithm, options."""
    asked: list[Any] = []
    monkeypatch.syspath_prepend(SCRIPTS)
    brax_sac = importlib.import_module("brax_sac")
    monkeypatch.setattr(brax_sac, "task", lambda *which: which)
    monkeypatch.setattr(jaxsafe, "train", lambda task, algo, **given: asked.extend((task, algo, given)))
    monkeypatch.setattr(sys, "argv", ["brax_sac.py", *words])
    return brax_sac.main(), asked


def test_sac_on_a_task_of_brax_takes_the_options_of_training(monkeypatch):
    words = ("ant", "algo=sac", "algo.lr=1e-4", "algo.hidden=[8,8]", "num_seeds=4")
    status, (task, algo, given) = brax_sac_with(monkeypatch, *words, "--backend", "spring")
    assert (status, task, algo) == (0, ("ant", "spring"), "sac")
    assert given == {
        "total_steps": 3_000_000, "video": False, "preset": "frequent", "algo.lr": 1e-4,
        "algo.hidden": [8, 8], "num_seeds": 4,
    }  # fmt: skip
    _, (task, algo, given) = brax_sac_with(monkeypatch, "algo=td3")
    assert (task, algo) == (("halfcheetah", "generalized"), "td3") and "preset" not in given


def test_the_task_of_brax_is_measured_by_its_address_and_its_options(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)
    settings = compose(["env=brax_sac:task", "env.env_name=fast"])
    assert settings.env_name == "brax_sac:task" and make_env(settings).obs_size == 2


@pytest.mark.parametrize(
    "words, message",
    [
        ("ant num_seeds=1,2", "num_seeds: expected one value"),
        ("ant env=point_goal1", "env=point_goal1: name a task of Brax instead"),
        ("ant hopper", "ant hopper: expected one task"),
    ],
)
def test_what_sac_on_brax_cannot_train_is_one_line(words, message, monkeypatch, capsys):
    status, asked = brax_sac_with(monkeypatch, *words.split())
    said = capsys.readouterr().err
    assert (status, asked) == (2, []) and message in said and said.count("\n") == 1
