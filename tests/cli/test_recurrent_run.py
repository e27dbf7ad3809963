"""A run of a policy with a memory: resumed, evaluated, filmed, and started from."""

import shutil

import jax
import numpy as np
import pytest
from shell import SMALL, STEPS, assert_same_run, typed
from toys import run_episodes

from jaxsafe.envs.view import render
from jaxsafe.run import checkpoint
from jaxsafe.run.policies import open_run

GRU = (*SMALL, "algo.trunk=gru", "num_seeds=2")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    run = tmp_path_factory.mktemp("recurrent") / "run"
    assert typed("train", *GRU, f"total_steps={6 * STEPS}", f"run_dir={run}") == 0
    return run


def test_stopped_and_resumed_it_ends_bit_for_bit_as_if_uninterrupted(trained, tmp_path):
    run = tmp_path / "run"
    args = (*GRU, f"total_steps={6 * STEPS}", "checkpoint_iterations=3", f"run_dir={run}")
    assert typed("train", *args) == 0
    for kind in ("checkpoints", "policy"):  # as if it had been killed after iteration 3
        shutil.rmtree(run / kind / "00000006")
    assert typed("train", *args, "resume=true") == 0
    assert_same_run(run, trained)
    carry = checkpoint.load(run / "checkpoints")[0]["rollout.carry"]
    assert carry.shape == (2, 4, 8) and carry.any()  # members, environments, units


def test_evaluated_and_filmed_it_remembers(trained):
    run = open_run(trained, ("env=toys:Corridor",))
    whole = run_episodes(run.algo, run.learned, 2, 0)
    player = run.one(0).player
    states, _ = render.run_episode(player, jax.random.key(0), run.env.episode_length)
    assert np.isfinite(whole.ret).all() and np.isfinite(states.obs).all()
    state, forgetful, mindful = player.task.reset(jax.random.key(0)), player.begin(), player.begin()
    for _ in range(3):
        action, mindful = player.act(mindful, state)
        state = player.task.step(state, action)
    assert (player.act(mindful, state)[0] != player.act(forgetful, state)[0]).any()


def test_another_run_starts_from_it(trained, tmp_path, capsys):
    run = tmp_path / "run"
    rest = (f"total_steps={STEPS}", "algo.lr=0", "eval_episodes=0", f"run_dir={run}")
    assert typed("train", *GRU, *rest, f"init_from={trained}") == 0
    before, after = (checkpoint.load(x / "policy")[0] for x in (trained, run))
    networks = [name for name in before if name.startswith("params.")]
    assert networks and "params.actor.mean.params.GRU_0.gates.kernel" in networks
    for name in networks:
        np.testing.assert_array_equal(before[name], after[name])
    other = tmp_path / "other"
    assert typed("train", *SMALL, *rest[:-1], f"run_dir={other}", f"init_from={trained}") == 2
    assert "algo.trunk is gru there, separate here" in capsys.readouterr().err
