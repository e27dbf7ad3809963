"""Pendulums to be held upright, tilted, moved or swung without ever falling or leaving the rail.

Upright and Tilt are of a pendulum with a motor, Move and Swing of a pendulum on a cart. An episode ends
at the first unsafe step, so that its cost is 1 or 0. The safe set is known: see `barrier`.

Source: Luo and Ma (2021), "Learning Barrier Certificates: Towards Safe Reinforcement Learning with Zero
Training-time Violations", arXiv:2108.01846, and the authors' code, roosephu/crabs @823da6c.
Differs from it: the cart is computed from its equations of motion, with the masses that MuJoCo gives to
Gymnasium's InvertedPendulum. The stops of rail and hinge, outside of the safe set, are left out.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp

from jaxsafe.config import Amount, Bounds, Weight
from jaxsafe.envs.check import check_action
from jaxsafe.envs.without_model import WithoutModel
from jaxsafe.learn.certificate import interval_barrier
from jaxsafe.types import State

Angle = Annotated[float, Bounds(1e-3, 3.0)]  # rad


@dataclass(frozen=True)
class Pendulum(WithoutModel):
    """Hold a pendulum at `goal` with a motor that is too weak to lift it from everywhere.

    Observation [2]: angle from upright (rad), angular velocity (rad/s).
    Action [1] in [-1, 1]: torque, in units of 2 Nm.
    Reward: -(angle - goal)^2, of the angle before the step. Cost: 1 where |angle| > `threshold`, which
    ends the episode.

    The motor just holds the pendulum where |angle| = 0.4115: 15 sin(0.4115) = 6. Tilt's goal is there.
    """

    goal: Annotated[float, Bounds(-3.0, 3.0)] = 0.0  # rad
    threshold: Angle = 1.5  # rad
    num_steps: Amount = 200  # time limit, of steps of 0.05 s

    obs_size = 2
    action_size = 1
    cost_names = ("fallen",)

    def barrier(self, obs: jax.Array) -> jax.Array:
        """At most 1 where `obs` [..., 2] is safe: float [...]."""
        return interval_barrier(obs[..., 0], self.threshold)

    def reset(self, key: jax.Array) -> State:
        return arrived(jnp.array([0.3, -0.9]), jnp.zeros(()), jnp.zeros(()))

    def step(self, state: State, action: jax.Array) -> State:
        check_action(action, self.action_size)
        angle, velocity = state.physics
        # rad/s^2: 3 g / (2 l) and 3 u / (m l^2), with g = 10 m/s^2, l = 1 m, m = 1 kg
        push = 15.0 * jnp.sin(angle) + 6.0 * jnp.clip(action[0], -1.0, 1.0)
        velocity = jnp.clip(velocity + 0.05 * push, -8.0, 8.0)
        reward = -((angle - self.goal) ** 2)
        angle += 0.05 * velocity
        unsafe = jnp.abs(angle) > self.threshold  # before it may come round on the other side
        angle = (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi
        return arrived(jnp.stack([angle, velocity]), reward, unsafe)


@dataclass(frozen=True)
class CartPendulum(WithoutModel):
    """Keep a pendulum on its cart, and the cart on its rail, while doing what `task` pays.

    Observation [4]: place of the cart (m), angle from upright (rad), and their velocities.
    Action [1] in [-1, 1]: force on the cart, in units of 100 N.
    Reward: angle^2 for `swing`, place^2 for `move`, -angle^2 for `upright`, less 10 where it is unsafe.
    Cost: 1 where |angle| > `threshold` or |place| > 0.9 m, which ends the episode.
    """

    task: Literal["upright", "move", "swing"] = "move"  # what pays
    threshold: Annotated[float, Bounds(1e-3, 1.5)] = 0.2  # rad
    penalty: Weight = 10.0  # what an unsafe step costs in reward
    num_steps: Amount = 1000  # time limit, of steps of 0.04 s

    obs_size = 4
    action_size = 1
    cost_names = ("unsafe",)

    def barrier(self, obs: jax.Array) -> jax.Array:
        """At most 1 where `obs` [..., 4] is safe: float [...]."""
        place, angle = obs[..., 0], obs[..., 1]
        return jnp.maximum(interval_barrier(angle, self.threshold), interval_barrier(place, RAIL))

    def reset(self, key: jax.Array) -> State:
        return arrived(jnp.zeros(4), jnp.zeros(()), jnp.zeros(()))

    def step(self, state: State, action: jax.Array) -> State:
        check_action(action, self.action_size)
        force = 100.0 * jnp.clip(action[0], -1.0, 1.0)
        x = runge_kutta(partial(cart_motion, force=force), state.physics, DT)
        x = runge_kutta(partial(cart_motion, force=force), x, DT)
        place, angle = x[0], x[1]
        unsafe = (jnp.abs(angle) > self.threshold) | (jnp.abs(place) > RAIL)
        reward = {"upright": -(angle**2), "move": place**2, "swing": angle**2}[self.task]
        return arrived(x, reward - self.penalty * unsafe, unsafe)


def arrived(x: jax.Array, reward: jax.Array, unsafe: jax.Array) -> State:
    cost = unsafe.astype(jnp.float32)
    return State(x, x, reward, cost, cost[None], unsafe.astype(bool), {})


# ---- the cart ----------------------------------------------------------------------------------

# Gymnasium's InvertedPendulum: capsules of 1000 kg/m^3. Their masses and inertias are MuJoCo's.
RAIL = 0.9  # m, how far from the middle the cart may go
DT = 0.02  # s, of which a step has two
CART = 10.4719755  # kg
POLE = 5.0185916  # kg
INERTIA = 0.18874977  # kg m^2, of the pole about its centre
ARM = 0.300000417  # m, from the hinge to the pole's centre
LEAN = 0.001 / 0.6  # rad, by which the pole leans at an angle of 0
DAMPING = 1.0  # of rail and hinge: N s/m, N m s
GRAVITY = 9.81  # m/s^2


def cart_motion(x: jax.Array, force: jax.Array) -> jax.Array:
    """The change of place, angle and their velocities, float [4], in a second.

    (M + m) x'' + m l cos(phi) phi'' = F - d x' + m l sin(phi) phi'^2
    m l cos(phi) x'' + (I + m l^2) phi'' = -d phi' + m g l sin(phi)
    """
    place_velocity, turn = x[2], x[3]
    phi = x[1] + LEAN
    a, b, c = CART + POLE, POLE * ARM * jnp.cos(phi), INERTIA + POLE * ARM**2
    lift = POLE * ARM * jnp.sin(phi)
    along = force - DAMPING * place_velocity + lift * turn**2
    around = lift * GRAVITY - DAMPING * turn
    det = a * c - b**2
    speeding, turning = (c * along - b * around) / det, (a * around - b * along) / det
    return jnp.stack([place_velocity, turn, speeding, turning])


def runge_kutta(change: Callable[[jax.Array], jax.Array], x: jax.Array, dt: float) -> jax.Array:
    """`x` after `dt`, by the method of fourth order."""
    k1 = change(x)
    k2 = change(x + dt / 2 * k1)
    k3 = change(x + dt / 2 * k2)
    k4 = change(x + dt * k3)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


ROWS: dict[str, Any] = {
    "pendulum_upright": Pendulum,
    "pendulum_tilt": partial(Pendulum, goal=-0.41151684),
    "pendulum_move": partial(CartPendulum, task="move", threshold=0.2),
    "pendulum_swing": partial(CartPendulum, task="swing", threshold=1.5),
}
ALIASES = {
    "MyPendulumUpright-v0": "pendulum_upright",
    "MyPendulumTilt-v0": "pendulum_tilt",
    "SafeInvertedPendulumMove-v2": "pendulum_move",
    "SafeInvertedPendulumSwing-v2": "pendulum_swing",
}
