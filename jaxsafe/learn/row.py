"""A row of the registry of algorithms: all that the rest of jaxsafe needs to know of one."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxsafe.learn.acting import Course, Play
from jaxsafe.types import Algorithm, Env, PyTree

NOTHING: Mapping[str, Any] = MappingProxyType({})


class Examined(NamedTuple):
    """What evaluation measures beside returns and costs, of N episodes by each of S policies.

    measures: float [S, N] by name.
    calibration: of steps with a foreseen probability in each of equal parts of [0, 1], float [S, 3,
        parts]: how many, the sum of the probabilities, and how often it came true; or nothing.
    """

    measures: Mapping[str, np.ndarray] = NOTHING
    calibration: np.ndarray | None = None


class Row(NamedTuple):
    """An algorithm. Command line, contract tests, tables, pages and migration are made from its row.

    config: a class under `jaxsafe.config.config`. Its docstring is the algorithm's page: equations,
        source, departures.
    make: make(env, axis_name=None) -> Algorithm.
    summary: what it does, in a few words.
    published: setting -> options of the config that reproduce it; `preset=published` is the
        first of them. `cpu` and `pixels`, which are ours, do not count.
        A class of the config may name in `SUITS` the tasks whose default one of them is, and in
        `ACTS_BY` settings that a trained policy acts by, of which it may have other values.
    omnisafe: OmniSafe's name for it, from which scripts/migrate.py translates; '' if it has none.
    total_steps: environment steps of a run that does not say how many.
    holds: what keeps to the cost limit: the cost of the average episode, the cost of every episode,
        or nothing, where the limit is only drawn in plots.
    lever: options with which it learns Lever, the small exact problem of tests/toys.py, if its
        defaults do not.
    note: note(cfg), a line to print before training: what its settings promise; '' for nothing.
    examine: examine(algo, learned, course, play, sampled) -> Examined, what else evaluation measures in
        the N episodes that each of the S policies in `learned` played with mean or with `sampled`
        actions. `course` are their steps, [S, N, T, ...]. `play` plays them again, as with other
        settings in `learned`.
    check: check(cfg, env, data) raises ConfigError for settings, or a data set, that cannot serve.
        `data` is () where there is none.
    """

    config: type[Any]
    make: Callable[..., Algorithm]
    summary: str = ""
    published: Mapping[str, dict[str, Any]] = NOTHING
    omnisafe: str = ""
    total_steps: int = 10_000_000
    holds: Literal["average", "episode", "nothing"] = "average"
    lever: Mapping[str, Any] = NOTHING
    check: Callable[[Any, Env, Any], None] = lambda cfg, env, data: None
    note: Callable[[Any], str] = lambda cfg: ""
    examine: Callable[[Algorithm, PyTree, Course, Play, bool], Examined] = lambda *_: Examined()
