"""A study: the runs that answer one question, condensed into four small files.

    STUDY/study.yaml    what is asked, and which runs answer it, in order of worth
    STUDY/final.csv     a row a run and seed: what it reached, and what it was made with
    STUDY/curves.npz    return, cost and rates of each row over training, 100 points each
    STUDY/README.md     a page made from the other three

A run of a study is one training command with all its seeds. `add` condenses its run folder, and
`write_page` draws the page. `jaxsafe.report.read` reads a study wherever it reads a run folder.

study.yaml has these keys; the first four are needed:

    title      the heading of the page
    about      what is asked, in Markdown
    options    options of scripts/train.py that all runs have, as 'num_seeds=5 total_steps=1e7'
    runs       a list of further options, a run each: 'env=point_goal1 algo=cpo'
    windows    stretches of training, [[begin, end], ...] in steps, over which final.csv has means too
    published  a CSV of published figures to set beside the runs, relative to the study
    ends       a CSV of where the published curves of those end, relative to the study
    printed    of runs whose evaluation was kept for all seeds together: the text that the run printed
"""

import functools
import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from jaxsafe.config import ConfigError
from jaxsafe.report import plots, scores, stats, study_files, tables, trade_off
from jaxsafe.report.group import LATE, Group, group, tasks_of, telling
from jaxsafe.report.looks import styles
from jaxsafe.report.published import Published, beside, end_beside, read_ends, read_published
from jaxsafe.report.read import SettingRun, defaults, repeat_of, with_evaluation
from jaxsafe.report.read import read as read_runs
from jaxsafe.report.study_files import CURVES, POINTS, Origin
from jaxsafe.run import files, run_folder

SPAN = 20  # iterations over which costs are averaged before their swing is taken
CHUNK = 8  # settings in one figure of curves
HIGH = 4  # tasks in one figure of curves
FEW = 3  # options of a run that are all in its name
STAGES = 4  # of training, after which costs are summed
MOST = 24  # settings of one task whose points can be told apart in one panel
PAGE = """# {title}

{about}

<!-- measured: figures -->
<!-- end -->

## Settings and tasks

<!-- measured: matrix -->
<!-- end -->

## Runs

<details markdown>
<summary>The table: every run, with its intervals and its commit</summary>

<!-- measured: runs -->
<!-- end -->

</details>
"""


class Study(NamedTuple):
    """What study.yaml says."""

    folder: Path
    title: str
    about: str
    options: list[str]  # of every run
    runs: list[str]  # 'env=point_goal1 algo=cpo', in order of worth
    windows: list[tuple[float, float]]  # in steps
    published: Path | None
    ends: Path | None
    printed: dict[str, str]  # by run

    def command(self, run: str) -> list[str]:
        """The options of scripts/train.py that train `run`."""
        return [*self.options, *run.split()]


def read(folder: Path) -> Study:
    """study.yaml.

    Raises:
        ConfigError: there is none, or it says something else.
    """
    path = folder / "study.yaml"
    found = files.read_yaml(path)
    needed, more = {"title", "about", "options", "runs"}, {"windows", "published", "ends", "printed"}
    if not isinstance(found, dict) or not needed <= found.keys() <= needed | more:
        raise ConfigError(
            f"{path}: expected {', '.join(sorted(needed))} and perhaps {', '.join(sorted(more))}"
        )
    runs, printed = found["runs"], found.get("printed") or {}
    published, ends = found.get("published"), found.get("ends")

    def check(right: bool, expected: str) -> None:
        if not right:
            raise ConfigError(f"{path}: expected {expected}")

    options = "'env=point_goal1 algo=cpo'"
    check(isinstance(found["options"], str), f"options in one line, as {options}")
    listed = isinstance(runs, list) and all(isinstance(run, str) and run.split() for run in runs)
    check(listed, f"runs as a list of options, as {options}")
    check(all(isinstance(x, str | None) for x in (published, ends)), "published and ends as file names")
    check(isinstance(printed, dict) and all(isinstance(x, str) for x in printed.values()),
          "printed as a text for each run")  # fmt: skip
    try:
        windows = [(float(begin), float(end)) for begin, end in found.get("windows") or []]
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{path}: expected windows as [[begin, end], ...] in steps") from error
    names = [study_files.name_of(run) for run in runs]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"{path}: {name} occurs twice")
    return Study(
        folder,
        str(found["title"]),
        str(found["about"]).strip(),
        found["options"].split(),
        runs,
        windows,
        folder / published if published else None,
        folder / ends if ends else None,
        printed,
    )


# ---- condensing ------------------------------------------------------------------------------


def add(study: Study, run: str, trained: SettingRun, origin: Origin, failure: str = "") -> None:
    """Put a run into final.csv and curves.npz, in place of what they had of it.

    `failure` is 'failed' or 'diverged' where the command said so.
    """
    made, drawn = rows_of(study, run, trained, origin, failure), points(trained)
    worth = {text: i for i, text in enumerate(study.runs)}
    with files.in_turn(study.folder):  # a second command may add its own
        rows, curves, settings = study_files.read(study.folder)
        rows = [*(row for row in rows if row["run"] != run), *made]
        rows.sort(key=lambda row: worth.get(row["run"], len(worth)))
        curves |= {(run, row["seed"]): x for row, x in zip(made, drawn, strict=True)}
        settings[run] = {k: v for k, v in trained.config.items() if k not in ("run_dir", "resume")}
        study_files.write(study.folder, study_files.Condensed(rows, curves, settings))


def rows_of(
    study: Study, run: str, trained: SettingRun, origin: Origin, failure: str
) -> list[dict[str, str]]:
    """The rows of final.csv of a run, one a seed."""
    table, values = trained.table, trained.values | more_figures(trained.table, study.windows)
    named = {name: x for name, x in values.items() if not name.startswith("normalised")}
    if trained.estimated:  # they have columns of their own
        named |= dict.fromkeys(("return", "cost"), np.full(len(trained.seeds), np.nan))
    usual = failure or ("done" if trained.ended else "unfinished")
    states = {int(seed): usual for seed in trained.seeds} | dict.fromkeys(trained.diverged, "diverged")
    seconds = [table["seconds"][table["seed"] == s].max() for s in trained.seeds]
    clock = run_folder.step_column(table)
    named = {"minutes": np.array(seconds) / 60} | named
    return [
        {
            "run": run,
            "env": trained.env,
            "algo": trained.config["algo.name"],
            "settings": " ".join(f"{k}={v}" for k, v in unusual(trained.config).items()),
            "seed": str(seed),
            "state": state,
            "steps": str(int(table[clock][table["seed"] == seed].max())),
        }
        | {name: "" if np.isnan(x[i]) else f"{x[i]:.9g}" for name, x in named.items()}
        | origin._asdict()
        for i, (seed, state) in enumerate(states.items())
    ]


def points(trained: SettingRun) -> list[np.ndarray]:
    """The `CURVES` of each seed over a hundred equal stretches, float32 [4, 100].

    Twelve bits of the mantissa are kept, four digits: the rest is noise that does not compress.
    """
    edges = np.linspace(0, trained.steps, POINTS + 1)
    table = dict(trained.table)
    table |= {f"mean {name}": table[name] for name in CURVES if name in table}
    nothing = np.full((len(trained.seeds), POINTS), np.nan)
    found = [
        plots.stretches(table, f"mean {name}", edges) if name in table else nothing for name in CURVES
    ]
    values = np.stack(found, axis=1).astype(np.float32)
    bits = values.view(np.uint32)
    rounded = ((bits + (1 << 10)) & np.uint32(0xFFFFF800)).view(np.float32)
    return [*np.where(np.isfinite(values), rounded, np.float32(np.nan))]


def more_figures(
    table: Mapping[str, np.ndarray], windows: Iterable[tuple[float, float]]
) -> dict[str, np.ndarray]:
    """What final.csv has of each seed beside `measured`, [S] by name.

    - Return and cost as the learner estimates them, which needs no whole episode, over the last 10%.
    - Of each window (begin, end]: means of return and cost, and how far the cost swings.
    - Of algorithms that linearise the cost: what a step promises to take off it, and which share of
      the promise is realised. That share is the slope of the change of the violation on the sum of the
      promises, from one span of `SPAN` iterations to the next.
    """
    estimates = [k for k in ("return_estimate", "cost_estimate") if f"train/{k}" in table]
    late = {k.replace("_", " "): run_folder.last_tenth(dict(table), f"train/{k}") for k in estimates}
    found: dict[str, list[float]] = {}
    for seed in np.unique(table["seed"]):
        part = {name: x[table["seed"] == seed] for name, x in table.items()}
        for begin, end in windows:
            inside = (part["steps"] > begin) & (part["steps"] <= end)
            ret, cost = (part[f"train/{name}"][inside] for name in ("return", "cost"))
            ret, cost = (x[np.isfinite(x)] for x in (ret, cost))  # where an episode ended
            name = window_name(begin, end)
            found.setdefault(f"return {name}", []).append(ret.mean() if len(ret) else np.nan)
            found.setdefault(f"cost {name}", []).append(cost.mean() if len(cost) else np.nan)
            swing = spans(cost).mean(1).std() if len(cost) >= SPAN else np.nan
            found.setdefault(f"swing {name}", []).append(swing)
        if {"train/objective_c", "train/violation"} <= part.keys() and len(part["steps"]) >= 3 * SPAN:
            promise, violation = (spans(part[f"train/{k}"]) for k in ("objective_c", "violation"))
            slope = np.polyfit(promise.sum(1)[:-1], np.diff(violation.mean(1)), 1)[0]
            found.setdefault("promised", []).append(-part["train/objective_c"].mean())
            found.setdefault("kept", []).append(slope)
    return late | {name: np.array(values) for name, values in found.items()}


def spans(values: np.ndarray) -> np.ndarray:
    """[T] as [T // SPAN, SPAN], without the rest."""
    return values[: len(values) // SPAN * SPAN].reshape(-1, SPAN)


def window_name(begin: float, end: float) -> str:
    return f"{begin:g}-{end:g}"


def unusual(config: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a flat config that differ from today's defaults of its preset and conventions."""
    preset, compat = config["preset"], config.get("compat", "none")
    chosen = {k: v for k, v in (("preset", preset), ("compat", compat)) if v not in ("fast", "none")}
    usual = defaults(config["env.name"], config["algo.name"], preset, compat)
    chosen |= {"devices": config["devices"]} if config.get("devices", 1) != 1 else {}
    return chosen | {
        name: value
        for name, value in config.items()
        if name.startswith(("env.", "algo.")) and name in usual and value != usual[name]
    }


def origin_of(folder: Path) -> Origin:
    """What a run folder's last start says of itself."""
    last = {name: str(value or "") for name, value in run_folder.last_start(folder).items()}
    commit = last.get("commit", "")
    return Origin(
        commit=commit.removesuffix("-dirty")[:7],
        dirty=("yes" if commit.endswith("-dirty") else "no") if commit else "",
        device=last.get("device", ""),
        engine=last.get("engine", ""),
        python=last.get("python", ""),
        jax=last.get("jax", ""),
        mujoco=last.get("mujoco", ""),
        warp=last.get("warp-lang", ""),
        trained=last.get("time", "")[:10],
        source=str(folder),
    )


# ---- the page --------------------------------------------------------------------------------


class Picture(NamedTuple):
    """A figure of the page, not yet drawn."""

    path: Path
    caption: str
    draw: Callable[[], Figure]


def write_page(study: Study) -> None:
    """Write README.md, and draw its figures into images/ beside the study."""
    with files.in_turn(study.folder):
        text, pictures = page(study)
        images = files.make_folder(study.folder.parent, "images")
        own = re.compile(rf"{re.escape(study.folder.name)}-(trade_off|curves\d+)\.png")
        for old in images.iterdir():
            if own.fullmatch(old.name):  # not one of a study whose name begins like this one's
                old.unlink()
        for picture in pictures:
            save_small(picture.draw(), picture.path)
        files.write(study.folder / "README.md", text)


def page(study: Study) -> tuple[str, list[Picture]]:
    """The text of README.md, and the figures that it shows.

    Tables stand between marks, as `<!-- measured: so far -->` and `<!-- end -->`. A README.md that is
    there keeps its own words around them; without one, `about` is all that the page says.
    """
    path = study.folder / "README.md"
    text = (
        files.read_text(path)
        if files.there(path)
        else PAGE.format(title=study.title, about=study.about)
    )
    runs = read_runs([study.folder])
    groups = in_order(study, runs)
    known = read_published(study.published) if study.published else {}
    pictures = pictures_of(study, groups, known) if "<!-- measured: figures -->" in text else []
    shown = [
        f"![{x.caption}]({Path('..') / x.path.relative_to(study.folder.parent)})" for x in pictures
    ]
    makers: dict[str, Callable[[], str]] = {
        "figures": lambda: "\n\n".join(shown),
        "matrix": lambda: matrices(groups, known),
        "so far": lambda: costs_so_far(groups),
        "runs": lambda: run_table(study, runs, known),
    }
    made = {name: make() for name, make in makers.items() if f"<!-- measured: {name} -->" in text}
    try:
        return tables.between_marks(text, made, "measured"), pictures
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def in_order(study: Study, runs: Sequence[SettingRun]) -> list[Group]:
    """The groups of each setting and task, in the order of the runs, the order of their worth.

    A name has what tells settings apart, and the options that a run sets where they are few. What a
    preset says anyway is not in it. Lengths are, where they differ and the study's runs set them.
    Preset, conventions and devices are, too, even before there is a second run to be told apart.
    """
    lengths = {"total_steps", "total_updates"}
    given = {word.partition("=")[0] for run in study.runs for word in run.split()}
    by = [name for name in telling(runs) if name not in lengths - given]
    by += [name for name in ("preset", "compat", "devices") if name in given and name not in by]
    options = {study_files.name_of(run): few_options(run) for run in study.runs}
    odd = {study_files.name_of(run): names for run, names in once_unusual(study).items()}
    told = {run.config["run_dir"]: options.get(Path(run.config["run_dir"]).name, []) for run in runs}
    same = {name for name in lengths if len({run.config.get(name) for run in runs}) == 1}
    more = dict.fromkeys(name for names in told.values() for name in names if name not in {*by, *same})
    groups = group(runs, [*by, *(name for name in more if any(name in run.config for run in runs))])
    firsts = [g.runs[0].config["run_dir"] for g in groups]
    own = [{*by, *told[run]} for run in firsts]
    usual = [said(g, fields, set()) for g, fields in zip(groups, own, strict=True)]
    once = [odd.get(Path(run).name, set()) for run in firsts]
    found = []
    for g, fields, short in zip(groups, own, usual, strict=True):
        # runs whose settings are the same today keep one name, whenever they were made
        alike = [names for names, other in zip(once, usual, strict=True) if other == short]
        found.append(g._replace(by=said(g, fields, set.intersection(*alike))))
    return found


def once_unusual(study: Study) -> dict[str, set[str]]:
    """The options of each run that were no defaults when it was made."""
    rows = study_files.read(study.folder).rows
    return {row["run"]: {word.partition("=")[0] for word in row["settings"].split()} for row in rows}


def few_options(run: str) -> list[str]:
    """The algorithm's options that `run` sets, none if they are many, and its length."""
    names = [word.partition("=")[0] for word in run.split()]
    own = [name for name in names if name.startswith("algo.")]
    return [*(own if len(own) <= FEW else ()), *(name for name in names if name.startswith("total_"))]


def said(g: Group, told: set[str], odd: set[str]) -> dict[str, Any]:
    """The fields of a group that belong in its name, of those in `told`: what is no default today, or
    was none when the run was made, as `odd` says. A data set goes by its file's name."""
    named = {"algo.name", "total_steps", "total_updates", "devices", *odd}
    named |= {*unusual(g.runs[0].config)}
    found = {name: value for name, value in g.by.items() if name in named & told}
    return found | ({"dataset": Path(g.by["dataset"]).stem} if g.by.get("dataset") else {})


def pictures_of(
    study: Study, groups: Sequence[Group], known: Mapping[tuple[str, str], Published]
) -> list[Picture]:
    """Return against cost of at most `MOST` settings of a task, and curves of at most `HIGH` tasks and
    `CHUNK` settings a figure."""
    images, name = study.folder.parent / "images", study.folder.name
    looks = styles(groups)
    found = []
    shown = first_of_each_task(groups, MOST)
    if len(looks) > 1:
        theirs = {(g.env, g.name): beside(g, known) for g in shown}
        some = f" of the first {MOST} settings of a task" if len(shown) < len(groups) else ""
        draw = functools.partial(trade_off.draw, shown, LATE, theirs, looks)
        caption = f"Return against cost of {LATE}{some}, a point a setting"
        if any(theirs.values()):  # these are of evaluated policies, and so are ours then
            draw = functools.partial(trade_off.draw, final(shown), "evaluated policies", theirs, looks)
            caption = (
                f"Return against cost of evaluated policies{some}, a point a setting; hollow diamonds "
                "are published means"
            )
        found.append(Picture(images / f"{name}-trade_off.png", caption, draw))
    read = read_ends(study.ends) if study.ends else {}
    ends = {(g.env, g.name): end for g in groups if (end := end_beside(g, known, read))}
    parts = chunks(groups)
    several = len({g.env for g in groups}) > HIGH
    for i, chunk in enumerate(parts, 1):
        draw = functools.partial(plots.learning, chunk, looks, ends)
        where = f" on {', '.join(tasks_of(chunk))}" if several else ""
        names, algos = (dict.fromkeys(x) for x in ((g.name for g in chunk), (g.algo for g in chunk)))
        told = ", ".join(map(str, algos))  # the legend has the options
        told += f", {len(names)} settings" if len(names) > len(algos) else ""
        caption = f"Return, cost and cost rate over training{where}: {told}"
        found.append(Picture(images / f"{name}-curves{i}.png", caption, draw))
    return found


def first_of_each_task(groups: Sequence[Group], most: int) -> list[Group]:
    """The first `most` groups of each task: a study names the most important runs first."""
    first = [[g for g in groups if g.env == env][:most] for env in tasks_of(groups)]
    return [g for found in first for g in found]


def chunks(groups: Sequence[Group]) -> list[list[Group]]:
    """The groups of each figure of curves: of at most `HIGH` tasks, as even as can be, and of at most
    `CHUNK` settings."""
    tasks = tasks_of(groups)
    count = -(-len(tasks) // HIGH)
    found = []
    for part in np.array_split(tasks, count):
        inside = [g for g in groups if g.env in part]
        settings = list(dict.fromkeys(g.name for g in inside))
        for first in range(0, len(settings), CHUNK):
            found.append([g for g in inside if g.name in settings[first : first + CHUNK]])
    return found


def save_small(figure: Figure, path: Path) -> None:
    """Write a PNG of 256 colours, which is a third as large. They are far apart, so that rare ones
    stay: the median cut would mix those up."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    picture = Image.open(buffer).convert("RGB")
    small = picture.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE)
    with files.replacing(path) as part:
        small.save(part, optimize=True)


def evaluated(runs: Sequence[SettingRun]) -> list[SettingRun]:
    """The runs with what their final policies made in fresh episodes in place of what training made;
    without those whose evaluation was not kept."""
    known = (run for run in runs if np.isfinite(run.values.get("final cost", np.nan)).all())
    return [with_evaluation(run) for run in known]


def final(groups: Sequence[Group]) -> list[Group]:
    """`groups` of evaluated policies, without those of which none is known."""
    return [g._replace(runs=runs) for g in groups if (runs := evaluated(g.runs))]


def matrices(groups: Sequence[Group], known: Mapping[tuple[str, str], Published]) -> str:
    """What training made of each setting on each task; and what its policies made, where they were
    evaluated, beside what is published of evaluated policies."""
    played = final(groups)
    trained = [g for g in groups if g.runs[0].clock == "steps"]  # with a data set, none plays episodes
    published = "; *in italics* published ones" if any(beside(g, known) for g in groups) else ""
    words = f"Evaluated policies{published}:"
    if not played:
        return matrix(groups, {})
    if not trained:
        return f"{words}\n\n{matrix(played, known)}"
    return f"The {LATE}:\n\n{matrix(groups, {})}\n\n{words}\n\n{matrix(played, known)}"


def matrix(groups: Sequence[Group], known: Mapping[tuple[str, str], Published]) -> str:
    """Return and cost of each setting on each task, and below them what is published."""
    tasks = tasks_of(groups)
    found = {(g.env, g.name): g for g in groups}
    lines = [f"| | {' | '.join(f'`{env}`' for env in tasks)} |", "|---|" + "---:|" * len(tasks)]
    for name in sorted({g.name for g in groups}):
        cells = []
        for env in tasks:
            cell = []
            if g := found.get((env, name)):
                ended = np.isfinite(g.ret.mean)  # whether an episode did in the last tenth
                cell.append(f"{g.ret.mean:.1f}, {g.cost.mean:.1f}" if ended else "-")
                if theirs := beside(g, known):
                    cell.append(f"*{theirs.ret[0]:.1f}, {theirs.cost[0]:.1f}*")
            cells.append("<br>".join(cell))
        lines.append(f"| `{name}` | {' | '.join(cells)} |")
    return "\n".join(lines)


def costs_so_far(groups: Sequence[Group]) -> str:
    """What training has cost in all after each of `STAGES` equal parts of the longest run.

    A cell has the mean over seeds, and the least and the most.
    """
    found = []
    for env in tasks_of(groups):
        shown = [g for g in groups if g.env == env and g.runs[0].clock == "steps"]
        if not shown:
            continue
        end = max(float(run.config["total_steps"]) for g in shown for run in g.runs)
        stages = np.linspace(0, end, STAGES + 1)[1:]
        found += [
            f"| `{env}`, steps | {' | '.join(f'{step:,.0f}' for step in stages)} |",
            "|---|" + "---:|" * STAGES,
        ]
        for g in shown:
            sums = np.concatenate([cost_so_far(run, stages) for run in g.runs])  # [S, STAGES]
            cells = [
                f"{x.mean():,.0f} ({x.min():,.0f} to {x.max():,.0f})" if np.isfinite(x).all() else ""
                for x in sums.T
            ]
            found.append(f"| `{g.name}` | {' | '.join(cells)} |")
        found.append("")
    return "\n".join(found).rstrip()


def cost_so_far(run: SettingRun, steps: np.ndarray) -> np.ndarray:
    """The summed cost of each seed after so many `steps` [T], [S, T]; NaN beyond its end.

    A cost rate is of the policy's steps. Where an action is repeated, these are fewer.
    """
    found = np.full((len(run.seeds), len(steps)), np.nan)
    for row, seed in zip(found, run.seeds, strict=True):
        of_seed = run.table["seed"] == seed
        at, rate = run.table["steps"][of_seed], run.table["train/cost_rate"][of_seed]
        taken = np.diff(at, prepend=0) / repeat_of(run.config)
        # a row's rate is of the steps up to it; stretches without a row have that of the row before
        late = int(np.isnan(rate).argmin())  # stretches before the first row
        sums = np.cumsum(np.append(rate[late:], np.repeat(rate[-1], late)) * taken)
        # the last iteration may end some steps before or after the round number of a run
        reached = steps <= 1.01 * at.max()
        row[reached] = np.interp(steps[reached], np.append(0, at), np.append(0, sums))
    return found


def run_table(
    study: Study, runs: Sequence[SettingRun], known: Mapping[tuple[str, str], Published]
) -> str:
    """A row a run: what it reached in training and after it, and what it was made with."""
    origins: dict[str, dict[str, str]] = {}
    states: dict[str, set[str]] = {}
    for row in study_files.read(study.folder).rows:
        origins[row["run"]] = row
        states.setdefault(row["run"], set()).add(row["state"])
    named = {Path(run.config["run_dir"]).name: run for run in runs}
    header = ["run", "seeds", "return, last 10%", "cost, last 10%", "final policy"]
    header += [*(["published"] if known else []), "minutes", "commit"]
    numbers = ("seeds", "return, last 10%", "cost, last 10%", "minutes")
    ends = ["---:" if name in numbers else "---" for name in header]
    lines = [f"| {' | '.join(header)} |", f"|{'|'.join(ends)}|"]
    for text, row in sorted(origins.items(), key=lambda item: study_files.name_of(item[0])):
        run = named[study_files.name_of(text)]
        ret, cost = (tables.cell(stats.of_measure(k, run.values[k]), ".2f") for k in ("return", "cost"))
        words = " ".join(f"`{re.sub('^(env|algo)=', '', word)}`" for word in text.split())
        odd = ", ".join(sorted(states[text] - {"done"}))
        cells = [f"{words}{f' ({odd})' if odd else ''}", str(len(run.seeds)), ret, cost]
        cells.append(final_policy(run, study.printed.get(text, "-")))
        cells += [published_cell(run, known)] if known else []
        known_minutes = run.values.get("minutes")
        cells.append("-" if known_minutes is None else f"{known_minutes.max():.1f}")
        cells.append(f"{row['commit'] or '-'}{' (dirty)' if row['dirty'] == 'yes' else ''}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def final_policy(run: SettingRun, otherwise: str) -> str:
    """What the mean action made in fresh episodes, and where it is known the sampled one: means over
    seeds, with their intervals if they have some."""

    def made(by: str) -> str:
        found = (stats.of_measure(k, run.values[f"final {by}{k}"]) for k in ("return", "cost"))
        ret, cost = (tables.cell(e, ".2f") for e in found)
        return f"{ret}, cost {cost}"

    if not {"final return", "final cost"} <= run.values.keys():
        return otherwise
    if "final sampled return" not in run.values:
        return made("")
    return f"{made('')}; sampled: {made('sampled ')}"


def published_cell(run: SettingRun, known: Mapping[tuple[str, str], Published]) -> str:
    """What others report of a setting, or where that is nothing constrained, unconstrained PPO."""
    if theirs := beside(Group(run.env, {}, [run]), known):
        (ret, ret_std), (cost, cost_std) = theirs.ret, theirs.cost
        return f"{theirs.source} {ret:.2f} ± {ret_std:.2f}, cost {cost:.2f} ± {cost_std:.2f}"
    if ppo := scores.CHARACTERISTIC.get(run.env):
        return f"none (unconstrained PPO: {ppo.ret:.4g}, cost {ppo.cost:.4g})"
    return "none"
