"""What a run and an evaluation say while they go on."""

import math

import pytest
import rich.console

from jaxsafe.run import progress


def test_the_progress_line_says_that_a_cost_is_the_learners_estimate(capsys):
    def line(ret: float, cost: float) -> str:
        report.update(5, 1, ret, cost, math.nan)
        return capsys.readouterr().out

    report = progress.Reporter()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(progress, "PLAIN_EVERY", 0.0)
        report.start(10, 0, [25.0], "updates")
        assert "return 3  cost 9/25  left" in line(3.0, 9.0)  # an evaluation
        assert "return 3  estimated cost -0.549/25  left" in line(math.nan, -0.549)
        assert "return 4  estimated cost -0.5/25  left" in line(4.0, -0.5)  # its return is evaluated
        report.start(10, 0, [25.0])
        assert "return -  cost 9/25  left" in line(math.nan, 9.0)  # of the steps of an iteration


def test_a_notebook_has_one_line_that_changes(monkeypatch, capsys):
    monkeypatch.setattr(rich.console, "_is_jupyter", lambda: True)
    monkeypatch.setattr(progress, "NOTEBOOK_EVERY", 0.0)
    with progress.Reporter() as report:
        report.line("first")
        report.start(100, 0, [25.0])
        for steps in (50, 100):
            report.update(steps, 1, ret=1.0, cost=2.0, lam=0.0)
        report.line("last")
    first, changing, last = capsys.readouterr().out.removesuffix("\n").split("\n")
    assert (first, last) == ("first", "last")
    assert [part[:4] for part in changing.split("\r")] == ["", " 50%", "100%"]


def test_a_task_that_takes_long_says_its_share_and_what_is_left(monkeypatch, capsys):
    """Ten parts of 3 s, of which the first compiles for 20 s more."""
    times = iter([0.0, *(23.0 + 3 * part for part in range(10))])
    monkeypatch.setattr(progress.time, "perf_counter", lambda: next(times))
    report = progress.Reporter()
    for part in range(11):
        report.going("evaluating", part / 10)
    assert capsys.readouterr().out.splitlines() == [
        " 10%  evaluating",
        " 30%  evaluating  left 0:21",
        " 50%  evaluating  left 0:15",
        " 70%  evaluating  left 0:09",
        " 90%  evaluating  left 0:03",
    ]


def test_a_task_of_a_moment_says_nothing(monkeypatch, capsys):
    times = iter([0.0, 0.3, 0.6])
    monkeypatch.setattr(progress.time, "perf_counter", lambda: next(times))
    report = progress.Reporter()
    for share in (0.0, 0.5, 1.0):
        report.going("evaluating", share)
    assert capsys.readouterr().out == ""


def test_on_a_terminal_the_line_of_a_task_changes_and_is_gone_at_the_end(monkeypatch, capsys):
    monkeypatch.setattr(progress, "MOMENT", 0.0)
    report = progress.Reporter(rich.console.Console(force_terminal=True, width=12))
    for share in (0.0, 0.5, 1.0):
        report.going("evaluating", share)
    report.line("found")
    assert capsys.readouterr().out == "\r 50%  evalu\r           \rfound\n"
