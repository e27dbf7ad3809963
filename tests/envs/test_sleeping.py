"""Sleeping objects: k awake ones go as all awake ones would, and k are the right ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import FAST
from mujoco import mjx
from tasks import ROBOT_AT_ORIGIN, Task, change, task, with_qpos

from jaxsafe import envs
from jaxsafe.config import ConfigError
from jaxsafe.envs.engines.jax import engine as jax_engine  # noqa: F401  (has the collisions)
from jaxsafe.envs.registry import OURS
from jaxsafe.envs.safety_gym import scene, sleeping
from jaxsafe.envs.safety_gym.config import config_from_plain as read_config


def walk(t: Task, steps: int, count: int = 4):
    """The states of `steps` random actions."""
    state, states = t.begin(count), []
    for key in jax.random.split(jax.random.key(7), steps):
        action = jax.random.uniform(key, (count, t.env.action_size), minval=-1)
        states.append(state := t.step(state, action))
    return states


@pytest.mark.parametrize("name", ["point_goal2", "point_button1"])
def test_who_is_out_of_reach_may_sleep(name):
    for some, everyone in zip(walk(task(name, awake=2), 20), walk(task(name), 20), strict=True):
        np.testing.assert_allclose(some.obs, everyone.obs, atol=2e-5)
        np.testing.assert_allclose(some.reward, everyone.reward, atol=1e-6)
        np.testing.assert_array_equal(some.costs, everyone.costs)
        world, whole = some.physics.bodies, everyone.physics.bodies
        np.testing.assert_allclose(world.qpos, whole.qpos, atol=2e-5)
        np.testing.assert_allclose(world.qvel, whole.qvel, atol=1e-3)


def beside_the_robot(t: Task, vase: int):
    """Worlds with the robot at the origin, facing `vase` 0.25 m ahead, the others behind its back."""
    state = t.begin()
    count = t.env.scene.frees["vases"]
    places = np.array([[-1.5, 0.4 * i - 2] for i in range(count)])
    places[vase] = [0.25, 0.0]
    for i, xy in enumerate(places):
        start = t.env.scene.qpos_slice("vases").start + 7 * i
        state = with_qpos(state, slice(start, start + 2), jnp.tile(jnp.asarray(xy), (4, 1)))
    return state


def test_a_vase_that_is_hit_wakes_and_costs():
    options = ROBOT_AT_ORIGIN | {"vases_num": 6, "hazards_num": 0, "constrain_vases": True}
    some, everyone = (task("point_goal1", awake=k, **options) for k in (2, None))
    a, b = beside_the_robot(some, 4), beside_the_robot(everyone, 4)
    ahead = jnp.tile(jnp.array([1.0, 0.0]), (4, 1))
    total = 0.0
    for _ in range(60):
        a, b = some.step(a, ahead), everyone.step(b, ahead)
        np.testing.assert_array_equal(a.costs, b.costs)
        total += float(a.cost.sum())
    np.testing.assert_allclose(a.obs, b.obs, atol=2e-3)
    assert total > 0


def test_a_moving_vase_stays_awake_and_the_others_rest():
    t = task("point_goal1", awake=2, **(ROBOT_AT_ORIGIN | {"vases_num": 6, "hazards_num": 0}))
    state = beside_the_robot(t, 4)
    first = t.env.scene.qvel_slice("vases").start
    qvel = state.physics.bodies.qvel.at[:, first].set(1.0)  # vase 0, the farthest, slides along x
    qvel = qvel.at[:, first + 12].set(5e-5)  # vase 2 does not count as moving
    state = change(state, {"qvel": qvel})
    after = t.idle(state).physics.bodies
    shift = (after.qpos - state.physics.bodies.qpos)[:, t.env.scene.qpos_slice("vases")]
    shift = shift.reshape(4, 6, 7)[:, :, 0]
    assert (shift[:, 0] > 5e-3).all()
    np.testing.assert_array_equal(shift[:, 1:4], 0)
    resting = after.qvel[:, t.env.scene.qvel_slice("vases")].reshape(4, 6, 6)[:, [1, 2, 3, 5]]
    np.testing.assert_array_equal(resting, 0)


def test_a_vase_whose_speed_is_charged_stays_awake():
    options = ROBOT_AT_ORIGIN | {"vases_num": 6, "hazards_num": 0, "vases_velocity_threshold": 1e-5}
    t = task("point_goal1", awake=2, **options)
    state = beside_the_robot(t, 4)
    at = t.env.scene.qvel_slice("vases").start + 12  # vase 2
    state = change(state, {"qvel": state.physics.bodies.qvel.at[:, at].set(5e-5)})
    after = t.idle(state).physics.bodies
    assert (after.qvel[:, at] != 0).all()  # asleep, it would rest


def test_of_too_many_moving_vases_the_nearest_stay_awake():
    t = task("point_goal1", awake=2, **(ROBOT_AT_ORIGIN | {"vases_num": 6, "hazards_num": 0}))
    state = beside_the_robot(t, 4)
    speeds = state.physics.bodies.qvel.at[:, t.env.scene.qvel_slice("vases")].set(0.5)
    physics = jax.tree.map(lambda x: x[0], change(state, {"qvel": speeds}).physics.bodies)
    small = envs.SafetyGym(sleeping.small_config(t.env.config, 2), "c").scene
    chosen = sleeping.awake_objects(physics, t.env.scene, small, "vases")
    np.testing.assert_array_equal(chosen, [4, 5])  # 0.25 m and 1.5 m away


def test_a_gremlin_alone_goes_where_mujoco_takes_it():
    options = ROBOT_AT_ORIGIN | {"gremlins_num": 3, "hazards_num": 0, "vases_num": 0}
    some, everyone = (task("point_goal1", awake=k, **options) for k in (1, None))
    a, b = some.begin(), everyone.begin()
    for _ in range(70):
        a, b = some.idle(a), everyone.idle(b)
    for field, tolerance in (("qpos", 1e-5), ("qvel", 1e-3)):
        ours, theirs = (getattr(s.physics.bodies, field) for s in (a, b))
        np.testing.assert_allclose(ours, theirs, atol=tolerance)


def test_how_many_are_awake_by_default():
    def simulated(name: str, **options) -> int:
        env = envs.make(name, **options)
        return sleeping.awake(env.config, env.engine)

    assert simulated("point_goal2", engine="c") == 10
    assert simulated("point_goal2", engine="warp") == sleeping.AWAKE
    assert simulated("point_goal2", engine="warp", lidar_type="natural") == 10
    assert simulated("point_goal2", engine="c", awake=3) == 3


def test_settings_that_need_everyone_are_refused():
    with pytest.raises(ConfigError, match=r"env.awake=0: expected a whole number between 1 and"):
        envs.make("point_goal2", engine="c", awake=0)
    with pytest.raises(ConfigError, match=r"env.awake=2: expected 10 or null with .*natural"):
        envs.make("point_goal2", engine="c", awake=2, lidar_type="natural")


def on_mjx(name: str, **options) -> scene.Scene:
    """The scene that engine `jax` has of a task."""
    config = read_config({k: v for k, v in OURS[name].items() if k != "wrap"} | options)
    return scene.build(sleeping.small_config(config, sleeping.awake(config, "jax")), mjx=True)


def test_the_jax_engine_has_room_for_the_contacts_of_all_that_are_awake():
    options = {"vases_num": 16, "vases_keepout": 0.1, "hazards_num": 0, "awake": 16}
    built = on_mjx("point_goal1", **options)
    start = built.qpos_slice("vases").start
    qpos = built.model.qpos0.copy()
    for i in range(16):
        qpos[start + 7 * i : start + 7 * i + 3] = i % 4 - 1.5, i // 4 - 1.5, 0.1 - 4e-5

    def touching(qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        model = mjx.put_model(built.model, impl="jax")
        data = mjx.kinematics(model, mjx.make_data(built.model, impl="jax").replace(qpos=qpos))
        contact = mjx.collision(model, data)._impl.contact  # type: ignore[union-attr]
        return contact.geom, contact.dist <= 0

    geom, met = map(np.asarray, jax.jit(touching, compiler_options=FAST)(jnp.asarray(qpos)))
    floor = built.model.geom("floor").id
    for i in range(16):
        pair = [floor, built.model.geom(f"vase{i}").id]
        assert (met & (np.sort(geom) == np.sort(pair)).all(1)).sum() == 4


def test_the_room_for_contacts_of_the_jax_engine_grows_with_what_is_awake():
    def room(*args, **options) -> list[float]:
        built = on_mjx(*args, **options)
        names = ("max_geom_pairs", "max_contact_points")
        return [float(built.model.numeric(name).data[0]) for name in names]

    for name in OURS:
        assert room(name) == [16, 48], name
    assert room("point_goal2", awake=10) == [18, 54]
    assert room("doggo_goal2", vases_num=16, awake=16, hazards_num=0) == [54, 162]
