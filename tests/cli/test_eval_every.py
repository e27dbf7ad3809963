"""Evaluation during training: when, of what, and that training does not notice it."""

from pathlib import Path

import numpy as np
import pytest
from shell import SMALL, STEPS, call, typed
from toys import run_episodes

from jaxsafe.report import plots, read, studies
from jaxsafe.run import checkpoint, run_folder
from jaxsafe.run.evaluate import COLUMNS
from jaxsafe.run.policies import open_run

END = 10 * STEPS
EVERY = 3 * STEPS - 1  # crossed by iterations 3, 6, 9
DUE = [3, 6, 9, 10]


def arrays(run: Path) -> dict[str, np.ndarray]:
    return checkpoint.load(run / "checkpoints")[0]


def due(run: Path) -> list[float]:
    """The iterations that were evaluated."""
    table = run_folder.read_metrics(run)
    known = np.isfinite(np.stack([table[name] for name in COLUMNS]))
    assert (known.all(0) == known.any(0)).all()
    return np.unique(table["iteration"][known[0]]).tolist()


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    run = tmp_path_factory.mktemp("watched") / "run"
    args = (*SMALL, f"total_steps={END}", f"eval_every={EVERY}", "num_seeds=2", f"run_dir={run}")
    assert typed("train", *args) == 0
    return run


def test_every_iteration_that_crosses_a_multiple_and_the_last_one_are_evaluated(watched):
    assert due(watched) == DUE
    text = (watched / "metrics.csv").read_text().splitlines()
    assert text[1].endswith(",,,,") and not text[-1].endswith(",")


def test_the_last_row_is_what_fresh_episodes_of_the_policies_make(watched):
    run = open_run(watched, ("env=toys:Corridor",))
    table = run_folder.read_metrics(watched)
    for end, sampled in (("", False), ("_sampled", True)):
        found = run_episodes(run.algo, run.learned, 2, 0, sampled)
        np.testing.assert_allclose(table[f"eval/return{end}"][-2:], found.ret.mean(1), rtol=1e-5)
        np.testing.assert_allclose(table[f"eval/cost{end}"][-2:], found.cost.mean(1), rtol=1e-5)
    assert (table["eval/return"][-2:] != table["eval/return_sampled"][-2:]).all()


def test_a_study_shows_what_sampled_actions_make_in_the_end(watched):
    table, limits = run_folder.read_metrics(watched), {"": 25.0}
    values = read.measured("", table, limits)
    for what in ("return", "cost"):
        np.testing.assert_array_equal(
            values[f"final sampled {what}"], table[f"eval/{what}_sampled"][-2:]
        )
    values |= {"final return": np.array([1.0, 3.0]), "final cost": np.array([5.0, 5.0])}
    run = read.SettingRun(watched, "", {}, limits, table, np.arange(2.0), values)
    mean, _, drawn = studies.final_policy(run, "-").partition("; sampled: ")
    assert mean == "2.00, cost 5.00"  # two seeds have no interval
    ret, cost = (values[f"final sampled {what}"].mean() for what in ("return", "cost"))
    assert drawn == f"{ret:.2f}, cost {cost:.2f}"
    cut = {name: x[:-4] for name, x in table.items()}  # ends in an iteration without evaluation
    assert "final sampled return" not in read.measured("", cut, limits)


def test_training_is_the_same_without_evaluation_which_may_change_on_resumption(watched, tmp_path):
    run = tmp_path / "run"
    args = (*SMALL, "num_seeds=2", f"run_dir={run}")
    assert typed("train", *args, f"total_steps={4 * STEPS}", "eval_episodes=0") == 0
    assert not {*COLUMNS} & run_folder.read_metrics(run).keys()
    assert typed("train", *args, f"total_steps={6 * STEPS}", f"eval_every={EVERY}", "resume=true") == 0
    assert due(run) == [6]
    assert typed("train", *args, f"total_steps={END}", "resume=true") == 0
    assert due(run) == [6]
    table, other = run_folder.read_metrics(run), run_folder.read_metrics(watched)
    assert {*table} == {*other} and len(table["steps"]) == len(other["steps"])
    # the learning rates of later rows are not the same: they decay to the end of each run
    np.testing.assert_array_equal(table["train/kl"][:2], other["train/kl"][:2])


def test_parameters_are_bit_identical_with_and_without_evaluation(watched, tmp_path):
    args = (*SMALL, f"total_steps={END}", "num_seeds=2", f"run_dir={tmp_path / 'run'}")
    assert typed("train", *args, "eval_episodes=0") == 0
    left, right = arrays(watched), arrays(tmp_path / "run")
    assert left.keys() == right.keys()
    for name in left:
        np.testing.assert_array_equal(left[name], right[name], err_msg=name)


def test_a_lone_seed_split_over_devices_is_evaluated(tmp_path):
    args = (*SMALL, "total_steps=128", "eval_every=64", "eval_episodes=2", "devices=2")
    status, out, err = call("train", *args, "run_dir=run", cwd=tmp_path, JAX_NUM_CPU_DEVICES="2")
    assert status == 0, out + err
    assert due(tmp_path / "run") == [1, 2]


def test_curves_show_evaluations_as_points_on_dashed_lines(watched, monkeypatch, tmp_path):
    drawn = []

    def savefig(figure, *_: object, **__: object) -> None:
        drawn.append(figure)

    monkeypatch.setattr(plots.Figure, "savefig", savefig)
    plots.curves(run_folder.read_metrics(watched), tmp_path / "curves.png", "title", 25.0)
    assert [axes.get_ylabel() for axes in drawn[0].axes] == [label for _, label in plots.PANELS]
    for axes in drawn[0].axes:
        lines = {line.get_label(): line for line in axes.lines}
        for name in ("evaluated, mean action", "evaluated, sampled"):
            line = lines[name]
            assert line.get_linestyle() == "--" and line.get_marker() != "None"
            assert np.asarray(line.get_xdata()).tolist() == [STEPS * i for i in DUE]


@pytest.mark.parametrize(
    "options, message",
    [
        (["eval_every=-1"], "eval_every=-1: expected a whole number between 0 and"),
        (["eval_every=10", "eval_episodes=0"], "eval_every=10: expected eval_episodes of at least 1"),
    ],
)
def test_what_cannot_be_evaluated_is_one_line(tmp_path, capsys, options, message):
    assert typed("train", *SMALL, f"run_dir={tmp_path / 'run'}", *options) == 2
    assert message in capsys.readouterr().err
