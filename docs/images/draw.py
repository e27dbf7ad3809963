"""Draw the pictures beside this file: python docs/images/draw.py"""

from pathlib import Path

import imageio
import jax
import mujoco

from jaxsafe import envs
from jaxsafe.envs import render

HERE = Path(__file__).parent
SCENES = {  # name: seed, steps into the episode, where the camera looks (m), its distance (m)
    "point_goal2": (1, 60, (-0.3, -0.45, 0.0), 3.4),
    "car_push2": (5, 60, (-0.3, -0.4, 0.1), 3.6),
    "doggo_button2": (5, 30, (-0.1, -0.35, 0.1), 3.4),
}


def draw(name: str) -> None:
    """One frame of an episode with a random policy."""
    seed, steps, lookat, distance = SCENES[name]
    env = envs.make(name, engine="c")

    def policy(obs: jax.Array, key: jax.Array) -> jax.Array:
        return jax.random.uniform(key, (env.action_size,), minval=-1.0)

    states = render.run_episode(env, policy, jax.random.key(seed), steps)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = lookat
    camera.distance, camera.azimuth, camera.elevation = distance, 90, -36
    frame = render.Renderer(env, 640, 400, camera).frame(jax.tree.map(lambda x: x[-1], states))
    imageio.imwrite(HERE / f"{name}.png", frame)


if __name__ == "__main__":
    for name in SCENES:
        draw(name)
