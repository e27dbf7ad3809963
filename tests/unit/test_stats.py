import numpy as np
import pytest
import scipy
from matplotlib.figure import Figure

from jaxsafe.report import plots, stats

# rliable 1.2.0 (with pandas 2.3) on these: 20,000 draws, probability of improvement 3,000.
X = np.array([
    [0.001, 0.299, -0.274], [-0.891, -0.455, -0.992], [0.06, 1.34, -0.492],
    [-0.62, 0.49, 0.357], [0.105, -0.93, -0.029], [0.695, -1.344, -0.458],
])  # fmt: skip
Y = np.array([
    [-1.401, -0.79, -1.342], [0.265, -0.767, 0.771], [0.657, 0.313, -2.017], [-0.039, 0.451, 0.613],
])  # fmt: skip
RLIABLE = {
    "mean": (-0.17433333, -0.46944444, 0.12794861),
    "iqm": (-0.1863, -0.5442075, 0.1339),
    "probability of improvement": (0.5, 0.26388889, 0.73611111),
    "profile": (
        [0.94444444, 0.44444444, 0.11111111],
        [0.83333333, 0.22222222, 0.0],
        [1.0, 0.66666667, 0.27777778],
    ),
}


def test_estimates_over_tasks_are_those_of_rliable_and_intervals_of_shares_too():
    found = {
        "mean": stats.estimate(*X.T),
        "iqm": stats.estimate(*X.T, statistic=stats.iqm),
        "probability of improvement": stats.probability_of_improvement([*X.T], [*Y.T]),
        "profile": stats.profile([*X.T], np.array([-1.0, 0.0, 0.5])),
    }
    for name, expected in RLIABLE.items():
        np.testing.assert_allclose(found[name].mean, expected[0], rtol=1e-6, err_msg=name)
        if name not in ("mean", "iqm"):  # whose intervals are by Student's t
            np.testing.assert_allclose(found[name][1:], expected[1:], atol=0.02, err_msg=name)


@pytest.mark.parametrize("seeds", [4, 5, 8])
def test_the_interval_of_a_mean_covers_it_95_times_in_100(seeds):
    """2,000 samples of one task, and as many of two tasks with other spreads and numbers of seeds."""
    rng = np.random.default_rng(seeds)
    one = rng.normal(3.0, 2.0, (seeds, 2000))
    two = rng.normal(5.0, 0.5, (seeds + 2, 2000))
    for samples, truth in (([one], 3.0), ([one, two], 4.0)):
        e = stats.estimate(*samples)
        assert 0.93 < np.mean((e.low <= truth) & (truth <= e.high)) < 0.97


@pytest.mark.parametrize("seeds", [4, 5, 8])
def test_the_interval_of_an_interquartile_mean_covers_it_at_least_as_often(seeds):
    values = np.random.default_rng(seeds).normal(3.0, 2.0, (seeds, 2000))
    e = stats.estimate(values, statistic=stats.iqm, draws=500)
    assert 0.93 < np.mean((e.low <= 3.0) & (e.high >= 3.0)) < 0.99


def test_the_interval_of_a_mean_is_scipys_of_student_and_welch():
    x, y = X[:, 0], Y[:, 1]
    known = scipy.stats.ttest_1samp(x, 0.0).confidence_interval()
    np.testing.assert_allclose(stats.estimate(x)[1:], known)
    # a mean over two tasks is half the difference of x and -y
    known = scipy.stats.ttest_ind(x, -y, equal_var=False).confidence_interval()
    np.testing.assert_allclose(stats.estimate(x, y)[1:], np.array(known) / 2)


def test_means_and_interquartile_means_by_hand():
    few, many = np.array([2.0, 4.0]), np.array([0.0, 10.0, 20.0, 30.0, 40.0, 50.0])
    assert stats.estimate(few, many).mean == (3 + 25) / 2  # a task counts once, whatever its seeds
    assert stats.estimate(few, many, statistic=stats.iqm).mean == (4 + 10 + 20 + 30) / 4
    low = 3.0 - 4.3026527 * 2 / 3**0.5  # t of two degrees of freedom, and a deviation of 2
    np.testing.assert_allclose(stats.estimate(np.array([1.0, 3.0, 5.0])), (3.0, low, 6.0 - low))


def test_of_three_seeds_the_interval_of_the_interquartile_mean_is_that_of_the_mean():
    x = X[:3, 0]  # of three there is no quarter to leave out
    known, found = stats.estimate(x), stats.estimate(x, statistic=stats.iqm)
    assert found.mean == pytest.approx(known.mean)
    np.testing.assert_allclose(found.high - found.low, known.high - known.low, rtol=0.02)


def test_the_spread_between_tasks_does_not_widen_the_interval():
    assert stats.estimate(np.full(5, 1.0), np.full(5, 9.0)) == (5.0, 5.0, 5.0)


def test_the_interval_of_the_mean_nears_that_of_the_normal_law():
    values = np.random.default_rng(3).normal(size=400)
    e, error = stats.estimate(values), values.std() / 20
    assert e.mean == pytest.approx(values.mean())
    np.testing.assert_allclose(
        [e.low, e.high], values.mean() + np.array([-1.96, 1.96]) * error, atol=0.01
    )


def test_fewer_than_three_seeds_have_no_interval_and_what_is_unknown_stays_unknown():
    one, two, three = np.array([7.0]), np.array([1.0, 3.0]), np.array([1.0, 2.0, 3.0])
    assert stats.estimate(one) == (7.0, 7.0, 7.0)
    assert stats.estimate(two) == stats.estimate(two, statistic=stats.iqm) == (2.0, 2.0, 2.0)
    assert stats.estimate(one, three) == (4.5, 4.5, 4.5)
    assert stats.estimate(two, three) == (2.0, 2.0, 2.0)
    assert stats.has_interval(three) and not stats.has_interval(two, three)
    assert np.isnan(stats.estimate(np.array([7.0, np.nan]))).all()
    columns = stats.estimate(np.array([[1.0, np.nan, 3.0], [2.0, 5.0, 3.0]]))
    np.testing.assert_array_equal(np.isnan(columns), [[False, True, False]] * 3)
    np.testing.assert_allclose(np.array(columns)[:, 2], 3.0)


WIDTH = 4.3026527 / 3**0.5  # half an interval's, of three seeds with a standard deviation of 1


@pytest.mark.parametrize(
    "name, values, ends",
    [
        ("violation rate", [0.0, 0.05, 0.1], (0.0, 0.05 + WIDTH * 0.05)),
        ("final violation rate", [0.9, 0.95, 1.0], (0.95 - WIDTH * 0.05, 1.0)),
        ("override rate", [0.9, 0.95, 1.0], (0.95 - WIDTH * 0.05, 1.0)),
        ("train/overruled", [0.9, 0.95, 1.0], (0.95 - WIDTH * 0.05, 1.0)),
        ("Brier score", [0.9, 0.95, 1.0], (0.95 - WIDTH * 0.05, 1.0)),
        ("hazards over 10", [0.0, 0.5, 1.0], (0.0, 1.0)),
        ("cost", [1.0, 2.0, 3.0], (0.0, 2 + WIDTH)),
        ("cost rate", [0.0, 0.05, 0.1], (0.0, 0.05 + WIDTH * 0.05)),
        ("cost", [-1.0, 1.0, 3.0], (1 - WIDTH * 2, 1 + WIDTH * 2)),  # costs may be negative there
        ("return", [1.0, 2.0, 3.0], (2 - WIDTH, 2 + WIDTH)),
        ("normalised return", [1.0, 2.0, 3.0], (2 - WIDTH, 2 + WIDTH)),
    ],
)
def test_an_interval_stops_where_its_measure_does(name, values, ends):
    e = stats.of_measure(name, np.array(values))
    assert e.mean == np.mean(values) and isinstance(e.low, float)
    np.testing.assert_allclose(e[1:], ends, rtol=1e-4)


def test_a_cost_below_0_of_one_task_leaves_the_interval_over_all_tasks_open():
    below, above = np.array([-1.0, 1.0, 3.0]), np.array([0.0, 0.0, 0.0])
    assert stats.of_measure("cost", below, above).low == stats.estimate(below, above).low < 0


def test_probability_of_improvement_counts_pairs_and_halves_of_equal_ones():
    a, b = [np.array([1.0, 3.0])], [np.array([0.0, 1.0, 2.0])]
    e = stats.probability_of_improvement(a, b)  # 1 beats 0 and equals 1, 3 beats all
    assert e.mean == pytest.approx(4.5 / 6)
    assert stats.probability_of_improvement(b, a).mean == pytest.approx(1.5 / 6)
    assert stats.probability_of_improvement(a, a).mean == 0.5


def test_a_profile_is_the_share_of_seeds_above_each_threshold():
    e = stats.profile([np.array([0.0, 1.0]), np.array([2.0, 2.0])], np.array([-1.0, 0.0, 1.0, 2.0]))
    np.testing.assert_array_equal(e.mean, [1, 0.75, 0.5, 0])
    assert np.all(e.low <= e.mean) and np.all(e.mean <= e.high)


def test_a_drawn_band_ends_where_its_measure_ends():
    """Three seeds cost 0, 0 and 3. The interval of their mean reaches below 0, but no cost does."""
    values = np.array([[0.0, 1.0], [0.0, 2.0], [3.0, 3.0]])
    axes = Figure().subplots()
    for measure in ("train/return", "train/cost"):
        plots.band(axes, measure, np.arange(2), values, "")
    low = [np.asarray(band.get_paths()[0].vertices)[:, 1].min() for band in axes.collections]
    assert low[0] < -1 and low[1] == 0


@pytest.mark.parametrize("seeds", [1, 3])
def test_a_single_point_is_a_dot_and_more_are_a_line(seeds):
    """As of a run of one iteration, or one whose first episode ends in its last."""
    values = np.full((seeds, 3), np.nan)
    values[:, 2] = 1.0
    for one, marker in ((values, "o"), (np.ones((seeds, 3)), "None")):
        axes = Figure().subplots()
        plots.draw_setting(axes, "train/return", np.arange(3), one, "C0", "")
        plots.traces(axes, "train/return", np.arange(3), one, "")
        assert {str(line.get_marker()) for line in axes.lines} == {marker}
        assert {line.get_clip_on() for line in axes.lines} == {marker == "None"}  # a dot is whole


@pytest.mark.parametrize(
    "iterations, points, first", [(200, 200, 3.0), (201, 100, 2.0), (1000, 100, 2.0)]
)
def test_a_long_run_is_drawn_by_means_over_stretches_of_it(
    iterations, points, first, tmp_path, monkeypatch
):
    """Returns of 3 and 1 in turn. Iterations of a short run are points, and means of a long one."""
    figures = []
    monkeypatch.setattr(plots, "write", lambda figure, *_, **__: figures.append(figure))
    t = np.arange(1.0, iterations + 1)
    table = {
        "iteration": t,
        "steps": 10 * t,
        "seed": 0 * t,
        "train/return": 2 - (-1) ** t,
        "train/cost": t,
    }
    plots.curves(table, tmp_path / "curves.png", "", 25.0)
    x, y = figures[0].axes[0].lines[0].get_data()
    assert len(x) == len(y) == points and x[-1] == 10 * iterations
    assert abs(y[0] - first) < 0.4 and abs(np.mean(y) - 2) < 0.01
    (told,) = figures[0].legends
    assert [text.get_text() for text in told.get_texts()] == ["limit 25"]


def test_evaluations_of_settings_side_by_side_are_named_where_training_has_no_episodes(
    tmp_path, monkeypatch
):
    figures = []
    monkeypatch.setattr(plots, "write", lambda figure, *_, **__: figures.append(figure))
    rates = np.array([1.0, 2.0])
    table = {
        "iteration": np.ones(2), "steps": np.zeros(2), "updates": np.ones(2), "seed": np.zeros(2),
        "algo.lr": rates, "eval/return": rates, "eval/cost": rates,
    }  # fmt: skip
    plots.curves(table, tmp_path / "curves.png", "", 25.0)
    table |= {"train/return": rates, "train/cost": rates}
    plots.curves(table, tmp_path / "curves.png", "", 25.0)
    offline, online = (f.axes[0].get_legend_handles_labels()[1] for f in figures)
    assert offline == [f"algo.lr={x}, evaluated, mean action" for x in (1, 2)]
    assert online == ["algo.lr=1", "evaluated, mean action", "algo.lr=2", "evaluated, mean action"]


def test_a_figure_grows_by_a_legend_of_many_long_names():
    """Its panel keeps its height, and all of the legend is inside the figure."""
    figure, panels = plots.grid(1, size=(3.0, 3.0))
    for i in range(20):
        panels[0].plot([0, 1], [i, i], label=f"an algorithm with option={i} and another={i}")
    plots.legend(figure, panels)
    figure.canvas.draw()
    below = figure.legends[0].get_window_extent()
    assert panels[0].get_window_extent().height > 2 * figure.dpi
    assert below.y0 >= 0 and below.x0 >= 0 and below.y1 < panels[0].get_window_extent().y0
    assert below.x1 <= figure.get_figwidth() * figure.dpi
