"""Our environments for Gymnasium: importing this module registers their ids.

    gymnasium.make("jaxsafe.interop.gymnasium:jaxsafe/point_goal1")
    gymnasium.make("jaxsafe.interop.gymnasium:jaxsafe/PointGoal1-v0")
    gymnasium.make("jaxsafe.interop.gymnasium:jaxsafe/SafetyPointGoal1-v0")
    gymnasium.make_vec("jaxsafe.interop.gymnasium:jaxsafe/point_goal1", num_envs=8)

The second is Safety Gym's id, the third Safety-Gymnasium's with its rules. All begin with `jaxsafe/`,
so that none takes the place of Safety-Gymnasium's own.

The cost of a step is `info["cost"]`, that of each constraint `info["cost_<name>"]`. `SixTuple` and
`SixTupleVector` give it beside the reward, as Safety-Gymnasium does. What steps is one compiled
program; for speed take `make_vec`, and for more speed stay in JAX.
"""

import dataclasses
import functools
import os
from typing import Any

import jax
import numpy as np

from jaxsafe import envs
from jaxsafe.config import ConfigError
from jaxsafe.envs.registry import IMPLIED
from jaxsafe.envs.view.render import FPS, Aerial, Renderer, renderer_of
from jaxsafe.envs.wrap import TimeLimit
from jaxsafe.learn.observations import observation_like
from jaxsafe.learn.rollout import RolloutState, init_rollout, restart
from jaxsafe.types import Env, PyTree, State

try:
    import gymnasium
    from gymnasium.envs.registration import EnvSpec
except ModuleNotFoundError as error:
    raise ConfigError("Gymnasium is not installed: pip install 'jaxsafe[gymnasium]'") from error

Info = dict[str, Any]
Array = np.ndarray
PROCESS = os.getpid()  # a forked one inherits this number, with JAX's threads gone


class Specified:
    """Has `spec`, which Gymnasium sets, and adds the time limit, which is ours, to it."""

    env: Env
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> Any:
        return self._spec

    @spec.setter
    def spec(self, spec: Any) -> None:
        limit = self.env.episode_length
        self._spec = spec and dataclasses.replace(spec, max_episode_steps=limit)


class GymEnv(Specified, gymnasium.Env):
    """One environment.

    Observation: float32 [obs_size], unbounded, or a dict with a picture, uint8. Action: float32
    [action_size] in [-1, 1]. The time limit `env.episode_length` truncates.

    Args:
        env: an `Env`, or the name of one that is registered.
        render_mode: 'rgb_array' or None.
        options: of `envs.make`, for a name.
    Raises:
        ConfigError: as of `envs.make`, or an environment that cannot be drawn.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012

    def __init__(self, env: Env | str, render_mode: str | None = None, **options: Any):
        self.env, self.render_mode = built(env, options), render_mode
        self.observation_space, self.action_space = spaces(self.env)
        self._draw = drawer(self.env, render_mode)
        self._reset, self._step = jax.jit(self.env.reset), jax.jit(self.env.step)
        self._state: State
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Array, Info]:
        super().reset(seed=seed)
        self._state, self._steps = self._reset(draw_key(self.np_random)), 0
        return arrays(self._state.obs), described(self.env, self._state)

    def step(self, action: Array) -> tuple[Array, float, bool, bool, Info]:
        self._state = state = self._step(self._state, np.float32(action))
        self._steps += 1
        terminated = bool(state.terminated)
        out_of_time = self._steps >= self.env.episode_length or bool(state.truncated)
        truncated = out_of_time and not terminated
        info = {name: x.item() for name, x in described(self.env, state).items()}
        return arrays(state.obs), float(state.reward), terminated, truncated, info

    def render(self) -> Array | None:
        return self._draw.frame(jax.device_get(self._state)) if self._draw else None


class GymVectorEnv(Specified, gymnasium.vector.VectorEnv):
    """N environments in one program.

    An episode that ends begins anew in the same step (`AutoresetMode.SAME_STEP`), with a layout of
    its own: `obs` is then the first of the new episode, `info["final_obs"]` and `info["final_info"]`
    are the last of the old one. Rewards and costs are always those of the step.

    Args: as of `GymEnv`, and num_envs, and max_episode_steps, a shorter time limit than the environment
        has: `make_vec` hands it over, as where it makes an environment again from its `spec`.
    """

    metadata = {**GymEnv.metadata, "autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        env: Env | str,
        num_envs: int = 1,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **options: Any,
    ):
        self.env, self.num_envs, self.render_mode = built(env, options), num_envs, render_mode
        if max_episode_steps is not None and max_episode_steps < self.env.episode_length:
            self.env = TimeLimit(self.env, max_episode_steps)
        self.single_observation_space, self.single_action_space = spaces(self.env)
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, num_envs)
        self.action_space = batch(self.single_action_space, num_envs)
        self._draw = drawer(self.env, render_mode)
        self._begin = jax.jit(lambda key: init_rollout(self.env, key, num_envs, stagger=False))
        self._advance = jax.jit(functools.partial(advance, self.env))
        self._rollout: RolloutState

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Array, Info]:
        super().reset(seed=seed)
        self._rollout = self._begin(draw_key(self.np_random))
        self._key = draw_key(self.np_random)
        state = self._rollout.state
        return arrays(state.obs), masked(described(self.env, state), np.ones(self.num_envs, bool))

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Info]:
        self._key, key = jax.random.split(self._key)
        out = self._advance(self._rollout, np.float32(actions), key)
        self._rollout, (state, terminated, truncated) = out[0], jax.device_get(out[1:])
        info = described(self.env, state)
        everyone, done = np.ones(self.num_envs, bool), terminated | truncated
        infos = masked(info, everyone)
        if done.any():
            final = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(done):
                final[i] = jax.tree.map(lambda x, i=i: x[i].copy(), state.obs)
            kept = {name: np.where(done, x, np.zeros_like(x)) for name, x in info.items()}
            infos |= masked({"final_obs": final, "final_info": masked(kept, done)}, done)
        rewards = state.reward.astype(np.float64)
        return arrays(self._rollout.state.obs), rewards, terminated.copy(), truncated.copy(), infos

    def render(self) -> tuple[Array, ...] | None:
        if self._draw is None:
            return None
        states = jax.device_get(self._rollout.state)
        rows = (jax.tree.map(lambda x, i=i: x[i], states) for i in range(self.num_envs))
        return tuple(self._draw.frame(state) for state in rows)


class SixTuple(gymnasium.Wrapper):
    """Safety-Gymnasium's step: obs, reward, cost, terminated, truncated, info.

    With `autoreset` an episode that ends begins anew in the same step, and `info` has the last
    observation and info of the old one as `final_observation` and `final_info`.
    """

    def __init__(self, env: gymnasium.Env, autoreset: bool = False):
        super().__init__(env)
        self.autoreset = autoreset

    def step(self, action: Any) -> Any:
        obs, reward, terminated, truncated, info = self.env.step(action)
        cost = info["cost"]
        if self.autoreset and (terminated or truncated):
            last = {"final_observation": obs, "final_info": info}
            obs, info = self.env.reset()
            info = info | last
        return obs, reward, cost, terminated, truncated, info


class SixTupleVector(gymnasium.vector.VectorWrapper):
    """The same for a `VectorEnv`: `final_observation` is `final_obs` by Safety-Gymnasium's name."""

    def step(self, actions: Any) -> Any:
        obs, rewards, terminated, truncated, info = self.env.step(actions)
        if "final_obs" in info:
            final = {"final_observation": info["final_obs"], "_final_observation": info["_final_obs"]}
            info = info | final
        return obs, rewards, info["cost"], terminated, truncated, info


# Parts ---------------------------------------------------------------------------------------


def built(env: Env | str, options: dict[str, Any]) -> Env:
    if os.getpid() != PROCESS:
        raise ConfigError(
            "JAX does not work in a forked process: give AsyncVectorEnv(..., context='spawn') or, "
            "faster, take GymVectorEnv"
        )
    if isinstance(env, str):
        return envs.make(env, **options)
    if options:
        raise ConfigError(
            f"{', '.join(options)}: options are for a name, not for a {type(env).__name__}"
        )
    return env


def spaces(env: Env) -> tuple[gymnasium.Space, gymnasium.Space]:
    """Of observations and of actions."""
    box = gymnasium.spaces.Box

    def part(like: jax.ShapeDtypeStruct) -> gymnasium.Space:
        picture = like.dtype == np.uint8
        return box(0, 255, like.shape, np.uint8) if picture else box(-np.inf, np.inf, like.shape)

    like = observation_like(env)
    action = box(-1.0, 1.0, (env.action_size,))
    if isinstance(like, dict):
        return gymnasium.spaces.Dict({name: part(x) for name, x in like.items()}), action
    return part(like), action


def arrays(obs: PyTree) -> Any:
    """Copies that may be written to."""
    return jax.tree.map(np.array, obs)


def drawer(env: Env, render_mode: str | None) -> Renderer | Aerial | None:
    if render_mode is None:
        return None
    if render_mode != "rgb_array":
        raise ConfigError(f"render_mode={render_mode!r}: expected 'rgb_array' or None")
    return renderer_of(env)


def draw_key(rng: np.random.Generator) -> jax.Array:
    return jax.random.key(rng.integers(2**31))


def described(env: Env, state: State) -> dict[str, Array]:
    """Cost, each constraint's, and what the environment reports itself: [] or [N] each."""
    costs = np.asarray(state.costs, np.float64)
    named = {f"cost_{name}": costs[..., k] for k, name in enumerate(env.cost_names)}
    mine = {name: np.asarray(x, np.float64) for name, x in state.info.items()}
    return {"cost": np.asarray(state.cost, np.float64), **named, **mine}


def masked(info: Info, mask: Array) -> Info:
    """Each entry, and which environments have it, as Gymnasium's vector environments give them."""
    return info | {f"_{name}": mask.copy() for name in info}


def advance(
    env: Env, rollout: RolloutState, actions: jax.Array, key: jax.Array
) -> tuple[RolloutState, State, jax.Array, jax.Array]:
    """A step of all: where they are now, and before any reset their states, terminated, truncated."""
    state = jax.vmap(env.step)(rollout.state, actions)
    steps = rollout.steps + 1
    truncated = ((steps >= env.episode_length) | state.truncated) & ~state.terminated
    rollout = dataclasses.replace(rollout, state=state, steps=steps)
    return restart(env, rollout, state.terminated | truncated, key), state, state.terminated, truncated


def ids() -> dict[str, dict[str, Any]]:
    """What each id stands for: arguments of `GymEnv`."""
    found: dict[str, dict[str, Any]] = {name: {"env": name} for name in envs.ENVS}
    for alias, name in envs.ALIASES.items():
        short = alias.removeprefix("Safexp-")
        found[short] = {"env": name, **IMPLIED.get(alias, {})}
    return found


for _id, _kwargs in ids().items():
    gymnasium.register(
        f"jaxsafe/{_id}",
        entry_point="jaxsafe.interop.gymnasium:GymEnv",
        vector_entry_point="jaxsafe.interop.gymnasium:GymVectorEnv",
        kwargs=_kwargs,
    )
