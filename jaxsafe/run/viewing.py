"""Looking at policies: scripts/render.py films them, scripts/watch.py shows one as it acts.

`envs` and `algos` are the registries, as in `jaxsafe.command`.
"""

import argparse
import contextlib
import importlib
from pathlib import Path
from typing import Any

import jax

from jaxsafe.config import ConfigError
from jaxsafe.run import runner
from jaxsafe.run.command import (
    Actor,
    NoVideo,
    check_video,
    compose,
    fail,
    film,
    guarded,
    make_env,
    one_line,
    open_run,
)

OF_PHYSICS = ("engine", "awake")  # options that leave a task what it is
MAX_SEED = 2**31 - 1


def open_actor(folder: Path, own: str | None, index: int, envs: Any, algos: Any) -> Actor:
    """Policy number `index` of a run; `own` as in `open_run`."""
    settings, env, algo, states = open_run(folder, own, envs, algos)
    if not 0 <= index < (rows := len(settings.configs) * settings.train.num_seeds):
        raise ConfigError(f"--index {index}: expected 0 to {rows - 1}, the policies of {folder}")
    return Actor(settings, env, algo, jax.tree.map(lambda x: x[index], states))


def check_one_task(folders: list[Path], actors: list[Actor]) -> None:
    """Raise ConfigError where layouts would differ."""
    tasks = [
        {"env": a.settings.env_name}
        | {f"env.{k}": v for k, v in a.settings.env_options.items() if k not in OF_PHYSICS}
        for a in actors
    ]
    for folder, task in zip(folders, tasks, strict=True):
        for name, value in tasks[0].items():
            if task[name] != value:
                raise ConfigError(
                    f"side by side, expected runs of one task: {name}={value} in {folders[0]}, "
                    f"{task[name]} in {folder}"
                )


def labels(folders: list[Path], algos: list[str]) -> list[str]:
    """The algorithms' names; where two are the same, with the end of each folder that tells."""
    if len({*algos}) == len(algos):
        return algos
    places = [folder.resolve().parts for folder in folders]
    for n in range(1, max(map(len, places)) + 1):
        tails = [Path(*parts[-n:]) for parts in places]
        if len({*tails}) == len({*places}):
            break
    return [f"{algo}, {tail}" for algo, tail in zip(algos, tails, strict=True)]


def parser_of(description: str, what: str, more: str) -> argparse.ArgumentParser:
    """With what both scripts take."""
    parser = argparse.ArgumentParser(description=description)
    parser.error = fail  # type: ignore[method-assign]
    parser.add_argument("what", nargs="+", metavar=what, help=more)
    parser.add_argument("--index", type=int, default=0, help="which of a run's policies (default 0)")
    parser.add_argument("--seed", type=int, default=1, help="of the (first) episode (default 1)")
    return parser


def parse(parser: argparse.ArgumentParser) -> tuple[argparse.Namespace, list[Path], list[str]]:
    """The arguments, and of those without a flag the folders and what begins with env."""
    args = parser.parse_args()
    runner.use_compilation_cache()
    if not 0 <= args.seed <= MAX_SEED:
        raise ConfigError(f"--seed {args.seed}: expected 0 to {MAX_SEED}")
    options = [text for text in args.what if text.startswith(("env=", "env."))]
    folders = [Path(text).expanduser() for text in args.what if text not in options]
    if folders and len(options) > 1:
        raise ConfigError(
            f"{options[1]}: with a run, expected env=MODULE:NAME alone, if its env is yours"
        )
    return args, folders, options


def render_main(envs: Any, algos: Any) -> int:
    """scripts/render.py. Exit status: 2 for bad input, 1 where nothing can be rendered."""

    def command() -> int:
        parser = parser_of(
            "Film one episode of the policy of a run, or of several runs side by side in one layout.",
            "RUN",
            "run folders; and env=MODULE:NAME, where their environment is code of yours",
        )
        parser.add_argument(
            "--out", type=Path, help="an .mp4 or .gif (default RUN/video.mp4; of several compared.mp4)"
        )
        args, folders, own = parse(parser)
        if not folders:
            raise ConfigError(f"{own[0]}: expected a run folder too")
        several = len(folders) > 1
        out = args.out or (Path("compared.mp4") if several else folders[0] / "video.mp4")
        check_video(out)
        actors = [open_actor(f, next(iter(own), None), args.index, envs, algos) for f in folders]
        check_one_task(folders, actors)
        names = labels(folders, [actor.settings.algo_name for actor in actors]) if several else None
        film(envs, actors, out, args.seed, names)
        print(out)
        return 0

    return guarded(command)


def watch_main(envs: Any, algos: Any) -> int:
    """scripts/watch.py. As above; Ctrl-C is its proper end, with status 0."""

    def command() -> int:
        parser = parser_of(
            "Watch the policy of a run as it acts, or drive a robot with the arrow keys.",
            "RUN or env=NAME",
            "a run folder; or a task to drive, and options of it: env=car_goal1 env.vases_num=5",
        )
        parser.add_argument("--page", action="store_true", help="a page, though there is a display")
        parser.add_argument("--port", type=int, default=8080, help="of the page (default 8080)")
        parser.add_argument("--open", action="store_true", help="open the page in a browser here")
        args, folders, options = parse(parser)
        if len(folders) > 1:
            raise ConfigError(
                f"{folders[1]}: expected one run, or env=NAME; side by side: python scripts/render.py"
            )
        watch = importlib.import_module(f"{envs.__name__}.view.watch")
        page = args.page or args.open or not watch.has_display()
        if page:
            watch.check_page(args.port, args.open)
        if folders:
            actor = open_actor(folders[0], next(iter(options), None), args.index, envs, algos)
            title = f"{actor.settings.env_name}, {actor.settings.algo_name}"
            env, player = actor.env, actor.player
        else:
            settings = compose(options, envs, algos)
            if settings.env_options.get("engine") == "auto":  # one environment gains from no other
                settings = settings._replace(env_options=settings.env_options | {"engine": "c"})
            title, env, player = settings.env_name, make_env(settings, envs), None
        print(f"{title}: compiling a step ...", flush=True)
        try:
            with contextlib.suppress(KeyboardInterrupt):  # the page's server may have taken it
                session = watch.Session(env, player, args.seed)
                if page:
                    watch.serve_page(session, title, args.port, args.open)
                else:
                    watch.open_window(session)
            print("closed")
        except watch.render.NoDisplay as error:
            raise NoVideo(one_line(error)) from error
        return 0

    return guarded(command)
