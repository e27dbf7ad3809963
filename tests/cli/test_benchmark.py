"""jaxsafe benchmark."""

import argparse
import json
import runpy
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from jaxsafe.commands import benchmark, peers
from jaxsafe.config import ConfigError

SCRIPTS = Path(__file__).parent.parent.parent / "scripts"
profile = runpy.run_path(str(SCRIPTS / "profile_learner.py"))
closed_loop = runpy.run_path(str(SCRIPTS / "closed_loop.py"))
kernels_of, products_of = profile["kernels_of"], profile["products_of"]


def test_a_row_tells_what_was_measured(tmp_path, monkeypatch, capsys):
    """Hopper takes 4 physics steps of 2 ms in a step."""
    rows = tmp_path / "rows.jsonl"
    sizes = "--engine c --num-envs 3 --horizon 2 --warmup 2 --repeats 2"
    monkeypatch.setattr(
        sys, "argv", ["benchmark", "hopper_velocity", *sizes.split(), "--json", str(rows)]
    )
    assert benchmark.main() == 0
    assert "hopper_velocity  c     steps           1 x 3" in capsys.readouterr().out
    row = json.loads(rows.read_text())
    rate = row["env_steps_per_s"]
    assert row["physics_steps_per_s"] == pytest.approx(4 * rate)
    assert row["simulated_s_per_s"] == pytest.approx(0.008 * rate)
    assert row["slowest"] <= rate <= row["fastest"]


def test_a_task_is_measured_with_the_settings_of_train(tmp_path, monkeypatch, capsys):
    """A step of two raw steps of hopper has 8 physics steps."""
    rows = tmp_path / "rows.jsonl"
    words = "hopper_velocity env.wrap.action_repeat=2 --engine c --num-envs 3 --horizon 2 --warmup 2"
    monkeypatch.setattr(sys, "argv", ["benchmark", *words.split(), "--json", str(rows)])
    assert benchmark.main() == 0
    row = json.loads(rows.read_text())
    assert row["options"] == "env.wrap.action_repeat=2" and row["engine"] == "c"
    assert row["physics_steps_per_s"] == pytest.approx(8 * row["env_steps_per_s"])
    monkeypatch.setattr(sys, "argv", ["benchmark", "hopper_velocity", "env.lidar_num_bins=8"])
    assert benchmark.main() == 2
    assert "lidar_num_bins" in capsys.readouterr().err


def test_updates_are_timed_one_after_another():
    """So that schedules go on, and learners with a replay begin to learn."""
    seen = []

    def update(state, iteration):
        jax.debug.callback(lambda i: seen.append(int(i)), iteration, ordered=True)
        return state + iteration

    timing = benchmark.timed(update, jnp.int32(0), before=3, repeats=2)
    timing.program(timing.state, timing.i)
    jax.effects_barrier()
    assert len(timing.runs) == 2 and seen == [0, 1, 2, 3, 4, 5]


def test_an_update_is_told_apart_by_kernels_and_where_they_come_from():
    def update(state, iteration):
        return jax.lax.scan(lambda x, _: (x @ x, None), state, None, length=3)[0]

    timing = benchmark.timed(update, jnp.eye(200), before=0, repeats=1)
    [product] = [k for k in kernels_of(timing) if k.source.endswith("dot_general")]
    assert product.count == 3 and product.ms > 0 and "while" in product.source


def test_an_algorithm_is_measured_with_the_settings_of_train():
    cfg = benchmark.config_of("sac_lag", ["preset=parallel", "algo.tau=0.5"], num_envs=8, horizon=None)
    assert (cfg.replay_ratio, cfg.tau, cfg.num_envs, cfg.horizon) == (256, 0.5, 8, 16)


@pytest.mark.parametrize("option", ["seed=1", "env.lidar_num_bins=8", "algo.taau=0.5", "preset=slow"])
def test_other_settings_are_refused(option):
    with pytest.raises(ConfigError, match=option.partition("=")[0]):
        benchmark.config_of("sac_lag", [option])


def test_settings_without_an_algorithm_are_refused(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["benchmark", "point_goal1", "algo.tau=0.5"])
    assert benchmark.main() == 2
    assert "algo.tau=0.5: expected env.OPTION=; other settings need --algo" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [[], ["--algo=sac_lag", "algo.tau=0.5"], ["env.awake=3"]])
def test_without_a_task_or_a_peer_there_is_nothing_to_measure(arguments, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["benchmark", *arguments])
    assert benchmark.main() == 2
    assert "nothing to measure: name a task" in capsys.readouterr().err


@pytest.mark.parametrize(
    "option, message",
    [
        ("--json=nowhere/rows", "--json nowhere/rows: No such file or directory"),
        ("--peer=carx=python", "--peer carx=python: unknown peer; did you mean 'crax'?"),
    ],
)
def test_where_rows_go_and_peers_are_looked_at_before_anything_is_measured(
    option, message, monkeypatch, capsys
):
    monkeypatch.setattr(benchmark, "measure", None)
    monkeypatch.setattr(sys, "argv", ["benchmark", "point_goal1", option])
    assert benchmark.main() == 2
    said = capsys.readouterr()
    assert message in said.err and said.err.count("\n") == 1 and not said.out


def test_a_task_of_the_user_s_own_is_measured_without_physics_steps(tmp_path, monkeypatch, capsys):
    rows = tmp_path / "rows.jsonl"
    sizes = "--num-envs 3 --horizon 2 --warmup 2 --repeats 2"
    monkeypatch.setattr(
        sys, "argv", ["benchmark", "toys:Corridor", *sizes.split(), "--json", str(rows)]
    )
    assert benchmark.main() == 0
    assert "toys:Corridor          steps           1 x 3" in capsys.readouterr().out
    row = json.loads(rows.read_text())
    assert row["env_steps_per_s"] > 0
    assert (row["engine"], row["physics_steps_per_s"], row["simulated_s_per_s"]) == (None, None, None)


def asked(algo: str | None, *options: str) -> argparse.Namespace:
    return argparse.Namespace(algo=algo, options=list(options), horizon=None)


@pytest.mark.parametrize("algo", ["sac", "sac_lag"])
@pytest.mark.parametrize("options", [[], ["preset=parallel"], ["algo.learn_every=4", "algo.n_step=2"]])
def test_a_peer_s_sac_has_our_environments_replay_and_networks(algo, options):
    cfg = benchmark.config_of(algo, options)
    sizes = benchmark.peer_sizes(None, asked(algo, *options))
    theirs = peers.sac_settings(peers.Sizes(*sizes.values()))
    assert list(sizes) == [name.replace("_", "-") for name in peers.Sizes._fields]
    replayed = theirs["batch_size"] * theirs["grad_updates_per_step"]
    assert replayed / theirs["num_envs"] == cfg.replay_ratio
    assert theirs["num_envs"] == cfg.num_envs
    assert theirs["batch_size"] == (cfg.batch_size or peers.Sizes().batch_size)
    assert (theirs["min_replay_size"], theirs["max_replay_size"]) == (
        cfg.learning_starts,
        cfg.replay_size,
    )
    assert (theirs["normalize_observations"], theirs["discounting"]) == (
        cfg.obs_normalize,
        cfg.discount,
    )
    assert cfg.hidden == (256, 256)  # what theirs have by default


def test_a_peer_of_another_algorithm_has_only_the_number_of_environments():
    assert benchmark.peer_sizes(16, asked("ppo_lag")) == benchmark.peer_sizes(16, asked(None))
    assert benchmark.peer_sizes(16, asked(None)) == {"num-envs": 16}
    assert benchmark.peer_sizes(None, asked(None)) == {}


def test_a_peer_s_sac_cannot_take_half_a_gradient_step():
    batches = asked("sac", "algo.learn_every=2", "algo.batch_size=65536")
    with pytest.raises(ConfigError, match=r"algo\.learn_every=2"):
        benchmark.peer_sizes(2048, batches)


def test_a_peer_s_row_keeps_the_versions_that_it_ran_by(monkeypatch, tmp_path):
    row = {"peer": "crax", "algo": None, "env": "e", "num_envs": 1, "env_steps_per_s": 1.0}
    monkeypatch.setattr(benchmark, "measure_peer", lambda spec, sizes: [row | {"mujoco": "0.0"}])
    monkeypatch.setattr(sys, "argv", ["benchmark", "--peer", "crax", "--json", str(tmp_path / "rows")])
    assert benchmark.main() == 0
    (kept,) = [json.loads(line) for line in (tmp_path / "rows").read_text().splitlines()]
    assert kept["mujoco"] == "0.0"
    assert kept["device"] == benchmark.versions()["device"]
    assert set(peers.own_versions()) == {"python", "jax", "mujoco", "mujoco-mjx"}


def test_a_peer_s_rate_is_that_of_its_settled_epochs():
    """A stand-in for Brax's trainer: 10,000 steps fill the replay, then come epochs of 100 steps."""

    class Evaluator:
        def run_evaluation(self, params, training_metrics):
            raise AssertionError("it is left out")

    def train(*, num_envs, num_timesteps, num_evals, min_replay_size, progress_fn, **_):
        evaluator: Any = Evaluator()
        progress_fn(0, evaluator.run_evaluation(None, training_metrics={}))
        length = (num_timesteps - min_replay_size) / (num_evals - 1)
        assert length == 100 * num_envs
        for epoch in range(num_evals - 1):
            end = min_replay_size + (epoch + 1) * length
            progress_fn(end - 1, {"training/sps": 1e9})  # a log within the epoch
            metrics = {"training/sps": 10.0 + epoch, "training/walltime": 1.0}
            progress_fn(end, evaluator.run_evaluation(None, training_metrics=metrics))

    row = peers.sac_training(train, Evaluator, None, peers.Sizes(100, 50, 4))
    assert (row["slowest"], row["env_steps_per_s"], row["fastest"]) == (12.0, 14.0, 16.0)
    assert (row["num_envs"], row["replay_ratio"]) == (100, 2.0)


@pytest.mark.parametrize(
    "words, message",
    [
        ("point_goal1 --episodes 1", "--episodes 1: expected at least 2, for an interval"),
        ("ant_velocity", "ant_velocity: expected a task of Safety Gym with a lidar for its goal"),
        ("point_circle1", "point_circle1: expected a task of Safety Gym with a lidar for its goal"),
    ],
)
def test_engines_are_not_compared_where_there_is_no_goal_or_no_interval(
    words, message, monkeypatch, capsys
):
    monkeypatch.setattr(sys, "argv", ["closed_loop.py", *words.split(), "--variants", "c"])
    assert closed_loop["main"]() == 2
    assert capsys.readouterr().err == f"error: {message}\n"


def test_the_products_of_a_program_are_counted_in_loops_branches_and_gradients():
    weights, x = jnp.ones((4, 6)), jnp.ones((3, 4))

    def once(weights, x):
        return (x @ weights).sum()  # 3 x 6 sums of 4 products

    def often(weights, x):
        def step(total, x):
            return total + jax.lax.cond(total > 0, once, lambda *_: 0.0, weights, x), ()

        return jax.lax.scan(step, 0.0, jnp.stack([x] * 5))[0]

    def count(fn):
        return products_of(jax.make_jaxpr(fn)(weights, x).jaxpr)

    assert count(once) == 2 * 3 * 6 * 4
    assert count(often) == count(jax.jit(often)) == 5 * count(once)
    assert count(jax.grad(once)) == 2 * count(once)  # forward, and back to the weights


@pytest.mark.parametrize(
    "name", ["closed_loop", "foresight", "parity", "profile_learner", "profile_warp"]
)
def test_a_script_refuses_what_it_cannot_read_in_one_line(name, monkeypatch, capsys):
    script = runpy.run_path(str(SCRIPTS / f"{name}.py"))
    monkeypatch.setattr(sys, "argv", [f"{name}.py", "x", "--nothing"])
    assert script["main"]() == 2
    assert capsys.readouterr().err == "error: unrecognized arguments: --nothing\n"
