"""A run that goes wrong says so: what stops being finite, what takes long, episodes that do not end."""

import dataclasses
import math
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from shell import SMALL, STEPS, TOY, rows, start, typed, wait_for
from tensorboard_events import tags
from toys import Ticker, reflex

from jaxsafe.learn import steps
from jaxsafe.learn.acting import course
from jaxsafe.report import plots
from jaxsafe.report.group import group
from jaxsafe.report.read import read
from jaxsafe.run import checkpoint, evaluate, run_folder
from jaxsafe.run.divergence import PATIENCE, Health, Lost, Watch, health, lost_by, read_lost, write_lost
from jaxsafe.run.programs import Member


def diverged(capsys: pytest.CaptureFixture, *args: str) -> str:
    """The line with which a run of the toy ends."""
    assert typed("train", *SMALL, "run_dir=run", *args) == 3
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    return err


def test_a_run_whose_parameters_are_not_finite_stops_and_names_the_setting(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(steps, "remaining", lambda iteration, cfg: jnp.inf)  # the rate is infinite
    line = diverged(capsys, "algo.lr_decay=true", f"total_steps={50 * STEPS}")
    assert "diverged at 64 steps: params.actor" in line and "unusual: algo." in line
    assert (
        not checkpoint.checkpoints(Path("run/checkpoints")) and not Path("run/evaluation.json").exists()
    )
    assert len(rows(Path("run"))) - 1 <= 2  # it is noticed an iteration late at most
    (lost,) = read_lost(Path("run"))
    assert (lost.iteration, lost.seed, lost.setting) == (1, 0, "") and lost.why in line
    (found,) = group(read([Path("run")]), ["algo.name"])
    assert found.held == "diverged" and found.diverged == [0]


def test_a_run_in_which_nothing_is_learned_stops_and_says_why(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    line = diverged(capsys, "env=toys:Lost", f"total_steps={50 * STEPS}")
    assert (
        f"nothing was learned in {PATIENCE} iterations, as the reward of worlds is not finite" in line
    )
    assert all(math.isnan(x) for x in run_folder.read_metrics(Path("run"))["train/cost_estimate"])


def test_bad_worlds_are_said_once_and_the_run_goes_on(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    args = (*SMALL, "env=toys:Sometimes", "run_dir=run", f"total_steps={6 * STEPS}")
    assert typed("train", *args, "eval_episodes=0") == 0
    out = capsys.readouterr().out
    assert out.count("worlds had a step that is not finite (cost)") == 1
    table = run_folder.read_metrics(Path("run"))
    assert table["train/bad_worlds"].sum() == table["train/bad_cost"].sum() > 0
    assert (table["train/cost_estimate"] == 10).all() and (table["train/nonfinite"] == 0).all()


def member(seed: int) -> Member:
    return Member(None, seed, {})


def test_of_several_members_the_others_go_on():
    watch = Watch([member(0), member(1)], lambda m: f"about {m.seed}")
    values = {"train/nonfinite": np.zeros(2)}
    params = {"a": jnp.array([[1.0], [jnp.nan]]), "config": jnp.array([[jnp.inf], [0.0]])}
    assert watch(5, "5 steps", values, health(params)) == [
        "seed 1 diverged at 5 steps: a is not finite; about 1"
    ]
    assert watch(6, "6 steps", values, health(params)) == [] and not watch.over
    again = Watch([member(0), member(1)], str, watch.lost.values())  # resumed: it is said already
    assert again(6, "6 steps", values, health(params)) == [] and again.lost == watch.lost
    params["a"] = params["a"] * jnp.nan
    assert len(watch(7, "7 steps", values, health(params))) == 1 and watch.over


def test_members_lost_after_a_checkpoint_are_forgotten_on_resumption(tmp_path):
    early, late = Lost(3, 0, "", "early"), Lost(9, 1, "", "late")
    assert lost_by(tmp_path, 5) == []
    write_lost(tmp_path, [early, late])
    assert lost_by(tmp_path, 5) == [early] == read_lost(tmp_path)
    assert lost_by(tmp_path, 0) == [] and not [*tmp_path.iterdir()]


def test_a_member_that_skips_some_updates_or_moves_is_not_given_up():
    watch = Watch([member(0)], str)
    bad, good = ({"train/nonfinite": np.array([x])} for x in (1.0, 0.0))

    def at(mark: int) -> Health:
        return Health({}, jnp.array([mark], jnp.uint32))

    for i in range(3 * PATIENCE):  # it moves in spite of what is skipped
        assert watch(0, "", bad, at(i)) == []
    for _ in range(3 * PATIENCE):  # nothing is skipped: a step that is rejected, a learning rate of 0
        assert watch(0, "", good, at(0)) == []
    lines = [watch(0, "", bad, at(0)) for _ in range(PATIENCE)]
    assert [len(x) for x in lines] == [0] * (PATIENCE - 1) + [1]
    assert "the gradient of the loss is not finite" in lines[-1][0]


def test_the_mark_of_parameters_changes_with_any_of_them():
    x = jax.random.normal(jax.random.key(0), (2, 3, 4))
    marks = {int(health({"w": x.at[0, i, j].add(1e-3)}).mark[0]) for i in range(3) for j in range(4)}
    swapped = health({"w": x[:, ::-1]}).mark
    assert len(marks | {int(health({"w": x}).mark[0]), int(swapped[0])}) == 14


# ---- evaluation ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Broken(Ticker):
    """A ticker of which nothing is finite after it terminated."""

    def step(self, state, action):
        after = super().step(state, action)
        over = after.obs[1] > after.obs[2]
        gone = {k: jnp.where(over, jnp.nan, getattr(after, k)) for k in ("reward", "cost", "costs")}
        return dataclasses.replace(after, **gone)


def test_what_comes_after_the_end_of_an_episode_does_not_count():
    player = reflex(lambda obs: obs[:1], Broken(episode_length=9, lives=(3, 3)))
    found = evaluate.totals(course(player, jax.random.key(0)))
    assert (found.ret, found.cost, found.length) == (3, 6, 3)


def test_a_cost_that_is_not_known_is_neither_within_the_limit_nor_over_it():
    sums = np.array([[1.0, np.nan, 3.0]])
    episodes = evaluate.Episodes(sums, sums, sums[..., None], sums, sums, sums, sums)
    rate = evaluate.measures(episodes, ("a",), {"": 2.0})["violation rate"]
    np.testing.assert_array_equal(rate, [[0, np.nan, 1]])


# ---- before the first episode ends -----------------------------------------------------------------


@pytest.fixture(scope="module")
def short(tmp_path_factory) -> Path:
    """A run of so few steps that no episode ended."""
    run = tmp_path_factory.mktemp("short") / "run"
    args = (TOY, *SMALL[1:], "algo.stagger=false", "algo.horizon=4", "eval_episodes=1")
    assert typed("train", *args, "total_steps=48", f"run_dir={run}") == 0
    assert np.isnan(run_folder.read_metrics(run)["train/return"]).all()
    return run


def labels(figure: Figure) -> list[str]:
    return [text for axes in figure.axes for text in axes.get_legend_handles_labels()[1]]


def test_curves_draw_estimates_dashed_until_an_episode_ends(short, tmp_path, monkeypatch):
    drawn: list[Figure] = []
    monkeypatch.setattr(plots, "write", lambda figure, path, **how: drawn.append(figure))
    plots.curves(run_folder.read_metrics(short), tmp_path / "curves.png", "title", 25.0)
    assert labels(drawn[0]).count(plots.ESTIMATED) == 2
    for axes in drawn[0].axes:
        line = axes.get_lines()[0]
        assert line.get_linestyle() == "--" and np.isfinite(np.asarray(line.get_ydata())).all()


def test_comparisons_use_estimates_until_an_episode_ends_and_say_so(short, tmp_path, capsys):
    (run,) = read([short])
    assert run.estimated and np.isfinite(run.values["return"]).all()
    assert typed("plot", str(short), "--out", str(tmp_path / "out")) == 0
    out = capsys.readouterr().out
    assert f"estimates, as no episode ended yet: {short}" in out


def test_tensorboard_has_estimates_until_an_episode_ends(short, finished):
    (file,) = short.glob("tensorboard/seed0/events*")
    assert "train/return (estimate, no episode ended yet)" in tags(file)
    (file,) = finished.glob("tensorboard/seed0/events*")
    assert "train/return" in tags(file)


# ---- stages and signals ---------------------------------------------------------------------------


def test_the_evaluation_is_announced(short, capsys):
    assert typed("train", f"resume={short}", TOY) == 0
    out = capsys.readouterr().out
    assert out.index("evaluating 1 x 1 episodes ...") < out.index("final policy")


def test_a_terminal_that_closes_leaves_a_checkpoint(tmp_path):
    run = tmp_path / "run"
    process: Any = start("train", *SMALL, "run_dir=run", "total_steps=1e8", cwd=tmp_path)
    wait_for(lambda: (run / "metrics.csv").exists() and len(rows(run)) > 2, process)
    process.stdout.close()  # nobody listens any more
    process.send_signal(signal.SIGHUP)
    process.send_signal(signal.SIGHUP)  # from the shell, and from the system
    process.wait(timeout=60)
    assert run_folder.newest_progress(run) is not None
