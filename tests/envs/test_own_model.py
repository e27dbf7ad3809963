"""The page about environments of one's own: its MuJoCo model, on all three engines."""
# pyright: reportAttributeAccessIssue=false
# (MuJoCo's bindings come without types)

import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiling import FAST

import jaxsafe
from jaxsafe.config import ConfigError
from jaxsafe.envs.check import check_env
from jaxsafe.envs.engines import ENGINES, Simulation, make_engine

PAGE = Path(__file__).parent.parent.parent / "docs" / "howto" / "own_environment.md"
CODE = re.search(r"```python\n(# my_cartpole\.py\n.*?)```", PAGE.read_text(), re.S)


@pytest.fixture(scope="module")
def page() -> ModuleType:
    assert CODE
    module = ModuleType("my_cartpole")
    exec(compile(CODE[1], "my_cartpole.py", "exec"), vars(module))
    return module


@pytest.mark.parametrize("engine", ENGINES)
def test_the_model_of_the_page_goes_where_mujoco_takes_it(page, engine):
    """Four carts, of which two drive into the walls; their poles fall as they do in MuJoCo."""
    env = check_env(page.CartPole(engine=engine), "cartpole")
    push = jnp.array([[-1.0], [1.0], [0.2], [0.0]])

    def episode(keys: jax.Array) -> Any:
        def step(state: Any, _: None) -> tuple[Any, Any]:
            state = jax.vmap(env.step)(state, push)
            return state, state

        state = jax.vmap(env.reset)(keys)
        return state, jax.lax.scan(step, state, length=40)[1]

    first, states = jax.jit(episode, compiler_options=FAST)(jax.random.split(jax.random.key(0), 4))
    model = mujoco.MjModel.from_xml_string(page.XML)
    data = mujoco.MjData(model)
    touched = np.zeros((40, 4))
    qpos = np.zeros((40, 4, 2))
    for i in range(4):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.ctrl[:] = first.physics.qpos[i], push[i]
        for k in range(40):
            mujoco.mj_step(model, data, 2)
            mujoco.mj_forward(model, data)
            qpos[k, i], touched[k, i] = data.qpos, data.ncon > 0
    before = touched.cumsum(0) == 0  # after a bounce, poles in float32 and float64 part
    np.testing.assert_allclose(states.physics.qpos[before], qpos[before], atol=1e-4)
    assert 0.95 < np.abs(states.physics.qpos[..., 0]).max() < 1  # walls hold at 0.95
    assert touched[:, :2].any(0).all() and not touched[:, 2:].any()
    hits = np.asarray(states.costs[..., 1])
    assert (hits.argmax(0) == touched.argmax(0)).all() and not hits[:, 2:].any()
    np.testing.assert_array_equal(states.costs[..., 0], np.abs(states.physics.qpos[..., 0]) > 0.5)


def test_the_environment_of_the_page_trains(page, tmp_path, monkeypatch):
    (tmp_path / "my_cartpole.py").write_text(CODE[1])  # type: ignore[index]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    run = jaxsafe.train(
        "my_cartpole:CartPole", "ppo_lag", run_dir="run", num_envs=4, total_steps=64, eval_episodes=2,
        video=False, horizon=16, minibatches=2, epochs=1, critic_epochs=1, hidden=(8,),
    )  # fmt: skip
    assert run.steps == 64 and (tmp_path / "run" / "config.yaml").exists()


def test_what_an_engine_cannot_run_is_one_line():
    body = "<body name='b'><joint name='j'/><geom size='1'/></body>"
    muscle = f"<mujoco><worldbody>{body}</worldbody>{{}}</mujoco>"
    filtered = "<actuator><general joint='j' dyntype='filter' dynprm='1'/></actuator>"
    plain = mujoco.MjSpec.from_string(muscle.format(""))
    for name in ENGINES:
        with pytest.raises(ConfigError, match="expected actuators without a state"):
            make_engine(name, Simulation(mujoco.MjSpec.from_string(muscle.format(filtered))))
        with pytest.raises(ConfigError, match="contacts: the model has no body 'c'"):
            make_engine(name, Simulation(plain, contacts=(("b", "c"),)))
        with pytest.raises(ConfigError, match="fields: 'xpo' cannot be reported; did you mean 'xpos'"):
            make_engine(name, Simulation(plain, fields=("xpo",)))


def test_contacts_count_for_what_a_body_carries_and_poses_come_along():
    """A hand on an arm rests on the floor; the arm's contacts count the hand's, the hand's its own."""
    xml = """
    <mujoco>
      <worldbody>
        <geom type="plane" size="1 1 1"/>
        <body name="arm" pos="0 0 0.5">
          <freejoint/><geom size="0.1"/>
          <body name="hand" pos="0 0 -0.41"><geom size="0.1"/><site name="palm" pos="0 0 0.1"/></body>
        </body>
      </worldbody>
    </mujoco>"""
    pairs = (("arm", "world"), ("hand", "world"), ("hand", "arm"))
    simulation = Simulation(
        mujoco.MjSpec.from_string(xml), fields=("xpos", "site_xpos", "xmat"), contacts=pairs
    )
    for name in ENGINES:
        engine = make_engine(name, simulation)
        _, readings = jax.jit(engine.forward)(engine.start(), jnp.zeros(0))
        np.testing.assert_array_equal(readings.contacts, [1, 1, 0])
        np.testing.assert_allclose(readings.fields["xpos"][1:], [[0, 0, 0.5], [0, 0, 0.09]], atol=1e-6)
        np.testing.assert_allclose(readings.fields["site_xpos"], [[0, 0, 0.19]], atol=1e-6)
        assert readings.fields["xmat"].shape == (3, 3, 3) and readings.sensors.shape == (0,)


def test_inertias_velocities_and_forces_are_mujocos(page):
    """A wheel is driven over the floor. No sensor of the model asks for the forces."""
    xml = """
    <mujoco>
      <worldbody>
        <geom type="plane" size="1 1 1"/>
        <body name="frame" pos="0 0 0.199">
          <joint type="slide" axis="0 0 1"/><joint type="slide" axis="1 0 0" damping="0.1"/>
          <geom size="0.1" contype="0"/>
          <body name="wheel" pos="0 0 0"><joint name="axle" axis="0 1 0"/><geom size="0.2"/></body>
        </body>
      </worldbody>
      <actuator><motor joint="axle" gear="3"/></actuator>
    </mujoco>"""
    fields = ("subtree_com", "cinert", "cvel", "cfrc_ext", "qfrc_actuator")
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.5
    mujoco.mj_step(model, data, 10)
    mujoco.mj_forward(model, data)
    mujoco.mj_rnePostConstraint(model, data)
    assert abs(data.cfrc_ext).max() > 100 and abs(data.cvel).max() > 0.01
    simulation = Simulation(mujoco.MjSpec.from_string(xml), substeps=10, fields=fields)
    for name in ENGINES:
        engine = make_engine(name, simulation)
        run = jax.jit(engine.run, compiler_options=FAST)
        _, readings = run(engine.start(), jnp.array([0.5]))
        assert readings.sensors.shape == (0,)
        for field in fields:
            their = getattr(data, field)
            error = np.abs(readings.fields[field] - their).max()
            assert error < 1e-3 * max(1.0, np.abs(their).max()), (name, field)


def test_a_model_that_our_kernels_are_not_for_runs_on_mujoco_warps_and_one_line_says_so(page, capfd):
    xml = page.XML.replace("<option ", '<option integrator="implicitfast" ')
    engine = make_engine("warp", Simulation(mujoco.MjSpec.from_string(xml), substeps=2))
    step = jax.jit(engine.run)
    physics = engine.start([0.0, 0.3])
    for _ in range(3):
        physics, _ = step(physics, jnp.ones(1))
    said = [line for line in capfd.readouterr().err.splitlines() if "engine warp" in line]
    assert said == [
        "engine warp: MuJoCo Warp's own kernels run this model (an integrator other than Euler and RK4)"
    ]
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = [0.0, 0.3], 1.0
    mujoco.mj_step(model, data, 6)
    np.testing.assert_allclose(physics.qpos, data.qpos, atol=1e-5)
