"""What is fixed in a task, what an episode remembers, and where things are."""

from dataclasses import dataclass
from functools import cached_property

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.envs.engines import Physics, Readings
from jaxsafe.envs.safety_gym import layout as layouts
from jaxsafe.envs.safety_gym import scene as scenes
from jaxsafe.envs.safety_gym.config import SafetyGymConfig
from jaxsafe.envs.vision.poses import rotation_of


@flax.struct.dataclass
class World:
    """What an episode remembers between two steps.

    bodies: what moves, in the engine's terms.
    layout [n, 2]: where each object of the placement was put; the goal's row is the current goal.
    start [3]: the robot's first x, y (m) and heading (rad).
    last_dist_goal, last_dist_box, last_box_goal (m), last_com [3]: what rewards compare with, as it
        was last measured.
    """

    bodies: Physics
    layout: jax.Array
    start: jax.Array
    goal_button: jax.Array
    buttons_timer: jax.Array
    last_dist_goal: jax.Array
    last_dist_box: jax.Array
    last_box_goal: jax.Array
    last_com: jax.Array
    steps: jax.Array
    key: jax.Array


@dataclass(frozen=True, eq=False)
class Arena:
    """Options, model and placement of a task: all that is the same in every world."""

    config: SafetyGymConfig
    scene: scenes.Scene
    place: layouts.Placement

    @property
    def goal_kind(self) -> str | None:
        """What the robot seeks: 'goal', 'buttons' or nothing."""
        return {"goal": "goal", "push": "goal", "button": "buttons"}.get(self.config.task)

    @property
    def goal_mark(self) -> tuple[float, float]:
        """Radius and half height of the goal's cylinder (m); a radius of 0: none is there.

        By SEditor's rules one stands at the button to press, too, as wide as that.
        """
        cfg = self.config
        half = cfg.half_height(cfg.goal_size / 2)
        if self.goal_kind == "buttons":
            return (cfg.buttons_size if cfg.rules == "seditor" else 0.0), half
        return (cfg.goal_size if self.goal_kind == "goal" else 0.0), half

    def at_rest(self, xy: jax.Array, headings: jax.Array, key: jax.Array) -> World:
        """Everything at rest at positions [n, 2] (m) with headings [n] (rad), before the first goal."""
        cfg, scene = self.config, self.scene
        heights = {
            "vases": cfg.half_height(cfg.vases_size) - cfg.vases_sink,
            "gremlins": cfg.half_height(cfg.gremlins_size),
            "box": cfg.half_height(cfg.box_size),
        }
        start = jnp.concatenate([xy[0], headings[:1]])
        root = start if scene.planar else pose(xy[0], scene.robot_height, headings[0])
        qpos = [root, np.float32(scene.model.qpos0[len(root) : scene.robot_nq])]
        for kind in scenes.FREES:
            rows = self.place.slice(kind)
            qpos.append(pose(xy[rows], heights[kind], headings[rows]).reshape(-1))
        # The weld keeps a gremlin's height above its mocap body, which has one of its own: it hovers.
        rest = {
            "gremlins": cfg.gremlins_size + heights["gremlins"],
            "pillars": cfg.pillars_height,
            "walls": cfg.walls_size,
            "buttons": cfg.half_height(cfg.buttons_size),
        }
        mocap = [
            pose(xy[self.place.slice(k)], rest[k], headings[self.place.slice(k)]) for k in scenes.MOCAPS
        ]
        mocap = jnp.concatenate(mocap) if mocap else jnp.zeros((0, 7))
        if "walls" in self.place.kinds:  # walls are never turned
            rows = scene.mocap_slice("walls")
            mocap = mocap.at[rows, 3:].set(jnp.array([1.0, 0.0, 0.0, 0.0]))
        zero, none = jnp.zeros(()), jnp.int32(0)
        return World(
            bodies=Physics(
                # no empty part, no constant to overwrite: jax 0.11 crashes on them within shard_map
                qpos=jnp.concatenate([x for x in qpos if x.size]),
                qvel=jnp.zeros(scene.model.nv),
                warmstart=jnp.zeros(scene.model.nv),
                mocap_pos=mocap[:, :3],
                mocap_quat=mocap[:, 3:],
                substeps=none,
            ),
            layout=xy,
            start=start,
            goal_button=none,
            buttons_timer=none,
            last_dist_goal=zero,
            last_dist_box=zero,
            last_box_goal=zero,
            last_com=jnp.zeros(3),
            steps=none,
            key=key,
        )

    def robot_pose(self, world: World) -> tuple[jax.Array, jax.Array]:
        """Position [3] and rotation [3, 3] (columns are the body's axes) of the robot."""
        qpos = world.bodies.qpos
        if self.scene.planar:
            c, s = jnp.cos(qpos[2]), jnp.sin(qpos[2])
            zero, one = jnp.zeros(()), jnp.ones(())
            rotation = jnp.stack([c, -s, zero, s, c, zero, zero, zero, one]).reshape(3, 3)
            return jnp.append(qpos[:2], self.scene.robot_height), rotation
        return qpos[:3], rotation_of(qpos[3:7])

    def positions(self, world: World, kind: str) -> jax.Array:
        """Current positions [n, 2] of the objects of a kind (m)."""
        if kind in self.scene.frees:
            return world.bodies.qpos[self.scene.qpos_slice(kind)].reshape(-1, 7)[:, :2]
        return world.layout[self.place.slice(kind)]

    def box_position(self, world: World) -> jax.Array:
        return world.bodies.qpos[self.scene.qpos_slice("box")][:3]

    def goal_position(self, world: World) -> jax.Array:
        """Position [3] of the goal, or of the button to press; the origin where there is neither."""
        cfg = self.config
        if self.goal_kind == "goal":
            height = cfg.half_height(cfg.goal_size / 2) + 0.01
            return jnp.append(self.positions(world, "goal")[0], height)
        if self.goal_kind == "buttons":
            height = cfg.half_height(cfg.buttons_size)
            return jnp.append(self.positions(world, "buttons")[world.goal_button], height)
        return jnp.zeros(3)

    def with_distances(self, world: World) -> World:
        """`world` with how far it is now from robot to goal in the plane, and from robot to box and box
        to goal in space (m; 0 without them)."""
        robot, goal = self.robot_pose(world)[0], self.goal_position(world)
        dist_goal = norm((robot - goal)[:2]) if self.goal_kind else jnp.zeros(())
        dist_box = box_goal = jnp.zeros(())
        if self.config.task == "push":
            box = self.box_position(world)
            dist_box, box_goal = norm(robot - box), norm(box - goal)
        return world.replace(last_dist_goal=dist_goal, last_dist_box=dist_box, last_box_goal=box_goal)

    def layout_now(self, world: World) -> jax.Array:
        """The layout with what has moved where it is now; gremlins count at their circles' centres."""
        xy = world.layout.at[0].set(self.robot_pose(world)[0][:2])
        for kind in ("vases", "box"):
            xy = xy.at[self.place.slice(kind)].set(self.positions(world, kind))
        return xy

    @cached_property
    def sensors(self) -> dict[str, tuple[slice, int]]:
        """Sensor name -> (place in sensordata, MuJoCo type)."""
        model = self.scene.model
        return {
            model.sensor(i).name: (slice(adr, adr + dim), int(kind))
            for i, (adr, dim, kind) in enumerate(
                zip(model.sensor_adr, model.sensor_dim, model.sensor_type, strict=True)
            )
        }

    def sensor(self, readings: Readings, name: str) -> jax.Array:
        return readings.sensors[self.sensors[name][0]]

    def contacts(self, readings: Readings, kind: str) -> jax.Array:
        """Contact points with the robot, for each object of a watched kind."""
        return readings.contacts[self.scene.contact_slice(kind)]


def norm(x: jax.Array) -> jax.Array:
    """Euclidean length over the last axis."""
    return jnp.sqrt(jnp.square(x).sum(-1))


def pose(xy: jax.Array, height: float, heading: jax.Array) -> jax.Array:
    """Position and upright quaternion [..., 7] of a free joint."""
    z = jnp.full_like(heading, height)
    zero = jnp.zeros_like(heading)
    quat = jnp.stack([jnp.cos(heading / 2), zero, zero, jnp.sin(heading / 2)], -1)
    return jnp.concatenate([xy, z[..., None], quat], -1)
