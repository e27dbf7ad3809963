"""Watch a policy, or drive a robot by keys, as it happens: in MuJoCo's window or a page for browsers.

A `Playback` plays episodes; `open_window` and `serve_page` show it, and hand it what is pressed.
"""

import io
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

from jaxsafe.config import ConfigError
from jaxsafe.envs.safety_gym.task import SafetyGym
from jaxsafe.envs.view import render
from jaxsafe.envs.view.driving import FRONT, drivable, drive, robot_of
from jaxsafe.envs.wrap import raw_steps
from jaxsafe.learn.acting import Player
from jaxsafe.types import PyTree, State

FPS = 30
KEYS = {  # a browser's names: (forward, turn)
    "ArrowUp": (1, 0),
    "KeyW": (1, 0),
    "ArrowDown": (-1, 0),
    "KeyS": (-1, 0),
    "ArrowLeft": (0, 1),
    "KeyA": (0, 1),
    "ArrowRight": (0, -1),
    "KeyD": (0, -1),
}
CAMERAS = ("track", "fixedfar", "fixednear", "vision")
BEHIND = 0.2  # s of simulation made up for after a frame that took long
LAST = 5  # episodes in the list of those that ended


class Ended(NamedTuple):
    """An episode that is over."""

    seed: int
    steps: int
    ret: float
    cost: float


class Playback:
    """Episodes one after another, with seeds that count up. Methods may be called from any thread.

    Args:
        env: the task.
        player: a policy in `env`, or in `env` with what an algorithm appends to its observation. None
            leaves the robot to the keys. Held keys take over from a policy.
        seed: of the first episode.
    Raises:
        ConfigError: an environment that cannot be drawn, or a robot that no keys are known for.
    """

    def __init__(
        self,
        env: SafetyGym,
        player: Player | None = None,
        seed: int = 0,
    ):
        self.env, self.playing, self.held = drivable(render.drawable(env)), True, set[str]()
        self.limit, self.seconds = env.episode_length, self.env.step_seconds * raw_steps(env)
        self.ended: list[Ended] = []  # the last `LAST`, newest first
        self._lock = threading.Lock()
        world = player.task if player else env

        def reset(key: jax.Array) -> tuple[State, PyTree]:
            return world.reset(key), player.begin() if player else ()

        def step(
            state: State, carry: PyTree, action: jax.Array, driven: jax.Array
        ) -> tuple[State, PyTree]:
            if player:
                own, carry = player.act(carry, state)
                action = jnp.where(driven, action, own)
            return world.step(state, action), carry

        self._reset, self._step = jax.jit(reset), jax.jit(step)
        self.reset(seed)
        still = np.zeros(env.action_size, np.float32)
        self._step(self.state, self._carry, still, np.bool_(False))  # compiles it

    def reset(self, seed: int) -> None:
        """Begin the episode of this seed."""
        with self._lock:
            self._begin(seed)

    def step(self) -> None:
        """One step; after the last of an episode, the next begins."""
        with self._lock:
            forward, turn = pushed(self.held)
            action = np.float32(drive(self.env, forward, turn, self.steps))
            driven = np.bool_(forward or turn)
            self.state, self._carry = jax.device_get(
                self._step(self.state, self._carry, action, driven)
            )
            self.steps += 1
            self.ret += float(self.state.reward)
            self.cost += float(self.state.cost)
            self.costs = self.costs + self.state.costs
            if self.state.ended or self.steps >= self.limit:
                ended = Ended(self.seed, self.steps, self.ret, self.cost)
                self.ended = [ended, *self.ended][:LAST]
                self._begin(self.seed + 1)

    def _begin(self, seed: int) -> None:
        self.seed, self.steps, self.ret, self.cost = seed, 0, 0.0, 0.0
        self.costs = np.zeros(len(self.env.cost_names))
        self.state: State
        self.state, self._carry = jax.device_get(self._reset(jax.random.key(seed)))

    def play(self, show: Callable[[], None], stop: Callable[[], bool]) -> None:
        """Step in real time, or as fast as it goes here, and `show` at most `FPS` times a second."""
        due = shown = time.monotonic()
        while not stop():
            now = time.monotonic()
            due = max(due, now - BEHIND)
            while self.playing and now >= due:
                self.step()
                due += self.seconds
            if now >= shown:
                show()
                shown = now + 1 / FPS
            time.sleep(max(0.001, min(due if self.playing else shown, shown) - time.monotonic()))


def pushed(held: set[str]) -> tuple[int, int]:
    """What the held keys ask for: (forward, turn), each -1, 0 or 1."""
    both = np.array([KEYS[key] for key in list(held) if key in KEYS] or [(0, 0)])
    forward, turn = np.sign(both.sum(0))
    return int(forward), int(turn)


def figures(playback: Playback) -> dict[str, str]:
    """What an episode has come to so far, by name."""
    named = zip(playback.env.cost_names, playback.costs, strict=True)
    return {
        "seed": f"{playback.seed}",
        "step": f"{playback.steps} of {playback.limit}",
        "return": f"{playback.ret:.2f}",
        "cost": f"{playback.cost:.0f}",
        **{f"cost {name}": f"{value:.4g}" for name, value in named},
    }


# A window --------------------------------------------------------------------------------------------

TAP = 0.4  # s that a key counts as held after a press or its repeat: the window tells of no release
CODES = {265: "ArrowUp", 264: "ArrowDown", 263: "ArrowLeft", 262: "ArrowRight"}  # GLFW's
SPACE, BACKSPACE, PAGE_DOWN = 32, 259, 267


def has_display() -> bool:
    """Whether MuJoCo's window can open here; on macOS that needs its launcher mjpython."""
    return sys.platform != "darwin" and render.works("glfw")


def open_window(playback: Playback) -> None:
    """Play in MuJoCo's own viewer until its window is closed."""
    import mujoco.viewer

    stage, presses = render.Stage(playback.env), dict[str, float]()

    def press(code: int) -> None:
        if code in CODES:
            presses[CODES[code]] = time.monotonic()
        elif code == SPACE:
            playback.playing = not playback.playing
        elif code in (BACKSPACE, PAGE_DOWN):
            playback.reset(playback.seed + (code == PAGE_DOWN))

    print("arrows drive, space pauses, backspace resets, page down goes to the next seed", flush=True)
    stage.move(playback.state.physics)
    with mujoco.viewer.launch_passive(
        stage.model, stage.data, key_callback=press, show_left_ui=False, show_right_ui=False
    ) as viewer:
        marks = viewer.user_scn
        assert marks is not None  # only once the window is closed
        with viewer.lock():
            viewer.opt.geomgroup[:] = 1
            viewer.cam.type = mujoco.mjtCamera.mjCAMERA_TRACKING.value
            viewer.cam.trackbodyid = stage.model.body("robot").id
            viewer.cam.distance, viewer.cam.azimuth, viewer.cam.elevation = 4.0, 90, -40

        def show() -> None:
            now = time.monotonic()
            playback.held = {key for key, pressed in presses.items() if now - pressed < TAP}
            state = playback.state
            with viewer.lock():
                stage.move(state.physics)
                marks.ngeom = 0
                stage.mark(marks, state)
            names, values = zip(*figures(playback).items(), strict=True)
            viewer.set_texts((None, None, "\n".join(names), "\n".join(values)))
            viewer.sync()

        playback.play(show, lambda: not viewer.is_running())


# A page ----------------------------------------------------------------------------------------------

STYLE = "style='border-spacing: 12px 2px; border-collapse: separate'"
RELEASED = "<script>window.addEventListener('blur', () => emitEvent('released'))</script>"


def check_page(port: int, open_browser: bool) -> None:
    """Raise ConfigError where no page can be served, with what to do."""
    try:
        import nicegui  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            f"the page for a browser needs the package {error.name}: pip install 'jaxsafe[watch]'"
        ) from error
    if not is_free(port):
        free = next((p for p in range(port + 1, min(port + 100, 65536)) if is_free(p)), None)
        hint = f"; --port {free} is free" if free else ""
        raise ConfigError(f"--port {port} is in use{hint}")
    if open_browser:
        try:
            webbrowser.get()
        except webbrowser.Error as error:
            raise ConfigError(
                "--open: no browser on this machine; without --open, the address works from any"
            ) from error


def is_free(port: int) -> bool:
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server will
        try:
            listener.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


@dataclass
class Frame:
    """What the page and the thread that plays share: the camera to look through, and what it saw."""

    camera: str = "track"
    jpeg: bytes = b""


def serve_page(playback: Playback, title: str, port: int, open_browser: bool) -> None:
    """Play in a page on this machine's `port` until Ctrl-C.

    Raises:
        NoDisplay: nothing to render with.
    """
    from fastapi import Response
    from nicegui import app, ui

    render.find_backend()
    frame, stopped = Frame(), threading.Event()
    failures: list[Exception] = []

    def play() -> None:
        try:
            renderer = render.Renderer(playback.env)  # here: OpenGL minds the thread

            def show() -> None:
                renderer.camera = render.named_camera(renderer.stage.model, frame.camera)
                frame.jpeg = as_jpeg(renderer.frame(playback.state))

            playback.play(show, stopped.is_set)
        except Exception as error:  # raised again below, in the thread of whoever called
            failures.append(error)
            app.shutdown()

    @app.get("/frame")
    def newest() -> Response:
        return Response(frame.jpeg, media_type="image/jpeg", headers={"Cache-Control": "no-store"})

    thread = threading.Thread(target=play, daemon=True)
    app.on_startup(thread.start)
    print(f"http://localhost:{port} shows it in a browser; Ctrl-C ends", flush=True)
    try:
        ui.run(
            lambda: lay_out_page(playback, title, frame),
            host="127.0.0.1",
            port=port,
            title=title,
            reload=False,
            show=open_browser,
            show_welcome_message=False,
        )
    finally:
        stopped.set()
        thread.join()
    for error in failures:
        raise error


def lay_out_page(playback: Playback, title: str, frame: Frame) -> None:
    """The picture, the lidars, the controls and the figures, which follow `playback`."""
    from nicegui import events, ui

    def on_key(event: events.KeyEventArguments) -> None:
        if event.key.code in KEYS:
            (playback.held.add if event.action.keydown else playback.held.discard)(event.key.code)
        elif event.key.code == "Space" and event.action.keydown:
            pause()

    def pause() -> None:
        playback.playing = not playback.playing

    def look_through(camera: str) -> None:
        frame.camera = camera

    ui.add_head_html(RELEASED)
    ui.on("released", lambda: playback.held.clear())
    ui.keyboard(on_key, repeating=False, ignore=["input", "select"])
    with ui.row(wrap=False):
        with ui.column():
            picture = ui.interactive_image().style("width: 640px; height: 480px")
            lidars = ui.html(sanitize=False)
        with ui.column():
            ui.label(title).classes("text-h6")
            with ui.row():
                button = ui.button("Pause", on_click=pause)
                ui.button("Reset", on_click=lambda: playback.reset(playback.seed))
                ui.button("Next", on_click=lambda: playback.reset(playback.seed + 1))
            with ui.row():
                seed = ui.number("Seed", value=playback.seed, min=0, max=2**31 - 1, precision=0)
                seed.style("width: 90px")
                seed.on("change", lambda: playback.reset(int(seed.value or 0)))
                view = ui.select(list(CAMERAS), value=frame.camera, label="Camera")
                view.style("width: 110px").on_value_change(lambda event: look_through(event.value))
            numbers = ui.html(sanitize=False)
            ui.label("Drive: arrow keys or W A S D. Pause: space.").classes("text-caption")

    def follow() -> None:
        button.text = "Pause" if playback.playing else "Play"
        numbers.content = as_table(playback)
        lidars.content = as_bars(playback.env, playback.state)

    ui.timer(1 / FPS, lambda: picture.set_source(f"/frame?{time.monotonic()}"))
    ui.timer(0.1, follow)


def as_jpeg(frame: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(frame).save(file, "jpeg", quality=85)
    return file.getvalue()


def as_table(playback: Playback) -> str:
    """The figures of the episode and of the last ones, as HTML."""
    rows = [f"<tr><td>{name}</td><td>{value}</td></tr>" for name, value in figures(playback).items()]
    now = f"<table {STYLE}>{''.join(rows)}</table>"
    if not playback.ended:
        return now
    rows = [
        f"<tr><td>{e.seed}</td><td>{e.steps}</td><td>{e.ret:.2f}</td><td>{e.cost:.0f}</td></tr>"
        for e in playback.ended
    ]
    head = "<tr><td>ended: seed</td><td>steps</td><td>return</td><td>cost</td></tr>"
    return f"{now}<hr><table {STYLE}>{head}{''.join(rows)}</table>"


def as_bars(env: SafetyGym, state: State) -> str:
    """The lidars as bars in an SVG: straight ahead is in the middle, what is left of the robot left."""
    parts = render.split(state.obs, env.observation_spec)
    kinds = [kind for kind in render.SEEN if f"{kind}_lidar" in parts]
    angles = render.lidar_angles(env.config) - FRONT[robot_of(env)]
    order = np.argsort((angles - np.pi) % (2 * np.pi))[::-1]
    width, height = 560 / len(angles), 28
    drawn = []
    for row, kind in enumerate(kinds):
        foot = (row + 1) * (height + 6)
        drawn.append(f"<text x='0' y='{foot}'>{kind}</text>")
        red, green, blue, _ = (round(255 * x) for x in render.colour(kind))
        for i, value in enumerate(parts[f"{kind}_lidar"][order]):
            tall = max(1.0, height * float(value))
            drawn.append(
                f"<rect x='{80 + i * width:.1f}' y='{foot - tall:.1f}' width='{width - 2:.1f}' "
                f"height='{tall:.1f}' fill='rgb({red},{green},{blue})'/>"
            )
    return f"<svg width='640' height='{len(kinds) * (height + 6) + 6}'>{''.join(drawn)}</svg>"
