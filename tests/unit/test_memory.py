"""Whether a run fits: what a program takes, by the four numbers of XLA, and what is advised."""

from functools import cache

import jax
import numpy as np
import pytest
from shell import SMALL, TOY

from jaxsafe.commands.guard import guarded
from jaxsafe.run import checkpoint, distributed, loop, memory, programs, session
from jaxsafe.run.arguments import compose
from jaxsafe.run.memory import Use
from jaxsafe.run.settings import make_env

SAC = (
    TOY, "algo=sac", "num_envs=4", "algo.horizon=8", "algo.learn_every=4", "algo.batch_size=16",
    "algo.replay_ratio=4", "algo.replay_size=4000", "algo.learning_starts=64", "algo.hidden=[8]",
)  # fmt: skip
COUNTERS = 8  # bytes of the two numbers that the loop hands to an update


@cache
def compiled(*texts):
    """A program with its data set in place, its compiled update and its train state."""
    _, program = session.prepare(compose([*texts]))
    ts = loop.fresh(program, loop.Hooks("")).ts
    program = program._replace(data=distributed.place(program.data, program.everywhere))
    return program, programs.compiled(program, ts), ts


@pytest.mark.parametrize("texts", [SAC, (*SAC, "num_seeds=2"), SMALL])
def test_an_update_takes_its_arguments_outputs_and_temporaries_and_what_is_donated_counts_once(texts):
    program, update, ts = compiled(*texts)
    use, said = memory.use_of(update, program), update.memory_analysis()
    assert (
        use.kept == said.alias_size_in_bytes == sum(x.nbytes for x in checkpoint.to_arrays(ts).values())
    )
    whole = said.argument_size_in_bytes + said.output_size_in_bytes + said.temp_size_in_bytes
    assert 0 <= whole - said.alias_size_in_bytes - use.total <= COUNTERS
    assert use.replay == checkpoint.replay_bytes(ts)


def test_a_data_set_counts_with_the_arrays_that_the_method_does_not_read(tmp_path):
    """Behaviour cloning reads no reward, so XLA's count of arguments lacks it. It is there all the
    same."""
    rows = np.zeros((100, 4), np.float32)
    ends = np.arange(100) % 50 == 49
    data = {"observations": rows, "next_observations": rows, "actions": rows[:, :2], "timeouts": ends}
    data |= dict.fromkeys(("rewards", "costs", "terminals"), rows[:, 0])
    np.savez(tmp_path / "data.npz", **data)
    program, update, _ = compiled(TOY, "algo=bc", f"dataset={tmp_path / 'data.npz'}", "algo.hidden=[8]")
    use, said = memory.use_of(update, program), update.memory_analysis()
    assert use.data == sum(x.nbytes for x in jax.tree.leaves(program.data))
    assert said.argument_size_in_bytes < use.kept


def test_what_is_kept_counts_once_before_it_is_there_and_not_at_all_afterwards(monkeypatch):
    settings = compose([*SAC])
    env, program = session.prepare(settings)
    _, update, _ = compiled(*SAC)
    use = memory.use_of(update, program)

    def room(size):
        monkeypatch.setattr(memory, "device_memory", lambda: (size, "the device"))

    room(use.kept)
    memory.check_state_memory(program, env, settings)
    room(use.work)
    with memory.watched(program, env, settings) as check:
        check(update)
    room(use.kept - 1)
    with pytest.raises(memory.TooLarge, match=r"^a run keeps .* a smaller algo.replay_size$"):
        memory.check_state_memory(program, env, settings)
    room(use.work - 1)
    refusal = pytest.raises(
        memory.TooLarge, match=r"^an update needs .*, the device has 0.0 GiB; use a"
    )
    with refusal, memory.watched(program, env, settings) as check:
        check(update)


def test_members_share_a_data_set_when_it_is_asked_how_many_fit(monkeypatch):
    """Of 10 bytes 8 may be used: 4 for the data, and 2 for each of two members of eight."""
    _, program = session.prepare(compose([*SMALL, "num_seeds=8"]))
    monkeypatch.setattr(memory, "use_of", lambda *_: Use(state=12, replay=0, data=4, work=4))
    monkeypatch.setattr(memory, "device_memory", lambda: (10.0, "the device"))
    assert memory.capacity(program) == 2


def test_a_gpu_has_what_others_leave_of_it_and_a_refusal_says_how_much_is_what(monkeypatch):
    class Device:
        def memory_stats(self):
            return {"bytes_limit": 104 * 2**30, "bytes_in_use": 45 * 2**30}

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "local_devices", lambda: [Device()])
    assert memory.device_memory() == (59 * 2**30, "the device")
    assert memory.fits(59 * 2**30) and not memory.fits(59 * 2**30 + 1)
    use = Use(state=1.5 * 2**30, replay=23 * 2**30, data=0, work=60 * 2**30)
    assert str(use) == "84.5 GiB a device (train state 1.5, replay 23.0, working arrays 60.0)"
    line = str(memory.too_large(f"an update needs {use}", "use less", held=use.kept))
    assert line == f"an update needs {use}, the device has 83.5 GiB; use less"


def test_in_a_container_this_process_has_taken_some_of_its_limit(monkeypatch):
    files = {
        "/proc/meminfo": "MemTotal: 9000 kB\nMemAvailable: 8000 kB\n",
        "/proc/self/status": "VmRSS:\t 900 kB\nRssAnon:\t 300 kB\n",
        "/sys/fs/cgroup/memory.max": "max\n",
    }

    def read(path):
        if str(path) not in files:
            raise FileNotFoundError(path)
        return files[str(path)]

    monkeypatch.setattr(checkpoint.Path, "read_text", read)
    assert checkpoint.host_memory() == 8000 * 1024
    files["/sys/fs/cgroup/memory.max"] = f"{1000 * 1024}\n"
    assert checkpoint.host_memory() == 700 * 1024
    files.clear()
    assert checkpoint.host_memory() == float("inf")


@pytest.mark.parametrize(
    "said",
    [
        "RESOURCE_EXHAUSTED: Out of memory while trying to allocate 64424509440 bytes.",
        "INTERNAL: Error dispatching computation: Out of memory allocating 4800000000 bytes.",
        "INTERNAL: Failed to allocate: CUDA_ERROR_OUT_OF_MEMORY: out of memory",
    ],
)
def test_any_command_that_runs_out_of_memory_ends_with_one_line(said, capsys):
    def evaluate():
        raise jax.errors.JaxRuntimeError(said)

    assert guarded(evaluate) == 1
    line = "error: out of memory; use fewer environments, seeds or episodes\n"
    assert capsys.readouterr() == ("", line)


PIXELS = (
    "env=point_goal1", "env.observe_vision=true", "env.vision_size=[64,64]", "algo=ambs",
    "preset=pixels", "num_seeds=2",
)  # fmt: skip
LEARNS = "algo.batch_size, algo.imagine_steps, algo.size, env.vision_size"


@pytest.mark.parametrize(
    "texts, use, names",
    [
        (PIXELS, Use(1.5, 23, 0, 60), f"{LEARNS}, algo.replay_size or num_seeds"),
        (PIXELS, Use(1.5, 80, 0, 60), "algo.replay_size, env.vision_size, algo.batch_size, "),
        (PIXELS, Use(1.5, 1, 0, 60), f"{LEARNS} or num_seeds"),
        (
            (*PIXELS, "algo.shield_rollouts=65536"),
            Use(0, 0, 0, 1),
            "algo.shield_rollouts, num_envs or ",
        ),
        (["algo=pets"], Use(0, 0, 0, 1), "algo.model_batch, algo.plans or num_envs"),
        (["algo=ppo_lag"], Use(0, 0, 0, 1), "algo.horizon or num_envs"),
        (["algo=ppo_lag"], Use(1, 0, 0, 0), "num_envs or algo.hidden"),
        (["algo=bc", "num_seeds=3"], Use(0, 0, 1, 0), "data set or num_seeds"),
    ],
)
def test_the_advice_names_what_the_large_parts_grow_with(texts, use, names):
    settings = compose([*texts])
    assert memory.smaller(use, make_env(settings), settings).startswith(f"a smaller {names}")


def test_members_of_a_sweep_can_train_one_after_the_other():
    settings = compose(["algo=ppo_lag", "num_seeds=2"])
    several = settings._replace(configs=settings.configs * 2)
    said = memory.smaller(Use(0, 0, 0, 1), make_env(settings), several)
    assert said == "a smaller algo.horizon, num_envs or max_parallel"
