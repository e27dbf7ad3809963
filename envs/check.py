"""Whether an environment that someone else wrote is an `Env`, and whether an action fits one."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxsafe.config import ConfigError
from jaxsafe.types import Env, State

SIZES = ("obs_size", "action_size", "episode_length")
MEMBERS = (*SIZES, "cost_names", "reset", "step")
TOLD = {"observed_cost": jnp.float32, "observed_end": jnp.bool_}  # of an observation, if it tells them


def check_env(env: Any, name: str) -> Env:
    """`env` itself. Shapes and types are traced, nothing is simulated.

    Args:
        env: what should be an `Env`.
        name: what to call it in messages.
    Raises:
        ConfigError: something is missing, has another shape, or changes its type from reset to step.
    """
    missing = [member for member in MEMBERS if getattr(env, member, None) is None]
    if missing:
        raise ConfigError(
            f"{name} ({type(env).__name__}) is no Env of jaxsafe.types: it lacks {', '.join(missing)}; "
            "an environment of Brax or Playground goes through jaxsafe.interop.brax.from_brax"
        )
    for member in SIZES:
        size, least = getattr(env, member), 0 if member == "obs_size" else 1
        if not isinstance(size, int) or size < least:
            raise ConfigError(f"{name}: {member} is {size!r}, expected a whole number from {least} on")
    if isinstance(env.cost_names, str):
        raise ConfigError(f"{name}: cost_names is {env.cost_names!r}, expected a tuple of names")
    first = jax.eval_shape(env.reset, jax.random.key(0))
    check_state(first, env, f"{name}.reset")
    if env.obs_size == 0 and not isinstance(first.obs, dict):
        raise ConfigError(f"{name}: obs_size is 0 and there is no picture, expected something to see")
    action = jax.ShapeDtypeStruct((env.action_size,), jnp.float32)
    after = jax.eval_shape(env.step, first, action)
    check_state(after, env, f"{name}.step")
    old, new = (dict(jax.tree_util.tree_leaves_with_path(x)) for x in (first, after))
    for path in dict.fromkeys([*old, *new]):
        if (was := form(old.get(path))) != (now := form(new.get(path))):
            where = jax.tree_util.keystr(path)
            raise ConfigError(f"{name}: state{where} is {was} after reset but {now} after step")
    for member, dtype in TOLD.items():
        check_told(env, member, dtype, name)
    return env


def check_action(action: Any, size: int) -> None:
    """Refuse, as a step is traced, an action that is not [size]. One of [1] would drive every motor.

    Raises:
        ConfigError: it has another shape.
    """
    if (shape := jnp.shape(action)) != (size,):
        several = "; step takes one environment, and jax.vmap(env.step) several" * (len(shape) > 1)
        raise ConfigError(f"the action is {list(shape)}, expected [{size}]{several}")


def check_told(env: Env, member: str, dtype: Any, name: str) -> None:
    """What an observation tells, if the environment says how: one number for each of many."""
    if (told := getattr(env, member, None)) is None:
        return
    expected = form(jax.ShapeDtypeStruct((2, 3), dtype))
    obs = jax.ShapeDtypeStruct((2, 3, env.obs_size), jnp.float32)
    try:
        found = form(jax.eval_shape(told, obs))
    except (TypeError, ValueError, IndexError) as error:
        found = f"no function of it ({error})"
    if found != expected:
        raise ConfigError(f"{name}: {member} of {form(obs)} is {found}, expected {expected}")


def check_state(state: Any, env: Env, where: str) -> None:
    if not isinstance(state, State):
        raise ConfigError(f"{where} gives a {type(state).__name__}, expected jaxsafe.types.State")
    scalar = jax.ShapeDtypeStruct((), jnp.float32)
    expected = {
        "obs": jax.ShapeDtypeStruct((env.obs_size,), jnp.float32),
        "reward": scalar,
        "cost": scalar,
        "costs": jax.ShapeDtypeStruct((len(env.cost_names),), jnp.float32),
        "terminated": jax.ShapeDtypeStruct((), jnp.bool_),
        "truncated": jax.ShapeDtypeStruct((), jnp.bool_),
        **{f"info[{name!r}]": scalar for name in state.info},
    }
    found = {field: getattr(state, field) for field in expected if not field.startswith("info")}
    found |= {f"info[{name!r}]": x for name, x in state.info.items()}
    if isinstance(state.obs, dict):
        check_picture(state.obs, where)
        found["obs"] = state.obs["vector"]
    for field, like in expected.items():
        if form(found[field]) != form(like):
            raise ConfigError(f"{where}: {field} is {form(found[field])}, expected {form(like)}")


def check_picture(obs: dict[str, Any], where: str) -> None:
    if obs.keys() != {"vector", "vision"}:
        raise ConfigError(f"{where}: obs has {', '.join(obs)}, expected vector and vision")
    vision = obs["vision"]
    if vision.dtype != jnp.uint8 or vision.ndim != 3:
        raise ConfigError(f"{where}: obs['vision'] is {form(vision)}, expected uint8[H, W, C]")


def form(x: Any) -> str:
    """'float32[3]': type and shape of a traced leaf."""
    if x is None:
        return "nothing"
    if not isinstance(x, jax.ShapeDtypeStruct):
        return type(x).__name__
    return f"{x.dtype}{list(x.shape)}"
