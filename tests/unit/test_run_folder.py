import dataclasses
import json
import lzma
import math
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from disk import full_beyond
from toys import Ticker, reflex

from jaxsafe.config import ConfigError
from jaxsafe.learn.acting import course
from jaxsafe.report import evaluation, plots, scores, stats
from jaxsafe.run import checkpoint, evaluate, files, run_folder
from jaxsafe.run.checkpoint import Progress
from jaxsafe.run.run_folder import Board, Metrics, read_config, read_metrics


def write(folder, iterations, resume_at=0):
    log = Metrics(folder, ["train/cost", "train/return"], resume_at)
    for i in iterations:
        values = {"train/return": [i, math.nan], "train/cost": [0.1, 2.0]}
        log.append(Progress(i, 10 * i, 2 * i), [4, 5], float(i), values)
    log.close()
    return log


def test_metrics_have_a_row_for_each_seed_and_empty_cells_for_no_value(tmp_path):
    write(tmp_path, [1])
    assert (tmp_path / "metrics.csv").read_text().splitlines() == [
        "iteration,steps,updates,seed,seconds,train/cost,train/return",
        "1,10,2,4,1.000,0.1,1.0",
        "1,10,2,5,1.000,2.0,",
    ]
    assert np.isnan(read_metrics(tmp_path)["train/return"][1])


def test_resuming_drops_rows_after_the_checkpoint_and_a_torn_last_line(tmp_path):
    write(tmp_path, [1, 2, 3, 4])
    whole = (tmp_path / "metrics.csv").read_text()
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write("5,50,10,4,5.0")
    log = write(tmp_path, [3, 4], resume_at=2)
    assert (tmp_path / "metrics.csv").read_text() == whole
    assert log.seconds == 2.0


def test_packed_metrics_are_read_like_the_plain_ones(tmp_path):
    write(tmp_path, [1, 2])
    plain, path = read_metrics(tmp_path), tmp_path / "metrics.csv"
    path.with_name("metrics.csv.xz").write_bytes(lzma.compress(path.read_bytes() + b"3,30,6,4"))
    path.unlink()
    packed = read_metrics(tmp_path)
    assert packed.keys() == plain.keys()
    for name, column in plain.items():
        np.testing.assert_array_equal(packed[name], column)
    for text in (b"not packed", lzma.compress(b"iteration,seed\n1,many\n")):
        path.with_name("metrics.csv.xz").write_bytes(text)
        with pytest.raises(ConfigError, match=r"metrics.csv.xz cannot be read: "):
            read_metrics(tmp_path)


def test_a_run_whose_metrics_are_packed_continues_with_all_its_rows(tmp_path):
    write(tmp_path, [1, 2, 3])
    path = tmp_path / "metrics.csv"
    whole = path.read_text()
    path.with_name("metrics.csv.xz").write_bytes(lzma.compress(path.read_bytes()))
    path.unlink()
    log = write(tmp_path, [3], resume_at=2)
    assert (path.read_text(), log.seconds) == (whole, 2.0)
    assert read_metrics(tmp_path)["iteration"].tolist() == [1, 1, 2, 2, 3, 3]


def test_an_error_of_the_disk_names_the_file(tmp_path):
    log, board, text = Metrics(tmp_path, ["train/cost"], 0), Board(tmp_path, 0), tmp_path / "a.txt"
    row = Progress(1, 10, 2), [*range(99)], 1.0, {"train/cost": np.ones(99)}
    with full_beyond(500):
        for path, write_to in (
            (log.path, lambda: log.append(*row)),
            (log.path, log.sync),
            (log.path, log.close),
            (board.path, lambda: [board.append(i, {"a": 1.0}) for i in range(999)]),
            (board.path, board.flush),
            (board.path, board.close),
            (text, lambda: files.write(text, 999 * " ")),
        ):
            with pytest.raises(OSError, match="File too large") as error:
                write_to()
            assert error.value.filename == str(path)


def test_metrics_of_other_columns_are_refused(tmp_path):
    write(tmp_path, [1])
    with pytest.raises(ConfigError, match="other columns"):
        Metrics(tmp_path, ["train/return"], 1)


@pytest.mark.parametrize(
    "text",
    ["", "a: [", "env: 3", "!!python/object/apply:os.system ['touch owned']", "\x00", "env: {name: 3}"],
)
def test_a_strangers_config_is_read_as_plain_values_or_refused_in_one_line(tmp_path, monkeypatch, text):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ConfigError) as error:
        read_config(tmp_path)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "owned").exists()


def test_a_folder_without_config_is_no_run(tmp_path):
    with pytest.raises(ConfigError, match="not a run folder"):
        read_config(tmp_path)


def test_curves_carry_the_last_value_over_iterations_without_an_episode():
    metrics = {
        "steps": np.array([1, 1, 2, 2, 3, 3.0]),
        "seed": np.array([0, 1, 0, 1, 0, 1.0]),
        "x": np.array([np.nan, 5, 2, np.nan, np.nan, 7]),
    }
    _, values = plots.by_seed(metrics, "x")
    np.testing.assert_array_equal(values, [[np.nan, 2, 2], [5, 5, 7]])


def test_curves_are_drawn_of_several_seeds_and_no_picture_of_none(tmp_path):
    write(tmp_path, [1, 2, 3])
    plots.curves(read_metrics(tmp_path), tmp_path / "several.png", "title", 25.0)
    plots.curves({}, tmp_path / "none.png", "title", 25.0)
    assert (tmp_path / "several.png").stat().st_size > 1000
    assert not (tmp_path / "none.png").exists()


def test_an_interval_is_over_seeds_and_of_one_seed_over_its_episodes():
    two = np.array([[0.0, 8.0], [6.0, 6.0]])
    over_seeds = evaluation.estimate_over_seeds("return", two)
    assert over_seeds == stats.estimate(np.array([4.0, 6.0]))
    assert evaluation.estimate_over_seeds("return", two[:1]) == stats.estimate(two[0])


def test_discounted_sums_and_named_costs_of_an_episode_by_hand():
    player = reflex(lambda obs: obs[:1], Ticker(lives=(3, 3)))
    three = evaluate.totals(course(player, jax.random.key(0)), 0.5, 0.1)
    assert (three.ret, three.length) == (3, 3) and three.cost == 6  # 1 and 2 a step
    np.testing.assert_allclose(three.discounted_ret, 1 + 0.5 + 0.25)
    np.testing.assert_allclose(three.discounted_cost, 2 * (1 + 0.1 + 0.01), rtol=1e-6)
    own = evaluate.Episodes(*(np.asarray(x)[None, None] for x in three))
    a, b = own.costs[0, 0]
    found = evaluate.measures(own, ("a", "b"), {"a": a - 0.5, "b": b})
    assert [found[f"cost {name}"].item() for name in "ab"] == [a, b]
    assert [found[k].item() for k in (f"a over {a - 0.5:g}", f"b over {b:g}")] == [True, False]
    assert found["violation rate"].item() == 1 and not {"cost wall", "goals"} & found.keys()


def test_the_only_cost_has_a_row_of_its_own_where_it_has_a_limit_of_its_own():
    one = evaluate.Episodes(*[np.ones((1, 1))] * len(evaluate.Episodes._fields))
    one = one._replace(costs=np.full((1, 1, 1), 7.0))
    assert evaluate.measures(one, ("a",), {"a": 9.0})["cost a"].item() == 7
    assert "cost a" not in evaluate.measures(one, ("a",), {"": 9.0})


def test_goals_of_an_episode_are_counted_until_its_end():
    class Scoring(Ticker):
        def reset(self, key):
            return dataclasses.replace(super().reset(key), info={"goal_met": jnp.float32(0)})

        def step(self, state, action):
            after = super().step(state, action)
            return dataclasses.replace(after, info={"goal_met": jnp.float32(after.obs[1] != 2)})

    player = reflex(lambda obs: obs[:1], Scoring(episode_length=9, lives=(4, 4)))
    four = evaluate.totals(course(player, jax.random.key(0)))
    own = evaluate.Episodes(*(np.asarray(x)[None, None] for x in four))
    assert evaluate.measures(own, ("a", "b"), {"": 9.0})["goals"].item() == 3


def test_cost_rate_is_total_cost_over_total_steps_of_each_seed():
    metrics = {"seed": np.array([0, 1, 0, 1.0]), "train/cost_rate": np.array([0.1, 0.2, 0.3, 0.4])}
    rate = evaluation.cost_rate(metrics)
    assert rate is not None
    np.testing.assert_allclose(rate, [0.2, 0.3])


def test_unconstrained_ppo_scores_one_and_a_safe_policy_violates_by_zero():
    for env, ppo in scores.CHARACTERISTIC.items():
        assert scores.normalized_return(env, ppo.ret) == 1
        assert scores.normalized_violation(env, ppo.cost, 25.0) == pytest.approx(1)
        assert str(scores.normalized_violation(env, 3.0, 25.0)) == "0.0"
    assert len(scores.CHARACTERISTIC) == 18


def test_dsrls_scores_by_hand():
    for env, (least, largest) in scores.DSRL.items():
        assert [scores.dsrl_return(env, x) for x in (least, largest)] == [0, 1]
    assert [scores.dsrl_cost(np.float64(x), 20.0) for x in (0, 10, 20, 50)] == [0, 0.5, 1, 2.5]
    assert [scores.dsrl_cost(np.float64(x), 0.0) for x in (0, 3)] == [1, 4]


def test_a_seed_within_the_limit_does_not_excuse_one_that_violates():
    found = {"return": np.zeros((2, 2)), "cost": np.array([[0.0, 10.0], [40.0, 60.0]])}
    rows = evaluation.summary("point_goal1", found, 25.0, {"seed": np.empty(0)})
    room = scores.CHARACTERISTIC["point_goal1"].cost - 25
    assert rows["normalised violation"].mean == pytest.approx((0 + 25 / room) / 2)  # of costs 5 and 50


def test_only_the_limit_in_force_gives_scores():
    found = {"return": np.zeros((1, 2)), "cost": np.array([[40.0, 60.0]])}
    episodes = np.zeros(2), np.zeros(2), np.ones(2), np.array([5.0, 30.0]), np.array([True, True])
    data = SimpleNamespace(episodes=episodes)

    def of(limit: float | None) -> set[str]:
        rows = evaluation.summary("point_goal1", found, limit, {"seed": np.empty(0)})
        rows |= evaluation.dsrl_scores("point_goal1", rows, limit) | evaluation.of_data(data, limit)
        return {*rows}

    assert of(25.0) - of(None) == {"normalised violation", "DSRL cost", "data best safe return"}
    assert {"normalised return", "data return", "data cost"} <= of(None) < of(25.0)


def test_the_datas_own_rows_are_of_its_whole_episodes_alone():
    """The best of them earns 9 and is cut off, the next costs 26."""
    ret, cost = np.array([1.0, 3.0, 8.0, 9.0]), np.array([0.0, 25.0, 26.0, 1.0])
    whole = np.array([True, True, True, False])
    data = SimpleNamespace(episodes=(np.zeros(4), np.zeros(4), ret, cost, whole))
    rows = {name: e.mean for name, e in evaluation.of_data(data, 25.0).items()}
    assert rows == {"data return": 4.0, "data cost": 17.0, "data best safe return": 3.0}
    assert "data best safe return" not in evaluation.of_data(data, -1.0)
    none = SimpleNamespace(episodes=(np.zeros(4), np.zeros(4), ret, cost, whole & False))
    assert evaluation.of_data(none, 25.0) == {}


def test_progress_reads_the_newest_manifest(tmp_path):
    assert run_folder.newest_progress(tmp_path) is None
    for done in (Progress(3, 30, 6), Progress(4, 40, 8)):
        newest = checkpoint.save(tmp_path / "checkpoints", {"x": np.ones(2)}, done)
    assert run_folder.newest_progress(tmp_path) == Progress(4, 40, 8)
    (newest / "manifest.json").write_text("{")
    assert run_folder.newest_progress(tmp_path) == Progress(3, 30, 6)


def test_the_command_of_a_run_is_recorded_as_it_was_typed(tmp_path, monkeypatch):
    # `as_hydra_reads` puts ++ before a named limit, which the command line does not take
    monkeypatch.setattr(sys, "argv", ["train.py", "algo=cpo", "++algo.cost_limits.hazards=5"])
    run_folder.append_versions(tmp_path, "cpu", None)
    (start,) = json.loads((tmp_path / "versions.json").read_text())
    assert start["command"].endswith(" train.py algo=cpo algo.cost_limits.hazards=5")


def test_the_command_jaxsafe_is_recorded_without_python():
    assert run_folder.typed_command(["jaxsafe train", "env=point_goal1", "tag=a b"]) == (
        "jaxsafe train env=point_goal1 'tag=a b'"
    )
