"""What `jaxsafe train --help` prints: every option with its value and what it is.

What an option is stands in the comment beside it in the code.
"""

import ast
import dataclasses
import inspect
import io
import textwrap
import tokenize
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from jaxsafe import algos, envs
from jaxsafe.config import flat
from jaxsafe.envs.wrap import WrapConfig
from jaxsafe.run.arguments import compose
from jaxsafe.run.plain import as_text
from jaxsafe.run.settings import Settings, TrainConfig

WIDTH = 100
COLUMN = 36  # where the meaning of an option begins
HEAD = """\
usage: jaxsafe train [key=value ...]

Train a policy, then evaluate and film it.

  jaxsafe train env=car_push1 algo=cpo
  jaxsafe train env=point_goal1 algo=ppo_lag num_seeds=4 algo.cost_limit=10 total_steps=2e6
  jaxsafe train resume=RUN                    go on with a run
  jaxsafe train -m algo=cpo,ppo_lag seed=0,1  one run after the other for several values
  jaxsafe train algo=cpo --cfg job            only print the settings

The options below are those of env={env} algo={algo}. To see those of others, name them:
jaxsafe train env=car_goal1 algo=sac_lag --help. Numbers may be written 1e7, lists [64,64].
"""


def text(texts: Sequence[str]) -> str:
    """The help for the environment and the algorithm that the arguments name.

    Raises:
        ConfigError: an argument that training would not take either.
    """
    settings = compose([*texts])
    algo, run = dataclasses.asdict(settings.algo), dataclasses.asdict(settings.train)
    title = f"The algorithm {settings.algo_name}: {settings.row.summary}"
    parts = [
        HEAD.format(env=settings.env_name, algo=settings.algo_name),
        listed("environments", sorted(envs.ENVS)),
        listed("algorithms", sorted(algos.ALGOS)),
        section("The run", run, comments(TrainConfig)),
        section(title, flat(algo), comments(type(settings.algo)), "algo."),
        section(
            f"The environment {settings.env_name}",
            flat(settings.env_options),
            about_env(settings),
            "env.",
        ),
    ]
    return "\n".join(parts)


def about_env(settings: Settings) -> dict[str, str]:
    """What the options of the environment are; '' where it is not ours."""
    entry = envs.ENVS.get(settings.env_name)
    found = {f"wrap.{name}": note for name, note in comments(WrapConfig).items()}
    found["engine"] = "what computes the physics: auto, c, warp or jax"
    if isinstance(entry, dict):
        return comments(envs.SafetyGymConfig) | found
    kind = entry.func if isinstance(entry, partial) else entry
    if kind in (envs.CarRacing, envs.Pendulum, envs.CartPendulum):
        return comments(kind) | found
    return (comments(type(entry)) if isinstance(entry, envs.VelocityConfig) else {}) | found


def section(title: str, options: Mapping[str, Any], about: Mapping[str, str], head: str = "") -> str:
    lines = [f"{title}\n"]
    for name, value in options.items():
        option = f"  {head}{name}={as_text(value)}"
        note = textwrap.wrap(about.get(name, ""), WIDTH - COLUMN) or [""]
        if len(option) >= COLUMN:  # its meaning begins on the next line
            lines.append(option)
            option = ""
        lines.append(f"{option:<{COLUMN}}{note[0]}".rstrip())
        lines += [" " * COLUMN + line for line in note[1:]]
    return "\n".join(line for line in lines if line) + "\n"


def listed(title: str, names: Sequence[str]) -> str:
    """`title` and the names, over as many lines as they need."""
    return (
        textwrap.fill(
            f"{title}: {', '.join(names)}", WIDTH, subsequent_indent="  ", break_on_hyphens=False
        )
        + "\n"
    )


def comments(config: type) -> dict[str, str]:
    """Field -> its comment, in the class that defines it or gives it another default."""
    found: dict[str, str] = {}
    for cls in reversed(config.__mro__[:-1]):
        found |= {name: note or found.get(name, "") for name, note in comments_of(cls).items()}
    return found


def comments_of(cls: type) -> dict[str, str]:
    """Field -> its comment: the lines of comment above the field and the one after its default. Lines
    that divide fields, `# ---- reward`, are none of them."""
    source = textwrap.dedent(inspect.getsource(cls))
    tokens = [*tokenize.generate_tokens(io.StringIO(source).readline)]
    notes = {t.start[0]: t.string.lstrip("# ") for t in tokens if t.type == tokenize.COMMENT}
    notes = {line: note for line, note in notes.items() if not note.startswith("----")}
    alone = {line for line in notes if source.splitlines()[line - 1].startswith("    #")}
    (tree,) = ast.parse(source).body
    found = {}
    for field in (node for node in ast.walk(tree) if isinstance(node, ast.AnnAssign)):
        first = field.lineno
        while first - 1 in alone:
            first -= 1
        lines = range(first, (field.end_lineno or field.lineno) + 1)
        found[ast.unparse(field.target)] = " ".join(notes[line] for line in lines if line in notes)
    return found
