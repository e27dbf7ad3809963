"""Environments: Safety Gym's, velocity tasks, racing, pendulums, a user's own, and wrappers."""

from jaxsafe.envs.pendulum import CartPendulum, Pendulum
from jaxsafe.envs.racing.task import CarRacing
from jaxsafe.envs.registry import (
    ALIASES,
    ENVS,
    canonical,
    check_options,
    env_defaults,
    load,
    make,
    register,
)
from jaxsafe.envs.safety_gym.config import SafetyGymConfig
from jaxsafe.envs.safety_gym.task import SafetyGym
from jaxsafe.envs.velocity.config import VelocityConfig
from jaxsafe.envs.velocity.task import Velocity

__all__ = [
    "ALIASES",
    "ENVS",
    "CarRacing",
    "CartPendulum",
    "Pendulum",
    "SafetyGym",
    "SafetyGymConfig",
    "Velocity",
    "VelocityConfig",
    "canonical",
    "check_options",
    "env_defaults",
    "load",
    "make",
    "register",
]
