"""jaxsafe benchmark."""

import json
import sys

import jax
import jax.numpy as jnp
import pytest

from jaxsafe.commands import benchmark


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
