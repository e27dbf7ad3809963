"""Write a page for each algorithm and each task from the code: python docs/pages.py

Of an algorithm, docs/algorithms/NAME.md: equations, source and departures are the module's docstring;
settings and their origin are the lines of its config; results are those of docs/results. Of a task,
docs/environments/NAME.md: objects, observations and costs are the environment's, how close it is to the
original is the tables of docs/fidelity.md. A test holds the pages to the code.
"""

import dataclasses
import importlib
import inspect
import math
import re
import sys
from pathlib import Path
from typing import Any

from jaxsafe.algos import ALGOS, Entry
from jaxsafe.config import from_dict
from jaxsafe.envs import ENVS
from jaxsafe.learn.offline import OfflineConfig
from jaxsafe.run import compat, run_folder
from jaxsafe.run.settings import algo_options

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE / "results")]
results, tables = importlib.import_module("make"), importlib.import_module("tables")
TASKS = {  # what a robot is paid for
    "goal": "Reach the goal (green), again and again: after each success it is elsewhere.",
    "button": "Press the marked button (orange cylinder), again and again: each success draws another.",
    "push": "Push the box (yellow) to the goal (green), again and again.",
    "run": "Run along x, as far as possible.",
    "circle": "Run along a circle of 1.5 m around the origin.",
    "grid": "Go to a goal straight ahead, once, between hazards at given places.",
}
ENVIRONMENTS = """# Environments

`point_TASK`, `car_TASK` and `doggo_TASK`, as in `point_goal1`; Safety Gym's ids, as in
`Safexp-PointGoal1-v0`, work too. Every option of Safety Gym's Engine but vision is `env.OPTION`, and
[`env.rules`](../howto/safety_gymnasium.md) takes Safety-Gymnasium's rules where they differ.

"""
COSTS = {
    "hazards": "inside a hazard (blue disc)",
    "vases_contact": "touching a vase (light blue cube)",
    "vases_velocity": "a vase moves, touched or not",
    "pillars": "touching a pillar (blue column)",
    "buttons": "pressing another button than the goal's",
    "gremlins": "touching a gremlin (purple cube, on a circle of its own)",
}


def prose(docstring: str) -> tuple[str, str]:
    """The docstring's first line, and the rest as Markdown: what is indented is code."""
    title, _, text = inspect.cleandoc(docstring).partition("\n")
    blocks = []
    for block in text.strip("\n").split("\n\n"):
        if block.startswith("    "):
            blocks.append(f"```text\n{inspect.cleandoc(block)}\n```")
        else:  # Source and departures begin lines of their own
            blocks.append(re.sub(r"\n(?=Source:|Differs from)", "\n\n", block))
    return title, "\n\n".join(blocks)


def settings(config: type) -> str:
    """A row a field: its default, and the comment beside it in the class that defines it."""
    comments = {}
    for cls in reversed(config.__mro__[:-1]):
        for name, comment in re.findall(r"^    (\w+): .*?(?:  # (.*))?$", inspect.getsource(cls), re.M):
            comments[name] = comment or comments.get(name, "")
    rows = ["| setting | default | |", "|---|---|---|"]
    for field in dataclasses.fields(config):
        note = comments[field.name].replace("|", "\\|")
        rows.append(f"| `algo.{field.name}` | `{field.default}` | {note} |")
    return "\n".join(rows)


def published(entry: Entry) -> str:
    """What `preset=published` and `compat=omnisafe` change."""
    lines = []
    for origin, options in entry.published.items():
        changed = ", ".join(f"`{name}={value}`" for name, value in options.items())
        lines.append(f"`preset=published` ({origin}): {changed}.")
    conventions = compat.overrides("omnisafe", entry.config)
    changed = ", ".join(f"`{name}={value}`" for name, value in conventions.items())
    if changed:
        lines.append(f"`compat=omnisafe` ([why](../howto/migrate.md#conventions)): {changed}.")
    return "\n\n".join(lines)


def measured(name: str) -> str:
    """The runs of this algorithm in docs/results."""
    rows = []
    for folder in sorted((HERE / "results").glob(f"*-{name}*/")):
        env, algo, *_ = folder.name.split("-")
        if algo != name:
            continue
        metrics = run_folder.read_metrics(folder)
        ret, cost = (results.last_tenth(metrics, f"train/{k}") for k in ("return", "cost"))
        config = run_folder.read_config(folder)
        rules = config["env"].get("rules", "safety_gym")
        which, seeds = config["preset"], len(set(metrics["seed"]))
        how = f"`{env}`, preset {which}, {seeds} seeds"
        how += f", `compat={config['compat']}`" if config.get("compat", "none") != "none" else ""
        how += f", `env.rules={rules}`" if rules != "safety_gym" else ""
        options = {k: x for k, x in config["algo"].items() if k != "name"}
        given = dataclasses.asdict(from_dict(ALGOS[name].config, options, "algo."))
        usual = algo_options(ALGOS[name], config["preset"], config.get("compat", "none"))
        how += "".join(f", `algo.{k}={given[k]}`" for k in options if given[k] != usual[k])
        rows.append(f"| {how} | {ret} | {cost} | {results.published(config)} |")
    if not rows and issubclass(ALGOS[name].config, OfflineConfig):
        return "Not run at length yet."
    if not rows:
        return "Not run at length yet; it learns the small exact problem of tests/test_on_policy.py."
    head = "| 1e7 steps a seed, limit 25 | return, last 10% | cost | published |\n|---|---|---|---|\n"
    return head + "\n".join(rows)


def page(name: str) -> str:
    entry = ALGOS[name]
    title, text = prose(importlib.import_module(entry.make.__module__).__doc__ or "")
    module = entry.make.__module__.rsplit(".", 1)[1]
    data = " dataset=data.npz" if issubclass(entry.config, OfflineConfig) else ""
    return f"""# {title.removesuffix(".")}

    python scripts/train.py env=point_goal1 algo={name}{data}

{text}

The code: [algos/{module}.py](../../algos/{module}.py).

## Settings

[O] is OmniSafe's default, [S] that of safety-starter-agents.

{settings(entry.config)}

{published(entry)}

## Results

{measured(name)}
"""


def fidelity(name: str) -> list[str]:
    """The row of docs/fidelity.md on an environment for each engine: of its first table."""
    rows: dict[str, str] = {}
    engine = ""
    for line in (HERE / "fidelity.md").read_text().splitlines():
        if line.startswith("## "):
            engine = line[3:].removeprefix("Engine ")
        elif line.startswith(f"| {name} |") and engine.startswith("`") and engine not in rows:
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            rows[engine] = f"| {' | '.join([f'`{name}`', engine, *cells[1:5], cells[8], cells[9]])} |"
    return [*rows.values()]


def objects(env: Any) -> str:
    cfg = env.config
    rows = ["| | number | size, m | free around it, m | costs |", "|---|---:|---:|---:|---|"]
    for kind in dict.fromkeys(env.place.kinds):
        size = getattr(cfg, f"{kind}_size", None)
        number, keepout = env.place.kinds.count(kind), getattr(cfg, f"{kind}_keepout")
        paid = any(name.startswith(kind) for name in env.cost_names)
        cells = [kind, number, "" if size is None else size, keepout, "yes" if paid else "no"]
        rows.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(rows)


def observed(env: Any) -> dict[str, int]:
    """Sizes of the components; those of a robot's joints and feet together."""
    found: dict[str, int] = {}
    for name, shape in env.observation_spec.items():
        kind = name.partition("_")[0]
        name = f"{kind}_*" if kind in ("jointpos", "jointvel", "touch") else name
        found[name] = found.get(name, 0) + math.prod(shape)
    return found


def task_page(task: str) -> str:
    made = tables.robots(task)
    kind = next(kind for kind in TASKS if task.startswith(kind))
    env = made[f"point_{task}"]
    parts = [observed(other) for other in made.values()]

    def row(head: str, cells: list[Any]) -> str:
        return f"| {head} | " + " | ".join(map(str, cells)) + " |"

    head = row("", [f"`{name}`" for name in made]) + "\n|---|" + "---:|" * len(made)
    sizes = [row("action", [e.action_size for e in made.values()])]
    sizes += [row("observation", [e.obs_size for e in made.values()])]
    for part in sorted({name for found in parts for name in found}):
        sizes.append(row(part, [found.get(part, "") for found in parts]))
    sizes.append(row("seconds of a step", [f"{e.step_seconds:g}" for e in made.values()]))
    drawn = (HERE / "images" / "environments" / f"point_{task}.jpg").exists()
    images = [f"![{name}](../images/environments/{name}.jpg)" for name in made]
    names = [f"`{name}`" for name in made]
    pictures = "\n".join(
        ["| " + " | ".join(names) + " |", "|---|---|---|", "| " + " | ".join(images) + " |"]
    )
    costs = "\n".join(f"| `{name}` | {COSTS[name]} |" for name in env.cost_names)
    if costs:
        costs = f"A step costs 1 if any of these is so:\n\n| | |\n|---|---|\n{costs}"
    found = [line for name in made for line in fidelity(name)]
    report = "It is not among the recordings of the original."
    if found:
        columns = "| | engine | steps | strict | pose | velocity | events that differ | result |"
        report = "\n".join([columns, "|---|---|---:|---:|---:|---:|---:|---|", *found])
        report += "\n\nWhat the columns mean: [fidelity](../fidelity.md)."
    xmin, ymin, xmax, ymax = env.config.placements_extents
    area = f"x {xmin:g} to {xmax:g} and y {ymin:g} to {ymax:g} m"
    return f"""# {task}

{TASKS[kind]}

    python scripts/train.py env=point_{task} algo=ppo_lag

{pictures if drawn else ""}

## Objects

{objects(env)}

They lie in {area}, unless options place them. Sizes are radii, and half sides
of boxes, vases and gremlins; those of Point's task. An episode has {env.episode_length:,} steps.

## Sizes

{head}
{chr(10).join(sizes)}

## Costs

{costs or "None."}

## Fidelity

{report}
""".replace("\n\n\n", "\n\n")


def pages() -> dict[Path, str]:
    """Every page that is made, by its path."""
    found = {HERE / "algorithms" / f"{name}.md": page(name) for name in ALGOS}
    lines = [f"| [`{name}`]({name}.md) | {entry.summary} |" for name, entry in ALGOS.items()]
    index = "# Algorithms\n\n| | |\n|---|---|\n" + "\n".join(lines) + "\n"
    found[HERE / "algorithms" / "README.md"] = index
    tasks = list(dict.fromkeys(name.split("_")[1] for name in ENVS))
    found |= {HERE / "environments" / f"{task}.md": task_page(task) for task in tasks}
    lines = ["| task | | costs |", "|---|---|---|"]
    for task in tasks:
        about = TASKS[next(kind for kind in TASKS if task.startswith(kind))]
        costs = ", ".join(tables.robots(task)[f"point_{task}"].cost_names) or "none"
        lines.append(f"| [`{task}`]({task}.md) | {about} | {costs} |")
    text = ENVIRONMENTS + "\n".join(lines) + "\n"
    return found | {HERE / "environments" / "README.md": text}


if __name__ == "__main__":
    for path, text in pages().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
