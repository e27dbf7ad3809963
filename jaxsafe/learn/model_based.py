"""Planning algorithms as learners of the off-policy loop: a model that is refitted, and a planner.

The loop takes the environment steps and writes the replay. What the policy remembers is its plan. At
the end of an update the model is refitted, if that is due by the loop's clock. A method may also learn
an actor and critics, by gradient steps on the same replay.
"""

from typing import Any

import jax
import jax.numpy as jnp

from jaxsafe.config import config
from jaxsafe.learn.acting import Learned
from jaxsafe.learn.learner import GradientStep, Learner
from jaxsafe.learn.models import ModelConfig, init_model, model_of, record_by, refit, with_model
from jaxsafe.learn.off_policy import off_policy
from jaxsafe.learn.planning import PlanConfig, Planner, planning_policy
from jaxsafe.learn.replay import Transitions
from jaxsafe.learn.steps import Trainable
from jaxsafe.learn.treatments import Treatment, no_treatment
from jaxsafe.types import Algorithm, Env, Metrics


@config
class ModelBasedConfig(PlanConfig, ModelConfig):
    """What the planning algorithms share, beside what they share with others that have a replay."""


def no_learner() -> Learner:
    """The learner of a method that learns nothing but the model."""

    def step(nets: Trainable, *_: Any) -> tuple[Trainable, Metrics]:
        return nets, {}

    return Learner(init=lambda *_: Trainable({}, {}), step=step)


def model_based(
    env: Env,
    axis_name: str | None = None,
    *,
    planner: Planner,
    treatment: Treatment = no_treatment,
    beside: Learner | None = None,
) -> Algorithm:
    """The algorithm that plans by `planner`.

    Args:
        planner: the scores and weights of plans.
        treatment: a price on cost, or another number that moves with the cost of episodes. The planner
            has it as `learned.dual`.
        beside: learns an actor and critics for the planner, on the same replay.
    """
    other = beside or no_learner()

    def init(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> Trainable:
        scores = jnp.zeros(cfg.plans)
        planner.weigh(scores, scores, cfg)  # refuses settings that it cannot serve
        model_key, key = jax.random.split(key)
        model = init_model(model_key, env, cfg)
        return with_model(other.init(key, obs_size, action_size, cfg), model)

    def step(
        nets: Trainable, batch: Transitions, at: GradientStep, cfg: Any, axis_name: str | None
    ) -> tuple[Trainable, Metrics]:
        rest = Trainable(*({k: x for k, x in part.items() if k != "model"} for part in nets))
        new, metrics = other.step(rest, batch, at, cfg, axis_name)
        return with_model(new, model_of(nets)), metrics

    def random_start(learned: Learned) -> jax.Array:
        """Who plans in the simulator has nothing to wait for."""
        return jnp.bool_(beside is not None or not learned.config.true_model)

    learner = Learner(
        init=init,
        step=step,
        random_start=random_start,
        policy=planning_policy(env, planner),
        refit=refit,
        record=record_by,
    )
    return off_policy(env, learner, treatment, axis_name)
