"""Draw the pictures beside this file: python docs/images/draw.py

With --run RUN it writes policy.gif instead, or what --out names, of a policy trained on that. The
policy.gif here is of `python scripts/train.py env=car_push1 algo=sac_lag preset=navigation
total_steps=3e6`, on a CPU, and doggo.gif of the run in docs/results/doggo, --index 2 --seed 7.
"""

import argparse
from pathlib import Path

import imageio
import jax
import mujoco
import numpy as np
from PIL import Image

from jaxsafe import envs
from jaxsafe.envs.racing.car import parked
from jaxsafe.envs.safety_gym.suite import ROBOTS, TASKS
from jaxsafe.envs.velocity import suite as velocities
from jaxsafe.envs.view import render
from jaxsafe.learn.acting import Player
from jaxsafe.run.policies import open_run
from jaxsafe.types import Policy, PyTree

HERE = Path(__file__).parent
SCENES = {  # name: seed, steps into the episode, where the camera looks (m), its distance (m)
    "point_goal2": (1, 60, (-0.3, -0.45, 0.0), 3.4),
    "car_push2": (5, 60, (-0.3, -0.4, 0.1), 3.6),
    "doggo_button2": (5, 30, (-0.1, -0.35, 0.1), 3.4),
}
STEPS, EVERY = 420, 3  # of the episode in policy.gif, and steps from a frame to the next
SMALL = [f"{robot}_{task}" for robot in ROBOTS for task in TASKS if task not in ("run", "circle")]


def camera(
    lookat: tuple[float, float, float], distance: float, elevation: float = -36
) -> mujoco.MjvCamera:
    made = mujoco.MjvCamera()
    made.lookat[:] = lookat
    made.distance, made.azimuth, made.elevation = distance, 90, elevation
    return made


def draw(name: str) -> None:
    """One frame of an episode with a random policy."""
    seed, steps, lookat, distance = SCENES[name]
    env = envs.make(name, engine="c")

    def act(learned: PyTree, carry: jax.Array, obs: jax.Array, key: None):
        carry, action_key = jax.random.split(carry)
        return jax.random.uniform(action_key, (env.action_size,), minval=-1.0), carry, {}

    player = Player(Policy(lambda learned: jax.random.key(seed), act), (), env)
    states, _ = render.run_episode(player, jax.random.key(seed), steps)
    view = camera(lookat, distance)
    frame = render.Renderer(env, 640, 400, view).frame(jax.tree.map(lambda x: x[-1], states))
    imageio.imwrite(HERE / f"{name}.png", frame)


def draw_small(name: str) -> None:
    """The first frame of an episode whose robot stands in front, all of the layout, at 240 x 160."""
    env = envs.make(name, engine="c", floor_display_mode=True)
    half = env.config.placements_extents[2]
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 16))
    front = np.asarray(states.physics.layout[:, 0, 1]).argmin()
    state = jax.tree.map(lambda x: x[front], states)
    view = camera((0.0, -0.05 * half, 0.1), 1.0 + 1.7 * half)
    frame = render.Renderer(env, 480, 320, view).frame(state).astype(np.float32)
    smooth = frame.reshape(160, 2, 240, 2, 3).mean((1, 3))  # four pixels make one
    path = HERE / "environments" / f"{name}.jpg"
    path.parent.mkdir(exist_ok=True)
    imageio.imwrite(path, smooth.round().astype(np.uint8), quality=88)


def draw_velocity(name: str) -> None:
    """The first frame of an episode, at 240 x 160."""
    env = envs.make(name, engine="c")
    state = jax.device_get(jax.jit(env.reset)(jax.random.key(0)))
    frame = render.Renderer(env, 480, 320, "track").frame(state).astype(np.float32)
    smooth = frame.reshape(160, 2, 240, 2, 3).mean((1, 3))
    path = HERE / "environments" / f"{name}.jpg"
    imageio.imwrite(path, smooth.round().astype(np.uint8), quality=88)


def draw_racing(name: str) -> None:
    """Before an obstacle in a bend: a frame of a film, and the picture that a policy sees, enlarged."""
    env = envs.make(name, observe_vision=True)
    state = jax.jit(env.reset)(jax.random.split(jax.random.key(0), 6)[1])
    world, tile = state.physics, 35
    along = world.track.direction(tile)
    car = parked(world.track.point(tile), jax.numpy.arctan2(along[1], along[0]))
    world = world.replace(car=car)
    seen = jax.jit(lambda world: env.observe(world, tile)["vision"])(world)
    large = np.asarray(seen).repeat(3, 0).repeat(3, 1).repeat(3, 2)
    frame = render.Aerial(432, 288).frame(state.replace(physics=world))
    imageio.imwrite(HERE / "environments" / f"{name}.png", render.beside(frame, large))


def draw_policy(run: Path, index: int, seed: int, begin: int, path: Path) -> None:
    """A part of an episode of a policy in `run`, from step `begin` on, as a small GIF."""
    policy = open_run(run).one(index)
    states, _ = render.run_episode(policy.player, jax.random.key(seed), begin + STEPS)
    drawing = render.Renderer(policy.env, 560, 400, camera((0.0, 0.0, 0.0), 4.5, elevation=-55))
    frames = [
        Image.fromarray(drawing.frame(jax.tree.map(lambda x, t=t: x[t], states)))
        for t in range(begin, begin + STEPS, EVERY)
    ]
    colours = frames[0].quantize(128)  # of all frames, so that what rests stays the same pixels
    frames = [frame.quantize(palette=colours, dither=Image.Dither.NONE) for frame in frames]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=50, loop=0, optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--index", type=int, default=0, help="which policy of RUN, from 0")
    parser.add_argument("--seed", type=int, default=1, help="of the episode")
    parser.add_argument("--begin", type=int, default=0, help="step at which the picture begins")
    parser.add_argument("--out", type=Path, default=HERE / "policy.gif", help="the GIF to write")
    args = parser.parse_args()
    if args.run:
        draw_policy(args.run, args.index, args.seed, args.begin, args.out)
    else:
        for name in SCENES:
            draw(name)
        for name in SMALL:
            draw_small(name)
        for name in velocities.suite():
            draw_velocity(name)
        draw_racing("car_racing1")
