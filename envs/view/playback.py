"""Episodes as they happen, of a policy or of a robot that keys drive.

A `Playback` plays them. `window` and `page` show it, and hand it what is pressed.
"""

import threading
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.envs.safety_gym.task import SafetyGym
from jaxsafe.envs.view.driving import drivable, drive
from jaxsafe.envs.view.stage import drawable
from jaxsafe.envs.wrap import raw_steps
from jaxsafe.learn.acting import Player
from jaxsafe.types import PyTree, State

FPS = 30
KEYS = {  # a browser's names: (forward, turn)
    "ArrowUp": (1, 0),
    "KeyW": (1, 0),
    "ArrowDown": (-1, 0),
    "KeyS": (-1, 0),
    "ArrowLeft": (0, 1),
    "KeyA": (0, 1),
    "ArrowRight": (0, -1),
    "KeyD": (0, -1),
}
BEHIND = 0.2  # s of simulation made up for after a frame that took long
LAST = 5  # episodes in the list of those that ended


class Ended(NamedTuple):
    """An episode that is over."""

    seed: int
    steps: int
    ret: float
    cost: float


class Playback:
    """Episodes one after another, with seeds that count up. Methods may be called from any thread.

    Args:
        env: the task.
        player: a policy in `env`, or in `env` with what an algorithm appends to its observation. None
            leaves the robot to the keys. Held keys take over from a policy.
        seed: of the first episode.
    Raises:
        ConfigError: an environment that cannot be drawn, or a robot that no keys are known for.
    """

    def __init__(
        self,
        env: SafetyGym,
        player: Player | None = None,
        seed: int = 0,
    ):
        self.env, self.playing, self.held = drivable(drawable(env)), True, set[str]()
        self.limit, self.seconds = env.episode_length, self.env.step_seconds * raw_steps(env)
        self.ended: list[Ended] = []  # the last `LAST`, newest first
        self._lock = threading.Lock()
        world = player.task if player else env

        def reset(key: jax.Array) -> tuple[State, PyTree]:
            return world.reset(key), player.begin() if player else ()

        def step(
            state: State, carry: PyTree, action: jax.Array, driven: jax.Array
        ) -> tuple[State, PyTree, dict[str, jax.Array]]:
            said = {}
            if player:
                chosen, carry, said = player.decide(carry, state)
                action = jnp.where(driven, action, chosen)
                said = {name: jnp.where(driven, 0.0, x) for name, x in said.items()}
            return world.step(state, action), carry, said

        self._reset, self._step = jax.jit(reset), jax.jit(step)
        self.reset(seed)
        still = np.zeros(env.action_size, np.float32)
        self._step(self.state, self._carry, still, np.bool_(False))  # compiles it

    def reset(self, seed: int) -> None:
        """Begin the episode of this seed."""
        with self._lock:
            self._begin(seed)

    def step(self) -> None:
        """One step; after the last of an episode, the next begins."""
        with self._lock:
            forward, turn = pushed(self.held)
            action = np.float32(drive(self.env, forward, turn, self.steps * self.seconds))
            driven = np.bool_(forward or turn)
            self.state, self._carry, self.said = jax.device_get(
                self._step(self.state, self._carry, action, driven)
            )
            self.steps += 1
            self.overruled += self.shield_acts
            self.ret += float(self.state.reward)
            self.cost += float(self.state.cost)
            self.costs = self.costs + self.state.costs
            if self.state.ended or self.steps >= self.limit:
                ended = Ended(self.seed, self.steps, self.ret, self.cost)
                self.ended = [ended, *self.ended][:LAST]
                self._begin(self.seed + 1)

    @property
    def shield_acts(self) -> bool:
        """Whether a shield overruled the policy at the last step."""
        return bool(self.said.get("overruled", False))

    def _begin(self, seed: int) -> None:
        self.seed, self.steps, self.ret, self.cost = seed, 0, 0.0, 0.0
        self.overruled, self.said = 0, dict[str, np.ndarray]()
        self.costs = np.zeros(len(self.env.cost_names))
        self.state: State
        self.state, self._carry = jax.device_get(self._reset(jax.random.key(seed)))

    def play(self, show: Callable[[], None], stop: Callable[[], bool]) -> None:
        """Step in real time, or as fast as it goes here, and `show` at most `FPS` times a second."""
        due = shown = time.monotonic()
        while not stop():
            now = time.monotonic()
            due = max(due, now - BEHIND)
            while self.playing and now >= due:
                self.step()
                due += self.seconds
            if now >= shown:
                show()
                shown = now + 1 / FPS
            time.sleep(max(0.001, min(due if self.playing else shown, shown) - time.monotonic()))


def pushed(held: set[str]) -> tuple[int, int]:
    """What the held keys ask for: (forward, turn), each -1, 0 or 1."""
    both = np.array([KEYS[key] for key in list(held) if key in KEYS] or [(0, 0)])
    forward, turn = np.sign(both.sum(0))
    return int(forward), int(turn)


def figures(playback: Playback) -> dict[str, str]:
    """What an episode has come to so far, by name."""
    named = zip(playback.env.cost_names, playback.costs, strict=True)
    return {
        "seed": f"{playback.seed}",
        "step": f"{playback.steps} of {playback.limit}",
        "return": f"{playback.ret:.2f}",
        "cost": f"{playback.cost:.0f}",
        **{f"cost {name}": f"{value:.4g}" for name, value in named},
        **shield(playback),
    }


def shield(playback: Playback) -> dict[str, str]:
    """What a shield does, if there is one."""
    said = playback.said
    if "overruled" not in said:
        return {}
    risk = {"risk": f"{float(said['risk']):.3f}"} if "risk" in said else {}
    acts = "acts" if playback.shield_acts else "rests"
    return {"shield": acts, "shield acted": f"{playback.overruled} steps", **risk}
