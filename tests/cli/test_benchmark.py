"""jaxsafe benchmark."""

import json
import sys

import jax
import jax.numpy as jnp
import pytest

from jaxsafe.commands import benchmark
from jaxsafe.config import ConfigError


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


def test_updates_are_timed_one_after_another():
    """So that schedules go on, and learners with a replay begin to learn."""
    seen = []

    def update(state, iteration):
        jax.debug.callback(lambda i: seen.append(int(i)), iteration, ordered=True)
        return state + iteration

    _, runs = benchmark.timed(update, jnp.int32(0), before=3, repeats=2)
    jax.effects_barrier()
    assert len(runs) == 2 and seen == [0, 1, 2, 3, 4]


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
    assert "give --algo" in capsys.readouterr().err
