import jax
import jax.numpy as jnp
import numpy as np
import pytest
from disk import full_beyond
from jax.flatten_util import ravel_pytree

from jaxsafe.run import checkpoint
from jaxsafe.run.checkpoint import (
    CheckpointError,
    NoRoom,
    NotSaved,
    Progress,
    checkpoints,
    restore,
    save,
)
from jaxsafe.run.loop import pause_after


def state(scale: float = 1.0):
    return {
        "params": {"w": scale * jnp.arange(6.0).reshape(2, 3), "empty": jnp.zeros((0, 3))},
        "key": jax.random.split(jax.random.key(3)),
        "half": jnp.bfloat16(0.1),
        "flags": (jnp.array([True, False]), ()),
        "iteration": jnp.int32(7),
    }


def at(iteration: int) -> Progress:
    return Progress(iteration, 10 * iteration, 2 * iteration)


def assert_same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        x, y = (jax.random.key_data(v) if checkpoint.is_key(v) else v for v in (x, y))
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


def flip_a_byte(path):
    largest = max(
        (p for p in (path / "state").rglob("*") if p.is_file()), key=lambda p: p.stat().st_size
    )
    data = bytearray(largest.read_bytes())
    data[len(data) // 2] ^= 1
    largest.write_bytes(data)


def test_a_train_state_comes_back_bit_for_bit_with_its_random_keys(tmp_path):
    save(tmp_path, state(0.1), at(7))
    restored, manifest = restore(tmp_path, jax.eval_shape(state))
    assert_same(restored, state(0.1))
    assert manifest.at == at(7)
    assert jax.random.normal(restored["key"][0]) == jax.random.normal(state()["key"][0])


def test_the_last_two_checkpoints_stay(tmp_path):
    for i in range(4):
        save(tmp_path, state(), at(i))
    assert [p.name for p in checkpoints(tmp_path)] == ["00000003", "00000002"]


def test_moments_that_are_one_array_on_a_gpu_go_on_apart_on_a_cpu_and_back(tmp_path):
    """Of two seeds each, of a network whose layers are not in the order of their names."""
    layers = [{"kernel": jnp.arange(12.0).reshape(2, 3, 2), "bias": jnp.array([[1.0], [2.0]])}] * 11
    apart = {"opt_state": {"mu": layers, "count": jnp.zeros(2)}}
    joined = {"opt_state": apart["opt_state"] | {"mu": jax.vmap(lambda x: ravel_pytree(x)[0])(layers)}}
    for there, here in ((joined, apart), (apart, joined)):
        save(tmp_path, there, at(1))
        assert_same(restore(tmp_path, jax.eval_shape(lambda x: x, here))[0], here)
    shorter = {"opt_state": apart["opt_state"] | {"mu": layers[:10]}}
    number = {"opt_state": apart["opt_state"] | {"mu": jnp.float32(1)}}
    for i, (there, here) in enumerate(
        [(joined, shorter), (shorter, joined), (number, apart), (apart, number)]
    ):
        save(tmp_path, there, at(i + 2))
        with pytest.raises(CheckpointError, match=r"another train state: opt_state.mu"):
            restore(tmp_path, here)


@pytest.mark.parametrize("damage", ["byte", "truncated", "missing", "manifest"])
def test_a_corrupt_newest_checkpoint_is_passed_over_with_one_line(tmp_path, damage):
    save(tmp_path, state(1.0), at(1))
    newest = save(tmp_path, state(2.0), at(2))
    if damage == "byte":
        flip_a_byte(newest)
    elif damage == "manifest":
        (newest / "manifest.json").write_text("{")
    else:
        file = newest / "state" / "_METADATA"
        file.write_bytes(file.read_bytes()[:10]) if damage == "truncated" else file.unlink()
    lines: list[str] = []
    restored, manifest = restore(tmp_path, jax.eval_shape(state), lines.append)
    assert manifest.at == at(1)
    assert_same(restored, state(1.0))
    assert len(lines) == 1 and "00000002 is corrupt" in lines[0] and "\n" not in lines[0]


def test_too_little_memory_is_no_corruption(tmp_path, monkeypatch):
    save(tmp_path, state(1.0), at(1))
    save(tmp_path, state(2.0), at(2))
    monkeypatch.setattr(checkpoint, "host_memory", lambda: 8.0)
    with pytest.raises(NoRoom, match=r"00000002: its arrays need .* bytes, this machine has 8"):
        restore(tmp_path, jax.eval_shape(state))


def test_what_is_saved_stays_among_higher_numbers(tmp_path):
    for iteration in (6, 7, 1):
        save(tmp_path, state(), at(iteration))
    assert [path.name for path in checkpoints(tmp_path)] == ["00000007", "00000001"]


def test_no_sound_checkpoint_is_one_clear_error(tmp_path):
    with pytest.raises(CheckpointError, match="no checkpoint in"):
        restore(tmp_path, jax.eval_shape(state))
    flip_a_byte(save(tmp_path, state(), at(1)))
    with pytest.raises(CheckpointError, match="is corrupt"):
        restore(tmp_path, jax.eval_shape(state), lambda line: None)


def test_another_train_state_is_refused_by_the_leaf_that_differs(tmp_path):
    save(tmp_path, state(), at(1))
    other = {**state(), "params": {"w": jnp.zeros((2, 4)), "empty": jnp.zeros((0, 3))}}
    with pytest.raises(CheckpointError, match=r"params\.w is float32\[2, 3\], not float32\[2, 4\]"):
        restore(tmp_path, jax.eval_shape(lambda: other))


def test_a_full_disk_is_one_error_and_the_last_good_checkpoint_stays(tmp_path, monkeypatch):
    good = save(tmp_path, state(1.0), at(1))

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint.ocp.Checkpointer, "save", full)
    with pytest.raises(NotSaved, match=f"No space left on device; the last good one is {good}"):
        save(tmp_path, state(2.0), at(2))
    assert checkpoints(tmp_path) == [good] and not list(tmp_path.glob("*.part"))
    assert_same(restore(tmp_path, jax.eval_shape(state))[0], state(1.0))


def test_what_orbax_raises_of_a_full_disk_it_does_not_log_as_well(tmp_path, caplog):
    noise = jax.random.normal(jax.random.key(0), (200, 200))  # 160 kB, which do not pack
    with full_beyond(50_000), pytest.raises(NotSaved, match="File too large; there is no earlier one"):
        save(tmp_path, {"w": noise}, at(1))
    assert not [record for record in caplog.records if record.exc_info]


def test_what_a_killed_process_left_behind_is_ignored_and_cleared(tmp_path):
    save(tmp_path, state(), at(1))
    (tmp_path / "00000002.part" / "state").mkdir(parents=True)
    assert [p.name for p in checkpoints(tmp_path)] == ["00000001"]
    save(tmp_path, state(), at(3))
    assert not list(tmp_path.glob("*.part"))


def test_a_replay_that_is_left_out_comes_back_empty_and_says_since_when(tmp_path):
    ts = state() | {"replay": {"obs": jnp.ones((5, 2)), "first": jnp.ones(5, bool)}}
    assert checkpoint.replay_bytes(ts) == 5 * 2 * 4 + 5
    save(tmp_path, ts, at(7), since=2)
    kept, manifest = restore(tmp_path, ts)
    assert_same(kept, ts)
    assert manifest.since == 2
    save(tmp_path, ts, at(8), since=2, replay=False)
    back, manifest = restore(tmp_path, ts)
    assert_same(back, ts | {"replay": jax.tree.map(jnp.zeros_like, ts["replay"])})
    assert (manifest.at, manifest.since) == (at(8), 8)
    save(tmp_path, state(), at(9))  # of another algorithm: its replay is not empty but absent
    assert checkpoint.replay_bytes(state()) == 0 and restore(tmp_path, state())[1].since == 0


@pytest.mark.parametrize(
    "took, every, pause",
    [(1.0, 60.0, 60.0), (10.0, 60.0, 190.0), (1200.0, 60.0, 1800.0), (1200.0, 3600.0, 3600.0)],
)
def test_a_slow_checkpoint_puts_the_next_off_by_half_an_hour_at_most(took, every, pause):
    assert pause_after(took, every) == pause
