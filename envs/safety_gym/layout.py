"""Where objects are at the start of an episode, and where the next goal appears.

Objects are placed one after another, each uniformly in its rectangle shrunk by its own keepout, at
the first of 100 draws that keeps its distance from all placed before it. If none does, the whole
layout is drawn again, up to 10,000 times. Source: Safety Gym's Engine, `build_layout`.

By SEditor's rules those with the largest keepouts are placed first, in 200 draws and 100,000 layouts.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.config import ConfigError
from jaxsafe.envs.safety_gym.config import KINDS, Rectangle, SafetyGymConfig

DRAWS_AT_ONCE = 25  # draws for an object that are examined at once
LANES = 32  # layouts tried side by side, at most
LAYOUT_BATCH = 100  # layouts examined at once before training
GOAL_DRAWS = 10_000
ORDER = {  # of placing
    "safety_gym": [
        "robot",
        "walls",
        "goal",
        "box",
        "buttons",
        "hazards",
        "vases",
        "pillars",
        "gremlins",
    ],
    "safety_gymnasium": ["robot", "buttons", "goal", "hazards", "pillars", "vases", "box", "gremlins"],
}
ORDER["seditor"] = ORDER["safety_gym"]
GOAL_BATCH = 16  # draws of a new goal examined at once
ROUNDING = 1e-6  # of distances in float32, times the largest coordinate


class Search(NamedTuple):
    """How many draws an object has, and how many layouts are tried."""

    draws: int
    layouts: int


SEARCHES = {
    "safety_gym": Search(100, 10_000),
    "safety_gymnasium": Search(100, 10_000),
    "seditor": Search(200, 100_000),
}


@dataclass(frozen=True)
class Placement:
    """The objects of a task.

    names: 'robot', 'goal', 'hazard0', ...; kinds: 'robot', 'goal', 'hazards', ...
    areas [n, r, 4] and weights [n, r]: the shrunk rectangles of each object, and how likely each is.
    keepouts [n], in m, and the margin between any two objects.
    turns [n]: which object is placed first, second and so on.
    """

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    areas: np.ndarray
    weights: np.ndarray
    keepouts: np.ndarray
    margin: float
    turns: np.ndarray
    search: Search = SEARCHES["safety_gym"]

    @property
    def apart(self) -> np.ndarray:
        """The distance required between any two objects, [n, n] in m, less what float32 rounds.

        Fixed objects may be just as far apart as required. In Safety Gym they then pass in about half
        of their draws, which differ by 1e-9 m.
        """
        required = self.keepouts[:, None] + self.keepouts[None, :] + self.margin
        rounding = ROUNDING * max(1.0, float(np.abs(self.areas).max()))
        return np.maximum(required - rounding, 0.0)

    @cached_property
    def lanes(self) -> int:
        """Layouts tried side by side: as many as hold a valid one on average, 1 where most are."""
        valid = count_valid(self, np.random.default_rng(0))
        return min(LANES, round(LAYOUT_BATCH / max(valid, 1)))

    def slice(self, kind: str) -> slice:
        """Where the objects of a kind are; they stand together."""
        start = self.kinds.index(kind) if kind in self.kinds else 0
        return slice(start, start + self.kinds.count(kind))


def placement(cfg: SafetyGymConfig) -> Placement:
    """Read a config's layout options.

    Raises:
        ConfigError: an object whose rectangles vanish when shrunk by its keepout.
    """
    mark = cfg.rules != "safety_gym"  # elsewhere a mark of the goal is placed among buttons, too
    counts = {kind: getattr(cfg, f"{kind}_num") for kind in KINDS}
    counts |= {
        "robot": 1,
        "goal": cfg.task in ("goal", "push") or (mark and cfg.task == "button"),
        "box": cfg.task == "push",
    }
    kinds = [kind for kind in ORDER[cfg.rules] for _ in range(counts[kind])]
    names, rectangles = [], []
    for i, kind in enumerate(kinds):
        number = i - kinds.index(kind)
        names.append(kind if kind in ("robot", "goal", "box") else f"{kind[:-1]}{number}")
        rectangles.append(areas_of(cfg, kind, number))
    keepouts = np.array([getattr(cfg, f"{kind}_keepout") for kind in kinds], np.float32)
    most = max(map(len, rectangles))
    areas = np.zeros((len(kinds), most, 4), np.float32)
    weights = np.zeros((len(kinds), most), np.float32)
    for i, found in enumerate(rectangles):
        areas[i, : len(found)] = found
        sizes = [(x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in found]
        weights[i, : len(found)] = np.array(sizes) / sum(sizes)
    return Placement(
        names=tuple(names),
        kinds=tuple(kinds),
        areas=areas,
        weights=weights,
        keepouts=keepouts,
        margin=cfg.placements_margin,
        turns=np.argsort(-keepouts, stable=True) if cfg.rules == "seditor" else np.arange(len(kinds)),
        search=SEARCHES[cfg.rules],
    )


def areas_of(cfg: SafetyGymConfig, kind: str, number: int) -> list[Rectangle]:
    """An object's rectangles, shrunk by its keepout; a fixed location is a tiny one."""
    keepout = getattr(cfg, f"{kind}_keepout")
    locations = getattr(cfg, f"{kind}_locations")
    if number < len(locations):
        (x, y), r = locations[number], keepout + 1e-9
        choices = ((x - r, y - r, x + r, y + r),)
    else:
        choices = getattr(cfg, f"{kind}_placements") or (cfg.placements_extents,)
    shrunk = [(x0 + keepout, y0 + keepout, x1 - keepout, y1 - keepout) for x0, y0, x1, y1 in choices]
    kept = [(x0, y0, x1, y1) for x0, y0, x1, y1 in shrunk if x0 < x1 and y0 < y1]
    if not kept:
        raise ConfigError(
            f"env: no room for {kind}: {list(choices)} shrunk by {kind}_keepout={keepout} is empty"
        )
    return kept


def draw_positions(key: jax.Array, areas: jax.Array, weights: jax.Array, count: int) -> jax.Array:
    """`count` positions [count, 2] of one object, from rectangles [r, 4] of given weights [r]."""
    choice_key, place_key = jax.random.split(key)
    if areas.shape[0] == 1:
        area = areas
    else:
        area = areas[jax.random.choice(choice_key, areas.shape[0], (count,), p=weights)]
    return jax.random.uniform(place_key, (count, 2), minval=area[:, :2], maxval=area[:, 2:])


def clear(candidates: jax.Array, xy: jax.Array, apart: jax.Array) -> jax.Array:
    """Whether candidates [m, 2] are at least `apart` [n] from the objects [n, 2]: bool [m, n]."""
    x, y = (candidates[:, None] - xy[None]).transpose(2, 0, 1)  # a norm is ten times as slow on a CPU
    return x**2 + y**2 >= apart**2


class Lane(NamedTuple):
    """A search for a layout of n objects.

    xy: float [n, 2], positions; those of the first `placed` objects, int32 [], count.
    draws: int32 [], draws for the next object so far. number: int32 [], of the layout tried.
    """

    xy: jax.Array
    placed: jax.Array
    draws: jax.Array
    number: jax.Array
    key: jax.Array


def sample_layout(place: Placement, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Positions of all objects [n, 2], and whether one of the layouts was valid.

    Layouts are numbered. Lane i tries those with the numbers i, i + lanes, i + 2 lanes and so on, and
    waits for no other lane. The valid layout with the lowest number is used: the one found first would
    favour layouts that need few draws.
    """
    n, lanes, turns, search = len(place.names), place.lanes, place.turns, place.search
    apart = place.apart[turns][:, turns]
    areas, weights, apart = map(jnp.asarray, (place.areas[turns], place.weights[turns], apart))

    def place_next(lane: Lane) -> Lane:
        xy, i, draws, number, key = lane
        key, draw_key = jax.random.split(key)
        candidates = draw_positions(draw_key, areas[i], weights[i], DRAWS_AT_ONCE)
        free = jnp.all(clear(candidates, xy, apart[i]) | (jnp.arange(n) >= i), axis=1)
        found, draws = free.any() & (i < n), draws + DRAWS_AT_ONCE
        failed = ~found & (i < n) & (draws >= search.draws)
        xy = jnp.where((jnp.arange(n) == i)[:, None], candidates[jnp.argmax(free)], xy)
        i, draws = jnp.where(failed, 0, i + found), jnp.where(found | failed, 0, draws)
        return Lane(xy, i, draws, number + lanes * failed, key)

    def searching(now: Lane) -> jax.Array:
        lowest = jnp.argmin(now.number)
        return (now.placed[lowest] < n) & (now.number[lowest] < search.layouts)

    zeros = jnp.zeros(lanes, jnp.int32)
    numbers, keys = jnp.arange(lanes, dtype=jnp.int32), key[None]
    if lanes > 1:  # a lone lane keeps the key, whose layouts are those of earlier versions
        keys = jax.random.split(key, lanes)
    start = Lane(jnp.zeros((lanes, n, 2)), zeros, zeros, numbers, keys)
    end = jax.lax.while_loop(searching, jax.vmap(place_next), start)
    lowest = jnp.argmin(end.number)
    return end.xy[lowest][np.argsort(turns)], end.placed[lowest] == n


def has_room(place: Placement) -> bool:
    """Whether the discs that stay free around the objects take no more than the whole area.

    With a negative margin they may overlap.
    """
    used, keepouts = place.weights > 0, place.keepouts[:, None, None].astype(float)
    low = (place.areas[..., :2] - keepouts)[used].min(0)
    high = (place.areas[..., 2:] + keepouts)[used].max(0)
    return place.margin < 0 or bool(np.pi * (keepouts**2).sum() <= np.prod(high - low))


def feasible(place: Placement) -> bool:
    """Whether as many layouts as are tried hold a valid one."""
    rng = np.random.default_rng(0)
    return any(count_valid(place, rng) for _ in range(0, place.search.layouts, LAYOUT_BATCH))


def count_valid(place: Placement, rng: np.random.Generator) -> int:
    """How many of 100 layouts are valid, by the search of `sample_layout` without compiling."""
    placed = np.zeros((0, 2, LAYOUT_BATCH, 1), np.float32)  # in the layouts still valid
    turns = place.turns
    apart_all = place.apart[turns][:, turns]
    for areas, weights, apart in zip(place.areas[turns], place.weights[turns], apart_all, strict=True):
        shape = placed.shape[2], place.search.draws
        area = areas[rng.choice(len(areas), shape, p=weights / weights.sum(dtype=float)).T].T
        x, y = area[:2] + rng.random((2, *shape), np.float32) * (area[2:] - area[:2])
        free = np.ones(shape, bool)
        for (other_x, other_y), gap in zip(placed, apart, strict=False):
            free &= (x - other_x) ** 2 + (y - other_y) ** 2 >= gap**2
        room, first = free.any(1), free.argmax(1)[:, None]
        chosen = np.stack([np.take_along_axis(v, first, 1) for v in (x, y)])
        placed = np.concatenate([placed, chosen[None]])[:, :, room]
        if not room.any():
            break
    return placed.shape[2]


class GoalSearch(NamedTuple):
    """Position of the goal, float [2], whether it is found, bool [], and draws so far, int32 []."""

    position: jax.Array
    found: jax.Array
    tries: jax.Array
    key: jax.Array


def sample_goal(
    place: Placement, key: jax.Array, xy: jax.Array, wanted: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """A new place for the goal, clear of all other objects [n, 2]: position [2] and whether found.

    Up to 10,000 draws, in batches; no work where `wanted` is False.
    """
    goal = place.names.index("goal")
    apart = jnp.asarray(place.apart[goal])
    others = np.arange(len(place.names)) != goal

    def batch(now: GoalSearch) -> GoalSearch:
        key, draw_key = jax.random.split(now.key)
        candidates = draw_positions(
            draw_key, jnp.asarray(place.areas[goal]), jnp.asarray(place.weights[goal]), GOAL_BATCH
        )
        free = jnp.all(clear(candidates, xy, apart) | ~others, axis=1)
        return GoalSearch(candidates[jnp.argmax(free)], free.any(), now.tries + GOAL_BATCH, key)

    start = GoalSearch(xy[goal], ~wanted, jnp.int32(0), key)
    end = jax.lax.while_loop(lambda now: ~now.found & (now.tries < GOAL_DRAWS), batch, start)
    return end.position, end.found
