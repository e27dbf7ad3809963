"""The command watch: watch a policy as it acts, or drive a robot."""

import contextlib

from jaxsafe.commands import viewing
from jaxsafe.commands.guard import guarded
from jaxsafe.commands.jaxsafe import called
from jaxsafe.config import ConfigError, Port, one_line
from jaxsafe.envs.view import page, window
from jaxsafe.envs.view.backend import NoDisplay
from jaxsafe.envs.view.playback import Playback
from jaxsafe.report.film import NoVideo
from jaxsafe.run.arguments import compose
from jaxsafe.run.flags import number
from jaxsafe.run.settings import make_env


def main() -> int:
    """Exit status as of render.py; Ctrl-C is its proper end, with status 0."""
    return guarded(command)


def command() -> int:
    parser = viewing.parser_of(
        "Watch the policy of a run as it acts, or drive a robot with the arrow keys.",
        "RUN or env=NAME",
        "a run folder, or a task to drive with its options: env=car_goal1 env.vases_num=5",
    )
    parser.add_argument("--page", action="store_true", help="serve a page even if there is a display")
    parser.add_argument("--port", type=number(Port), default=8080, help="of the page (default 8080)")
    parser.add_argument("--open", action="store_true", help="also open the page in a browser here")
    args, what = viewing.parse(parser)
    if len(what.folders) > 1:
        raise ConfigError(
            f"{what.folders[1]}: expected one run, or env=NAME; side by side: {called('render')}"
        )
    in_browser = args.page or args.open or not window.has_display()
    if in_browser:
        page.check_page(args.port, args.open)
    if what.folders:
        (policy,) = what.policies(args.index)
        title = f"{policy.settings.env_name}, {policy.settings.algo_name}"
        env, player = policy.env, policy.player
    else:
        settings = compose(what.options)
        if settings.env_options.get("engine") == "auto":  # one environment gains from no other
            settings = settings._replace(env_options=settings.env_options | {"engine": "c"})
        title, env, player = settings.env_name, make_env(settings), None
    print(f"{title}: compiling a step ...", flush=True)
    try:
        with contextlib.suppress(KeyboardInterrupt):  # the page's server may have taken it
            playback = Playback(env, player, args.seed)  # type: ignore[arg-type]
            if in_browser:
                page.serve_page(playback, title, args.port, args.open)
            else:
                window.open_window(playback)
        print("closed")
    except NoDisplay as error:
        raise NoVideo(one_line(error)) from error
    return 0
