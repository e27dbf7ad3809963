"""Six robots that are paid for their speed along x and charged for each step above a threshold.

    v      = (x(t + dt) - x(t)) / dt
    reward = forward_reward_weight v + healthy_reward - ctrl_cost_weight |control|^2
    cost   = 1 if speed > threshold else 0

The speed of robots in a plane is v, so that backwards is free. The speed of Ant and Humanoid is the
length of the velocity in x and y.

Source: Ji et al. (2023), "Safety Gymnasium: A Unified Safe Reinforcement Learning Benchmark", on
Gymnasium's environments of version 4.
Differs from it: v is that of the state in which a step ends. There, v of Ant and Humanoid is that of
the integrator's last stage, as are the inertias, velocities and forces that Humanoid observes. Humanoid
has Newton's solver, and no tendons, which pull nothing there. Humanoid's actions are in [-1, 1] as all
others' are, there in [-0.4, 0.4]. A physics error ends the episode in its last good state.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import flax.struct
import jax
import jax.numpy as jnp
import mujoco

from jaxsafe.envs import engines
from jaxsafe.envs.check import check_action
from jaxsafe.envs.engines import Physics, Readings, Room, Simulation
from jaxsafe.envs.velocity.config import ROBOTS, VelocityConfig
from jaxsafe.types import State

ASSETS = Path(__file__).parent / "assets"
SEEN = ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")  # what Humanoid observes beside its state


@flax.struct.dataclass
class World:
    """What the next step needs: the physics, and the place [2] (m) whose speed counts."""

    physics: Physics
    place: jax.Array


class Velocity:
    """One task. Pure functions `reset(key)` and `step(state, action)`; callers `vmap`.

    Observation float [obs_size]: the components of `observation_spec` in its order. Positions along x,
    and along y where there is one, are not observed.
    Action float [action_size] in [-1, 1]: shares of the largest control, which is 0.4 of Humanoid and 1
    of the others. Beyond it an action does no more, but is paid for, as in the original.
    `cost_names` is ('velocity',). `info` has the speed that the cost goes by, as 'velocity' (m/s).

    Raises:
        ConfigError: an engine that cannot serve.
    """

    cost_names = ("velocity",)

    def __init__(self, cfg: VelocityConfig, engine: str = "auto", name: str = "custom"):
        self.name, self.config, self.robot = name, cfg, ROBOTS[cfg.robot]
        room = self.robot.room
        self.simulation = Simulation(
            self.spec(),
            substeps=cfg.frame_skip,
            fields=(*SEEN, "subtree_com") if cfg.robot == "humanoid" else (),
            room=Room(*(max(1, round(cfg.contact_room * size)) for size in room)),
        )
        self._engine = engines.make_engine(engine, self.simulation)
        self.engine, self.model = self._engine.name, self._engine.model
        threshold = cfg.velocity_threshold
        self.threshold = self.robot.thresholds[cfg.thresholds] if threshold is None else threshold
        # of Swimmer, too, in the older version
        self.counts_y = self.robot.free or (cfg.robot == "swimmer" and cfg.thresholds == "v0")
        model = self.model
        sizes = {"qpos": model.nq - self.robot.unseen, "qvel": model.nv}
        if cfg.robot == "humanoid":
            per_body = {"cinert": 10, "cvel": 6, "cfrc_ext": 6}
            sizes |= {part: model.nbody * per_body.get(part, 0) or model.nv for part in SEEN}
        self.observation_spec = {part: (size,) for part, size in sizes.items()}
        self.obs_size = sum(sizes.values())

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_file(str(ASSETS / self.robot.file))

    # What learners ask -----------------------------------------------------------------------------

    @property
    def action_size(self) -> int:
        return self.model.nu

    @property
    def episode_length(self) -> int:
        return self.config.num_steps

    @property
    def substeps(self) -> int:
        """Physics steps in a step."""
        return self.config.frame_skip

    @property
    def step_seconds(self) -> float:
        """Simulated seconds in a step."""
        return self.model.opt.timestep * self.substeps

    @property
    def ceiling(self) -> float:
        """The return of an episode at the threshold, without control's price. No safe one has more."""
        speed = self.config.forward_reward_weight * self.threshold
        return self.config.num_steps * (speed + self.config.healthy_reward)

    @property
    def observed_end(self) -> Callable[[jax.Array], jax.Array] | None:
        """obs [..., obs_size] -> whether the step after which it is observed ends the episode, bool
        [...]. None where no step does. It does not tell an end by a physics error, nor one by a speed
        beyond what is observed."""
        ranges = (getattr(self.config, f"healthy_{name}_range") for name in ("z", "angle", "state"))
        if not self.config.terminate_when_unhealthy or not any(ranges):
            return None
        (seen,), (speeds,) = self.observation_spec["qpos"], self.observation_spec["qvel"]

        def end(obs: jax.Array) -> jax.Array:
            unseen = jnp.zeros((*obs.shape[:-1], self.robot.unseen))
            qpos = jnp.concatenate([unseen, obs[..., :seen]], -1)
            return ~self.healthy(qpos, obs[..., seen : seen + speeds])

        return end

    # Episode ---------------------------------------------------------------------------------------

    def reset(self, key: jax.Array) -> State:
        model, noise = self.model, self.config.reset_noise_scale
        pose_key, speed_key = jax.random.split(key)
        qpos = noise * jax.random.uniform(pose_key, (model.nq,), minval=-1.0)
        if self.robot.gaussian:
            qvel = noise * jax.random.normal(speed_key, (model.nv,))
        else:
            qvel = noise * jax.random.uniform(speed_key, (model.nv,), minval=-1.0)
        # a quaternion's noise is added to it, too; physics normalises it
        start = self._engine.start(model.qpos0 + qpos, qvel)
        physics, readings = self._engine.forward(start, jnp.zeros(model.nu))
        zero = jnp.zeros(())
        return State(
            physics=World(physics, self.place(physics, readings)),
            obs=self.observe(physics, readings),
            reward=zero,
            cost=zero,
            costs=jnp.zeros(1),
            terminated=jnp.bool_(False),
            info={"velocity": zero, "exception": zero, "overflow": readings.overflow},
        )

    def step(self, state: State, action: jax.Array) -> State:
        check_action(action, self.action_size)
        ctrl = action * jnp.asarray(self.model.actuator_ctrlrange[:, 1], jnp.float32)
        return self.judge(state, ctrl, *self._engine.run(state.physics.physics, ctrl))

    def judge(self, state: State, ctrl: jax.Array, physics: Physics, readings: Readings) -> State:
        """What comes after the physics of a step: reward, cost, observation."""
        cfg, world = self.config, state.physics
        place = self.place(physics, readings)
        velocity = (place - world.place) / self.step_seconds  # [2], m/s
        cost = self.cost(velocity)
        healthy = self.healthy(physics.qpos, physics.qvel)
        paid = healthy | cfg.terminate_when_unhealthy
        reward = cfg.forward_reward_weight * velocity[0] + cfg.healthy_reward * paid
        reward -= cfg.ctrl_cost_weight * jnp.square(ctrl).sum()

        bad = engines.is_bad(physics.qpos, physics.qvel, physics.warmstart, reward)
        good: State = State(
            physics=World(physics, place),
            obs=self.observe(physics, readings),
            reward=reward,
            cost=cost,
            costs=cost[None],
            terminated=~healthy & cfg.terminate_when_unhealthy,
            info={
                "velocity": self.speed(velocity),
                "exception": jnp.zeros(()),
                "overflow": jnp.zeros(()),
            },
        )
        kept = dataclasses.replace(
            state,
            reward=jnp.zeros(()),
            cost=jnp.zeros(()),
            costs=jnp.zeros(1),
            terminated=jnp.bool_(True),
            info={"velocity": jnp.zeros(()), "exception": jnp.ones(()), "overflow": jnp.zeros(())},
        )
        after = jax.tree.map(lambda old, new: jnp.where(bad, old, new), kept, good)
        return dataclasses.replace(after, info=after.info | {"overflow": readings.overflow})

    # Its parts -------------------------------------------------------------------------------------

    def place(self, physics: Physics, readings: Readings) -> jax.Array:
        """Where the robot is, x and y [2] in m: Humanoid's centre of mass, else its trunk."""
        if self.config.robot == "humanoid":
            return readings.fields["subtree_com"][1, :2]
        second = physics.qpos[1] if self.robot.height != 1 else jnp.zeros(())
        return jnp.stack([physics.qpos[0], second])

    def speed(self, velocity: jax.Array) -> jax.Array:
        """The speed that the cost goes by, of the velocity [2] in x and y (m/s)."""
        return jnp.linalg.norm(velocity) if self.counts_y else velocity[0]

    def cost(self, velocity: jax.Array) -> jax.Array:
        return (self.speed(velocity) > self.threshold).astype(jnp.float32)

    def healthy(self, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        """Of positions [..., nq] and speeds [..., nv], bool [...]."""
        cfg, height, pitch = self.config, self.robot.height or 0, self.robot.pitch or 0
        ok = jnp.ones(qpos.shape[:-1], bool)
        for bounds, value in (
            (cfg.healthy_z_range, qpos[..., height : height + 1]),
            (cfg.healthy_angle_range, qpos[..., pitch : pitch + 1]),
            (cfg.healthy_state_range, jnp.concatenate([qpos[..., 2:], qvel], -1)),
        ):
            if bounds is not None:
                ok &= ((bounds[0] < value) & (value < bounds[1])).all(-1)
        return ok

    def observe(self, physics: Physics, readings: Readings) -> jax.Array:
        clip, qvel = self.robot.clip, physics.qvel
        parts = {
            "qpos": physics.qpos[self.robot.unseen :],
            "qvel": qvel if clip is None else jnp.clip(qvel, -clip, clip),
            **readings.fields,
        }
        return jnp.concatenate([parts[name].reshape(-1) for name in self.observation_spec])
