"""Data sets that are collected from runs, and those of other libraries."""

import dataclasses
import json
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from disk import full_beyond
from shell import SMALL, TOY, typed
from toys import Corridor, Ticker

import jaxsafe
from jaxsafe.config import ConfigError
from jaxsafe.learn.augment import Budget
from jaxsafe.run import collect, dataset, policies
from jaxsafe.run.dataset import other_task, read_about, read_dataset, write_dataset
from jaxsafe.run.policies import open_run
from jaxsafe.types import Policy


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("collect") / "run"
    options = ("total_steps=64", "num_seeds=2", "eval_episodes=0", f"run_dir={folder}")
    assert typed("train", *SMALL, *options) == 0
    return folder


def flat(data) -> dict[str, np.ndarray]:
    named = {k: np.asarray(x) for k, x in data._asdict().items() if k not in ("costs", "episodes")}
    named |= {f"cost {k}": np.asarray(x) for k, x in data.costs.items()}
    return named | {k: np.asarray(x) for k, x in data.episodes._asdict().items()}


def assert_equal(one, other):
    one, other = flat(one), flat(other)
    assert one.keys() == other.keys()
    for name in one:
        assert one[name].dtype == other[name].dtype, name
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)


def test_whole_episodes_of_every_policy_with_dsrls_keys_and_a_recipe(run, tmp_path, capsys):
    out = tmp_path / "mixed.hdf5"
    args = (f"{run}:0.25", f"{run}:0.75", TOY, "size=200", f"out={out}", "actions=mean")
    assert typed("collect", *args) == 0
    said = capsys.readouterr().out
    assert "220 transitions in 11 episodes" in said and len(said.splitlines()) == 1
    with h5py.File(out) as file:
        arrays: dict[str, Any] = {name: file[name][()] for name in file}  # type: ignore[index]
        attrs: dict[str, Any] = {**file.attrs}
    dsrl = {"observations", "next_observations", "actions", "rewards", "costs", "terminals", "timeouts"}
    assert {*arrays} == dsrl | {"cost_wall", "run", "policy", "episode"}
    # 50 transitions are 3 episodes of 20 steps, 150 are 8
    assert np.bincount(arrays["run"]).tolist() == [60, 160]
    assert np.bincount(arrays["policy"][60:]).tolist() == [80, 80]
    assert arrays["timeouts"].nonzero()[0].tolist() == list(range(19, 220, 20))
    assert not arrays["terminals"].any()
    assert len(np.unique(arrays["observations"][::20], axis=0)) == 11  # of one run given twice, too
    recipe = json.loads(attrs["recipe"])
    assert [x["share"] for x in recipe["runs"]] == [0.25, 0.75] and attrs["actions"] == b"mean"
    assert recipe["runs"][0]["algo"] == "ppo_lag" and recipe["runs"][0]["seeds"] == 2
    # the recorded steps are those of the environment
    env, size = Corridor(), np.float32(0.02)
    obs, after, action = (arrays[k] for k in ("observations", "next_observations", "actions"))
    np.testing.assert_allclose(after[:, 2:], obs[:, 2:] + size * env.max_accel * action, atol=1e-6)
    np.testing.assert_allclose(arrays["rewards"], after[:, 2], atol=1e-6)
    inside = ~arrays["timeouts"][:-1]
    np.testing.assert_array_equal(after[:-1][inside], obs[1:][inside])


def test_python_collects_what_the_command_does(run, tmp_path):
    files = [tmp_path / f"{name}.npz" for name in ("command", "python")]
    assert typed("collect", str(run), TOY, "size=40", "seed=3", f"out={files[0]}") == 0
    opened = jaxsafe.Run(run, "toys:Corridor")
    made = jaxsafe.collect({opened: 1}, files[1], size=4e1, seed=3)
    assert_equal(*map(read_dataset, map(str, files)))
    assert made.run.tolist() == [0] * 40 and made.recipe["runs"][0]["episodes"] == 2
    for shares, path, message in (
        ({opened: 0.5}, files[1], "sum to 1"),
        ({opened: -1}, files[1], "sum to 1"),
        ({opened: 1}, tmp_path / "data.csv", "ends in .hdf5 or .npz"),
    ):
        with pytest.raises(ConfigError, match=message):
            jaxsafe.collect(shares, path)


def test_a_recipe_has_the_limits_in_force_of_each_setting(run):
    opened = open_run(run, (TOY,))
    (cfg,) = opened.settings.configs
    configs = cfg, dataclasses.replace(cfg, cost_limits={"wall": 10.0})
    several = opened._replace(settings=opened.settings._replace(configs=configs))
    assert collect.about(several)["limits"] == [{"cost": 25.0}, {"cost wall": 10.0}]


def test_a_data_set_that_is_there_is_not_overwritten(run, tmp_path, capsys):
    out = tmp_path / "data.npz"
    out.write_text("hours of work")
    assert typed("collect", str(run), TOY, "size=40", f"out={out}") == 2
    assert f"out={out}: this data set is there already; name another" in capsys.readouterr().err
    assert out.read_text() == "hours of work"


def test_the_same_command_collects_the_same_and_mean_actions_are_not_sampled_ones(run, tmp_path):
    files = [tmp_path / f"{i}.npz" for i in range(3)]
    for out, actions in zip(files, ("sampled", "sampled", "mean"), strict=True):
        assert typed("collect", str(run), TOY, "size=40", f"out={out}", f"actions={actions}") == 0
    first, again, mean = (read_dataset(str(path)) for path in files)
    assert_equal(first, again)
    assert np.abs(first.action - mean.action).max() > 0.1
    assert np.abs(first.action).max() == 1  # as environments clip them


@pytest.mark.parametrize(
    "args, message",
    [
        (("RUN:0.5",), "the shares sum to 0.5; expected 1, or one run without a share"),
        (("RUN:2",), "expected RUN:SHARE, with a share between 0 and 1"),
        (("RUN:a",), "expected RUN:SHARE"),
        (("RUN", "size=0"), "size=0: expected a whole number between 1 and"),
        (("RUN", "size=many"), "size=many: expected a number"),
        (("RUN", "out=data.txt"), "expected a name that ends in .hdf5 or .npz"),
        (("RUN", "actions=meen"), "did you mean 'mean'?"),
        (("RUN", "sizes=3"), "unknown option sizes; did you mean 'size'?"),
        (("nowhere",), "nowhere is not a run folder"),
        (("000-a-ppo.horizon=128:1",), "000-a-ppo.horizon=128 is not a run folder"),
        (("runs/ppo.horizon=128",), "runs/ppo.horizon=128 is not a run folder"),
    ],
)
def test_what_cannot_be_collected_is_one_line(run, tmp_path, capsys, args, message):
    args = [word.replace("RUN", str(run)) for word in args]
    given = () if any("out=" in word for word in args) else (f"out={tmp_path / 'data.npz'}",)
    assert typed("collect", *args, *given) == 2
    said = capsys.readouterr()
    assert message in said.err and len((said.out + said.err).strip().splitlines()) == 1


def test_a_place_that_cannot_be_written_is_refused_before_anything_is_played(tmp_path, capsys):
    """The run is not even looked for."""
    folder, file = tmp_path / "folder.hdf5", tmp_path / "file.hdf5"
    folder.mkdir()
    file.touch()
    for out, message in (
        (folder, f"out={folder} is a folder; expected a file, such as {folder}/data.hdf5"),
        (file / "x.hdf5", f"out={file}/x.hdf5: {file} is a file; expected a folder"),
        (file / "a" / "x.npz", f"out={file}/a/x.npz: {file} is a file; expected a folder"),
        ("/proc/d.hdf5", "out=/proc/d.hdf5: cannot write to /proc: "),
    ):
        assert typed("collect", "nowhere", f"out={out}") == 2
        err = capsys.readouterr().err
        assert err.startswith(f"error: {message}") and err.count("\n") == 1
    assert collect.data_file(tmp_path / "new" / "x.npz") == tmp_path / "new" / "x.npz"
    assert {*tmp_path.iterdir()} == {folder, file}  # to look leaves nothing


@pytest.mark.parametrize("suffix", [".hdf5", ".npz"])
def test_a_disk_that_fails_at_the_end_is_one_line_and_status_1(run, tmp_path, capsys, suffix):
    out, write = tmp_path / f"data{suffix}", dataset.write_dataset

    def on_a_full_disk(*args):
        with full_beyond(4000):
            write(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "write_dataset", on_a_full_disk)
        assert typed("collect", str(run), TOY, "size=400", f"out={out}") == 1
    assert capsys.readouterr().err.splitlines()[-2:] == [
        "playing episodes with 400 steps ...",
        f"error: cannot write {out}: File too large; no data set is written",
    ]
    assert not [*tmp_path.iterdir()]


def test_two_tasks_are_told_by_their_names_and_options_but_not_by_their_engines():
    def check(*tasks: dict[str, Any]) -> None:
        settings: list[Any] = [SimpleNamespace(plain=lambda env=env: {"env": env}) for env in tasks]
        policies.check_same_task([Path("a"), Path("b"), Path("c")][: len(tasks)], settings)

    one = {"name": "task_a", "bounds": 2, "engine": "c", "awake": None, "contact_room": 1.0}
    check(one)
    check(one, one | {"engine": "warp", "awake": 2, "contact_room": 3.0})
    with pytest.raises(ConfigError) as error:
        check(one, {"name": "task_b", "bounds": 0})
    assert str(error.value) == "env.name is task_a in a, task_b in b; expected runs of the same task"
    with pytest.raises(ConfigError, match=r"env\.bounds is 2 in a, 0 in c; expected runs of the same"):
        check(one, one, one | {"bounds": 0})


def test_each_policy_meets_the_task_as_it_was_trained_in():
    """What is left of the budget, which is the action here, depends on the setting and the seed."""
    env = Ticker()
    algo = SimpleNamespace(
        policy=Policy(lambda learned: (), lambda learned, carry, obs, key: (obs[-1:], carry, {})),
        task=lambda learned: Budget(env, learned["start"], learned["budget"], 1.0),
    )
    learned = {"start": np.array([1, 0.5], np.float32), "budget": np.array([4, 8], np.float32)}
    run: Any = SimpleNamespace(algo=algo, env=env, learned=learned)
    played = collect.episodes(run, 2 * env.episode_length, seed=1, sampled=False)
    for expected in ([1, 0.5, 0, -0.5, -1], [0.5, 0.25, 0, -0.25, -0.5]):  # a step costs 2
        steps = next(played)[1]
        np.testing.assert_allclose(steps.action[:, 0], expected)
        assert np.shape(steps.obs) == (6, 3)  # the task's own, without what is left


def test_an_episode_ends_where_it_terminates_or_runs_out_of_time_and_the_rest_is_left_out():
    """Lives of 2 to 6 steps, and time for 5. A step that is taken after the end would be counted."""
    env = Ticker(lives=(2, 6))
    algo = SimpleNamespace(
        policy=Policy(lambda learned: (), lambda learned, carry, obs, key: (obs[:1], carry, {})),
        task=lambda learned: env,
    )
    run: Any = SimpleNamespace(algo=algo, env=env, learned=np.zeros(1))
    played = collect.episodes(run, 50 * env.episode_length, seed=1, sampled=False)
    ends = set()
    for _ in range(50):
        made = collect.arrays(next(played)[1])
        steps, life = len(made["reward"]), int(made["obs"][0, 2])
        assert steps == min(life, 5)
        assert made["next_obs"][:, 1].tolist() == [*range(1, steps + 1)]
        for name, at_end in (("terminated", life <= 5), ("truncated", life > 5)):
            assert made[name].tolist() == [False] * (steps - 1) + [at_end]
        ends.add(life)
    assert ends == {2, 3, 4, 5, 6}


def test_an_episode_with_a_number_that_is_not_finite_is_left_out(run):
    """Every second one, of the second policy. A run that plays no other one is refused."""
    opened = open_run(run, (TOY,))

    def holed(policies: slice) -> Any:
        def act(learned, carry, obs, key):
            action, carry, extras = opened.algo.policy.act(learned["own"], carry, obs, key)
            return action + learned["hole"], carry, extras

        hole = np.zeros(2, np.float32)
        hole[policies] = np.nan
        algo = opened.algo._replace(
            policy=Policy(lambda learned: (), act), task=lambda learned: opened.env
        )
        return opened._replace(algo=algo, learned={"own": opened.learned, "hole": hole})

    made = collect.collect([collect.Ingredient(holed(slice(1, 2)), 1.0)], 60)
    assert made.policy.tolist() == [0] * 60 and np.isfinite(made.data.action).all()
    assert made.recipe["runs"][0]["episodes"] == 3
    with pytest.raises(ConfigError, match="plays episodes with numbers that are not finite"):
        collect.collect([collect.Ingredient(holed(slice(0, 2)), 1.0)], 60)


def test_a_run_that_terminates_gives_shorter_episodes():
    alive = np.array([True, True, False])
    terminated = np.array([False, True, True])
    x = np.arange(3, dtype=np.float32)
    obs = np.arange(4, dtype=np.float32)[:, None]
    recorded: Any = (obs, x[:, None], x, x, x[:, None], terminated, alive)
    steps = collect.Steps(*recorded)
    made = collect.arrays(steps)
    assert made["terminated"].tolist() == [False, True] and not made["truncated"].any()
    assert made["next_obs"][:, 0].tolist() == [1, 2]


# ---- formats -----------------------------------------------------------------------------------


def made(ends: str = "..t..T.c..T"):
    """A data set with 3 numbers a step: t terminates, T runs out of time, c is cut, as is the end."""
    rng, n = np.random.default_rng(0), len(ends)
    marks = np.array(list(ends))
    numbers = rng.normal(size=(n + 1, 3)).astype(np.float32)
    costs = {"a": rng.normal(size=n), "b": rng.normal(size=n)}
    obs, after = numbers[:-1], numbers[1:].copy()
    after[marks != "."] += 1  # a reset follows
    cut = marks == "c"
    return dataset.data_set(
        obs, rng.uniform(-1, 1, (n, 2)), rng.normal(size=n), rng.normal(size=n), after,
        marks == "t", marks == "T", costs, cut,
    ), cut  # fmt: skip


def test_episodes_are_found_and_those_that_are_cut_are_not_whole():
    data, _ = made("..t..T.c..")
    assert data.episodes.number.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 3, 3]
    assert data.episodes.whole.tolist() == [True, True, False, False]
    np.testing.assert_array_equal(data.episodes.first_obs, data.obs[[0, 3, 6, 8]])
    np.testing.assert_allclose(data.episodes.cost[1], data.cost[3:6].sum(), rtol=1e-6)


@pytest.mark.filterwarnings("error")  # as of a file that stays open
@pytest.mark.parametrize("ends", ["..t..T...T", "..t..T.c..T", "c.c.."])
@pytest.mark.parametrize("suffix", [".hdf5", ".npz"])
def test_our_files_come_back_bit_for_bit(tmp_path, suffix, ends):
    data, _ = made(ends)
    write_dataset(tmp_path / f"data{suffix}", data)
    assert_equal(read_dataset(str(tmp_path / f"data{suffix}")), data)


@pytest.mark.parametrize("suffix", [".hdf5", ".npz"])
def test_a_file_says_what_it_was_made_of(tmp_path, suffix):
    path, about = tmp_path / f"data{suffix}", {"recipe": '{"runs": []}', "commit": "ä", "count": 3}
    data, _ = made("..t..T...T")
    write_dataset(path, data, about=about)
    assert read_about(str(path)) == about
    assert_equal(read_dataset(str(path)), data)
    write_dataset(path, data)
    assert read_about(str(path)) == {}


def test_both_kinds_of_file_say_the_same(run, tmp_path):
    files = [tmp_path / f"data{suffix}" for suffix in (".hdf5", ".npz")]
    for out in files:
        assert typed("collect", str(run), TOY, "size=40", "seed=3", f"out={out}") == 0
    one, other = (read_about(str(path)) for path in files)
    assert one == other and {*one} == {"recipe", "env", "actions", "jaxsafe", "commit"}
    recipe = json.loads(one["recipe"])
    assert recipe["seed"] == 3 and recipe["runs"][0]["seeds"] == 2
    assert json.loads(one["env"])["name"] == "toys:Corridor"


def test_a_text_of_any_length_in_a_strangers_hdf5_is_passed_over(tmp_path):
    """Where one is damaged, HDF5 crashes the process, or never ends. Ours have a fixed length."""
    path, ours = tmp_path / "data.hdf5", {"env": "x" * 100_000, "commit": "", "count": 3}
    write_dataset(path, made()[0], about=ours)
    with h5py.File(path, "a") as file:
        assert all(file.attrs.get_id(name).dtype.kind in "iS" for name in file.attrs)
        file.attrs.update({"text": "text", "latin": np.bytes_(b"\xe4"), "several": [1, 2]})
    assert read_about(str(path)) == ours | {"latin": "\ufffd"}


@pytest.mark.parametrize("suffix", [".hdf5", ".npz"])
def test_data_of_another_task_is_told_by_both_names(tmp_path, suffix):
    path = str(tmp_path / f"data{suffix}")
    write_dataset(path, made()[0], about={"env": '{"name": "point_circle1\\u001b"}'})
    assert other_task(path, {"name": "point_circle2"}) == (
        f"warning: dataset={path} is of point_circle1?, and env=point_circle2; expected data of the "
        "same task"
    )
    for unknown in ('{"name": "point_circle2"}', "{}", "[]", "text", '{"name": 3}', 3, "[" * 9999):
        write_dataset(path, made()[0], about={"env": unknown})
        assert other_task(path, {"name": "point_circle2"}) == ""


def test_data_of_other_options_is_told_but_not_of_another_engine(tmp_path):
    path, env = str(tmp_path / "data.npz"), {"name": "point_goal1", "rules": "safety_gym", "new": 1}
    for more, option in (
        ({}, ""),
        ({"engine": "warp", "awake": 3, "old": 2}, ""),
        ({"rules": "safety_gymnasium"}, "env.rules=safety_gymnasium, and env.rules=safety_gym"),
        ({"wrap": {"frame_stack": 3}}, "env.wrap.frame_stack=3, and env.wrap.frame_stack=1"),
    ):
        said = {"name": "point_goal1", "rules": "safety_gym"} | more
        write_dataset(path, made()[0], about={"env": json.dumps(said)})
        ours = env | {"wrap": {"frame_stack": 1}, "engine": "c", "awake": 2}
        expected = f"warning: dataset={path} is of {option}; expected data of the same task"
        assert other_task(path, ours) == (expected if option else "")


def test_a_strangers_npz_says_nothing(tmp_path):
    for about in (np.zeros(3), np.array("text"), np.array("[1]"), np.array([{}], object)):
        np.savez(tmp_path / "data.npz", about=about)
        assert other_task(str(tmp_path / "data.npz"), {"name": "point_circle2"}) == ""


def test_a_file_with_dsrls_keys_written_by_h5py_alone_loads(tmp_path):
    data, _ = made("..t..T...T")
    data = data._replace(costs={})
    with h5py.File(tmp_path / "dsrl.hdf5", "w") as file:
        file.create_dataset("timeouts", data=data.truncated)
        for name, (field, _) in dataset.ARRAYS.items():
            file.create_dataset(name, data=getattr(data, field), compression="gzip")
    assert_equal(read_dataset(str(tmp_path / "dsrl.hdf5")), data)


def test_omnisafes_done_is_told_apart_by_the_length_of_the_episode(tmp_path):
    data, _ = made("..t..T.c..T")  # no episode but those that end by T has 3 steps, save the first
    kept = ("obs", "action", "reward", "cost", "next_obs")  # OmniSafe's names are ours
    columns = {name: getattr(data, name) for name in kept}
    columns["done"] = data.terminated | data.truncated
    np.savez(tmp_path / "omni.npz", **{k: x if x.ndim == 2 else x[:, None] for k, x in columns.items()})
    found = read_dataset(str(tmp_path / "omni.npz"), episode_length=3)
    for name in kept:
        np.testing.assert_array_equal(getattr(found, name), columns[name], err_msg=name, strict=True)
    assert found.truncated.nonzero()[0].tolist() == [2, 5, 10] and not found.terminated.any()
    assert found.episodes.number.tolist() == data.episodes.number.tolist()
    assert found.episodes.whole.tolist() == [True, True, False, True]
    found = read_dataset(str(tmp_path / "omni.npz"), episode_length=4)
    assert found.terminated.nonzero()[0].tolist() == [2, 5, 10]


@pytest.mark.parametrize(
    "name, x, message",
    [
        ("done", None, "has OmniSafe's names, and no done"),
        ("obs", None, "has OmniSafe's names, and no obs"),
        ("next_obs", np.zeros((4, 1)), "next_obs is [4, 1], expected [4, 3], as obs is"),
    ],
)
def test_what_a_file_of_omnisafes_lacks_is_one_line(tmp_path, name, x, message):
    arrays: dict[str, Any] = dict.fromkeys(("reward", "cost", "done"), np.zeros((4, 1)))
    arrays |= {"obs": np.zeros((4, 3)), "next_obs": np.zeros((4, 3)), "action": np.zeros((4, 2))}
    arrays[name] = x
    path = str(tmp_path / "omni.npz")
    np.savez(path, **{key: array for key, array in arrays.items() if array is not None})
    with pytest.raises(ConfigError) as error:
        read_dataset(path)
    assert message in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("extra", [0, 1])
def test_minaris_episodes_load(tmp_path, extra):
    data, _ = made("..t..T...T")
    folder = tmp_path / "set" / "data"
    folder.mkdir(parents=True)
    with h5py.File(folder / "main_data.hdf5", "w") as file:
        for k in (2, 0, 1):  # in any order
            own = data.episodes.number == k
            group = file.create_group(f"episode_{k}")
            group["observations"] = np.concatenate([data.obs[own], data.next_obs[own][-1:]])
            for name, field in (
                ("actions", "action"), ("rewards", "reward"), ("terminations", "terminated"),
                ("truncations", "truncated"),
            ):  # fmt: skip
                group[name] = getattr(data, field)[own]
            group["infos/cost"] = np.concatenate([np.zeros(extra, np.float32), data.cost[own]])
    assert_equal(read_dataset(str(tmp_path / "set")), data._replace(costs={}))


@pytest.mark.parametrize(
    "name, x, message",
    [
        ("rewards", None, "has no episode_0/rewards"),
        ("rewards", 1.0, "episode_0/rewards is float64[], expected numbers [n]"),
        ("observations", np.zeros((3, 2)), "expected numbers [n + 1, size], with the same n"),
        ("infos/cost", None, "has no episode_0/infos/cost; Minari has no other costs"),
        ("infos/cost", np.zeros(9), "infos/cost is float64[9], expected numbers [n], with the same n"),
    ],
)
def test_what_an_episode_of_minaris_lacks_is_one_line(tmp_path, name, x, message):
    steps = np.ones(3)
    arrays: dict[str, Any] = dict.fromkeys(("rewards", "terminations", "truncations"), steps)
    arrays |= {"observations": np.ones((4, 2)), "actions": np.ones((3, 1)), "infos/cost": steps}
    arrays[name] = x
    with h5py.File(path := tmp_path / "main_data.hdf5", "w") as file:
        for key, array in arrays.items():
            if array is not None:
                file[f"episode_0/{key}"] = array
    with pytest.raises(ConfigError) as error:
        read_dataset(str(path))
    assert message in str(error.value) and "\n" not in str(error.value)


def test_without_timeouts_the_episodes_are_not_known(tmp_path):
    data, _ = made()
    write_dataset(tmp_path / "data.hdf5", data._replace(episodes=()))
    assert read_dataset(str(tmp_path / "data.hdf5")).episodes == ()


def broken(tmp_path, change):
    path = tmp_path / "data.hdf5"
    write_dataset(path, made()[0])
    with h5py.File(path, "a") as file:
        del file["costs"]
        change(file)
    with pytest.raises(ConfigError) as error:
        read_dataset(str(path))
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_strangers_hdf5_reads_no_other_file_and_takes_no_more_memory_than_it_has(tmp_path):
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(44))
    with h5py.File(tmp_path / "other.hdf5", "w") as file:
        file["costs"] = np.zeros(11, np.float32)

    def external(file):
        file.create_dataset("costs", (11,), "f4", external=[(str(secret), 0, 44)])

    def virtual(file):
        layout = h5py.VirtualLayout((11,), "f4")
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.hdf5"), "costs", (11,))
        file.create_virtual_dataset("costs", layout)

    def linked(file):
        file["costs"] = h5py.ExternalLink(str(tmp_path / "other.hdf5"), "costs")

    def bomb(file):
        file.create_dataset("costs", (10**14,), "f4", chunks=(10**6,), compression="gzip")

    assert "costs is not kept in the file itself" in broken(tmp_path, external)
    assert "costs is not kept in the file itself" in broken(tmp_path, virtual)
    assert "has no costs" in broken(tmp_path, linked)
    assert "unpacks to" in broken(tmp_path, bomb)
    assert "expected numbers" in broken(tmp_path, lambda file: file.create_dataset("costs", data="x"))
    assert "expected numbers [n]" in broken(
        tmp_path, lambda file: file.create_dataset("costs", data=1.0)
    )


def test_what_a_torn_npz_holds_is_not_said_at_length(tmp_path):
    path = tmp_path / "data.npz"
    write_dataset(path, made()[0])
    torn = bytearray(path.read_bytes())
    torn[26:28] = (1000).to_bytes(2, "little")  # the length of the first array's name
    path.write_bytes(torn)
    with pytest.raises(ConfigError, match=r"cannot be read as \.npz: File name in") as error:
        read_dataset(str(path))
    assert len(str(error.value)) < len(str(path)) + 250


@pytest.mark.parametrize(
    "size, message",
    [
        (4, r"is neither \.hdf5 nor \.npz"),
        (100, r"cannot be read as \.hdf5"),
        (2000, r"cannot be read as \.hdf5"),
    ],
)
def test_a_torn_hdf5_is_one_line(tmp_path, size, message):
    path = tmp_path / "data.hdf5"
    write_dataset(path, made()[0])
    os.truncate(path, size)
    with pytest.raises(ConfigError, match=message):
        read_dataset(str(path))
