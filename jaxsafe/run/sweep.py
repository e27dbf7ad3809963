"""A grid of settings, trained side by side where one compiled program can hold them.

A group of `jaxsafe.run.sweep_plan` is one program. One that does not fit the memory is split into equal
parts: of whole settings or, where the seeds of one setting are too many, of seeds.

    SWEEP/sweep.yaml                   what was asked; how many members of a group run at once
    SWEEP/000-<env>-<algo>...[.part0]/ a run folder as of train.py, of a group or a part of one
    SWEEP/summary.md, .csv, .png, .svg a row a setting, rewritten after each run folder
"""

import itertools
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from jaxsafe.run import checkpoint, clock, files, memory, run_folder, session
from jaxsafe.run.divergence import Diverged
from jaxsafe.run.interrupts import Interrupts
from jaxsafe.run.policies import warm_start
from jaxsafe.run.programs import Program
from jaxsafe.run.progress import Reporter
from jaxsafe.run.session import Finish, Session
from jaxsafe.run.settings import Settings
from jaxsafe.run.sweep_folder import open_folder, write_folder
from jaxsafe.run.sweep_plan import Sweep


class After(NamedTuple):
    """What follows the training of a run folder of a sweep."""

    finish: Finish
    summarise: Callable[[Path], object]  # of the sweep's folder


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
        checkpoint.NotSaved: the disk failed. A folder that cannot be written shows before it compiles.
        Diverged: a run did, after the others were trained.
    """
    parallel, diverged = open_folder(sweep), []
    with checkpoint.writing_to(sweep.folder):
        files.try_writing(sweep.folder)
    sizes = [len(s.configs) for s in sweep.groups.values()]
    report.line(
        f"sweep: {sum(sizes)} settings in {len(sizes)} group{'s' * (len(sizes) > 1)}, in {sweep.folder}"
    )
    for name, settings in sweep.groups.items():
        compiled: dict[int, Program] = {}  # by the number of their members
        if not begun(sweep, name):
            parallel[name], first = begin(sweep, name, resume_command, report)
            compiled[len(first.members)] = first
            write_folder(sweep, parallel)
        elif sweep.max_parallel not in (None, parallel[name]) and parallel[name] < settings.num_members:
            report.line(f"{name} goes on as it began, {parallel[name]} members at once")
        pieces = parts(settings, parallel[name])
        if len(pieces) > 1:
            report.line(
                f"{name}: {settings.num_members} members in {len(pieces)} parts, one after the other"
            )
        for i, piece in enumerate(pieces):
            part = name if len(pieces) == 1 else f"{name}.part{i:03d}"
            folder = files.inside(sweep.folder, part)
            if finished(piece, folder):
                report.line(f"finished already: {folder}")
                continue
            session.check_goes_on(folder, piece.train, lambda line: None)
            run = run_of(piece, folder, compiled, resume_command)
            try:
                status = session.run(run, report, after.finish)
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


def run_of(piece: Settings, folder: Path, compiled: dict[int, Program], resume_command: str) -> Session:
    """What trains `piece` in `folder`. Parts of one size differ in data, so they share a program."""
    piece = piece._replace(train=replace(piece.train, run_dir=str(folder), resume=True))
    env, program = session.prepare(piece)
    same = compiled.setdefault(len(program.members), program)
    program = program._replace(init=same.init, update=same.update)
    return Session(piece, folder, env, program, resume_command)


# ---- what there is of a group ------------------------------------------------------------------


def run_folders(sweep: Sweep, name: str) -> list[Path]:
    """Those of a group, perhaps in other parts than now."""
    return [files.inside(sweep.folder, folder.name) for folder in sweep.folder.glob(f"{name}*")]


def begun(sweep: Sweep, name: str) -> bool:
    """Whether anything of a group was saved."""
    folders = run_folders(sweep, name)
    parts = itertools.product(folders, ("checkpoints", "policy"))
    return any(checkpoint.checkpoints(files.inside(folder, part)) for folder, part in parts)


def begin(sweep: Sweep, name: str, resume_command: str, report: Reporter) -> tuple[int, Program]:
    """How many members of a group will run at once, and the program of its first part."""
    for leftover in run_folders(sweep, name):  # stopped before a first checkpoint
        with files.held(leftover):
            shutil.rmtree(leftover)
    with Interrupts(report.line, report.hosted) as stop:
        stop.nothing_to_save = f"stopped before the first update; {resume_command}"
        if not sweep.max_parallel:
            report.line(f"{name}: compiling, to see how many members fit the memory ...")
        return members_at_once(sweep.groups[name], sweep.max_parallel)


def finished(settings: Settings, folder: Path) -> bool:
    done = run_folder.newest_progress(folder) or run_folder.newest_progress(folder, "policy")
    train = settings.train
    evaluated = files.there(folder / "evaluation.json") or not train.eval_episodes
    return done is not None and clock.ended(train, done) and evaluated


# ---- parts of a group --------------------------------------------------------------------------


def parts(settings: Settings, parallel: int) -> list[Settings]:
    """`settings` in parts of at most `parallel` members, of about one size: whole settings, or seeds of
    one. Several members that run at once are as many on each device."""
    train, configs = settings.train, settings.configs
    parallel = on_devices(parallel, train.devices)
    each = train.devices if parallel > 1 else 1
    step = each // math.gcd(each, train.num_seeds)  # settings whose seeds split over the devices
    fits = step * train.num_seeds <= parallel
    whole = len(configs) // step * step if fits else 0
    together = slices(whole, parallel // train.num_seeds, step) if whole else []
    even = train.num_seeds // each * each
    apart = slices(even, parallel, each) if even else []
    apart += [slice(seed, seed + 1) for seed in range(even, train.num_seeds)]
    seeds = [
        replace(train, seed=train.seed + piece.start, num_seeds=piece.stop - piece.start)
        for piece in apart
    ]
    return [
        *(settings._replace(configs=configs[piece]) for piece in together),
        *(settings._replace(configs=(c,), train=t) for c in configs[whole:] for t in seeds),
    ]


def on_devices(members: int, devices: int) -> int:
    """At most so many members that split over the devices: a multiple of them, or a lone one, whose
    environments split."""
    return members // devices * devices or 1


def slices(count: int, most: int, step: int = 1) -> list[slice]:
    """Of 0 .. count, as few as hold at most `most` each, whose sizes differ by one `step` at most.
    `count` and all sizes are multiples of `step`."""
    steps = count // step
    number = -(-steps // (most // step))
    ends = [step * (steps * i // number) for i in range(number + 1)]
    return [slice(a, b) for a, b in itertools.pairwise(ends)]


def members_at_once(settings: Settings, most: int | None) -> tuple[int, Program]:
    """How many members run at once, `most` or what the memory holds; and the first part's program."""
    count, devices = settings.num_members, settings.train.devices
    if most:
        most = on_devices(min(count, most), devices)
        return most, first_program(settings, most)
    while True:
        try:
            program = first_program(settings, count)
        except memory.TooLarge:
            if count == 1:
                raise
            count = on_devices(-(-count // 2), devices)
            continue
        held = count if count == 1 else on_devices(memory.capacity(program), devices)
        fits = held >= len(program.members)  # which are fewer than `count` where settings are whole
        return (count if fits else held), program


def first_program(settings: Settings, parallel: int) -> Program:
    """The program of the first part. What is wrong with `init_from` shows before it compiles."""
    part = parts(settings, parallel)[0]
    _, program = session.prepare(part)
    if part.train.init_from:
        warm_start(part, program, lambda line: None)
    return program
