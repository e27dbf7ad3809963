"""A grid of settings, trained side by side where one compiled program can hold them.

The command line is train.py's, with several values for some options. Floats of the algorithm are
arrays to the program, so their grid and the seeds are the members of one; any other option with
several values makes a group, and so a program, of each. A group that does not fit the memory is
split into equal parts of whole settings or, where the seeds of one are too many, of seeds.

    SWEEP/sweep.yaml                   what was asked; how many members of a group run at once
    SWEEP/000-<env>-<algo>...[.part0]/ a run folder as of train.py, of a group or a part of one
    SWEEP/summary.md, .csv, .png       a row a setting, rewritten after each run folder
"""

import argparse
import csv
import hashlib
import io
import itertools
import json
import math
import re
import shlex
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from hydra.core.override_parser.types import Override, ValueType

from jaxsafe.config import ConfigError, flat, is_float
from jaxsafe.learn import on_policy
from jaxsafe.learn.constraints import in_words, written
from jaxsafe.report import compare, plots, tables
from jaxsafe.report.compare import Group
from jaxsafe.report.tables import Table
from jaxsafe.run import checkpoint, command, distributed, run_folder, runner
from jaxsafe.run.command import Settings, compose, guarded, one_line, parse
from jaxsafe.run.interrupts import Interrupts
from jaxsafe.run.progress import Report

EPILOG = """\
Options are those of train.py (python scripts/train.py --help), and

  max_parallel=N   members (settings x seeds) trained at once; default: what the memory holds
  run_dir=FOLDER   the sweep's folder; default: runs/sweep-<env>-<algo>-<a hash of the settings>

The same command again goes on where it was stopped."""


class Sweep(NamedTuple):
    """What a command line asks for."""

    swept: list[str]  # the options with several values, as `flat` names them
    groups: dict[str, Settings]  # by the name of their folders
    folder: Path
    max_parallel: int | None


# ---- from the command line to groups ---------------------------------------------------------


def read(texts: list[str], envs: Any, algos: Any) -> Sweep:
    """The groups of a command line, every one of them checked.

    Raises:
        ConfigError: an option that no run could use, or nothing to sweep.
    """
    own, given = {}, []
    for text in texts:
        override = parse(text)
        key = override.key_or_group
        if key in ("max_parallel", "run_dir"):
            own[key] = str(override.value())
        elif key == "resume":
            raise ConfigError(f"{text}: a sweep goes on when the same command is given again")
        elif key in distributed.OPTIONS:
            raise ConfigError(f"{text}: a sweep is one process")
        else:
            given.append(override)
    several = {o.key_or_group: choices(o) for o in given if o.is_sweep_override()}
    command.read_arguments(["--multirun", *(o.input_line for o in given)], envs, algos)
    if not several:
        raise ConfigError(
            "nothing to sweep: give an option several values, as in algo.cost_limit=5,10,25, "
            "or train one setting with scripts/train.py"
        )
    single = {o.key_or_group: str(o.value()) for o in given if not o.is_sweep_override()}
    algo = several.get("algo", [single.get("algo", command.DEFAULT["algo"])])[0]
    kind = algos.ALGOS[algo].config
    lists = {
        k: v
        for k, v in several.items()
        if k.startswith("algo.") and is_float(kind, k.removeprefix("algo."))
    }
    grid = list(zip(*itertools.product(*lists.values()), strict=True))
    side_by_side = [f"{k}=[{','.join(v)}]" for k, v in zip(lists, grid, strict=True)]
    fixed = [o.input_line for o in given if not o.is_sweep_override()]
    groups = {}
    apart = {k: v for k, v in several.items() if k not in lists}
    for i, values in enumerate(itertools.product(*apart.values())):
        texts = [f"{k}={v}" for k, v in zip(apart, values, strict=True)]
        settings = compose([*fixed, *side_by_side, *texts], envs, algos)
        command.make_env(settings, envs)
        on_policy.check(settings.algo)
        rest = [t for t in texts if not t.startswith(("env=", "algo="))]
        name = "-".join([f"{i:03d}", settings.label, *rest])
        groups[re.sub(r"[^\w.=+-]+", "_", name)[:100]] = settings
    parallel = own.get("max_parallel")
    if parallel is not None and not (parallel.isdigit() and int(parallel)):
        raise ConfigError(f"max_parallel={parallel}: expected a whole number of at least 1")
    swept = [f"{k}.name" if k in ("env", "algo") else k for k in several]
    folder = own.get("run_dir") or default_folder(groups)
    return Sweep(swept, groups, Path(folder).expanduser(), int(parallel) if parallel else None)


def choices(override: Override) -> list[str]:
    """The values of an option, as they were written."""
    key = override.key_or_group
    if override.value_type is ValueType.GLOB_CHOICE_SWEEP:
        raise ConfigError(f"{override.input_line}: name the values, a pattern has none")
    found = list(override.sweep_string_iterator())
    for value in found:
        if found.count(value) > 1:
            raise ConfigError(f"{key}={value} occurs twice")
    return found


def identity(settings: Settings) -> dict[str, Any]:
    """What a sweep's folder must agree on."""
    return {k: v for k, v in flat(settings.plain()).items() if k not in command.NOT_COMPARED}


def default_folder(groups: dict[str, Settings]) -> Path:
    first = next(iter(groups.values()))
    text = json.dumps([identity(s) for s in groups.values()], sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    return Path("runs") / f"sweep-{first.label}-{digest}"


# ---- the folder ------------------------------------------------------------------------------


def open_folder(sweep: Sweep) -> dict[str, int]:
    """How many members of each group run at once, as far as the folder's sweep knows already.

    Raises:
        ConfigError: the folder holds something else.
    """
    asked = {name: identity(settings) for name, settings in sweep.groups.items()}
    if not (sweep.folder / "sweep.yaml").exists():
        if sweep.folder.exists() and (not sweep.folder.is_dir() or any(sweep.folder.iterdir())):
            raise ConfigError(f"run_dir={sweep.folder} holds something else than a sweep")
        return {}
    saved = read_folder(sweep.folder)
    other = f"{sweep.folder} belongs to another sweep"
    if [*asked] != [*saved["groups"]]:
        raise ConfigError(f"{other}, of {', '.join(saved['groups'])}; choose another run_dir")
    for name, settings in asked.items():
        for key, (here, there) in command.differences(settings, flat(saved["groups"][name])).items():
            raise ConfigError(f"{other}: {key} is {there} there, {here} here; choose another run_dir")
    return saved["parallel"]


def read_folder(folder: Path) -> dict[str, Any]:
    path = folder / "sweep.yaml"
    if not path.is_file():
        raise ConfigError(f"{folder} is not a sweep's folder: it has no sweep.yaml")
    try:
        saved = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read: {one_line(error)}") from error
    if not isinstance(saved, dict) or not {"swept", "groups", "parallel"} <= saved.keys():
        raise ConfigError(f"{path} does not describe a sweep")
    return saved


def write_folder(sweep: Sweep, parallel: dict[str, int]) -> None:
    asked = {name: identity(settings) for name, settings in sweep.groups.items()}
    saved = {"swept": sweep.swept, "parallel": parallel, "groups": asked}
    try:
        sweep.folder.mkdir(parents=True, exist_ok=True)
        run_folder.replace_text(sweep.folder / "sweep.yaml", yaml.safe_dump(saved, sort_keys=False))
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


def fitting(settings: Settings, most: int | None, envs: Any, algos: Any) -> tuple[int, runner.Program]:
    """How many members run at once, `most` or what the memory holds; and the first part's program."""
    members = len(settings.configs) * settings.train.num_seeds
    parallel = min(members, most or members)
    while True:
        part = parts(settings, parallel)[0]
        try:
            _, program = command.prepare(part, envs, algos)
        except runner.TooLarge:
            if parallel == 1 or most:
                raise
            parallel = -(-parallel // 2)
            continue
        if part.train.init_from:  # what is wrong with it shows before anything compiles
            command.warm_start(part, program, envs, algos, lambda line: None)
        held = parallel if parallel == 1 or most else runner.capacity(program)
        return (held if held < len(program.members) else parallel), program


def train(sweep: Sweep, envs: Any, algos: Any, again: str, report: Report) -> int:
    """Train every group that is not finished. Returns the exit status."""
    known = open_folder(sweep)
    sizes = [len(s.configs) for s in sweep.groups.values()]
    report.line(
        f"sweep: {sum(sizes)} settings in {len(sizes)} group{'s' * (len(sizes) > 1)}, in {sweep.folder}"
    )
    for name, settings in sweep.groups.items():
        members = len(settings.configs) * settings.train.num_seeds
        programs: dict[int, runner.Program] = {}  # by the number of their members
        begun = list(sweep.folder.glob(f"{name}*"))
        if not any(checkpoint.checkpoints(f / "checkpoints") for f in begun):
            for leftover in begun:  # stopped before a first checkpoint, perhaps in other parts
                shutil.rmtree(leftover)
            with Interrupts(report.line, report.hosted) as stop:
                stop.nothing_to_save = f"stopped before the first update; {again}"
                known[name], program = fitting(settings, sweep.max_parallel, envs, algos)
            programs[len(program.members)] = program
            write_folder(sweep, known)
        elif sweep.max_parallel not in (None, known[name]) and known[name] < members:
            report.line(f"{name} goes on as it began, {known[name]} members at once")
        pieces = parts(settings, known[name])
        if len(pieces) > 1:
            report.line(f"{name}: {members} members in {len(pieces)} parts, one after the other")
        for i, piece in enumerate(pieces):
            folder = sweep.folder / (name if len(pieces) == 1 else f"{name}.part{i:03d}")
            if finished(piece, folder):
                report.line(f"finished already: {folder}")
                continue
            piece = piece._replace(train=replace(piece.train, run_dir=str(folder), resume=True))
            env, program = command.prepare(piece, envs, algos)
            # what differs between parts of one size is data, so they share what is compiled
            same = programs.setdefault(len(program.members), program)
            program = program._replace(init=same.init, update=same.update)
            status = command.run(piece, env, program, folder, envs, algos, report, again)
            summarise(sweep.folder, envs, algos)
            if status:
                return status
    return 0


def finished(settings: Settings, folder: Path) -> bool:
    done, train = run_folder.progress(folder), settings.train
    evaluated = (folder / "evaluation.json").exists() or not train.eval_episodes
    return done is not None and done[1] >= train.total_steps and evaluated


# ---- the summary -----------------------------------------------------------------------------


def rows_of(folder: Path, envs: Any, algos: Any) -> list[Group]:
    """A row for each setting that has begun."""
    swept = read_folder(folder)["swept"]
    paths = sorted(folder.glob("*/config.yaml"))
    runs = [run for path in paths for run in compare.read_one(path.parent, envs, algos)]
    return compare.group(runs, swept) if runs else []


def summarise(folder: Path, envs: Any, algos: Any) -> str:
    """Write summary.md, .csv and .png of a sweep; returns the table."""
    rows = rows_of(folder, envs, algos)
    text = markdown(rows)
    run_folder.replace_text(folder / "summary.md", text)
    run_folder.replace_text(folder / "summary.csv", as_csv(rows))
    title = "last 10 % of training, mean and 95 % interval"
    plots.save(plots.trade_off(rows, title), folder / "summary", ["png"])
    return text


def columns(rows: list[Group]) -> list[str]:
    return [name.removesuffix(".name") for name in rows[0].by] if rows else []


def limited(rows: list[Group]) -> list[str]:
    """The cost, as '', and those that have limits of their own."""
    return sorted({"", *(name for r in rows for name in r.limits)})


def markdown(rows: list[Group]) -> str:
    costs = limited(rows)
    header = [*columns(rows), "seeds", "steps", "return", *map(written, costs), "limit", "limit held"]
    lines = [
        [
            *(tables.number(v) if isinstance(v, float) else str(v) for v in r.by.values()),
            str(len(r.costs)), f"{r.steps:,}", tables.cell(r.ret),
            *(tables.cell(r.estimate(written(name))) for name in costs), in_words(r.limits), r.held,
        ]
        for r in rows
    ]  # fmt: skip
    return tables.markdown(Table("", header, lines))


def as_csv(rows: list[Group]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    costs = limited(rows)
    measured = ["return", *map(written, costs)]
    bounds = [f"{m.replace(' ', '_')}{end}" for m in measured for end in ("", "_low", "_high")]
    limits = [f"cost_limit_{name}" if name else "cost_limit" for name in costs]
    writer.writerow([*columns(rows), "seeds", "steps", *bounds, *limits, "held"])
    for r in rows:
        head = [*r.by.values(), len(r.costs), r.steps]
        found = [x for m in measured for x in r.estimate(m)]
        writer.writerow([*head, *found, *(r.limits.get(name, math.nan) for name in costs), r.held])
    return out.getvalue()


def main(envs: Any, algos: Any) -> int:
    """scripts/sweep.py. Exit status as of train.py."""

    def sweep() -> int:
        parser = argparse.ArgumentParser(
            description="Train a grid: python scripts/sweep.py algo=ppo_lag algo.cost_limit=5,10,25",
            epilog=EPILOG,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        parser.error = command.fail  # type: ignore[method-assign]
        parser.add_argument("options", nargs="*", metavar="key=value[,value...]")
        parser.add_argument("--summary", type=Path, metavar="SWEEP", help="only rewrite its summary")
        args = parser.parse_args()
        if args.summary:
            for text in args.options:
                command.load_own(text.removeprefix("env="), envs)
            print(summarise(args.summary, envs, algos), end="")
            return 0
        asked = read(args.options, envs, algos)
        again = f"python scripts/sweep.py {shlex.join(sys.argv[1:])}"
        status = train(asked, envs, algos, again, Report())
        print(summarise(asked.folder, envs, algos) + f"sweep folder: {asked.folder}")
        return status

    return guarded(sweep)
