"""A `Playback` in a page for browsers."""

import io
import socket
import threading
import time
import webbrowser
from dataclasses import dataclass

import numpy as np
from PIL import Image

from jaxsafe.config import ConfigError
from jaxsafe.envs.safety_gym.task import SafetyGym
from jaxsafe.envs.view import backend
from jaxsafe.envs.view.driving import FRONT, robot_of
from jaxsafe.envs.view.playback import FPS, KEYS, Playback, figures
from jaxsafe.envs.view.render import Renderer, named_camera
from jaxsafe.envs.view.stage import SEEN, colour, lidar_angles, split
from jaxsafe.types import State

CAMERAS = ("track", "fixedfar", "fixednear", "vision")
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

    backend.find_backend()
    frame, stopped = Frame(), threading.Event()
    failures: list[Exception] = []

    def play() -> None:
        try:
            renderer = Renderer(playback.env)  # here: OpenGL minds the thread

            def show() -> None:
                renderer.camera = named_camera(renderer.stage.model, frame.camera)
                frame.jpeg = as_jpeg(renderer.frame(playback.state, playback.shield_acts))

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
            picture = ui.interactive_image().style("min-width: 640px; height: 480px")
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
    parts = split(state.obs, env.observation_spec)
    kinds = [kind for kind in SEEN if f"{kind}_lidar" in parts]
    angles = lidar_angles(env.config) - FRONT[robot_of(env)]
    order = np.argsort((angles - np.pi) % (2 * np.pi))[::-1]
    width, height = 560 / len(angles), 28
    drawn = []
    for row, kind in enumerate(kinds):
        foot = (row + 1) * (height + 6)
        drawn.append(f"<text x='0' y='{foot}'>{kind}</text>")
        red, green, blue, _ = (round(255 * x) for x in colour(kind))
        for i, value in enumerate(parts[f"{kind}_lidar"][order]):
            tall = max(1.0, height * float(value))
            drawn.append(
                f"<rect x='{80 + i * width:.1f}' y='{foot - tall:.1f}' width='{width - 2:.1f}' "
                f"height='{tall:.1f}' fill='rgb({red},{green},{blue})'/>"
            )
    return f"<svg width='640' height='{len(kinds) * (height + 6) + 6}'>{''.join(drawn)}</svg>"
