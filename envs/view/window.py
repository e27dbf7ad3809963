"""A `Playback` in MuJoCo's own window."""

import sys
import time

from jaxsafe.envs.view import backend
from jaxsafe.envs.view.playback import Playback, figures
from jaxsafe.envs.view.stage import Stage

TAP = 0.4  # s that a key counts as held after a press or its repeat: the window tells of no release
CODES = {265: "ArrowUp", 264: "ArrowDown", 263: "ArrowLeft", 262: "ArrowRight"}  # GLFW's
SPACE, BACKSPACE, PAGE_DOWN = 32, 259, 267


def has_display() -> bool:
    """Whether MuJoCo's window can open here; on macOS that needs its launcher mjpython."""
    return sys.platform != "darwin" and backend.works("glfw")


def open_window(playback: Playback) -> None:
    """Play in MuJoCo's own viewer until its window is closed."""
    import mujoco.viewer  # it needs a display

    stage, presses = Stage(playback.env), dict[str, float]()

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
            if (seen := stage.seen(state)) is not None:
                height, width, _ = seen.shape
                viewer.set_images((mujoco.MjrRect(0, 0, width, height), seen))
            viewer.sync()

        playback.play(show, lambda: not viewer.is_running())
