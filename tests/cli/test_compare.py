"""Comparisons of runs written by hand, on the real registries."""

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image
from shell import typed

from jaxsafe import algos, envs
from jaxsafe.config import ConfigError
from jaxsafe.report import (
    comparison_tables,
    evaluation,
    group,
    looks,
    plots,
    read,
    scores,
    stats,
    studies,
    sweep_summary,
    tables,
    trade_off,
)
from jaxsafe.report.published import Published, beside, end_beside, read_ends, read_published
from jaxsafe.report.stats import Estimate
from jaxsafe.run import run_folder
from jaxsafe.run.checkpoint import Progress
from jaxsafe.run.divergence import Lost, write_lost

RESULTS = Path(__file__).parent.parent.parent / "docs" / "results"
HEADER = "task,algo,source,return,return_std,cost,cost_std,cost_limit\n"


def write(
    folder: Path,
    env: str = "point_goal1",
    algo: str = "ppo_lag",
    returns: Any = (1.0, 3.0),
    costs: Any = (20.0, 40.0),
    seeds: Any = (0, 1),
    total_steps: int = 200,
    columns: Any = (),
    **options: Any,
) -> Path:
    """A run of 20 iterations of 10 steps: these returns and costs, a seed each, in the last two."""
    folder.mkdir(parents=True)
    config = {"env": {"name": env}, "algo": {"name": algo, **options}}
    train = {"total_steps": total_steps, "seed": seeds[0], "num_seeds": len(set(seeds))}
    run_folder.write_config(folder, config | train)
    more = dict(columns)
    log = run_folder.Metrics(folder, ["train/return", "train/cost", "train/cost_rate", *more], 0)
    for i in range(1, 21):
        late = i > 18
        values = {
            "train/return": late * np.array(returns),
            "train/cost": np.where(late, costs, 99.0),
            "train/cost_rate": np.full(len(returns), i / 100),
        }
        log.append(Progress(i, 10 * i, i), list(seeds), 0.0, values | more)
    log.close()
    return folder


def runs_in(*paths: Path) -> list[read.SettingRun]:
    return read.read(paths)


def compared(*paths: Path, by: tuple[str, ...] = ()) -> list[group.Group]:
    runs = runs_in(*paths)
    return group.ordered(group.group(runs, by or group.telling(runs)))


# ---- what is known of a run ------------------------------------------------------------------


def test_what_is_known_of_each_seed_by_hand(tmp_path):
    (run,) = runs_in(write(tmp_path / "a", columns={"train/cost_hazards": [4.0, 6.0]}))
    ppo = scores.CHARACTERISTIC["point_goal1"]
    expected = {
        "return": [1, 3],
        "cost": [20, 40],
        "violation rate": [0, 1],
        "cost rate": [0.105, 0.105],  # of all iterations: mean of 0.01 .. 0.20
        "cost hazards": [4, 6],
        "normalised return": [1 / ppo.ret, 3 / ppo.ret],
        "normalised violation": [0, 15 / (ppo.cost - 25)],
        "normalised cost rate": [0.105 / ppo.cost_rate] * 2,
    }
    assert run.values.keys() == expected.keys()
    for name, values in expected.items():
        np.testing.assert_allclose(run.values[name], values, rtol=1e-6, err_msg=name)


def test_a_published_cost_rate_is_of_steps_of_the_environment(tmp_path):
    """With an action repeated five times, a step of the policy has five of these."""
    folder = write(tmp_path / "a")
    config = run_folder.read_config(folder)
    config["env"]["wrap"] = {"action_repeat": 5}
    run_folder.write_config(folder, config)
    (run,) = runs_in(folder)
    expected = 0.105 / 5 / scores.CHARACTERISTIC["point_goal1"].cost_rate
    np.testing.assert_allclose(run.values["normalised cost rate"], expected, rtol=1e-6)
    found = {"return": np.zeros((2, 2)), "cost": np.zeros((2, 2))}
    rows = evaluation.summary("point_goal1", found, 25.0, run.table, 5)
    assert rows["normalised cost rate"].mean == pytest.approx(expected)


@pytest.mark.filterwarnings("error")
def test_the_cost_rate_of_a_seed_whose_every_step_was_bad_is_not_known():
    rates = np.array([0.25, 0.75, np.nan, 0.5, np.nan, np.nan])
    table = {"seed": np.array([0.0, 0.0, 1.0, 1.0, 2.0, 2.0]), "train/cost_rate": rates}
    np.testing.assert_array_equal(evaluation.cost_rate(table), [0.5, 0.5, np.nan])


def test_costs_under_limits_of_their_own_violate_when_one_of_them_does():
    table = {
        "iteration": np.array([1.0, 1.0]), "steps": np.array([1.0, 1.0]), "seed": np.array([0.0, 1.0]),
        "train/return": np.zeros(2), "train/cost": np.array([9.0, 9.0]),
        "train/cost_a": np.array([5.0, 5.0]), "train/cost_b": np.array([0.0, 1.0]),
        "train/cost_estimate_a": np.zeros(2),
    }  # fmt: skip
    values = read.measured("point_goal1", table, {"a": 5.0, "b": 0.5})
    np.testing.assert_array_equal(values["violation rate"], [0, 1])
    assert "cost estimate_a" not in values and "normalised violation" not in values


def test_evaluations_of_each_seed_join_in_where_the_run_has_them(tmp_path):
    a, b = write(tmp_path / "a"), write(tmp_path / "b", seeds=(2, 3))
    rows = evaluation.as_json({"return": Estimate(6.0, 5.0, float("nan"))})
    assert rows == {"return": {"mean": 6.0, "low": 5.0, "high": None}}
    (a / "evaluation.json").write_text(json.dumps(rows | {"seeds": {"return": [5.0, 7.0]}}))
    # as earlier versions wrote it
    (b / "evaluation.json").write_text(json.dumps({"return": [5.0, 4.0, 6.0]}))
    (both,) = compared(a, b)
    np.testing.assert_array_equal(both.values("final return"), [5, 7, np.nan, np.nan])
    (b / "evaluation.json").write_text(json.dumps({"seeds": {"return": [5.0]}}))
    with pytest.raises(ConfigError, match=r"is of 1 seeds, metrics.csv of 2"):
        runs_in(b)


def test_scores_follow_what_stands_in_for_return_and_cost(tmp_path):
    (run,) = runs_in(write(tmp_path / "a"))
    final = {"final return": np.array([6.0, 9.0]), "final cost": np.array([30.0, 10.0])}
    found = read.with_evaluation(run._replace(values=run.values | final)).values
    ppo = scores.CHARACTERISTIC["point_goal1"]
    np.testing.assert_array_equal(found["return"], [6, 9])
    np.testing.assert_allclose(found["normalised return"], [6 / ppo.ret, 9 / ppo.ret])
    np.testing.assert_allclose(found["normalised violation"], [5 / (ppo.cost - 25), 0])


def test_stretches_of_training_are_means_carried_on_to_the_end_of_each_seed():
    table = {
        "steps": np.array([10, 20, 30, 40, 10, 20.0]), "seed": np.array([0, 0, 0, 0, 1, 1.0]),
        "x": np.array([1, 3, np.nan, np.nan, np.nan, 7]),
        "train/cost_rate": np.array([1, 3, 5, 7, 2, 4.0]),
    }  # fmt: skip
    edges = np.array([0.0, 20.0, 40.0, 60.0])
    np.testing.assert_array_equal(
        plots.stretches(table, "x", edges), [[2, 2, np.nan], [7, np.nan, np.nan]]
    )
    np.testing.assert_array_equal(  # so far: 1, 2, 3, 4 and 2, 3
        plots.stretches(table, "train/cost_rate", edges), [[1.5, 3.5, np.nan], [2.5, np.nan, np.nan]]
    )
    table["train/cost_rate"][[0, 2]] = np.nan  # so far: none, 3, 3, 5
    np.testing.assert_array_equal(
        plots.stretches(table, "train/cost_rate", edges), [[3, 4, np.nan], [2.5, np.nan, np.nan]]
    )


# ---- which runs are averaged -----------------------------------------------------------------


def test_seeds_of_one_setting_are_pooled_and_other_settings_stand_apart(tmp_path):
    write(tmp_path / "x" / "1")
    write(tmp_path / "x" / "2", seeds=(2,), returns=(5.0,), costs=(30.0,))
    write(tmp_path / "y", algo="cpo")
    ppo_lag, cpo = sorted(compared(tmp_path), key=lambda g: g.name, reverse=True)
    assert (cpo.name, ppo_lag.name) == ("cpo", "ppo_lag")
    np.testing.assert_array_equal(np.sort(ppo_lag.returns), [1, 3, 5])
    assert (ppo_lag.cost, ppo_lag.held) == (stats.estimate(np.array([20.0, 40, 30])), "unclear")


def test_a_group_with_a_seed_that_diverged_holds_no_limit_and_the_tables_say_so(tmp_path):
    for name, seeds in (("a", (0, 1)), ("b", (2, 3))):
        write(tmp_path / name, seeds=seeds, costs=(1.0, 2.0))
    assert compared(tmp_path)[0].held == "yes"
    write_lost(tmp_path / "b", [Lost(12, 3, "", "a is not finite"), Lost(12, 3, "algo.clip=1", "")])
    groups = compared(tmp_path)
    assert [g.held for g in groups] == ["diverged"]
    said = f"diverged, so no limit counts as held: {tmp_path / 'b'}, seed 3"
    assert comparison_tables.notes(groups) == [said]
    assert "**" not in str(comparison_tables.results(groups, "return", {}).rows)
    text = sweep_summary.markdown(groups)
    assert "| diverged |" in text and "no limit counts as held: ppo_lag (seed 3)" in text


@pytest.mark.parametrize("each, few", [(3, False), (2, True)])
def test_a_limit_that_few_episodes_are_within_is_unclear_with_a_remark(tmp_path, each, few):
    """In the last two of 20 iterations of two seeds, 4 times as many end as in one of one seed."""
    write(tmp_path / "a", costs=(1.0, 2.0), columns={"train/episodes": np.full(2, each)}.items())
    groups = compared(tmp_path)
    assert [g.held for g in groups] == ["unclear" if few else "yes"]
    told = "to tell whether the limit is held: ppo_lag"
    remarks, text = comparison_tables.notes(groups), sweep_summary.markdown(groups)
    assert [f"{told} on point_goal1, 8 of at least 10" in x for x in remarks] == [True] * few
    assert (f"{told} (8)." in text) == few
    final = [run._replace(evaluated=True) for run in groups[0].runs]  # not of these episodes
    assert not groups[0]._replace(runs=final).few_episodes
    assert groups[0]._replace(runs=final).held == "yes"


def test_settings_of_an_algorithm_are_told_apart_by_what_differs(tmp_path):
    for limit in (100, 5, 20):
        write(tmp_path / f"{limit}", cost_limit=float(limit), costs=(19.0, 31.0))
    groups = compared(tmp_path)
    assert [g.name for g in groups] == [f"ppo_lag, algo.cost_limit={x}" for x in (5, 20, 100)]
    assert [g.held for g in groups] == ["no", "unclear", "yes"]  # of 5 no seed is within
    assert "**" not in str(
        comparison_tables.results(groups, "return", {}).rows
    )  # of other limits, none is best


def test_settings_side_by_side_in_one_run_are_groups_of_their_own(tmp_path):
    limits = {"algo.cost_limit": [5.0, 5.0, 10.0, 10.0]}
    write(tmp_path / "a", returns=(1, 2, 3, 4), costs=[0] * 4, seeds=[0, 1, 0, 1], columns=limits,
          cost_limit=[5, 10])  # fmt: skip
    groups = compared(tmp_path, by=("algo.cost_limit",))
    assert [(g.cost_limit, *g.returns) for g in groups] == [(5, 1, 2), (10, 3, 4)]


def test_averaging_over_a_field_is_asked_for_and_said(tmp_path):
    write(tmp_path / "a", dual_lr=0.1)
    write(tmp_path / "b", dual_lr=0.2)
    (both,) = compared(tmp_path, by=("algo.name",))
    assert len(both.returns) == 4
    assert comparison_tables.notes([both]) == ["averaged over algo.dual_lr (0.1, 0.2)"]


def test_tasks_stand_apart_and_only_those_of_every_setting_are_compared(tmp_path):
    write(tmp_path / "1", "point_goal1", "cpo", returns=(10.0, 20.0), costs=(10.0, 11.0))
    write(tmp_path / "2", "car_goal1", "cpo", returns=(4.0, 8.0))
    write(tmp_path / "3", "point_goal1", "ppo_lag", returns=(0.0, 15.0), costs=(12.0, 20.0))
    write(tmp_path / "4", "point_run", "cpo", total_steps=400)
    groups = compared(tmp_path)
    assert len(groups) == 4
    s = group.suite(groups)
    assert s.tasks == ["point_goal1"]
    pairs = comparison_tables.improvements(s)
    assert pairs["cpo", "ppo_lag", "return"].mean == 3 / 4  # 10 beats 0, 20 beats both
    assert pairs["cpo", "ppo_lag", "cost"].mean == 1
    assert comparison_tables.notes(groups) == [
        f"unfinished: {tmp_path / '4'}, at 200 of 400 steps",
        "not in comparisons across tasks, as a setting lacks them: car_goal1, point_run",
        "without normalised scores, as there are no published ones: point_run",
    ]
    cpo = group.suite([g for g in groups if g.algo == "cpo" and g.env != "point_run"])
    found = comparison_tables.aggregates(cpo)["cpo", "normalised return", "mean"]
    assert found.mean == pytest.approx((6 / 25.49 + 15 / 25.179) / 2)


# ---- tables and figures ----------------------------------------------------------------------


def test_published_figures_stand_below_and_what_lies_beyond_their_spread_is_marked(tmp_path):
    three = (10.0, 15.0, 20.0)
    write(tmp_path / "1", "point_goal1", "cpo", three, three, (0, 1, 2))
    write(tmp_path / "2", "point_goal1", "ppo_lag", (30.0, 30.0), (30.0, 31.0))
    write(tmp_path / "3", "car_push1", "cpo", (1.0, 2.0), (0.0, 0.0))
    path = tmp_path / "published.csv"
    path.write_text(
        f"{HEADER}point_goal1,cpo,Peer,12,2.9,30,20,25\npoint_goal1,ppo_lag,Peer,1,2,3,4,10\n"
    )
    table = comparison_tables.results(compared(tmp_path), "return", read_published(path))
    assert table.header == ["", "car_push1", "point_goal1"]
    assert "Fewer than three seeds have no interval." in table.caption
    assert table.rows == [
        ["`cpo`", "**1.50**", "**15.00 [2.58, 27.42]** ↑"],  # of two seeds and of three
        ["Peer", "-", "12.00 ± 2.90"],
        ["`ppo_lag`", "-", "30.00"],  # published with another limit; the cost is over ours
    ]
    cost = comparison_tables.results(compared(tmp_path), "cost", read_published(path))
    assert cost.rows[0][2] == "15.00 [2.58, 27.42]" and cost.rows[1][2] == "30.00 ± 20.00"


def test_published_figures_stand_beside_runs_of_the_same_rules_alone(tmp_path):
    path = tmp_path / "published.csv"
    path.write_text(f"{HEADER.strip()},rules\npoint_button1,cpo,Peer,1,2,3,4,25,safety_gymnasium\n")
    for rules in ("safety_gym", "safety_gymnasium"):
        folder = write(tmp_path / rules / "1", "point_button1", "cpo")
        config = run_folder.read_config(folder)
        config["env"]["rules"] = rules
        run_folder.write_config(folder, config)
        (g,) = compared(tmp_path / rules)
        known = beside(g, read_published(path))
        assert (known is not None) == (rules == "safety_gymnasium")


def test_the_committed_published_figures_are_whole():
    found = read_published(RESULTS / "published.csv")
    # 20 on-policy rows on 14 tasks, 9 off-policy ones on 8, 6 planners on 2
    assert len(found) == 364
    for env, algo in found:
        assert env in envs.ENVS and algo in algos.ALGOS
    assert found["point_goal1", "cpo"] == ((20.46, 1.38), (28.84, 7.76), 25.0, "OmniSafe", "")
    assert {f.rules for (env, _), f in found.items() if "button" in env} == {"safety_gymnasium"}


def test_a_table_is_markdown_and_latex():
    table = tables.Table("50% & _more_", ["", "a|b"], [["`x_y`", "**1** ↑ ±"], ["[2]", "-"]])
    assert (
        tables.markdown(table) == "|  | a\\|b |\n| --- | ---: |\n| `x_y` | **1** ↑ ± |\n| [2] | - |\n"
    )
    text = tables.latex(table)
    assert r"\caption{50\% \& \_more\_}" in text and r"\begin{tabular}{lr}" in text
    assert r"\texttt{x\_y} & \textbf{1} $\uparrow$ $\pm$ \\" in text


def test_the_pareto_front_leaves_out_what_costs_more_and_returns_less():
    points = [(3.0, 1.0), (1.0, 2.0), (2.0, 5.0), (4.0, 5.0), (5.0, 6.0), (0.0, np.nan)]
    assert trade_off.front(points) == ([1, 2, 2, 5, 5], [2, 2, 5, 5, 6])


def test_the_frame_of_a_trade_off_holds_every_seed_and_cuts_wide_intervals(tmp_path):
    write(tmp_path / "a", "point_goal1", "cpo", (1.0, 2.0, 3.0), (20.0, 30.0, 40.0), (0, 1, 2))
    (group,) = compared(tmp_path / "a")
    axes = trade_off.draw([group], "").axes[0]
    for (low, high), values, wide in (
        (axes.get_xlim(), [*group.costs, group.cost_limit], group.estimate("cost")),
        (axes.get_ylim(), group.returns, group.ret),
    ):
        assert low < min(values) <= max(values) < high
        assert high - low < 1.13 * np.ptp(values) < wide.high - wide.low
    assert plots.frame([3.0, np.nan, 3.0]) is None


def test_a_lone_seed_is_inside_its_trade_off(tmp_path):
    write(tmp_path / "a", returns=(5.0,), costs=(25.0,), seeds=(0,))  # at the limit
    axes = trade_off.draw(compared(tmp_path / "a"), "").axes[0]
    assert axes.get_xlim()[0] < 25 < axes.get_xlim()[1]
    assert axes.get_ylim()[0] < 5 < axes.get_ylim()[1]


def in_the_legend(figure: Any) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def points_of(line: Any) -> np.ndarray:
    return np.array(line.get_xydata())


def test_a_sweep_of_limits_is_a_line_an_algorithm_in_the_order_of_the_limits(tmp_path):
    costs = {10.0: (9.0, 10.0, 12.0), 2.5: (2.0, 3.0, 4.0), 25.0: (20.0, 25.0, 33.0)}
    for algo in ("cpo", "ppo_lag"):
        for limit, found in costs.items():
            returns = tuple(x + (algo == "cpo") for x in found)
            folder = tmp_path / f"{algo}-{limit:g}"
            write(folder, algo=algo, returns=returns, costs=found, seeds=(0, 1, 2), cost_limit=limit)
    figure = trade_off.draw(compared(tmp_path), "")
    (axes,) = figure.axes
    assert in_the_legend(figure) == ["cpo", "ppo_lag", "cost limits, the numbers on points"]
    drawn = [line for line in axes.lines if len(points_of(line)) == 3]
    lines = [line for line in drawn if line.get_linestyle() == "-"]
    means = [3, 31 / 3, 26]
    for line, algo, more in zip(lines, ("cpo", "ppo_lag"), (1, 0), strict=True):
        assert line.get_color() == looks.color_of(algo)
        np.testing.assert_allclose(points_of(line), [(mean, mean + more) for mean in means])
    assert [text.get_text() for text in axes.texts] == 2 * ["2.5", "10", "25"]
    assert list(axes.get_xticks(minor=True)) == [2.5, 10, 25]


def test_limits_share_a_number_box_where_points_lie_on_each_other_and_have_an_arrow_beyond(tmp_path):
    for limit, cost in ((1.0, 3.0), (5.0, 3.0), (20.0, 30.0), (2.0, 200.0), (25.0, 300.0)):
        write(tmp_path / f"{limit:g}", costs=(cost, cost + 1), cost_limit=limit)
    figure = trade_off.draw(compared(tmp_path), "")
    (axes,) = figure.axes
    found = [text.get_text() for text in axes.texts]
    assert found == ["1, 5", "20", "return", "cost", "2", "200", "2", "300", "2", "25"]
    boxes = [box for text in axes.texts if (box := text.get_bbox_patch())]
    assert len({box.get_edgecolor() for box in boxes}) == 1, "a line and its arrows differ in colour"


def test_a_long_title_is_not_cut_off_above_one_panel(tmp_path):
    write(tmp_path / "a")
    figure = trade_off.draw(compared(tmp_path), 3 * "last 10% of training, mean and 95% interval; ")
    figure.draw_without_rendering()
    box = figure.texts[0].get_window_extent()
    assert 0 <= box.x0 < box.x1 <= figure.bbox.width


def test_a_limit_has_the_colour_of_the_one_setting_that_it_belongs_to_and_else_is_grey():
    limits, colors = [5.0, 25.0, np.nan, 25.0], ["red", "green", "blue", "black"]
    assert plots.limit_colors(limits, colors, "grey") == {5.0: "red", 25.0: "grey"}
    assert plots.limit_colors(limits[2:], colors[2:], "grey") == {25.0: "grey"}


def test_a_mean_far_over_the_limit_is_an_arrow_and_not_on_the_front(tmp_path):
    three: dict[str, Any] = {"seeds": (0, 1, 2)}
    write(tmp_path / "a", algo="cpo", returns=(1, 2, 3), costs=(18, 20, 22), **three)
    write(tmp_path / "b", algo="ppo_lag", returns=(4, 5, 6), costs=(28, 30, 32), **three)  # over
    write(tmp_path / "c", algo="ppo", returns=(9, 9, 9), costs=(10, 10, 10), **three)  # has no limit
    write(tmp_path / "d", algo="trpo", returns=(40, 40, 40), costs=(900, 900, 900), **three)
    groups = compared(tmp_path)
    known = Published((7.0, 1.0), (21.0, 1.0), 25.0, "theirs", "")
    figure = trade_off.draw(groups, "", {("point_goal1", "cpo"): known})
    (axes,) = figure.axes
    assert max(axes.get_xticks()) == 4 * 25 and axes.get_ylim()[1] < 10
    assert [text.get_text() for text in axes.texts] == ["return", "cost", "40", "900"]
    (front,) = [line for line in axes.lines if line.get_label() == "front within the limit"]
    np.testing.assert_allclose(points_of(front), [[20, 2]])
    assert {"published, same colour", "costs more than the axis shows"} < {*in_the_legend(figure)}


def test_most_points_are_never_cut_off(tmp_path):
    for algo, cost in (("cpo", 300.0), ("ppo_lag", 200.0), ("ppo", 90.0)):
        write(tmp_path / algo, algo=algo, costs=(cost, cost + 1))
    (axes,) = trade_off.draw(compared(tmp_path), "").axes
    assert axes.get_xlim()[1] > 300 and not axes.texts


def test_an_algorithm_has_its_colour_in_every_figure_and_a_setting_a_line_and_shade(tmp_path):
    for algo in ("cpo", "ppo_lag"):
        for clip in (0.0, 1.0):
            write(tmp_path / f"{algo}{clip}", algo=algo, entropy_coef=clip)
    groups = compared(tmp_path)
    found = looks.styles(groups)
    assert len({(x["color"], x["ls"]) for x in found.values()}) == 4
    first, _, third, _ = found.values()
    assert first["color"] == looks.color_of("cpo")
    assert third["color"] == looks.color_of("ppo_lag")
    assert found == looks.styles([*groups, *groups])
    (axes, *_) = plots.learning(groups[:2], found).axes
    assert {line.get_color() for line in axes.lines} == {x["color"] for x in [*found.values()][:2]}
    alone = looks.styles(groups[:2])  # one algorithm's settings have the colours to themselves
    assert {x["ls"] for x in alone.values()} == {"-"} and len({x["color"] for x in alone.values()}) == 2


def test_every_algorithm_has_one_colour():
    names = [name for names in looks.COLORS.values() for name in names.split()]
    assert sorted(names) == sorted(algos.ALGOS)
    assert looks.color_of("mine:priced") in looks.COLORS


def test_a_small_picture_keeps_the_colours_of_all_settings_apart(tmp_path):
    colors = [looks.shaded(color, count) for count in range(2) for color in looks.COLORS]
    figure = Figure(figsize=(8, 6))
    axes = figure.subplots()
    for i, color in enumerate(colors):
        axes.plot([i], [i], "o", color=color, label=f"a setting with a long name {i}")
        axes.plot(np.random.default_rng(i).normal(i, 1, 50), color=color)
    axes.legend(ncols=2)
    studies.save_small(figure, tmp_path / "small.png")
    small = np.asarray(Image.open(tmp_path / "small.png").convert("RGB")).reshape(-1, 3).astype(int)
    for color in 255 * np.array([to_rgb(color) for color in colors]):
        assert np.abs(small - color).max(-1).min() < 12, color


def test_two_seeds_are_two_lines_and_three_have_a_band(tmp_path):
    for count in (2, 3):
        write(
            tmp_path / str(count), returns=range(count), costs=range(count), seeds=tuple(range(count))
        )
        (axes, *_) = plots.learning(compared(tmp_path / str(count))).axes
        assert len(axes.collections) == (count == 3) and len(axes.lines) == (1 if count == 3 else 2)


def test_a_curve_ends_where_its_run_does_beside_a_longer_one(tmp_path):
    write(tmp_path / "short")
    write(tmp_path / "long", algo="cpo", total_steps=330)
    long, short = sorted(compared(tmp_path / "short", tmp_path / "long"), key=lambda g: g.name)
    (run,) = long.runs
    stretched = {name: 1.65 * x if name == "steps" else x for name, x in run.table.items()}
    later = long._replace(runs=[run._replace(table=stretched)])
    axes, *_ = plots.learning([short, later]).axes
    curves = (map(np.asarray, line.get_data()) for line in axes.get_lines()[:4])
    assert sorted(x[np.isfinite(y)].max() for x, y in curves) == [200, 200, 330, 330]


def test_the_axis_of_training_begins_at_0(tmp_path):
    write(tmp_path / "a")
    axes = plots.learning(compared(tmp_path / "a")).axes
    assert all(x.get_xlim() == (0, 200) for x in axes)
    words = [axes[0].xaxis.get_major_formatter()(x) for x in (0, 500, 2500, 1.5e6, 1e7)]
    assert words == ["0", "500", "2.5k", "1.5M", "10M"]


def test_the_axes_say_what_a_value_is_of(tmp_path):
    write(tmp_path / "a")
    labels = [x.get_ylabel() for x in plots.learning(compared(tmp_path / "a")).axes]
    assert labels == [
        "return of an episode", "cost of an episode", "cost rate so far,\nper step of the policy",
    ]  # fmt: skip


def test_the_end_of_a_published_curve_stands_beside_runs_of_its_length(tmp_path):
    write(tmp_path / "a", algo="cpo")
    (g,) = compared(tmp_path / "a")
    (tmp_path / "ends.csv").write_text("env,algo,steps,return,cost\npoint_goal1,cpo,200,3,\n")
    ends = read_ends(tmp_path / "ends.csv")
    known = {("point_goal1", "cpo"): Published((9.0, 1.0), (3.0, 1.0), 25.0, "theirs", "")}
    end = end_beside(g, known, ends)
    assert end and (end.steps, end.ret) == (200, 3) and np.isnan(end.cost)
    figure = plots.learning([g], ends={("point_goal1", "cpo"): end})
    marks = [line for line in figure.axes[0].lines if line.get_marker() == "D"]
    assert points_of(marks[0]).tolist() == [[200, 3]]
    assert "end of the published curve" in in_the_legend(figure)
    longer = {k: x._replace(steps=400.0) for k, x in ends.items()}
    assert end_beside(g, known, longer) is None and end_beside(g, {}, ends) is None


def test_one_command_writes_every_table_and_figure_the_same_each_time(tmp_path, capsys):
    for env in ("point_goal1", "car_goal1"):
        for algo in ("cpo", "ppo_lag"):
            three = (1.0, 2.0, 3.0), (20.0, 30.0, 40.0), (0, 1, 2)
            write(tmp_path / "runs" / f"{env}-{algo}", env, algo, *three)
    out = tmp_path / "out"
    arguments = [*map(str, (tmp_path / "runs", "--published", RESULTS / "published.csv", "--out", out))]
    assert typed("plot", *arguments) == 0
    figures = [
        f"{name}.{s}" for name in ("curves", "trade_off", "scores", "profiles") for s in plots.FORMATS
    ]
    assert {p.name for p in out.iterdir()} == {*figures, "results.md", "results.tex", "results.csv"}
    first = {p.name: p.read_bytes() for p in out.iterdir()}
    printed = capsys.readouterr().out
    assert "| OmniSafe | 43.32 ± 14.35 | 28.84 ± 7.76 |" in printed and printed.endswith(
        f"written: {out}\n"
    )
    rows = list(csv.DictReader(io.StringIO((out / "results.csv").read_text())))
    (one,) = [r for r in rows if r["task"] == "car_goal1" and r["algo.name"] == "cpo"
              and (r["metric"], r["statistic"]) == ("return", "mean")]  # fmt: skip
    width = 4.3026527 / 3**0.5  # t of two degrees of freedom, and a deviation of 1
    np.testing.assert_allclose(
        [float(one[k]) for k in ("seeds", "value", "low", "high")], [3, 2, 2 - width, 2 + width]
    )
    assert "P(better than ppo_lag)" in {r["statistic"] for r in rows}
    assert typed("plot", *arguments, "--by", "algo.name") == 0
    assert {p.name: p.read_bytes() for p in out.iterdir()} == first


def test_a_row_of_scores_names_the_tasks_that_have_scores_and_counts_their_seeds(tmp_path):
    for env in ("point_goal1", "point_run"):  # the second has none
        for algo in ("cpo", "ppo_lag"):
            write(tmp_path / "runs" / f"{env}-{algo}", env, algo)
    assert typed("plot", str(tmp_path / "runs"), "--out", str(tmp_path / "out")) == 0
    rows = [*csv.DictReader(io.StringIO((tmp_path / "out" / "results.csv").read_text()))]
    scored = {(r["task"], r["seeds"]) for r in rows if r["metric"].startswith("normalised")}
    pairs = {(r["task"], r["seeds"]) for r in rows if r["statistic"].startswith("P(")}
    assert scored == {("point_goal1", "2")} and pairs == {("point_goal1 point_run", "4")}


def test_by_the_task_alone_all_its_runs_are_one_setting(tmp_path, capsys):
    for algo in ("cpo", "ppo_lag"):
        write(tmp_path / "runs" / algo, algo=algo)
    out = tmp_path / "out"
    assert typed("plot", str(tmp_path / "runs"), "--out", str(out), "--by", "env.name") == 0
    said = capsys.readouterr()
    assert said.err == "2 runs by env.name\n"
    assert "| `all` |" in said.out and "averaged over algo.name (cpo, ppo_lag)" in said.out


def test_a_committed_study_is_read_like_the_runs_that_it_was_made_of():
    groups = compared(RESULTS / "goal")
    known = {(g.env, g.name): g for g in groups}
    cpo = known["point_goal1", "cpo"]
    assert tables.cell(cpo.ret, ".2f") == "18.71 [17.08, 20.35]" and len(cpo.costs) == 5


BAD = {
    "nowhere": "nowhere is not a folder",
    "empty": "empty holds no run",
    "begun": "no run has begun in begun",
    "runs --by algo.cost_limt": "unknown field algo.cost_limt; did you mean 'algo.cost_limit'?",
    "runs --by cost_limit": "unknown field cost_limit; did you mean 'algo.cost_limit'?",
    "runs --published none.csv": "none.csv cannot be read",
    "runs --published bad.csv": "bad.csv has no column algo; expected task, algo, source",
    "runs --published quote.csv": "quote.csv cannot be read: field larger than field limit",
    "runs --published twice.csv": "twice.csv: point_goal1 cpo occurs twice",
    "runs --published words.csv": "words.csv cannot be read: could not convert string to float: 'many'",
    "runs --out runs/a/config.yaml": "--out runs/a/config.yaml: File exists",
    "runs --out /proc/here": "--out /proc/here: No such file or directory",
    "runs copy": "runs/a and copy are the same run of seed 0",
    "other": "trained by jaxsafe 9.0 (abc), does not fit jaxsafe 0.1.0: unknown option algo.magic",
    "columns": "columns/metrics.csv has no column train/return",
    "torn": "torn/metrics.csv cannot be read",
    "runs --fast": "unrecognized arguments: --fast",
    "": "the following arguments are required: RUNS",
}


@pytest.mark.parametrize("arguments", BAD)
def test_bad_input_is_one_line_and_status_2(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write(Path("runs/a"))
    write(Path("copy"))
    write(Path("other"), magic=3)
    Path("other/versions.json").write_text('[{"jaxsafe": "9.0", "commit": "abc"}]')
    write(Path("begun"))
    Path("begun/metrics.csv").unlink()
    Path("empty").mkdir()
    write(Path("columns"))
    Path("columns/metrics.csv").write_text("iteration,steps,seed\n1,1,1\n")
    write(Path("torn"))
    Path("torn/metrics.csv").write_text("iteration,steps\n1,many\n")
    Path("bad.csv").write_text("task,return\npoint_goal1,3\n")
    Path("quote.csv").write_text(f'{HEADER}"{200_000 * "x"}')
    Path("twice.csv").write_text(HEADER + 2 * "point_goal1,cpo,Peer,1,1,1,1,25\n")
    Path("words.csv").write_text(f"{HEADER}point_goal1,cpo,Peer,many,1,1,1,25\n")
    assert typed("plot", *arguments.split()) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and BAD[arguments] in lines[0]
    assert not Path("comparison").exists()
