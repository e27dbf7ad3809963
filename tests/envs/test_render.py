"""Frames and films. Whether a picture is a good one is for the eye; here, what must be in it."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import imageio
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from toys import reflex

from jaxsafe import envs
from jaxsafe.config import ConfigError
from jaxsafe.envs.view import backend, render
from jaxsafe.envs.view.stage import Stage, split

WIDTH, HEIGHT = 320, 240


def reset(name: str, **options):
    env = envs.make(name, engine="c", **options)
    return env, jax.jit(env.reset)(jax.random.key(0))


def from_above(height: float = 8.0) -> Any:
    """Looks down on the origin; +x is right and +y is up in the picture."""
    camera = mujoco.MjvCamera()  # type: ignore[attr-defined]
    camera.distance, camera.azimuth, camera.elevation = height, 90, -90
    return camera


def pixel(xy, height: float = 8.0) -> tuple[int, int]:
    """Row and column of a place on the floor, seen `from_above` (45 degrees of view)."""
    scale = HEIGHT / (2 * height * np.tan(np.pi / 8))
    return int(HEIGHT / 2 - xy[1] * scale), int(WIDTH / 2 + xy[0] * scale)


def greenness(frame: np.ndarray) -> np.ndarray:
    red, green, blue = np.moveaxis(frame.astype(int), -1, 0)
    return green - np.maximum(red, blue)


def move_goal(env, state, xy):
    row = env.place.names.index("goal")
    return state.replace(physics=state.physics.replace(layout=state.physics.layout.at[row].set(xy)))


@pytest.mark.parametrize("name", ["point_goal2", "car_push2", "doggo_button2", "car_circle"])
def test_a_frame_has_its_size_and_shows_something(display, name):
    env, state = reset(name)
    for camera in ("fixedfar", "fixednear", "track", "vision"):
        frame = render.Renderer(env, WIDTH, HEIGHT, camera).frame(state)
        assert frame.shape == (HEIGHT, WIDTH, 3) and frame.dtype == np.uint8
        assert frame.reshape(-1, 3).std(0).max() > 5


def test_the_goal_is_green_where_it_is_and_only_there(display):
    env, state = reset("point_goal0", render_lidar_markers=False)
    renderer = render.Renderer(env, WIDTH, HEIGHT, from_above())
    here, there = jnp.array([1.5, 0.5]), jnp.array([-1.5, -1.0])
    for goal, other in ((here, there), (there, here)):
        green = greenness(renderer.frame(move_goal(env, state, goal)))
        assert green[pixel(goal)] > 30 and abs(green[pixel(other)]) < 10
        rows, columns = np.nonzero(green > 30)
        centre = np.array([rows.mean(), columns.mean()])
        assert np.abs(centre - pixel(goal)).max() < 6  # the cylinder's top is nearer to the camera


def test_bodies_hazards_and_the_robot_are_drawn_where_the_state_has_them(display):
    env, state = reset("point_goal2", render_lidar_markers=False)
    frame = render.Renderer(env, WIDTH, HEIGHT, from_above()).frame(state).astype(int)
    for xy in env.arena.positions(state.physics, "hazards"):
        red, green, blue = frame[pixel(xy)]
        assert blue > max(red, green) + 30
    for xy in env.arena.positions(state.physics, "vases"):
        red, green, blue = frame[pixel(xy)]
        assert min(green, blue) > red + 60
    red, green, blue = frame[pixel(env.arena.robot_pose(state.physics)[0])]
    assert red > max(green, blue) + 60


def test_the_active_button_alone_is_marked_in_orange(display):
    env, state = reset("point_button0", render_lidar_markers=False)
    renderer = render.Renderer(env, WIDTH, HEIGHT, from_above())
    for active in range(2):
        world = state.physics.replace(goal_button=jnp.int32(active))
        red, _, blue = np.moveaxis(renderer.frame(state.replace(physics=world)).astype(int), -1, 0)
        beside = env.arena.positions(world, "buttons") + jnp.array([0.15, 0.0])
        marked = [bool((red - blue)[pixel(xy)] > 30) for xy in beside[:2]]
        assert marked == [active == 0, active == 1]


def test_a_cost_turns_on_the_red_light(display):
    env, state = reset("point_goal1")
    renderer = render.Renderer(env, WIDTH, HEIGHT, "track")
    dark, lit = (renderer.frame(state.replace(cost=jnp.float32(cost))).astype(int) for cost in (0, 1))
    changed = np.abs(lit - dark).sum(-1) > 10
    assert 100 < changed.sum() < changed.size / 4
    assert ((lit - dark)[changed][:, 1:] < 0).all()  # less green and blue: redder


@pytest.mark.parametrize("flat", [True, False])
def test_the_halo_shows_the_lidars_of_the_observation(display, flat):
    env, state = reset("point_goal1", observation_flatten=flat)
    parts = split(state.obs, env.observation_spec)
    assert {k: v.size for k, v in parts.items()} == {
        k: np.prod(v) for k, v in env.observation_spec.items()
    }
    robot, _ = env.arena.robot_pose(state.physics)
    goal = env.arena.goal_position(state.physics)
    closeness = 1 - jnp.linalg.norm((robot - goal)[:2]) / env.config.lidar_max_dist
    np.testing.assert_allclose(parts["goal_lidar"].max(), closeness, rtol=1e-3)
    renderer = render.Renderer(env, WIDTH, HEIGHT)
    renderer.frame(state)
    with_halo = renderer._geoms.ngeom
    plain = render.Renderer(reset("point_goal1", render_lidar_markers=False)[0], WIDTH, HEIGHT)
    plain.frame(state)
    assert with_halo - plain._geoms.ngeom == 3 * env.config.lidar_num_bins  # goal, hazards, vases


def marks(env, state) -> list[Any]:
    """The geoms over a scene without bodies."""
    stage, geoms = Stage(env), mujoco.MjvScene(mujoco.MjModel.from_xml_string("<mujoco/>"), 500)  # type: ignore[attr-defined]
    stage.move(state.physics)
    stage.mark(geoms, state)
    return list(geoms.geoms[: geoms.ngeom])


def test_halo_and_cost_light_have_the_places_and_colours_of_the_original():
    options: Any = {"robot_locations": ((0.0, 0.0),), "robot_keepout": 0.0, "robot_rot": 0.0}
    env, state = reset("point_goal0", observe_goal_comp=True, **options)
    parts = {name: np.zeros(shape) for name, shape in env.observation_spec.items()}
    parts["goal_compass"][1] = 1.0  # it points left
    parts["goal_lidar"][:2] = 0.5, 0.95
    obs = np.concatenate([*parts.values()])
    goal, *halo, compass, light = marks(env, state.replace(obs=obs, cost=jnp.float32(1)))
    assert goal.size[0] == np.float32(env.config.goal_size) and len(halo) == 16
    np.testing.assert_allclose(halo[0].pos, [0.15 * np.cos(np.pi / 16), 0.15 * np.sin(np.pi / 16), 0.6])
    np.testing.assert_allclose(halo[0].rgba, [0, 0.6, 0, 0.6])  # COLOR_GOAL * (value + 0.1)
    np.testing.assert_allclose(halo[1].rgba, [0, 1, 0, 1])
    np.testing.assert_allclose(halo[2].rgba, [0, 0.1, 0, 0.1])
    np.testing.assert_allclose(compass.pos, [0, 0.15, 0.6], atol=1e-7)
    np.testing.assert_allclose((compass.size[0], light.size[0]), (0.05, 0.25))
    np.testing.assert_allclose(light.rgba, [0.5, 0, 0, 0.5])
    np.testing.assert_allclose(light.pos, [0, 0, 0.1], atol=1e-7)


def test_seditor_s_goal_and_hazards_are_drawn_as_high_as_they_are():
    """0.4 m, from a centimetre up. The goal stands at the button to press, as wide as that."""
    env, state = reset("seditor_point_button1", wrap={"frame_stack": 1}, render_lidar_markers=False)
    *hazards, goal = marks(env, state)
    for geom in (*hazards, goal):
        np.testing.assert_allclose((geom.size[2], geom.pos[2]), (0.2, 0.21), atol=1e-7)
    assert goal.size[0] == np.float32(env.config.buttons_size)
    np.testing.assert_allclose(
        [hazard.pos[:2] for hazard in hazards], env.arena.positions(state.physics, "hazards")
    )
    np.testing.assert_allclose(goal.pos[:2], env.arena.goal_position(state.physics)[:2])
    np.testing.assert_allclose(goal.rgba, [0, 1, 0, 0.25])


def test_panels_stand_side_by_side_and_a_short_film_waits_at_its_end():
    long = [np.full((4, 6, 3), i, np.uint8) for i in range(3)]
    short = [np.full((4, 6, 3), 100 + i, np.uint8) for i in range(2)]
    frames = render.side_by_side([long, short])
    assert [frame.shape for frame in frames] == 3 * [(4, 12 + render.GAP, 3)]
    assert [(frame[0, 0, 0], frame[0, -1, 0]) for frame in frames] == [(0, 100), (1, 101), (2, 101)]
    np.testing.assert_array_equal(render.side_by_side([long]), long)


def test_a_caption_says_what_an_episode_has_earned_and_cost(display, monkeypatch):
    said, size = [], {"width": 64, "height": 48}
    monkeypatch.setattr(render, "captioned", lambda frame, text: said.append(text) or frame)
    env, _ = reset("point_goal0", num_steps=4)
    player = reflex(lambda obs: jnp.array([1.0, 0.0]), env)
    states, told = render.run_episode(player, jax.random.key(3), 4)
    assert told == {}
    shield = {"overruled": np.array([False, False, False, True])}  # and a light says where it acts
    monkeypatch.setattr(render, "run_episode", lambda *args: (states, shield))
    frames = render.render_episode(env, player, jax.random.key(3), every=2, label="cpo", **size)
    plain = render.Renderer(env, **size)
    for frame, t, lit in zip(frames, (0, 2, 4), (False, True, False), strict=True):
        state = jax.tree.map(lambda x, t=t: x[t], states)
        assert (frame != plain.frame(state)).any() == lit
    assert (frames[1][6, -6] == [220, 30, 30]).all()
    returns = np.cumsum(states.reward)
    assert said == [f"cpo   return {returns[t]:.1f}   cost 0" for t in (0, 2, 4)]
    frame = np.zeros((48, 200, 3), np.uint8)
    monkeypatch.undo()
    drawn = render.captioned(frame, "cpo")
    assert drawn.shape == (48 + render.CAPTION, 200, 3) and (drawn[render.CAPTION :] == 0).all()
    line = drawn[: render.CAPTION]  # black on white
    assert 20 < (line < 128).sum() < line.size / 4


def test_what_an_algorithm_appends_to_an_observation_is_not_drawn():
    obs, spec = np.arange(5.0), {"goal_lidar": (3,), "velocimeter": (2,)}
    for seen in (obs, np.append(obs, 9.0)):
        parts = split(seen, spec)
        np.testing.assert_array_equal(parts["goal_lidar"], [0, 1, 2])
        np.testing.assert_array_equal(parts["velocimeter"], [3, 4])


def test_of_stacked_components_the_newest_is_drawn():
    env, state = reset("point_goal1", observation_flatten=False)
    older = jax.tree.map(jnp.zeros_like, state.obs)
    stacked = jax.tree.map(lambda *x: jnp.concatenate(x, -1), state.obs, older)
    newest, both = (split(obs, env.observation_spec) for obs in (state.obs, stacked))
    assert newest.keys() == both.keys() == env.observation_spec.keys()
    for name, value in newest.items():
        np.testing.assert_array_equal(both[name], value)
    places = [geom.pos.tolist() for geom in marks(env, state)]
    assert [geom.pos.tolist() for geom in marks(env, state.replace(obs=stacked))] == places


def test_an_unknown_camera_is_named_with_the_nearest():
    env, _ = reset("point_goal0")
    with pytest.raises(ConfigError, match=r"'fixedfur'.*fixedfar"):
        render.Renderer(env, camera="fixedfur")


def test_an_episode_is_drawn_at_most_at_30_frames_a_second_and_until_it_terminates(display):
    env, _ = reset("point_goal0", num_steps=12)
    zero = reflex(lambda obs: jnp.zeros(2), env)
    assert env.step_seconds == pytest.approx(0.02)
    size: Any = {"width": 64, "height": 48}
    assert len(render.render_episode(env, zero, jax.random.key(0), **size)) == 7  # steps 0, 2, ..., 12
    assert len(render.render_episode(env, zero, jax.random.key(0), length=4, every=1, **size)) == 5
    at_goal, _ = reset("point_goal0", num_steps=12, continue_goal=False, goal_size=9.0)
    zero = reflex(lambda obs: jnp.zeros(2), at_goal)
    assert len(render.render_episode(at_goal, zero, jax.random.key(0), every=1, **size)) == 2


@pytest.mark.parametrize("ending", ["mp4", "gif"])
def test_films_can_be_read_back(tmp_path, ending):
    frames = [np.full((48, 64, 3), 40 * i, np.uint8) for i in range(6)]
    path = tmp_path / "new" / f"film.{ending}"
    render.write_video(frames, path)
    film = np.stack([np.asarray(frame)[..., :3] for frame in imageio.v2.mimread(path)])
    assert film.shape == (6 if ending == "mp4" else 2, 48, 64, 3)
    assert abs(int(film[0].mean()) - 0) < 12 and film[-1].mean() > film[0].mean() + 60


def test_a_film_of_another_kind_is_refused_in_one_line(tmp_path):
    with pytest.raises(ConfigError, match=r"film\.avi: expected .* \.mp4 or \.gif"):
        render.write_video([np.zeros((2, 2, 3), np.uint8)], tmp_path / "film.avi")


def test_without_a_backend_there_is_one_line(monkeypatch):
    monkeypatch.setattr(backend, "works", lambda backend: False)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    with pytest.raises(backend.NoDisplay) as error:
        backend.find_backend()
    assert "\n" not in str(error.value) and "libegl1" in str(error.value)


def test_backends_are_tried_in_turn_unless_one_is_asked_for(monkeypatch):
    tried = []
    monkeypatch.setattr(backend.platform, "system", lambda: "Linux")
    monkeypatch.setattr(backend, "works", lambda backend: tried.append(backend) or backend == "osmesa")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    assert backend.find_backend() == "osmesa" and tried == ["egl", "osmesa"]
    monkeypatch.setenv("MUJOCO_GL", "egl")
    with pytest.raises(backend.NoDisplay, match="unset MUJOCO_GL=egl"):
        backend.find_backend()


def test_a_backend_that_is_off_is_no_display(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "off")
    with pytest.raises(backend.NoDisplay, match="unset MUJOCO_GL=off"):
        backend.find_backend()


def test_a_process_that_drew_ends_quietly(display):
    script = """if True:
        import jax
        from jaxsafe import envs
        from jaxsafe.envs.view import render
        env = envs.make("point_goal0", engine="c")
        renderer = render.Renderer(env, 64, 48)
        print(renderer.frame(env.reset(jax.random.key(0))).shape)
    """
    root = Path(__file__).parent.parent.parent
    environ = {**os.environ, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=root, env=environ, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "(48, 64, 3)\n", "")
