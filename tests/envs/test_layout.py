"""Where objects are placed: distributions of the original, and the rules they keep."""

import functools
import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import BUSY, FAST
from scipy.stats import chisquare, ks_2samp, kstest
from tasks import ROBOT_AT_ORIGIN, change, in_parts, put, task, with_qpos

from jaxsafe import envs
from jaxsafe.config import ConfigError
from jaxsafe.envs import registry
from jaxsafe.envs.safety_gym import layout as layouts
from jaxsafe.envs.safety_gym.arena import World
from jaxsafe.envs.safety_gym.config import config_from_plain, defaults

DATA = Path(__file__).parent.parent / "data"
RECORDED = ("point_goal2", "car_push2", "doggo_button2")
COUNT = 1000
FALSE_ALARM = 1e-3  # of a whole test, shared among its comparisons


def recorded(name: str) -> dict[str, np.ndarray]:
    with np.load(DATA / f"layouts_{name}.npz", allow_pickle=False) as file:
        return {k: file[k] for k in file.files}


@functools.cache
def begun(name: str) -> World:
    reset, _ = in_parts(task(name).env, compiler_options=BUSY)
    return reset(jax.random.split(jax.random.key(11), COUNT)).physics


@functools.cache
def starts(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Layouts, the robot's start poses and goal buttons of 1000 resets."""
    world = begun(name)
    return np.asarray(world.layout), np.asarray(world.start), np.asarray(world.goal_button)


def sampled(place: layouts.Placement, count: int, seed: int = 0) -> tuple[jax.Array, jax.Array]:
    """Layouts [count, n, 2], and whether each is valid."""
    sample = jax.jit(jax.vmap(lambda k: layouts.sample_layout(place, k)), compiler_options=FAST)
    return sample(jax.random.split(jax.random.key(seed), count))


@functools.cache
def first_layouts(name: str) -> np.ndarray:
    """Layouts as they are before the goal is drawn anew."""
    place = task(name).env.place
    xy, found = sampled(place, COUNT, seed=5)
    assert found.all()
    return np.asarray(xy)


def distances(xy: np.ndarray) -> np.ndarray:
    """Of all pairs of objects [layouts, pairs]."""
    i, j = np.triu_indices(xy.shape[1], 1)
    return np.linalg.norm(xy[:, i] - xy[:, j], axis=-1)


def same_distribution(ours: np.ndarray, theirs: np.ndarray) -> None:
    """Columns [samples, columns] pass two-sample Kolmogorov-Smirnov tests, Bonferroni-corrected."""
    p = np.array([ks_2samp(a, b)[1] for a, b in zip(ours.T, theirs.T, strict=True)])
    assert p.min() > FALSE_ALARM / len(p), f"column {p.argmin()} of {len(p)}: p = {p.min():.1g}"


@pytest.mark.parametrize("name", RECORDED)
def test_positions_and_distances_are_distributed_as_in_the_original(name):
    theirs = recorded(name)
    names = json.loads(str(theirs["meta"]))["layout_sample_names"]
    xy, start, _ = starts(name)
    order = [task(name).env.place.names.index(n) for n in names]
    ours = xy[:, order]
    same_distribution(
        ours.reshape(len(ours), -1), theirs["layout.xy"].reshape(len(theirs["layout.xy"]), -1)
    )
    same_distribution(distances(ours), distances(theirs["layout.xy"]))
    same_distribution(start[:, 2:], theirs["layout.robot_rot"][:, None])


@pytest.mark.parametrize("name", ["point_goal2", "car_push2"])
def test_the_goal_that_is_discarded_is_distributed_as_in_the_original(name):
    theirs = recorded(name)
    names = json.loads(str(theirs["meta"]))["layout_sample_names"]
    place = task(name).env.place
    first, goal = first_layouts(name), place.names.index("goal")
    discarded = theirs["layout.first_goal_xy"]
    others = [n for n in names if n != "goal"]

    def around(goal_xy: np.ndarray, xy: np.ndarray) -> np.ndarray:
        """The goal's position and its distances from all else."""
        return np.concatenate([goal_xy, np.linalg.norm(xy - goal_xy[:, None], axis=-1)], 1)

    ours = around(first[:, goal], first[:, [place.names.index(n) for n in others]])
    same_distribution(ours, around(discarded, theirs["layout.xy"][:, [names.index(n) for n in others]]))


def test_the_goal_is_drawn_anew_after_the_layout(monkeypatch):
    env, seen = task("point_goal1").env, []

    def remember(place, key):
        seen.append(sample(place, key))
        return seen[-1]

    sample = layouts.sample_layout
    monkeypatch.setattr(layouts, "sample_layout", remember)
    begin = jax.jit(lambda key: (env.reset(key).physics, seen[-1]), compiler_options=FAST)
    world, (xy, found) = begin(jax.random.key(2))
    others = np.arange(len(xy)) != env.place.names.index("goal")
    np.testing.assert_array_equal(world.layout[others], xy[others])
    assert found and np.abs(world.layout - xy)[~others].max() > 0.01


def test_goal_buttons_are_drawn_evenly():
    _, _, button = starts("doggo_button2")
    theirs = np.bincount(recorded("doggo_button2")["layout.goal_button"], minlength=4)
    assert chisquare(np.bincount(button, minlength=4)).pvalue > FALSE_ALARM
    assert chisquare(theirs).pvalue > FALSE_ALARM


def test_headings_are_uniform_and_differ_between_objects():
    vases = begun("point_goal2").bodies.qpos[:, task("point_goal2").env.scene.qpos_slice("vases")]
    quat = np.asarray(vases).reshape(COUNT, -1, 7)[:, :, 3:]
    heading = np.mod(2 * np.arctan2(quat[..., 3], quat[..., 0]), 2 * np.pi) / (2 * np.pi)
    assert min(kstest(column, "uniform").pvalue for column in heading.T) > FALSE_ALARM / 10
    assert np.abs(np.corrcoef(heading.T) - np.eye(10)).max() < 0.1


@pytest.mark.parametrize("name", RECORDED)
def test_objects_keep_apart_and_inside_the_extents(name):
    env = task(name).env
    samples = [starts(name)[0]]
    if "goal" in env.place.names:
        samples.append(first_layouts(name))
    for xy in samples:
        keepouts = env.place.keepouts
        i, j = np.triu_indices(len(keepouts), 1)
        assert (distances(xy) >= (keepouts[i] + keepouts[j]) - 1e-6).all()
        assert (np.abs(xy) <= env.config.placements_extents[2] - keepouts[:, None] + 1e-6).all()


def test_a_margin_is_added_to_every_distance():
    place = layouts.placement(envs.make("point_goal1", engine="c", placements_margin=0.2).config)
    xy, found = sampled(place, 64)
    i, j = np.triu_indices(len(place.names), 1)
    apart = distances(np.asarray(xy)) - (place.keepouts[i] + place.keepouts[j])
    assert found.all() and 0.2 - 1e-6 <= apart.min() < 0.25


def test_a_negative_margin_lets_objects_overlap():
    place = layouts.placement(envs.make("point_goal1", engine="c", placements_margin=-2.0).config)
    xy, found = sampled(place, 64)
    assert found.all() and layouts.feasible(place) and distances(np.asarray(xy)).min() < 0.1


def test_locations_fix_the_first_objects_of_a_kind():
    fixed = ((-1.2, 0.3), (0.7, -1.1))
    t = task(
        "point_goal1",
        hazards_locations=fixed,
        robot_locations=((0.5, 0.5),),
        goal_locations=((1.1, 1.0),),
    )
    xy = np.asarray(t.begin(16).physics.layout)
    hazards = xy[:, t.env.place.slice("hazards")]
    np.testing.assert_allclose(hazards[:, :2], np.broadcast_to(fixed, (16, 2, 2)), atol=1e-6)
    np.testing.assert_allclose(xy[:, 0], [[0.5, 0.5]] * 16, atol=1e-6)
    np.testing.assert_allclose(xy[:, 1], [[1.1, 1.0]] * 16, atol=1e-6)
    assert np.ptp(hazards[:, 2:], axis=0).min() > 0.1


@pytest.mark.parametrize("x", [0.0, 0.05, 0.1, 0.2, -0.3, 7.3, 301.7])
def test_fixed_objects_may_be_just_as_far_apart_as_required(x):
    options = {
        "task": "none",
        "hazards_num": 2,
        "hazards_keepout": 0.3,
        "robot_locations": ((x, 2.0),),
    }
    for gap, fits in ((0.6, True), (0.599, False)):
        locations = ((x, 0.0), (x + gap, 0.0))
        place = layouts.placement(config_from_plain(defaults(**options, hazards_locations=locations)))
        _, found = layouts.sample_layout(place, jax.random.key(0))
        assert layouts.feasible(place) == fits and found == fits


def test_placements_are_chosen_by_their_shrunken_areas():
    """Keepout 0.18 shrinks a 1 x 1 square to 0.4096 m^2, and a 0.5 x 1 one to 0.0896 m^2."""
    rectangles = ((-3.0, -3.0, -2.0, -2.0), (2.0, 2.0, 2.5, 3.0), (0.0, 0.0, 0.3, 5.0))
    place = layouts.placement(
        envs.make("point_goal1", engine="c", hazards_placements=rectangles, hazards_num=1).config
    )
    xy = np.asarray(sampled(place, 4000, seed=1)[0])[:, place.names.index("hazard0")]
    first = xy[:, 0] < 0
    share = 0.64**2 / (0.64**2 + 0.14 * 0.64)
    assert abs(first.mean() - share) < 4 * np.sqrt(share * (1 - share) / 4000)
    low, high = xy[first].min(0), xy[first].max(0)
    np.testing.assert_allclose([low, high], [[-2.82] * 2, [-2.18] * 2], atol=0.01)
    assert (xy[~first] > [2.179, 2.179]).all() and (xy[~first] < [2.321, 2.821]).all()


@pytest.mark.parametrize(
    "options, says",
    [
        ({"placements_extents": (-0.3, -0.3, 0.3, 0.3)}, "no room for robot"),
        ({"goal_keepout": 1.6}, "no room for goal"),
        ({"hazards_placements": ((0.0, 0.0, 0.36, 1.0),)}, "no room for hazards"),
        ({"placements_extents": (1.0, -1.0, -1.0, 1.0)}, "min < max"),
        ({"vases_placements": ((0.0, 1.0, 1.0, 1.0),)}, "min < max"),
        ({"hazards_num": -1}, "expected a whole number between 0 and 200"),
    ],
)
def test_a_layout_without_room_is_refused_when_made(options, says):
    with pytest.raises(ConfigError, match=says):
        envs.make("point_goal1", engine="c", **options)


SAME_PLACE = {"hazards_num": 2, "hazards_locations": ((0.0, 0.0), (0.0, 0.0))}


@pytest.mark.parametrize("options", [SAME_PLACE, {"hazards_num": 65}])
def test_a_layout_that_nobody_finds_is_refused_when_made(options):
    start = time.process_time()
    with pytest.raises(ConfigError, match=r"env: no valid layout in 10,000 tries: fewer or smaller"):
        envs.make("point_goal1", engine="c", **options)
    assert time.process_time() - start < 10  # s; about 2


def test_a_config_without_a_layout_is_refused_when_made():
    with pytest.raises(ConfigError, match="no valid layout"):
        envs.make(config_from_plain(defaults(**envs.ENVS["point_goal1"]) | SAME_PLACE), engine="c")


def test_only_changed_options_are_tried(monkeypatch):
    monkeypatch.setattr(layouts, "feasible", lambda place: pytest.fail("a layout was tried"))
    assert envs.make("point_goal1", engine="c").name == "point_goal1"


@pytest.mark.parametrize("name", sorted(n for n in registry.OURS if n.startswith("car")))
def test_every_registered_layout_is_found(name):
    assert layouts.feasible(layouts.placement(config_from_plain(defaults(**envs.ENVS[name]))))


@pytest.mark.parametrize("lanes", [1, 8])
def test_trying_layouts_side_by_side_favours_none(lanes):
    """Two hazards on a line: the nearer to its middle the first, the more draws the second needs.

    With f of the line free, the second is found with probability 1 - (1 - f)^100; that is the law
    of the first. Were the layout found first the one used, the middle would be rare.
    """
    line, gap = np.array([[-1, -1e-4, 1, 1e-4]], np.float32), 0.998
    place = layouts.Placement(
        names=("hazard0", "hazard1"),
        kinds=("hazards", "hazards"),
        areas=np.stack([line, line]),
        weights=np.ones((2, 1), np.float32),
        keepouts=np.full(2, gap / 2, np.float32),
        margin=0.0,
        turns=np.arange(2),
    )
    vars(place)["lanes"] = lanes
    xy, found = sampled(place, 10_000, seed=2)
    grid = np.linspace(0, 1, 2001)
    free = (grid + 1 - gap + np.maximum(1 - gap - grid, 0)) / 2
    law = np.cumsum(1 - (1 - free) ** place.search.draws)
    assert found.all()
    assert kstest(np.abs(xy[:, 0, 0]), lambda x: np.interp(x, grid, law / law[-1])).pvalue > FALSE_ALARM


def test_a_layout_is_found_exactly_where_there_is_room():
    """Two hazards of keepout 0.4 on a line of 0.8 m between centres need a margin of at most 0."""
    line = {"hazards_num": 2, "hazards_locations": ((0.6, 0.0), (1.4, 0.0)), "hazards_keepout": 0.4}
    line |= {"robot_locations": ((-1.0, 0.0),), "task": "none"}
    for margin, room in ((-0.01, True), (0.01, False)):
        place = layouts.placement(config_from_plain(defaults(**line, placements_margin=margin)))
        assert layouts.feasible(place) == room
        assert layouts.sample_layout(place, jax.random.key(0))[1] == room


def test_a_new_goal_is_clear_of_where_things_are_now():
    """Goal keepout 0.305: 0.705 m from the robot (0.4), 0.455 m from a vase (0.15), as they are."""
    t = task("point_goal1")
    begun = with_qpos(t.begin(256), slice(0, 2), [0.2, -0.3])
    vase = t.env.scene.qpos_slice("vases").start
    begun = with_qpos(begun, slice(vase, vase + 2), [-0.6, 0.4])
    state = t.idle(put(t, begun, "goal", [0.25, -0.3]))
    assert state.info["goal_met"].all() and not state.terminated.any()
    xy = np.asarray(state.physics.layout)
    goal, hazards = xy[:, 1], xy[:, t.env.place.slice("hazards")]
    assert 0.705 - 1e-4 < np.linalg.norm(goal - [0.2, -0.3], axis=1).min() < 0.75
    assert np.linalg.norm(goal - [-0.6, 0.4], axis=1).min() > 0.455 - 1e-4
    assert np.linalg.norm(goal[:, None] - hazards, axis=-1).min() > 0.485 - 1e-6
    assert len(np.unique(goal[:, 0])) == 256 and (np.abs(goal) < 1.195 + 1e-6).all()


def test_a_goal_without_room_ends_the_episode_or_stays():
    """Goals are within 0.1 m of (0.6, 0), and the robot in their midst needs 0.505 m."""
    area = ((0.195, -0.405, 1.005, 0.405),)
    crowd = {"goal_placements": area, **ROBOT_AT_ORIGIN, "robot_keepout": 0.2}
    for ends in (True, False):
        t = task("point_goal0", **crowd, terminate_resample_failure=ends)
        state = with_qpos(t.begin(), slice(0, 2), [0.6, 0.0])
        after = t.idle(state)
        np.testing.assert_array_equal(after.info["goal_met"], 1)
        np.testing.assert_array_equal(after.terminated, ends)
        np.testing.assert_array_equal(after.physics.layout[:, 1], state.physics.layout[:, 1])


def test_a_goal_may_be_drawn_where_the_last_one_was():
    options = {"task": "goal", "goal_locations": ((0.5, 0.0),), "robot_locations": ((-1.0, 0.0),)}
    place = layouts.placement(config_from_plain(defaults(**options)))
    xy = jnp.array([[-1.0, 0.0], [0.5, 0.0]])
    found = layouts.sample_goal(place, jax.random.key(0), xy, jnp.bool_(True))
    assert found[1] and np.abs(found[0] - xy[1]).max() < 1e-6


def test_a_new_goal_keeps_clear_of_where_the_box_is_now_and_of_where_gremlins_circle():
    options = {"gremlins_num": 1, "vases_num": 1, "placements_extents": (-3.0, -3.0, 3.0, 3.0)}
    env = envs.make("car_push1", engine="c", **options)
    names = env.place.names
    xy = jnp.stack([jnp.arange(len(names)) * 0.1, jnp.zeros(len(names))], 1)
    world = env.arena.at_rest(xy, jnp.zeros(len(names)), jax.random.key(0))
    qpos = world.bodies.qpos.at[0].set(1.5)
    for kind, x in {"box": 2.5, "vases": -1.5, "gremlins": -2.5}.items():
        qpos = qpos.at[env.scene.qpos_slice(kind).start].set(x)
    now = env.arena.layout_now(world.replace(bodies=world.bodies.replace(qpos=qpos)))
    moved = {"robot": 1.5, "box": 2.5, "vase0": -1.5}
    expected = [moved.get(name, 0.1 * i) for i, name in enumerate(names)]
    np.testing.assert_allclose(now[:, 0], expected, rtol=1e-6)
    np.testing.assert_array_equal(now[:, 1], 0)


def test_one_layout_repeats_if_it_is_not_randomized():
    t = task("point_goal1", randomize_layout=False, action_noise=0.1)
    state = t.begin(3)
    for _ in range(2):
        jax.tree.map(
            lambda x: np.testing.assert_array_equal(x, jnp.broadcast_to(x[:1], x.shape)),
            state.physics.layout,
        )
        np.testing.assert_array_equal(state.obs, np.broadcast_to(state.obs[:1], state.obs.shape))
        state = t.idle(
            change(state, layout=state.physics.layout.at[:, 1].set(state.physics.start[:, :2]))
        )
    assert state.info["goal_met"].all()


def test_layouts_differ_between_keys_and_seeds():
    first, again, other = (
        np.asarray(task("point_goal1").begin(64, seed=s).physics.layout) for s in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, again)
    assert len(np.unique(first[:, 0, 0])) == 64
    assert not np.isin(first[:, 0, 0], other[:, 0, 0]).any()
    seeded = np.asarray(task("point_goal1", _seed=3).begin(64, seed=0).physics.layout)
    assert not np.isin(first[:, 0, 0], seeded[:, 0, 0]).any()
