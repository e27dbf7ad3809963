"""Episodes as a viewer plays them, keys as actions, and the page and the commands around it."""

import dataclasses
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
import webbrowser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxsafe import envs
from jaxsafe.commands import render as render_command
from jaxsafe.commands import watch as watch_command
from jaxsafe.config import ConfigError
from jaxsafe.envs.view import playback, window
from jaxsafe.envs.view.driving import FRONT, drive, robot_of
from jaxsafe.envs.view.page import as_bars, as_jpeg, as_table
from jaxsafe.learn.acting import Player
from jaxsafe.report import film
from jaxsafe.types import Policy

ROOT = Path(__file__).parent.parent.parent


@pytest.fixture(scope="module")
def session() -> playback.Playback:
    """Of a policy that always turns left at half speed, and whose shield acts at every second step."""
    env = envs.make("point_goal0", engine="c", num_steps=6)

    def act(learned, carry, obs, key):
        said = {"overruled": carry % 2 == 1, "risk": jnp.float32(0.25)}
        return jnp.array([0.0, 0.5]), carry + 1, said

    policy = Policy(lambda learned: jnp.int32(0), act)
    return playback.Playback(env, Player(policy, (), env), seed=3)


@pytest.mark.parametrize(
    ("robot", "steps", "metres"), [("point", 20, 0.1), ("car", 20, 0.3), ("doggo", 60, 0.5)]
)
def test_keys_drive_forth_back_left_and_right(robot, steps, metres):
    env = envs.make(f"{robot}_goal0", engine="c")
    ahead = {ask: driven(env, ask, steps)[0] for ask in ((1, 0), (-1, 0))}
    turned = {ask: driven(env, ask, steps)[1] for ask in ((0, 1), (0, -1))}
    assert ahead[1, 0] > metres and ahead[-1, 0] < -metres
    assert turned[0, 1] > 0.5 and turned[0, -1] < -0.5


def driven(env: envs.SafetyGym, ask: tuple[int, int], steps: int) -> tuple[float, float]:
    """How far the robot went to its first front (m) and turned to its left (rad), on an empty floor."""
    model = env.scene.model
    data = mujoco.MjData(model)  # type: ignore[attr-defined]
    mujoco.mj_forward(model, data)  # type: ignore[attr-defined]
    body, turned = data.body("robot"), 0.0
    place = body.xpos.copy()
    for step in range(steps):
        before = body.xmat.reshape(3, 3).copy()
        data.ctrl[:] = drive(env, *ask, seconds=step * env.step_seconds)
        mujoco.mj_step(model, data, env.config.frameskip_binom_n)  # type: ignore[attr-defined]
        turned += float(np.arctan2(*(before.T @ body.xmat.reshape(3, 3))[[1, 0], 0]))
    front = FRONT[robot_of(env)]
    return float((body.xpos - place) @ (np.cos(front), np.sin(front), 0)), turned


def test_a_gait_keeps_its_pace_where_actions_are_repeated(monkeypatch):
    times = []
    monkeypatch.setattr(
        playback, "drive", lambda env, go, turn, seconds: times.append(seconds) or np.zeros(2)
    )
    env = envs.make("point_goal0", engine="c", wrap={"action_repeat": 5})  # of 0.02 s each
    played = playback.Playback(env)
    for _ in range(3):
        played.step()
    np.testing.assert_allclose(times, [0.0, 0.1, 0.2])


def test_no_keys_drive_a_robot_of_ones_own(tmp_path):
    own = tmp_path / "rover.xml"
    own.write_text((ROOT / "envs" / "safety_gym" / "assets" / "point.xml").read_text())
    env = envs.make("point_goal0", engine="c", robot_base=str(own))
    with pytest.raises(ConfigError, match=r"rover\.xml'?: keys drive point, car, doggo alone"):
        playback.Playback(env)
    with pytest.raises(
        ConfigError,
        match="only Safety Gym's environments, velocity and racing tasks can be drawn, not a Simple",
    ):
        playback.Playback(SimpleNamespace())  # type: ignore[arg-type]
    assert robot_of(envs.make("car_goal0", engine="c", robot_base="xmls/car.xml")) == "car"


def test_opposite_keys_cancel_and_letters_are_arrows_too():
    assert playback.pushed(set()) == (0, 0)
    assert playback.pushed({"ArrowUp", "KeyW", "KeyA"}) == (1, 1)
    assert playback.pushed({"KeyW", "KeyS", "ArrowRight"}) == (0, -1)
    assert playback.pushed({"KeyQ", "ArrowDown"}) == (-1, 0)


def test_a_session_counts_and_goes_on_to_the_next_seed(session):
    session.reset(3)
    first, rewards = session.state, []
    for _ in range(5):
        session.step()
        rewards.append(float(session.state.reward))
    assert (session.seed, session.steps) == (3, 5)
    assert session.ret == pytest.approx(sum(rewards)) and any(rewards)
    shown = playback.figures(session)
    assert shown["step"] == "5 of 6" and shown["return"] == f"{session.ret:.2f}"
    session.step()
    assert (session.seed, session.steps, session.ret) == (4, 0, 0.0)
    last = session.ended[0]
    assert last[:2] == (3, 6) and f"<td>{last.ret:.2f}</td>" in as_table(session)
    session.reset(3)
    np.testing.assert_array_equal(session.state.obs, first.obs)


def test_it_says_when_a_shield_acts(session):
    session.reset(3)
    assert not session.shield_acts and "shield" not in playback.figures(session)
    acts = []
    for held in (set(), set(), set(), {"ArrowUp"}, set()):  # keys overrule a shield
        session.held = held
        session.step()
        acts.append(session.shield_acts)
    assert acts == [False, True, False, False, False]
    session.reset(3)
    for _ in range(4):
        session.step()
    said = playback.figures(session)
    assert (said["shield"], said["shield acted"], said["risk"]) == ("acts", "2 steps", "0.250")


def test_held_keys_take_over_from_the_policy(session):
    def turning(held: set[str]) -> float:
        session.held = held
        session.reset(3)
        for _ in range(5):
            session.step()
        session.held = set()
        return float(session.state.physics.bodies.qvel[2])

    assert turning(set()) > 0.1 and turning({"ArrowRight"}) < -0.1
    assert turning({"ArrowRight", "ArrowLeft"}) == turning(set())


def test_play_shows_all_the_time_and_steps_at_the_pace_of_the_robot_unless_paused(session):
    def seconds(playing: bool) -> tuple[int, int]:
        stepped, shown, session.playing = [], [], playing
        fake = dataclasses.make_dataclass("Fake", ["seconds", "playing", "step"])(
            session.seconds, playing, lambda: stepped.append(1)
        )
        end = time.monotonic() + 0.5
        playback.Playback.play(fake, lambda: shown.append(1), lambda: time.monotonic() > end)  # type: ignore[arg-type]
        return len(stepped), len(shown)

    stepped, shown = seconds(True)
    assert 10 <= stepped <= 26 and 3 <= shown <= 16  # 0.5 s of 0.02 s, at most 30 frames a second
    stepped, shown = seconds(False)
    assert stepped == 0 and 3 <= shown <= 16


@pytest.mark.parametrize(("robot", "bins"), [("point", (0, 15)), ("car", (12, 11)), ("doggo", (0, 15))])
def test_bars_have_what_is_ahead_in_the_middle_and_what_is_left_left(robot, bins):
    env = envs.make(f"{robot}_goal0", engine="c")
    at = list(env.observation_spec).index("goal_lidar")
    before = sum(int(np.prod(shape)) for shape in list(env.observation_spec.values())[:at])
    for side, bin_ in zip(("left", "right"), bins, strict=True):
        obs = np.zeros(env.obs_size)
        obs[before + bin_] = 1.0
        svg = as_bars(env, SimpleNamespace(obs=obs))  # type: ignore[arg-type]
        heights = [float(h) for h in re.findall(r"height='([\d.]+)' fill", svg)]
        assert int(np.argmax(heights)) == (7 if side == "left" else 8) and len(heights) == 16


def test_pictures_are_sent_as_jpeg():
    assert as_jpeg(np.zeros((8, 8, 3), np.uint8))[:3] == b"\xff\xd8\xff"


# Bad input -------------------------------------------------------------------------------------------


def said(monkeypatch, capsys, main, *args: str) -> str:
    """The one line of an error with status 2."""
    monkeypatch.setattr(sys, "argv", ["script", *args])
    assert main() == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line.removeprefix("error: ")


BAD = {
    ("env=point_gaol1",): "did you mean 'point_goal1'?",
    ("env=point_goal0", "env.hazard_num=3"): "did you mean 'hazards_num'?",
    ("nowhere",): "nowhere is not a run folder: it has no config.yaml",
    ("nowhere", "elsewhere"): "elsewhere: expected one run, or env=NAME",
    ("env=point_goal0", "algo=cpo"): "algo=cpo is not a run folder",
    ("env=point_goal0", "--seed", "-1"): "--seed: -1: expected a whole number between 0 and 2147483647",
    ("env=point_goal0", "--port", "0"): "--port: 0: expected a whole number between 1 and 65535",
    ("nowhere", "env=a:b", "env.engine=c"): "env.engine=c: with a run, expected env=MODULE:NAME or",
    (): "required",
}


@pytest.mark.parametrize("args", BAD, ids=" ".join)
def test_watch_refuses_in_one_line(monkeypatch, capsys, args):
    monkeypatch.setattr(window, "has_display", lambda: False)
    assert BAD[args] in said(monkeypatch, capsys, watch_command.main, *args)


def test_without_a_display_a_page_needs_its_package_a_port_and_a_browser_to_open(monkeypatch, capsys):
    monkeypatch.setattr(window, "has_display", lambda: False)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        line = said(monkeypatch, capsys, watch_command.main, "env=point_goal0", "--port", str(port))
    assert re.fullmatch(rf"--port {port} is in use; --port \d+ is free", line)

    def none() -> Any:
        raise webbrowser.Error("could not locate runnable browser")

    monkeypatch.setattr(webbrowser, "get", none)
    line = said(
        monkeypatch, capsys, watch_command.main, "env=point_goal0", "--port", str(port), "--open"
    )
    assert line.startswith("--open: no browser on this machine")
    monkeypatch.setitem(sys.modules, "nicegui", None)
    line = said(monkeypatch, capsys, watch_command.main, "env=point_goal0", "--port", str(port))
    assert line == "the page for a browser needs the package nicegui: pip install 'jaxsafe[watch]'"


def test_render_refuses_in_one_line(monkeypatch, capsys):
    assert "not a run folder" in said(monkeypatch, capsys, render_command.main, "nowhere", "elsewhere")
    assert "a.avi: expected a name that ends in" in said(
        monkeypatch, capsys, render_command.main, "nowhere", "--out", "a.avi"
    )
    assert "expected a run folder" in said(monkeypatch, capsys, render_command.main, "env=a:b")


def test_panels_are_labelled_with_what_tells_them_apart():
    folders = [Path("/runs/x/1"), Path("/runs/y/1")]
    assert film.labels(folders, ["cpo", "ppo_lag"]) == ["cpo", "ppo_lag"]
    assert film.labels(folders, ["cpo", "cpo"]) == ["cpo, x/1", "cpo, y/1"]
    assert film.labels([folders[0]] * 2, ["cpo", "cpo"]) == ["cpo, 1", "cpo, 1"]


# The page --------------------------------------------------------------------------------------------


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@pytest.fixture(scope="module")
def page(display: None) -> Any:
    """A page that plays point_goal0, in a process of its own: (process, address)."""
    port = free_port()  # NiceGUI serves nothing where it sees pytest
    environ = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    process = subprocess.Popen(
        [sys.executable, "scripts/watch.py", "env=point_goal0", "--page", "--port", str(port)],
        cwd=ROOT, env={**environ, "JAX_PLATFORMS": "cpu"}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout
    assert process.stdout.readline() == "point_goal0: compiling a step ...\n"
    address = f"http://localhost:{port}"
    assert process.stdout.readline() == f"{address} shows it in a browser; Ctrl-C ends\n"
    yield process, address
    process.kill()


def fetch(address: str) -> bytes:
    for _ in range(300):
        try:
            with urllib.request.urlopen(address, timeout=20) as answer:
                body = answer.read()
            if body:
                return body
        except OSError:  # it is not up yet
            pass
        time.sleep(0.1)
    raise AssertionError(f"no answer from {address}")


@pytest.mark.slow  # needs playwright and Debian's chromium
def test_a_browser_shows_it_and_its_keys_drive(page):
    playwright = pytest.importorskip("playwright.sync_api")

    with playwright.sync_playwright() as play:
        quiet = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]
        browser = play.chromium.launch(executable_path="/usr/bin/chromium", args=quiet)
        tab = browser.new_page(viewport={"width": 1040, "height": 680})
        wrong: list[str] = []
        tab.on("pageerror", lambda error: wrong.append(str(error)))
        fetch(f"{page[1]}/frame")
        tab.goto(page[1])

        def figure(name: str) -> float:
            cell = tab.locator(f"td:text-is('{name}') + td").first
            return float(cell.inner_text().split()[0])

        def after(seconds: float) -> tuple[float, float]:
            tab.wait_for_timeout(1000 * seconds)
            return figure("step"), figure("return")

        still = after(2)
        assert after(1)[0] > still[0] and after(0)[1] == still[1]  # it plays; the robot stands
        tab.keyboard.down("w")
        moving = after(2)
        assert moving[1] != still[1]
        tab.keyboard.up("w")
        tab.keyboard.press("Space")
        paused = after(1)
        assert after(1) == paused and tab.get_by_role("button", name="Play").is_visible()
        tab.get_by_label("Seed").fill("7")
        tab.get_by_label("Seed").press("Enter")
        tab.get_by_label("Seed").blur()
        assert after(1) == (0, 0) and figure("seed") == 7
        tab.get_by_role("button", name="Next").click()
        assert after(1) == (0, 0) and figure("seed") == 8
        assert tab.locator("svg rect").count() == 16  # bins of the goal's lidar
        tab.wait_for_function("document.querySelector('img').naturalWidth == 640")
        assert wrong == []
        browser.close()


def test_the_page_is_served_with_pictures_and_ctrl_c_ends_it(page):  # the last: it ends the page
    process, address = page
    assert b"point_goal0" in fetch(address)
    assert fetch(f"{address}/frame")[:3] == b"\xff\xd8\xff"
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (0, "closed\n", "")
