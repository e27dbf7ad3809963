"""Environments small enough to know the answers of, and how algorithms update and play in them."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree

from jaxsafe.algos import dreamer
from jaxsafe.learn.acting import Player
from jaxsafe.learn.certificate import interval_barrier
from jaxsafe.learn.steps import Context, Trainable
from jaxsafe.run.evaluate import Episodes, evaluated, keys_of_episodes, make_play
from jaxsafe.types import Algorithm, Env, Metrics, Policy, PyTree, Shared, State

START = Shared(np.int32(0))


def updated(algo: Algorithm) -> Callable:
    """ts -> (ts, metrics), for what does not depend on the iteration."""
    return lambda ts: algo.update(ts, START)


def training(algo: Algorithm, cfg: Any, updates: int) -> Callable:
    """key -> (ts, metrics [updates]) of one member from its start."""

    def train(key: jax.Array) -> tuple[PyTree, Metrics]:
        start = algo.init(key, cfg, START)
        return jax.lax.scan(lambda ts, i: algo.update(ts, Shared(i)), start, jnp.arange(updates))

    return train


def run_episodes(
    algo: Algorithm, learned: PyTree, num_episodes: int, seed: int, sampled: bool = False
) -> Episodes:
    """`num_episodes` fresh episodes for each of the S policies in `learned` (leading axis), which are
    the seeds of one setting.

    Actions are the mean ones, or `sampled`.
    """
    keys = keys_of_episodes(seed, num_episodes, range(len(jax.tree.leaves(learned)[0])))
    return evaluated(make_play(algo, keys), learned, sampled)[0]


def momentum(nets: Trainable, name: str) -> PyTree:
    """Adam's first moment of a network, as a tree like its parameters."""
    params, moment = nets.params[name], optax.tree_utils.tree_get(nets.opt_state[name], "mu")
    if jax.default_backend() == "cpu":
        return moment
    return ravel_pytree(params)[1](moment)  # elsewhere `steps.adam` sees the parameters as one array


def context(
    cfg: Any,
    key: jax.Array | None = None,
    iteration: int = 0,
    axis_name: str | None = None,
    violation: Any = 0.0,
    episode_length: float = 1.0,
) -> Context:
    """What a step is told, for tests that take one outside a loop."""
    key = jax.random.key(1) if key is None else key
    violation = jnp.asarray(violation, jnp.float32)  # of a limit of 0
    return Context(iteration, cfg, key, axis_name, violation, violation, jnp.float32(episode_length))


def reflex(act: Callable[[jax.Array], jax.Array], task: Env) -> Player:
    """A player that remembers nothing, from a function: obs [O] -> action [A]."""
    policy = Policy(lambda learned: (), lambda learned, carry, obs, key: (act(obs), (), {}))
    return Player(policy, (), task)


@dataclass(frozen=True)
class Corridor:
    """A point mass paid for speed along x and charged for leaving |y| <= half_width.

    Observation [4]: position x, y (m), then velocity x, y (m/s). Action [2]: acceleration.
    """

    half_width: float = 0.5  # m
    max_accel: float = 2.0  # m/s^2
    dt: float = 0.02  # s
    obs_size: int = 4
    action_size: int = 2
    episode_length: int = 20
    cost_names: tuple[str, ...] = ("wall",)

    def barrier(self, obs: jax.Array) -> jax.Array:
        return interval_barrier(obs[..., 1], self.half_width)

    def reset(self, key: jax.Array) -> State:
        position = jax.random.uniform(key, (2,), minval=-0.1, maxval=0.1)
        return self._state(jnp.concatenate([position, jnp.zeros(2)]))

    def step(self, state: State, action: jax.Array) -> State:
        position, velocity = jnp.split(state.physics, 2)
        velocity += self.dt * self.max_accel * jnp.clip(action, -1.0, 1.0)
        position += self.dt * velocity
        return self._state(jnp.concatenate([position, velocity]))

    def _state(self, x: jax.Array) -> State:
        cost = (jnp.abs(x[1]) > self.half_width).astype(jnp.float32)
        info = {"fast": (x[2] > 0.1).astype(jnp.float32)}
        return State(x, x, x[2], cost, cost[None], jnp.bool_(False), info)


@dataclass(frozen=True)
class Ticker:
    """Counts its steps and knows which reset it came from; ignores actions.

    Observation [3]: the episode's random name, steps since the reset, steps until it terminates
    (`lives[0] .. lives[1]`, drawn uniformly; beyond `episode_length` it never does).
    Reward 1 and cost 2 a step; info counts steps too.
    """

    episode_length: int = 5
    lives: tuple[int, int] = (99, 99)
    obs_size: int = 3
    action_size: int = 1
    cost_names: tuple[str, ...] = ("a", "b")

    def reset(self, key: jax.Array) -> State:
        life_key, name_key, key = jax.random.split(key, 3)
        life = jax.random.randint(life_key, (), self.lives[0], self.lives[1] + 1)
        name = jax.random.uniform(name_key)
        obs = jnp.stack([name, 0.0, life.astype(jnp.float32)])
        zero = jnp.zeros(())
        return State(key, obs, zero, zero, jnp.zeros(2), jnp.bool_(False), {"ticks": zero})

    def step(self, state: State, action: jax.Array) -> State:
        obs = state.obs.at[1].add(1.0)
        one = jnp.ones(())
        return State(
            state.physics, obs, one, 2 * one, jnp.array([0.5, 1.5]), obs[1] >= obs[2], {"ticks": one}
        )


@dataclass(frozen=True)
class Arriving(Ticker):
    """A ticker whose episodes end where the others fail, and whose values go on."""

    def step(self, state, action):
        after = super().step(state, action)
        return dataclasses.replace(after, terminated=jnp.bool_(False), truncated=after.terminated)


@dataclass(frozen=True)
class Lost(Ticker):
    """A ticker that never has a finite reward."""

    def step(self, state, action):
        after = super().step(state, action)
        return dataclasses.replace(after, reward=after.reward * jnp.nan)


@dataclass(frozen=True)
class Sometimes(Ticker):
    """A ticker whose cost is NaN at step 3 of episodes with a name below 0.2."""

    def step(self, state, action):
        after = super().step(state, action)
        bad = (after.obs[0] < 0.2) & (after.obs[1] == 3)
        return dataclasses.replace(after, cost=jnp.where(bad, jnp.nan, after.cost))


@dataclass(frozen=True)
class Recall:
    """A sign is shown at the first observation only, and is to be pulled towards at every step.

    Observation [2]: the sign (0 but at the first), and 1. Reward: 1 - |a - sign|, a in [-1, 1]. The
    best return of an episode of T steps is T. It is 1 for a policy without memory, which earns nothing
    from the second step on. Cost: 1 where a > 0.
    """

    obs_size: int = 2
    action_size: int = 1
    episode_length: int = 6
    cost_names: tuple[str, ...] = ("right",)

    def reset(self, key: jax.Array) -> State:
        sign = jax.random.rademacher(key, (), jnp.float32)
        obs, zero = jnp.stack([sign, jnp.ones(())]), jnp.zeros(())
        return State(sign, obs, zero, zero, zero[None], jnp.bool_(False), {})

    def step(self, state: State, action: jax.Array) -> State:
        sign, a = state.physics, jnp.clip(action[0], -1.0, 1.0)
        cost = (a > 0).astype(jnp.float32)
        obs = jnp.array([0.0, 1.0])
        return State(sign, obs, 1 - jnp.abs(a - sign), cost, cost[None], jnp.bool_(False), {})


@dataclass(frozen=True)
class Lever:
    """Two levers; the first earns and costs, the second earns for free. Its optimum is known.

    Observation [2]: signs that say which way to pull, redrawn at each step. With a the action times
    the signs, clipped to [-1, 1], and u = (1 + a) / 2 in [0, 1]:

        reward = u_0 (2 - u_0) + u_1 +- 1/2 at random,   cost = u_0

    so over an episode of 10 steps the best return is 20, at a cost of 10, and within a cost limit
    of 2.5 it is 14.375, with u_0 = 1/4 always.
    """

    obs_size: int = 2
    action_size: int = 2
    episode_length: int = 10
    cost_names: tuple[str, ...] = ("lever",)

    def reset(self, key: jax.Array) -> State:
        return self._state(key, jnp.zeros(2))

    def step(self, state: State, action: jax.Array) -> State:
        return self._state(state.physics, 0.5 * (1 + jnp.clip(action * state.obs, -1.0, 1.0)))

    def _state(self, key: jax.Array, u: jax.Array) -> State:
        key, sign_key, noise_key = jax.random.split(key, 3)
        obs = jax.random.rademacher(sign_key, (2,), jnp.float32)
        noise = 0.5 * jax.random.rademacher(noise_key, (), jnp.float32)
        reward = u[0] * (2 - u[0]) + u[1] + noise
        return State(key, obs, reward, u[0], u[:1], jnp.bool_(False), {})


@dataclass(frozen=True)
class Ledge:
    """A point on a line that is paid for standing far to the right, where a step beyond 1/2 is unsafe.

    Observation [1]: x in [-1, 1], 0 at first. An action moves it by up to 0.3. Reward: x. Cost: 1 where
    x > 1/2. In an episode of 10 steps there are 8.9 to earn, with 9 violations, or 4.8 without any.
    """

    obs_size: int = 1
    action_size: int = 1
    episode_length: int = 10
    cost_names: tuple[str, ...] = ("beyond",)

    def reset(self, key: jax.Array) -> State:
        return dataclasses.replace(self._state(jnp.zeros(())), reward=jnp.zeros(()))

    def step(self, state: State, action: jax.Array) -> State:
        x = state.physics + 0.3 * jnp.clip(action[0], -1.0, 1.0)
        return self._state(jnp.clip(x, -1.0, 1.0))

    def _state(self, x: jax.Array) -> State:
        cost = (x > 0.5).astype(jnp.float32)
        return State(x, x[None], x, cost, cost[None], jnp.bool_(False), {})


SHIELDED: dict[str, Any] = dreamer.LEVER | {  # settings of AMBS that hold it on the ledge
    "overshoot": 0, "discount": 0.9, "imagine_steps": 6, "penalty": "plpg", "penalty_coef": 0.8,
    "rule": "hoeffding", "delta": 0.1, "eps": 0.05, "shield_rollouts": 32, "shield_steps": 6,
    "shield_horizon": 4, "least_penalty_scale": 1.0, "replay_value": 0.0,
}  # fmt: skip


@dataclass(frozen=True)
class Patch:
    """A picture with a green patch, at whose column to point, and a red one to keep away from.

    Observation: `vision` uint8 [8, 8, 3] and `vector` [1], the share of the episode that is left.
    Action [1]: a column, from -1 (left) to 1 (right). Reward: 1 - |a - green|. Cost: 1 if |a - red| is
    below 0.25.
    Both are at -0.8, -0.4, 0.4 or 0.8, drawn anew at each step. The best return of an episode of 5
    steps is 5; without eyes it is 2.
    """

    obs_size: int = 1
    action_size: int = 1
    episode_length: int = 5
    cost_names: tuple[str, ...] = ("red",)

    def reset(self, key: jax.Array) -> State:
        return self._state(key, jnp.zeros(()), jnp.zeros(()), jnp.zeros(()))

    def step(self, state: State, action: jax.Array) -> State:
        green, red = (jnp.argmax(state.obs["vision"][3, :, k] > 200) for k in (1, 0))
        a, (green, red) = jnp.clip(action[0], -1.0, 1.0), (x * 0.4 - 1.2 for x in (green, red))
        cost = (jnp.abs(a - red) < 0.25).astype(jnp.float32)
        passed = jnp.round((1 - state.obs["vector"][0]) * self.episode_length) + 1
        return self._state(state.physics, passed, 1 - jnp.abs(a - green), cost)

    def _state(self, key: jax.Array, passed: jax.Array, reward: jax.Array, cost: jax.Array) -> State:
        key, place_key = jax.random.split(key)
        green, red = jax.random.permutation(place_key, jnp.array([1, 2, 4, 5]))[:2]
        picture = jnp.full((8, 8, 3), 90, jnp.uint8)
        for column, colour in ((green, [0, 255, 0]), (red, [255, 0, 0])):
            picture = picture.at[2:6, column].set(jnp.array(colour, jnp.uint8))
        left = jnp.reshape(1 - passed / self.episode_length, (1,))
        obs = {"vision": picture, "vector": left}
        return State(key, obs, reward, cost, cost[None], jnp.bool_(False), {})
