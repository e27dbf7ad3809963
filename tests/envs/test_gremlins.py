"""A gremlin that is hit stands in the way, as on MuJoCo 2, where the original ran."""
# pyright: reportAttributeAccessIssue=false
# (MuJoCo's bindings come without types)

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiling import FAST

from jaxsafe.envs.engines import ENGINES, Simulation, make_engine
from jaxsafe.envs.safety_gym import scene

SIZE = 0.1  # m, half the side of a gremlin
SETTLING, STEPS = 200, 600


def pushed() -> mujoco.MjSpec:
    """A ball that slides along x, at 1 m/s and with 0.02 N, past the middle of a gremlin."""
    spec = mujoco.MjSpec.from_string(f"""
    <mujoco>
      <option timestep="0.002"/>
      <worldbody>
        <geom type="plane" size="5 5 1"/>
        <body name="robot" pos="-0.5 0.06 {SIZE}">
          <joint name="x" type="slide" axis="1 0 0" damping="0.01"/>
          <geom size="{SIZE}" condim="6" density="1"/>
        </body>
      </worldbody>
      <actuator><motor joint="x"/></actuator>
    </mujoco>""")
    scene.add_block(spec, "gremlin0obj", "gremlin", SIZE, SIZE, 0.001)
    scene.add_gremlin_guide(spec, 0, SIZE)
    spec.body("gremlin0obj").pos = (0, 0, SIZE)
    spec.body("gremlin0mocap").pos = (0, 0, 2 * SIZE)  # as in the tasks, whose gremlins hover
    return spec


@pytest.mark.parametrize("engine", ENGINES)
def test_a_gremlin_that_is_pushed_keeps_its_heading_as_on_mujoco_2(engine):
    """On MuJoCo 2.2.0, 2.3.3 and 2.3.7: 479 steps in contact, turned by at most 5.0 degrees, the ball
    after 0.42 m at 0.017 m/s. On 3.17.0 without the weld's torquescale: 144, 117.5, 1.82 and 1.87."""
    spec = pushed()
    simulation = Simulation(spec, contacts=(("robot", "gremlin0obj"),))
    physics_engine = make_engine(engine, simulation)

    def step(physics, ctrl):
        physics, readings = physics_engine.run(physics, ctrl)
        return physics, (readings.contacts[0] > 0, physics.qpos[4])

    def episode(physics):
        physics, _ = jax.lax.scan(step, physics, jnp.zeros((SETTLING, 1)))
        start = physics.qpos.at[0].set(0.0), physics.qvel.at[0].set(1.0)
        physics = physics.replace(qpos=start[0], qvel=start[1])
        return jax.lax.scan(step, physics, jnp.full((STEPS, 1), 0.02))

    end, (touching, w) = jax.jit(episode, compiler_options=FAST)(physics_engine.start())
    turned = np.degrees(2 * np.arccos(np.minimum(1.0, np.abs(w)))).max()
    assert touching.sum() == pytest.approx(479, abs=8)
    assert turned == pytest.approx(5.0, abs=0.5)
    assert end.qpos[0] == pytest.approx(0.42, abs=0.02)
    assert end.qvel[0] == pytest.approx(0.017, abs=0.005)
