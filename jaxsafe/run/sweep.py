"""A grid of settings, trained side by side where one compiled program can hold them.

Floats of the algorithm are arrays to the program, so their grid and the seeds are the members of one.
Any other option with several values makes a group, and so a program, of each value. A group that does
not fit the memory is split into equal parts: of whole settings or, where the seeds of one setting are
too many, of seeds.

    SWEEP/sweep.yaml                   what was asked; how many members of a group run at once
    SWEEP/000-<env>-<algo>...[.part0]/ a run folder as of train.py, of a group or a part of one
    SWEEP/summary.md, .csv, .png       a row a setting, rewritten after each run folder
"""

import hashlib
import itertools
import json
import math
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from jaxsafe.config import Amount, ConfigError, convert, flat, is_float
from jaxsafe.run import checkpoint, clock, distributed, files, memory, run_folder, session
from jaxsafe.run.divergence import Diverged
from jaxsafe.run.interrupts import Interrupts
from jaxsafe.run.plain import as_text, differences, merged, repeated
from jaxsafe.run.policies import warm_start
from jaxsafe.run.programs import Program
from jaxsafe.run.progress import Reporter
from jaxsafe.run.session import Finish, Session
from jaxsafe.run.settings import (
    DEFAULT,
    MOST,
    NO_EXTRAS,
    NOT_COMPARED,
    Extras,
    Settings,
    find_algo,
    make_env,
    nested,
    settings_from_options,
)


class Sweep(NamedTuple):
    """What is to be trained."""

    swept: list[str]  # the options with several values, as `flat` names them
    groups: dict[str, Settings]  # by the name of their folders
    folder: Path
    max_parallel: int | None


class After(NamedTuple):
    """What follows the training of a run folder of a sweep."""

    finish: Finish
    summarise: Callable[[Path], object]  # of the sweep's folder


# ---- from options to groups ------------------------------------------------------------------


def plan(given: dict[str, Any], several: dict[str, list[Any]], extras: Extras = NO_EXTRAS) -> Sweep:
    """The groups of a sweep, every one of them checked.

    Args:
        given: the options with one value, as `settings_from_options` takes them, and `max_parallel`.
        several: those with several values, by name: 'env', 'seed', 'algo.clip'.
        extras: environments and algorithms beside the registered ones.
    Raises:
        ConfigError: an option that no run could use, or nothing to sweep.
    """
    given = dict(given)
    most, folder = given.pop("max_parallel", None), given.pop("run_dir", None)
    for name in {**given, **several}:
        if name == "resume":
            raise ConfigError("resume: a sweep goes on when the same command is given again")
        if name in distributed.OPTIONS:
            raise ConfigError(f"{name}: a sweep is one process")
    for name in ("max_parallel", "run_dir"):
        if name in several:
            raise ConfigError(f"{name}: expected one value")
    most = convert(most, Amount | None, "max_parallel")
    if not several:
        settings_from_options(given, extras)  # what is wrong with an option comes first
        raise ConfigError(
            "nothing to sweep: give an option several values, as in algo.cost_limit=5,10,25, "
            "or train one setting with the command train"
        )
    for name, values in several.items():
        if (value := repeated(values)) is not None:
            raise ConfigError(f"{name}={as_text(value)} occurs twice")
    if (count := math.prod(map(len, several.values()))) > MOST:
        raise ConfigError(f"{count:,} settings: expected at most {MOST:,} in a sweep")
    first = several.get("algo") or [given.get("algo", {}).get("name", DEFAULT["algo"])]
    kind = find_algo(first[0], extras).config
    floats = {k: v for k, v in several.items() if k.startswith("algo.") and is_float(kind, k[5:])}
    grid = list(zip(*itertools.product(*floats.values()), strict=True))
    side_by_side = {name: list(values) for name, values in zip(floats, grid, strict=True)}
    apart = {name: values for name, values in several.items() if name not in floats}
    groups = {}
    for i, values in enumerate(itertools.product(*apart.values())):
        chosen = dict(zip(apart, values, strict=True))
        settings = settings_from_options(merged(given, nested(side_by_side | chosen)), extras)
        settings.row.make(make_env(settings)).clocks(settings.algo)  # refuses sizes that do not fit
        rest = [f"{k}={as_text(v)}" for k, v in chosen.items() if k not in DEFAULT]
        name = "-".join([f"{i:03d}", settings.label, *rest])
        groups[re.sub(r"[^\w.=+-]+", "_", name)[:100]] = settings
    swept = [f"{k}.name" if k in DEFAULT else k for k in several]
    where = Path(folder).expanduser() if folder else default_folder(groups)
    return Sweep(swept, groups, where, most)


def compared_settings(settings: Settings) -> dict[str, Any]:
    """What a sweep's folder must agree on."""
    return {k: v for k, v in flat(settings.plain()).items() if k not in NOT_COMPARED}


def default_folder(groups: dict[str, Settings]) -> Path:
    first = next(iter(groups.values()))
    text = json.dumps([compared_settings(s) for s in groups.values()], sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    return Path("runs") / f"sweep-{first.label}-{digest}"


# ---- the folder ------------------------------------------------------------------------------


def open_folder(sweep: Sweep) -> dict[str, int]:
    """How many members of each group run at once, as far as the folder's sweep knows already.

    Raises:
        ConfigError: the folder holds something else.
    """
    asked = {name: compared_settings(settings) for name, settings in sweep.groups.items()}
    if not files.there(sweep.folder / "sweep.yaml"):
        if sweep.folder.exists() and (not sweep.folder.is_dir() or any(sweep.folder.iterdir())):
            raise ConfigError(f"run_dir={sweep.folder} holds something else than a sweep")
        return {}
    saved = read_folder(sweep.folder)
    other = f"{sweep.folder} belongs to another sweep"
    if [*asked] != [*saved["groups"]]:
        raise ConfigError(f"{other}, of {', '.join(saved['groups'])}; choose another run_dir")
    for name, settings in asked.items():
        for key, (here, there) in differences(settings, flat(saved["groups"][name])).items():
            raise ConfigError(f"{other}: {key} is {there} there, {here} here; choose another run_dir")
    return saved["parallel"]


def read_folder(folder: Path) -> dict[str, Any]:
    path = folder / "sweep.yaml"
    if not files.there(path):
        raise ConfigError(f"{folder} is not a sweep's folder: it has no sweep.yaml")
    saved = files.read_yaml(path)
    kinds = {"swept": list, "groups": dict, "parallel": dict}
    if not isinstance(saved, dict) or not all(
        isinstance(saved.get(k), kind) for k, kind in kinds.items()
    ):
        raise ConfigError(f"{path} does not describe a sweep")
    if not all(isinstance(name, str) for name in saved["swept"]):
        raise ConfigError(f"{path}: expected the names of options as swept")
    return saved


def write_folder(sweep: Sweep, parallel: dict[str, int]) -> None:
    asked = {name: compared_settings(settings) for name, settings in sweep.groups.items()}
    saved = {"swept": sweep.swept, "parallel": parallel, "groups": asked}
    try:
        sweep.folder.mkdir(parents=True, exist_ok=True)
        files.write(sweep.folder / "sweep.yaml", yaml.safe_dump(saved, sort_keys=False))
    except OSError as error:
        raise checkpoint.CheckpointError(f"cannot write to {sweep.folder}: {error.strerror}") from error


# ---- training --------------------------------------------------------------------------------


def parts(settings: Settings, parallel: int) -> list[Settings]:
    """`settings` in parts of at most `parallel` members, whose sizes differ by one at most."""
    train, configs = settings.train, settings.configs
    if train.num_seeds <= parallel:
        return [
            settings._replace(configs=configs[piece])
            for piece in slices(len(configs), parallel // train.num_seeds)
        ]
    seeds = [
        replace(train, seed=train.seed + piece.start, num_seeds=piece.stop - piece.start)
        for piece in slices(train.num_seeds, parallel)
    ]
    return [settings._replace(configs=(c,), train=t) for c in configs for t in seeds]


def slices(count: int, most: int) -> list[slice]:
    """Of 0 .. count, as few as hold at most `most` each, whose sizes differ by one at most."""
    number = -(-count // most)
    ends = [count * i // number for i in range(number + 1)]
    return [slice(a, b) for a, b in itertools.pairwise(ends)]


def members_at_once(settings: Settings, most: int | None) -> tuple[int, Program]:
    """How many members run at once, `most` or what the memory holds; and the first part's program."""
    members = len(settings.configs) * settings.train.num_seeds
    parallel = min(members, most or members)
    while True:
        part = parts(settings, parallel)[0]
        try:
            _, program = session.prepare(part)
        except memory.TooLarge:
            if parallel == 1 or most:
                raise
            parallel = -(-parallel // 2)
            continue
        if part.train.init_from:  # what is wrong with it shows before anything compiles
            warm_start(part, program, lambda line: None)
        held = parallel if parallel == 1 or most else memory.capacity(program)
        return (held if held < len(program.members) else parallel), program


def train(sweep: Sweep, resume_command: str, report: Reporter, after: After) -> int:
    """Train every group that is not finished.

    Args:
        sweep: from `plan`.
        resume_command: the command that continues it.
        report: where progress goes.
        after: what follows the training of each run folder.
    Returns:
        The exit status: 0, or 130 if the user stopped it.
    Raises:
        Diverged: a run did, after the others were trained.
    """
    known, diverged = open_folder(sweep), []
    sizes = [len(s.configs) for s in sweep.groups.values()]
    report.line(
        f"sweep: {sum(sizes)} settings in {len(sizes)} group{'s' * (len(sizes) > 1)}, in {sweep.folder}"
    )
    for name, settings in sweep.groups.items():
        members = len(settings.configs) * settings.train.num_seeds
        programs: dict[int, Program] = {}  # by the number of their members
        begun = [files.inside(sweep.folder, f.name) for f in sweep.folder.glob(f"{name}*")]
        if not any(checkpoint.checkpoints(files.inside(f, "checkpoints")) for f in begun):
            for leftover in begun:  # stopped before a first checkpoint, perhaps in other parts
                shutil.rmtree(leftover)
            with Interrupts(report.line, report.hosted) as stop:
                stop.nothing_to_save = f"stopped before the first update; {resume_command}"
                if not sweep.max_parallel:
                    report.line(f"{name}: compiling, to see how many members fit the memory ...")
                known[name], program = members_at_once(settings, sweep.max_parallel)
            programs[len(program.members)] = program
            write_folder(sweep, known)
        elif sweep.max_parallel not in (None, known[name]) and known[name] < members:
            report.line(f"{name} goes on as it began, {known[name]} members at once")
        pieces = parts(settings, known[name])
        if len(pieces) > 1:
            report.line(f"{name}: {members} members in {len(pieces)} parts, one after the other")
        for i, piece in enumerate(pieces):
            part = name if len(pieces) == 1 else f"{name}.part{i:03d}"
            folder = files.inside(sweep.folder, part)
            if finished(piece, folder):
                report.line(f"finished already: {folder}")
                continue
            piece = piece._replace(train=replace(piece.train, run_dir=str(folder), resume=True))
            env, program = session.prepare(piece)
            # what differs between parts of one size is data, so they share what is compiled
            same = programs.setdefault(len(program.members), program)
            program = program._replace(init=same.init, update=same.update)
            try:
                status = session.run(
                    Session(piece, folder, env, program, resume_command), report, after.finish
                )
            except Diverged as error:
                diverged.append(f"{folder.name}: {error}")
                report.line(f"warning: {diverged[-1]}; the sweep goes on")
                status = 0
            after.summarise(sweep.folder)
            if status:
                return status
    if diverged:
        raise Diverged(f"{len(diverged)} run folders diverged, the first is {diverged[0]}")
    return 0


def finished(settings: Settings, folder: Path) -> bool:
    done, train = run_folder.newest_progress(folder), settings.train
    evaluated = files.there(folder / "evaluation.json") or not train.eval_episodes
    return done is not None and clock.ended(train, done) and evaluated
