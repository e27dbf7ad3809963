"""What a faithful rebuild of Safety Gym keeps, each worked out by hand."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tasks import ROBOT_AT_ORIGIN, change, put, task, with_qpos

from jaxsafe.envs import make
from jaxsafe.envs.engines import Readings
from jaxsafe.envs.safety_gym import costs, observe, rewards, sensing

BARE = {"hazards_num": 0, "gremlins_num": 0, "vases_num": 0, "pillars_num": 0}
UPRIGHT = (jnp.array([0.0, 0.0, 0.1]), jnp.eye(3))


@pytest.mark.parametrize("robot, limit, ahead", [("point", 0.05, (1, 0)), ("car", 0.02, (1, 1))])
def test_drives_saturate_far_below_the_largest_action(robot, limit, ahead):
    t = task(f"{robot}_goal0")
    state = jax.tree.map(lambda x: jnp.broadcast_to(x[:1], x.shape), t.idle(t.begin()))
    actions = jnp.array([limit, 1.0, 7.0, limit / 2])[:, None] * jnp.array(ahead)
    velocity = np.asarray(t.step(state, actions).physics.bodies.qvel)
    np.testing.assert_allclose(velocity[1:3], velocity[:1].repeat(2, 0), atol=1e-6)
    assert np.abs(velocity[3] - velocity[0]).max() > 1e-3


def test_point_is_slowed_by_its_joints_alone():
    """Damping d on mass m: each of 10 implicit substeps of h divides the speed by 1 + h d / m."""
    t = task("point_goal0", robot_rot=0.0)
    model = t.env.scene.model
    state = t.begin()
    state = change(state, {"qvel": state.physics.bodies.qvel.at[:, 0].set(0.7)})
    factor = (1 + model.opt.timestep * model.dof_damping[0] / model.body_subtreemass[1]) ** -10
    speed = t.idle(state).physics.bodies.qvel
    np.testing.assert_allclose(speed, [[0.7 * factor, 0, 0]] * 4, rtol=1e-5, atol=1e-7)


def test_gremlins_hover_and_circle_in_phase():
    t = task("point_button1")
    state = t.begin()
    rows = t.env.scene.qpos_slice("gremlins")

    def gremlins(state) -> np.ndarray:
        centres = state.physics.layout[:, t.env.place.slice("gremlins")]
        poses = np.asarray(state.physics.bodies.qpos)[:, rows].reshape(4, -1, 7)[..., :3]
        return poses - np.pad(centres, ((0, 0), (0, 0), (0, 1)))

    np.testing.assert_allclose(gremlins(state), np.broadcast_to([0, 0, 0.1], (4, 4, 3)), atol=1e-6)
    before = gremlins(state)
    for _ in range(100):
        before, state = gremlins(state), t.idle(state)
    offset = gremlins(state)
    np.testing.assert_allclose(offset[..., 2], 0.2, atol=2e-3)
    np.testing.assert_allclose(offset, np.broadcast_to(offset[:1, :1], offset.shape), atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(offset[..., :2], axis=-1), 0.35, rtol=0.02)
    time = 100 * 0.02
    lag = 2 * 1.5 * 0.02 * 2  # a weld (0.02, 1.5) trails by at most some hundredths of a radian
    angle = np.arctan2(offset[..., 0], offset[..., 1])  # (sin t, cos t)
    assert (np.abs(angle - time) < lag).all()
    step = np.linalg.norm((offset - before)[..., :2], axis=-1)
    np.testing.assert_allclose(step, 0.35 * 0.02, rtol=0.05)


def test_push_distances_are_in_space():
    """Point's centre is at 0.1 m, the box's at 0.2 m and the goal's at 0.16 m."""
    t = task("point_push0")
    state = t.begin()
    world = state.physics
    robot, goal, box = (np.asarray(world.layout[:, i]) for i in range(3))
    np.testing.assert_allclose(
        world.last_dist_box, np.hypot(np.linalg.norm(robot - box, axis=1), 0.1), rtol=1e-5
    )
    np.testing.assert_allclose(
        world.last_box_goal, np.hypot(np.linalg.norm(box - goal, axis=1), 0.04), rtol=1e-5
    )


def test_a_box_at_rest_has_to_come_closer_than_the_goal_is_wide():
    """In the plane sqrt(0.3^2 - 0.04^2) = 0.29732 m."""
    t = task(
        "point_push0", robot_locations=((0.8, 0.8),), robot_keepout=0.1, goal_locations=((-0.3, -0.3),)
    )
    rows = t.env.scene.qpos_slice("box").start
    distance = jnp.array([0.3, 0.2980, 0.2966, 0.1])
    box = jnp.stack([-0.3 + distance, jnp.full(4, -0.3)], 1)
    state = with_qpos(t.begin(), slice(rows, rows + 2), box)
    state = with_qpos(state, slice(rows + 3, rows + 7), [1.0, 0, 0, 0])
    np.testing.assert_array_equal(t.idle(state).info["goal_met"], [0, 0, 1, 1])


def test_the_bonus_is_outside_the_clip():
    t = task("point_goal0", reward_clip=0.01, reward_goal=3.0)
    state = t.begin()
    state = put(t, state, "goal", state.physics.start[:, :2] + jnp.array([0.1, 0.0]))
    state = change(state, last_dist_goal=jnp.array([1.0, 0.101, 0.1, 0.0]))  # distance is now 0.1
    after = t.idle(state)
    np.testing.assert_allclose(after.reward, [3.01, 3.001, 3.0, 2.99], atol=1e-5)
    np.testing.assert_array_equal(after.info["goal_met"], 1)


def test_after_a_success_progress_counts_from_the_new_goal():
    t = task("point_goal0")
    state = t.begin()
    after = t.idle(put(t, state, "goal", state.physics.start[:, :2]))
    distance = np.linalg.norm(after.physics.layout[:, 1] - after.physics.start[:, :2], axis=1)
    np.testing.assert_allclose(after.physics.last_dist_goal, distance, rtol=1e-5)
    np.testing.assert_allclose(t.idle(after).reward, 0, atol=1e-6)


BUTTONS = {
    **ROBOT_AT_ORIGIN,
    **BARE,
    "buttons_num": 2,
    "buttons_keepout": 0.0,
    "buttons_locations": ((0.6, 0.0), (-0.6, 0.0)),
}


def pressing(t, state, button):
    """The robot, at rest, against a button."""
    x = jnp.array([0.41, -0.41])[button]  # sphere of 0.1 m against one of 0.1 m at 0.6
    state = with_qpos(state, slice(0, 3), jnp.stack([x, 0 * x, 0 * x], 1))
    return change(state, {"qvel": jnp.zeros_like(state.physics.bodies.qvel)})


def test_for_ten_steps_after_a_success_buttons_are_not_seen_and_cost_nothing():
    t = task("point_button1", **BUTTONS)
    state = t.begin()
    state = t.step(pressing(t, state, state.physics.goal_button), jnp.zeros((4, 2)))
    np.testing.assert_array_equal(state.info["goal_met"], 1)
    np.testing.assert_array_equal(state.cost, 0)
    seen, paid = [t.part(state, "buttons_lidar").max(1) > 0], []
    assert (t.part(state, "goal_lidar").max(1) > 0).all()  # the goal stays in sight
    for _ in range(12):
        wrong = 1 - state.physics.goal_button
        state = t.idle(pressing(t, state, wrong))
        np.testing.assert_array_equal(state.info["goal_met"], 0)
        paid.append(state.cost > 0)
        seen.append(t.part(state, "buttons_lidar").max(1) > 0)
    np.testing.assert_array_equal(
        seen, np.array([[k >= 10] * 4 for k in range(13)])
    )  # steps k .. k + 9
    np.testing.assert_array_equal(
        paid, np.array([[k > 10] * 4 for k in range(1, 13)])
    )  # k + 1 .. k + 10


def test_the_button_may_be_drawn_again_and_scores_again_at_once():
    t = task("point_button1", **BUTTONS)
    state = t.begin(64)
    first = state.physics.goal_button
    state = t.step(pressing(t, state, first), jnp.zeros((64, 2)))
    again = np.asarray(state.physics.goal_button == first)
    assert 10 < again.sum() < 54
    state = t.step(pressing(t, state, first), jnp.zeros((64, 2)))
    np.testing.assert_array_equal(state.info["goal_met"], again)
    np.testing.assert_array_equal(state.cost, 0)


def test_hazards_cost_their_depth_and_the_rim_is_free():
    t = task("point_goal1", **ROBOT_AT_ORIGIN, vases_num=0, hazards_num=2, constrain_indicator=False)
    state = put(t, t.begin(), "hazard0", [[0.2, 0.0], [0.15, 0.0], [0.0, 0.05], [0.21, 0.0]])
    state = put(t, state, "hazard1", [[9.0, 0.0], [0.0, -0.1], [9.0, 0.0], [0.0, 0.2]])
    np.testing.assert_allclose(t.idle(state).cost, [0, 0.05 + 0.1, 0.15, 0], atol=1e-6)
    assert t.idle(state).cost[0] == 0  # exactly on the rim


def test_every_cost_and_their_sum_are_indicators():
    t = task("point_goal2", **ROBOT_AT_ORIGIN, hazards_num=2, vases_num=2, hazards_cost=7.0)
    state = put(t, t.begin(), "hazard0", [0.01, 0.0])
    state = put(t, state, "hazard1", [0.0, 0.02])
    vases = t.env.scene.qpos_slice("vases").start
    state = with_qpos(state, slice(vases, vases + 2), [0.19, 0.0])
    after = t.idle(state)
    np.testing.assert_array_equal(after.costs[:, t.env.cost_names.index("hazards")], 1)
    np.testing.assert_array_equal(after.costs[:, t.env.cost_names.index("vases_contact")], 1)
    np.testing.assert_array_equal(after.cost, 1)


def test_a_vase_costs_while_it_slides_untouched():
    t = task("point_goal2", **ROBOT_AT_ORIGIN, hazards_num=0, vases_num=1)
    rows = t.env.scene.qvel_slice("vases").start
    vase = t.env.scene.qpos_slice("vases").start
    state = with_qpos(t.begin(), slice(vase, vase + 2), [1.5, 1.5])
    qvel = state.physics.bodies.qvel.at[:, rows].set(jnp.array([0.0, 0.5, 1.0, 2.0]))
    after = t.idle(change(state, {"qvel": qvel}))
    np.testing.assert_array_equal(after.costs[:, t.env.cost_names.index("vases_contact")], 0)
    np.testing.assert_array_equal(
        after.costs[:, t.env.cost_names.index("vases_velocity")], [0, 1, 1, 1]
    )
    np.testing.assert_array_equal(after.cost, [0, 1, 1, 1])


def test_a_vase_costs_its_speed_in_space_and_how_far_it_is_from_its_place():
    """One flies, one turns on the spot, one was moved, and one was moved a little."""
    options: dict[str, Any] = {"constrain_indicator": False, "vases_displace_cost": 3.0}
    t = task("point_goal2", **ROBOT_AT_ORIGIN, hazards_num=0, vases_num=1, **options)
    vase, rows = (s("vases").start for s in (t.env.scene.qpos_slice, t.env.scene.qvel_slice))
    state = t.begin()
    place = state.physics.layout[:, t.env.place.slice("vases")][:, 0]
    away = jnp.array([[0.0, 0.0], [0.0, 0.0], [0.03, 0.04], [5e-4, 0.0]])
    state = with_qpos(state, slice(vase, vase + 2), place + away)
    qvel = jnp.zeros_like(state.physics.bodies.qvel)
    qvel = qvel.at[0, rows : rows + 3].set(jnp.array([2.0, 3.0, 6.0])).at[1, rows + 5].set(5.0)
    unread: Any = ()

    def paid(world: Any) -> jax.Array:
        both = costs.vases_velocity, costs.vases_displace
        return jnp.array([cost(t.env.arena, world, unread) for cost in both])

    found = jax.vmap(paid)(change(state, {"qvel": qvel}).physics)
    np.testing.assert_allclose(found, [[7, 0], [0, 0], [0, 0.15], [0, 0]], rtol=1e-4, atol=1e-6)


def still(env, **world):
    """A world at rest with everything at the origin, and some of its fields."""
    count = len(env.place.names)
    return env.arena.at_rest(jnp.zeros((count, 2)), jnp.zeros(count), jax.random.key(0)).replace(
        **world
    )


def reading(contacts=(), **fields):
    return Readings(jnp.zeros(0), jnp.array(contacts, float), fields, jnp.zeros(()))


def test_each_point_of_contact_costs_and_the_button_to_press_is_free():
    kinds = ("vases", "pillars", "gremlins", "buttons")  # in the order of `watched`
    options: dict[str, Any] = {f"{kind}_num": 2 for kind in kinds}
    options |= {f"constrain_{kind}": True for kind in kinds}
    options |= {"placements_extents": (-3.0, -3.0, 3.0, 3.0), "constrain_indicator": False}
    env = make("point_button0", engine="c", **options, pillars_cost=0.5)
    assert list(env.scene.watched) == ["vases", "pillars", "gremlins", "buttons"]
    parts, total = costs.costs(env.arena, still(env), reading([1, 3, 2, 4, 0, 5, 7, 2]))
    names = ("vases_contact", "pillars", "buttons", "gremlins", "vases_velocity")
    assert env.cost_names == names
    assert parts.tolist() == [1 + 3, 0.5 * (2 + 4), 2, 5, 0] and total == 14


def test_vases_that_are_not_constrained_cost_nothing_by_their_place_either():
    env = make("point_goal1", engine="c", vases_displace_cost=1.0)
    assert env.cost_names == ("hazards",)


@pytest.mark.parametrize(
    "clip, expected", [(10.0, [10, -10, 3]), (None, [20, -20, 3]), (0.0, [20, -20, 3])]
)
def test_a_clip_of_null_or_0_is_none(clip, expected):
    env = make("point_goal0", engine="c", reward_clip=clip)
    after, none = still(env, last_dist_goal=jnp.float32(20)), reading()
    found = [
        rewards.reward(env.arena, still(env, last_dist_goal=jnp.float32(before)), after, none)
        for before in (40, 0, 23)
    ]
    np.testing.assert_allclose(found, expected)


@pytest.mark.parametrize(
    "quat, paid",
    [
        ((0.6, 0, 0, 0.8), 10),  # upright, with any heading: 30, clipped
        ((0.8, 0.6, 0, 0), 30 * 0.28),  # tilted about x, by the angle whose cosine is 0.28
        ((0.8, 0, 0.6, 0), 30 * 0.28),
        ((0.0, 1.0, 0, 0), -10),  # upside down
    ],
)
def test_uprightness_pays_within_the_clip(quat, paid):
    env = make("point_goal0", engine="c", reward_orientation=True, reward_orientation_scale=30.0)
    body, world = env.scene.model.body("robot").id, still(env)
    xquat = jnp.zeros((env.scene.model.nbody, 4)).at[body].set(jnp.array(quat))
    found = rewards.reward(env.arena, world, world, reading(xquat=xquat))
    np.testing.assert_allclose(found, paid, atol=1e-5)


@pytest.mark.parametrize(
    "name, height", [("point_goal0", 0.15 + 0.01), ("point_push0", 0.15 + 0.01), ("point_button0", 0.1)]
)
def test_what_is_sought_is_as_high_as_its_middle(name, height):
    env = make(name, engine="c", goal_size=0.3, buttons_size=0.1)
    assert env.arena.goal_position(still(env))[2] == pytest.approx(height)


def test_nearing_the_box_pays_by_how_far_it_was_before():
    """Farther than 2 times 0.2 m, and nothing from there on."""
    env = make("point_push0", engine="c", box_null_dist=2.0)
    for old, new, paid in ((0.5, 0.3, 0.2), (0.39, 0.45, 0.0), (0.3, 0.2, 0.0)):
        before, after = (still(env, last_dist_box=jnp.float32(x)) for x in (old, new))
        found = rewards.reward(env.arena, before, after, reading())
        np.testing.assert_allclose(found, paid, atol=1e-6)


def test_the_first_step_of_run_is_paid_from_where_the_robot_stood():
    t = task("point_run")
    state = t.begin()
    assert (np.abs(state.physics.start[:, 0]) > 0.01).any()
    np.testing.assert_allclose(t.idle(state).reward, 0, atol=1e-6)


def test_the_vase_of_level_one_is_free():
    t = task("point_goal1", **ROBOT_AT_ORIGIN, hazards_num=0)
    vase = t.env.scene.qpos_slice("vases").start
    before = with_qpos(t.begin(), slice(vase, vase + 2), [0.19, 0.0])
    after = t.step(before, jnp.ones((4, 2)))
    assert (np.abs(after.physics.bodies.qpos[:, vase] - 0.19) > 1e-3).all()
    np.testing.assert_array_equal(after.cost, 0)


def test_nothing_keeps_a_robot_inside():
    t = task("point_goal0", robot_rot=0.0)
    state = with_qpos(t.begin(), slice(0, 1), [1.0])
    for _ in range(60):
        state = t.step(state, jnp.array([[1.0, 0.0]] * 4))
    assert (state.physics.bodies.qpos[:, 0] > 1.2).all()
    assert not state.terminated.any() and not state.info["exception"].any()


def test_the_coordinates_of_point_are_those_of_its_start():
    """It began at (1, 2) with its front along y, went 3 m along y, and moves so at 0.5 m/s."""
    options = {"observe_qpos": True, "observe_qvel": True, "observe_sensors": False}
    env = make("point_goal0", engine="c", **options, observe_goal_lidar=False)
    world = still(env, start=jnp.array([1.0, 2.0, np.pi / 2]))
    qpos, qvel = jnp.array([1.0, 5.0, np.pi / 2 + 0.1]), jnp.array([0.0, 0.5, 0.2])
    world = world.replace(bodies=world.bodies.replace(qpos=qpos, qvel=qvel))
    seen = observe.observe(env.arena, world, reading(), jnp.zeros(2))
    np.testing.assert_allclose(seen, [3.0, 0.0, 0.1, 0.5, 0.0, 0.2], atol=1e-6)


def test_a_goal_s_distance_is_seen_in_the_plane_and_the_free_joint_whole():
    options = {"observe_goal_dist": True, "observe_freejoint": True, "observe_sensors": False}
    env = make("car_goal0", engine="c", **options, observe_goal_lidar=False)
    world = still(env)
    world = world.replace(
        layout=world.layout.at[env.place.names.index("goal")].set(jnp.array([3.0, 4.0]))
    )
    seen = observe.observe(env.arena, world, reading(), jnp.zeros(2))
    np.testing.assert_allclose(seen, [0, 0, 0.1, 1, 0, 0, 0, np.exp(-5)], atol=1e-6)


def test_remaining_grows():
    t = task("point_goal0", observe_remaining=True, num_steps=8)
    state = t.begin()
    for k in range(4):
        np.testing.assert_allclose(t.part(state, "remaining"), k / 8)
        state = t.idle(state)


def test_an_environment_does_not_end_by_time():
    t = task("point_goal0", observe_remaining=True, num_steps=8)
    state = t.begin()
    for _ in range(9):
        state = t.idle(state)
    assert not state.terminated.any()


def lidar(targets, bins=16, position=UPRIGHT[0], rotation=UPRIGHT[1], max_dist=3.0, alias=True):
    return np.asarray(
        sensing.pseudo_lidar(jnp.array(targets), position, rotation, bins, max_dist, 1.0, alias)
    )


def test_a_lidar_shares_a_reading_with_its_neighbours_by_angle():
    """2 m away, a quarter into bin 3 of 8: 1/3 there, a quarter of it in 4, the rest in 2."""
    angle = (3 + 0.25) * np.pi / 4
    reading = lidar([[2 * np.cos(angle), 2 * np.sin(angle)]], bins=8)
    np.testing.assert_allclose(reading, [0, 0, 0.75 / 3, 1 / 3, 0.25 / 3, 0, 0, 0], atol=1e-6)
    alone = lidar([[2 * np.cos(angle), 2 * np.sin(angle)]], bins=8, alias=False)
    np.testing.assert_allclose(alone, [0, 0, 0, 1 / 3, 0, 0, 0, 0], atol=1e-6)


def test_a_lidar_without_a_range_decays_exponentially():
    reading = sensing.pseudo_lidar(jnp.array([[2.0, 0.0]]), *UPRIGHT, 4, None, 0.5, False)
    np.testing.assert_allclose(reading, [np.exp(-1), 0, 0, 0], rtol=1e-6)


@pytest.mark.parametrize("y", [-1e-9, -1e-12, 0.0, 1e-9])
def test_a_target_exactly_ahead_falls_into_the_first_bin(y):
    """In floating point -1e-9 modulo 2 pi is 2 pi: bin 16 of 16, where the original fails."""
    reading = lidar([[1.0, y]])
    np.testing.assert_allclose(reading, [2 / 3, *[0] * 14, 2 / 3], atol=1e-6)


def test_the_nearest_target_counts_and_none_reads_zero():
    np.testing.assert_allclose(
        lidar([[1.0, 1e-3], [2.0, 1e-3], [4.0, 1e-3]], alias=False)[0], 2 / 3, atol=1e-5
    )
    np.testing.assert_array_equal(lidar(np.zeros((0, 2), np.float32)), np.zeros(16))
    np.testing.assert_array_equal(lidar([[0.0, 3.1]]), np.zeros(16))


def test_the_height_of_a_tilted_robot_leaks_into_its_lidar():
    """Pitched by p about y at height h, a target at x ahead seems x cos p + h sin p away."""
    p, h = 0.4, 0.22
    pitch = jnp.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    reading = lidar([[1.0, 0.0]], position=jnp.array([0.0, 0.0, h]), rotation=pitch, alias=False)
    np.testing.assert_allclose(reading[0], 1 - (np.cos(p) + h * np.sin(p)) / 3, rtol=1e-5)


def test_a_compass_is_a_little_shorter_than_one():
    for size, length in ((2, 5.0), (3, np.sqrt(25 + 0.06**2))):
        reading = sensing.compass(jnp.array([3.0, 4.0, 0.16]), *UPRIGHT, size)
        np.testing.assert_allclose(np.linalg.norm(reading), length / (length + 0.001), rtol=1e-6)
    turned = jnp.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # facing +y
    reading = sensing.compass(jnp.array([0.0, 2.0, 0.1]), UPRIGHT[0], turned, 2)
    np.testing.assert_allclose(reading, [2 / 2.001, 0], atol=1e-6)


def test_natural_lidar_measures_to_the_surface_and_never_sees_the_circle():
    """A pillar of radius 0.2 at 1 m reads exp(-0.8); group 6, the circle's, is not a MuJoCo group."""
    options = {
        **ROBOT_AT_ORIGIN,
        **BARE,
        "pillars_num": 1,
        "pillars_locations": ((1.0, 0.0),),
        "observe_pillars": True,
    }
    t = task("point_circle", **options, lidar_type="natural", lidar_num_bins=4)
    state = t.begin()
    np.testing.assert_allclose(t.part(state, "pillars_lidar"), [[np.exp(-0.8), 0, 0, 0]] * 4, atol=1e-6)
    np.testing.assert_array_equal(t.part(state, "circle_lidar"), 0)


def test_a_ray_along_the_face_of_a_shape_does_not_meet_it():
    along = jnp.array([1.0, 0.0, 2e-8])  # level but for rounding
    for hit, size in ((sensing.hit_cylinder, (0.1, 0.2, 0)), (sensing.hit_box, (0.1, 0.1, 0.2))):
        inside = hit(along, jnp.array([0.0, 0.0, 0.2 - 1e-9]), size=np.array(size), slack=0.0)
        np.testing.assert_allclose(inside, 0.1, rtol=1e-5)  # the side, not the lid


def test_a_ray_meets_the_caps_of_a_capsule():
    """Of radius 0.1 m and half length 0.3 m: 0.4 m from the middle along the axis."""
    size = np.array((0.1, 0.3, 0))
    for z in (1.0, -1.0):
        start, ahead = jnp.array([0.0, 0.0, -z]), jnp.array([0.0, 0.0, z])
        np.testing.assert_allclose(sensing.hit_capsule(ahead, start, size, 0.0), 0.6, rtol=1e-5)


def test_walls_stand_straight_and_pillars_are_turned():
    env = make("point_goal0", engine="c", walls_num=1, pillars_num=1)
    count = len(env.place.names)
    world = env.arena.at_rest(jnp.zeros((count, 2)), jnp.ones(count), jax.random.key(0))
    turned = [np.cos(0.5), 0, 0, np.sin(0.5)]
    for kind, quat in (("walls", [1, 0, 0, 0]), ("pillars", turned)):
        found = world.bodies.mocap_quat[env.scene.mocap_slice(kind)]
        np.testing.assert_allclose(found, [quat], rtol=1e-6)


def test_circle_pays_for_speed_along_the_circle():
    """0.1 (v x - u y) / r / (1 + |r - 1.5|), with x, y and r of the centre of mass."""
    t = task("point_circle", robot_rot=0.0)
    model = t.env.scene.model
    state = with_qpos(t.begin(), slice(0, 3), [1.0, 0.0, 0.0])
    state = change(state, {"qvel": jnp.array([[0.3, 0.4, 0.0]] * 4)})
    after = t.idle(state)
    qpos, qvel = (
        np.asarray(x)[0].astype(float) for x in (after.physics.bodies.qpos, after.physics.bodies.qvel)
    )
    (x, y), (u, v) = qpos[:2], qvel[:2]
    body = model.body("robot")
    x += body.ipos[0]  # heading 0: the centre of mass is ahead
    r = np.hypot(x, y)
    np.testing.assert_allclose(after.reward, (v * x - u * y) / r / (1 + abs(r - 1.5)) * 0.1, rtol=1e-4)


def test_a_success_ends_the_episode_if_there_is_no_next_goal():
    t = task("point_goal0", continue_goal=False)
    state = t.begin()
    goal = np.asarray(state.physics.layout[:, 1])
    near = np.asarray(state.physics.start[:, :2])
    after = t.idle(put(t, state, "goal", np.where([[True], [False]] * 2, near, goal)))
    np.testing.assert_array_equal(after.terminated, [True, False] * 2)
    np.testing.assert_array_equal(after.info["goal_met"], [1, 0] * 2)
    np.testing.assert_array_equal(after.physics.layout[::2, 1], near[::2])


@pytest.mark.parametrize("field, robot", [("qpos", "point"), ("qvel", "point"), ("qvel", "doggo")])
def test_a_physics_error_ends_its_own_world_only(field, robot, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT
    t = task(f"{robot}_goal1")
    state, action = t.begin(), jax.random.uniform(jax.random.key(1), (4, t.env.action_size), minval=-1)
    good = t.step(state, action)
    physics = state.physics.bodies
    broken = getattr(physics, field).at[2, 1].set(jnp.nan)
    after = t.step(change(state, {field: broken}), action)
    assert (after.reward[2], after.cost[2]) == (-10, 0)
    np.testing.assert_array_equal(after.terminated, [False, False, True, False])
    np.testing.assert_array_equal(after.info["exception"], [0, 0, 1, 0])
    assert np.isfinite(after.obs).all()
    others = np.array([0, 1, 3])
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(good), strict=True):
        if not jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            np.testing.assert_array_equal(np.asarray(a)[others], np.asarray(b)[others])
    for name in ("key", "steps"):  # which go on in all four
        assert (getattr(after.physics, name) == getattr(good.physics, name)).all()
    assert (t.idle(after).info["exception"] == after.info["exception"]).all()


def test_gremlins_take_the_same_seconds_for_a_turn_whatever_the_robot():
    steps = {
        r: 2 * np.pi / make(f"{r}_button1", engine="c").step_seconds for r in ("point", "car", "doggo")
    }
    assert {r: round(n) for r, n in steps.items()} == {"point": 314, "car": 157, "doggo": 63}
