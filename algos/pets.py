"""PETS, which plans with an ensemble, and its constrained kin: CCE, RCE and CAP."""

from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp

from jaxsafe.config import Amount, Bounds, Iterations, Rate, Weight, config
from jaxsafe.learn.bill import PriceClockConfig
from jaxsafe.learn.conventions import Convention
from jaxsafe.learn.model_based import ModelBasedConfig, model_based
from jaxsafe.learn.planning import (
    Planner,
    cautious_cost,
    elites,
    mean_cost,
    mean_return,
    no_cost,
    worst_cost,
)
from jaxsafe.learn.row import Row
from jaxsafe.learn.timetable import ReplayConfig
from jaxsafe.learn.treatments import Treatment
from jaxsafe.types import Algorithm, Count, Env


@config
class PETSConfig(ModelBasedConfig, ReplayConfig):
    """PETS: plans with an ensemble of probabilistic networks, blind to cost.

        R(a_1 .. a_H) = mean over particles of sum_h r_h,   each model's particles follow that model
        a* = the mean that CEM finds for the largest R;     acts with a*_1
        minimise_m  mean[(mu_m(s, a) - y)^2 / sigma_m(s, a)^2 + log sigma_m(s, a)^2],   y = (r, s' - s)

    for each model m of the ensemble, at each refit on all of the replay. Where the cost is learned, y
    has it, too. A plan earns nothing after the end of an episode, where the observation tells it
    (`foresee_end`).

    With `true_model` it plans in the simulator instead, whose random numbers it foresees: the most that
    planning can do. Nothing is learned then, and no action is random.

    Source: Chua et al. (2018), "Deep Reinforcement Learning in a Handful of Trials using Probabilistic
    Dynamics Models", arXiv:1805.12114; the settings are OmniSafe's.
    Differs from OmniSafe: the bounds of the variances are learned, and weights begin with a truncated
    normal, as in the authors' code. A refit of several epochs puts each model back to its best, as in
    the code of Janner et al. (2019), arXiv:1906.08253. The defaults have one epoch (`max_epochs`), so
    that its last weights stay. Plans see the end of an episode. They begin anew with each, and
    evaluation has plans of its own. Batches are drawn with replacement. The defaults are for a GPU:
    many environments, and a fixed number of large steps at each refit.
    """

    ACTS_BY: ClassVar = ("elites",)

    # Environments side by side, of all devices together. OmniSafe has 1.
    num_envs: Amount = 64
    horizon: Amount = 10  # Steps of each environment in an update. Two updates have those of a refit.
    # Transitions kept, rounded to whole updates. OmniSafe keeps all of a run: 200,000 in navigation.
    replay_size: Annotated[int, Bounds(1, 2**31 - 1)] = 200_000
    # Environment steps with random actions before the first fit, rounded up to whole updates. OmniSafe
    # has 10,000 raw steps.
    learning_starts: Annotated[int, Bounds(0, 2**31 - 1)] = 2_000
    # The best plans, which make the next mean and variance. As in OmniSafe.
    elites: Amount = 64
    model_lr: Rate = 2e-3  # Adam's step of the model. The paper and OmniSafe have 1e-3.
    # Transitions of a step of each model, of all devices together, drawn with replacement. OmniSafe has
    # 256.
    model_batch: Amount = 1024
    max_epochs: Iterations = 1  # Epochs that end a refit anyway. OmniSafe has no bound.
    # Steps of an epoch. 0 is as many as one pass over the data has, as in OmniSafe. 1000 with 1024
    # transitions are 5 passes over a full replay.
    epoch_steps: Annotated[int, Bounds(0, 2**24)] = 1000


@config
class CCEConfig(PETSConfig):
    """CCE-PETS: PETS that takes its elites from plans whose expected cost is within the limit.

        C(a_1 .. a_H) = T / H  mean over particles of sum_h c_h,   T the steps of an episode
        elites: the largest R among plans with C <= cost_limit;
                if there are fewer of these than elites, the smallest C of all plans

    The rest is as in PETS. A plan that ends the episode costs nothing after that. So where too few
    plans are within the limit, one that falls soon may be the cheapest.

    Source: Wen and Topcu (2018), "Constrained Cross-Entropy Method for Safe Reinforcement Learning".
    Differs from OmniSafe: there C is the cost of 1000 steps of the planner, whatever an episode has.
    """

    ACTS_BY: ClassVar = ("cost_limit",)


@config
class RCEConfig(PETSConfig):
    """RCE-PETS: as CCE-PETS, but C has the worst particle at each step.

        C(a_1 .. a_H) = T / H  sum_h max over particles of c_h

    The rest is as in CCE-PETS. Where a step costs 0 or 1 and the limit is below T / H divided by the
    number of particles, both allow the same plans: those without any cost.

    Source: Liu et al. (2020), "Constrained Model-based Reinforcement Learning with Robust Cross-Entropy
    Method", arXiv:2010.07968.
    Differs from OmniSafe: there C is the cost of 1000 steps of the planner, whatever an episode has.
    """

    ACTS_BY: ClassVar = ("cost_limit",)


@config
class CAPConfig(PriceClockConfig, PETSConfig):
    """CAP-PETS: as CCE-PETS, but cost is raised by the model's uncertainty, at an adaptive price.

        C(a_1 .. a_H) = T / H  mean over particles of sum_h (c_h + kappa max_m |sigma_m(s_h, a_h)|)
        kappa <- clip(kappa + kappa_lr (J_c - cost_limit), 0, kappa_max),   every `dual_every` steps

    J_c is what an episode has cost since kappa last moved. The vector sigma_m has the standard
    deviations of all outputs of model m, at that model's own particle. The rest is as in CCE-PETS.

    Source: Ma et al. (2022), "Conservative and Adaptive Penalty for Model-Based Safe Reinforcement
    Learning", arXiv:2112.07701.
    Differs from OmniSafe: there a plan gets the uncertainty of other plans, because an array is
    reshaped in the wrong order (`compat=omnisafe`). J_c is over 50 episodes there. kappa moves 100
    times as fast there, and may be 20 times as large.

    A plan without cost is feasible as long as T kappa |sigma| <= cost_limit, with |sigma| the mean of
    the penalty over its steps. With 30 outputs |sigma| begins at 0.04 or more, because no variance is
    below e^-10 then. On PointGoal1 it was 2 after a short fit to 2,000 random steps. There T is 200.
    With OmniSafe's limit of 1 no plan at all is feasible from kappa = 0.0025 on. The planner then takes
    the plans of the smallest C, whatever they earn. OmniSafe's kappa is 1 after one move from J_c = 50
    (`preset=published`), and falls by at most 0.1 a move.
    """

    ACTS_BY: ClassVar = ("cost_limit",)
    CONVENTIONS: ClassVar = (
        Convention(
            {"uncertainty": "mixed"},
            "CAP adds the uncertainty of other plans to the cost of a plan",
            "it adds that of the plan itself",
        ),
    )

    # Environment steps between two moves of kappa. OmniSafe has 20,000 raw steps.
    dual_every: Annotated[int, Bounds(1, 2**30)] = 4_000
    kappa_init: Weight = 0.0  # kappa at first, as in OmniSafe.
    # The change of kappa for each unit of violation. It raises C by T kappa_lr |sigma|, which is 0.4 on
    # PointGoal1. OmniSafe has 0.1, which raises it by 40.
    kappa_lr: Weight = 1e-3
    # The largest kappa. null: 0.4 cost_limit / T. On PointGoal1 plans without cost are feasible up to
    # cost_limit / (T |sigma|) = 0.5 cost_limit / T. OmniSafe has 1, with a limit of 1.
    kappa_max: Weight | None = None
    # Whose uncertainty is added to the cost of a plan. own: as in the paper. mixed: that of other plans
    # at the same step, as in OmniSafe.
    uncertainty: Literal["own", "mixed"] = "own"


def caution(steps: int) -> Treatment:
    """The price kappa, for episodes of so many steps."""

    def move(kappa: jax.Array, episode_cost: jax.Array, cfg: Any, iteration: Count) -> jax.Array:
        most = 0.4 * cfg.cost_limit / steps if cfg.kappa_max is None else cfg.kappa_max
        return jnp.clip(kappa + cfg.kappa_lr * (episode_cost - cfg.cost_limit), 0.0, most)

    return Treatment(
        init=lambda cfg: jnp.asarray(cfg.kappa_init, jnp.float32),
        update=move,
        advantage=lambda kappa, adv_r, adv_c: adv_r - kappa * adv_c,
        metrics=lambda kappa: {"train/kappa": kappa},
    )


PETS, CCE, RCE, CAP = (
    Planner(mean_return, cost, elites) for cost in (no_cost, mean_cost, worst_cost, cautious_cost)
)
make = partial(model_based, planner=PETS)


def make_cautious(env: Env, axis_name: str | None = None) -> Algorithm:
    return model_based(env, axis_name, planner=CAP, treatment=caution(env.episode_length))


# OmniSafe @15603dd, configs/model-based; of navigation with env.wrap.action_repeat=5 and
# env.observation=coordinates, where 5 raw steps are one step here. An update of 40 steps is ours.
ALONE: dict[str, Any] = {
    "num_envs": 1, "horizon": 40, "stagger": False, "model_batch": 256, "max_epochs": 1000,
    "epoch_steps": 0, "model_lr": 1e-3, "foresee_end": False,
}  # fmt: skip
NAVIGATION: dict[str, Any] = ALONE | {"refit_every": 240, "learn_cost": False}
PLANS: dict[str, Any] = {"plan_steps": 16, "plan_var": 0.1, "model_lr": 1e-3}  # of velocity tasks
VELOCITY: dict[str, Any] = ALONE | PLANS | {
    "refit_every": 1200, "learning_starts": 10_000, "replay_size": 1_000_000,
}  # fmt: skip
TRUE: dict[str, Any] = {"true_model": True}
LIMIT: dict[str, Any] = {"cost_limit": 1.0}
# for a problem of two levers, whose next signs nobody can foresee
LEVER: dict[str, Any] = {
    "num_envs": 16, "horizon": 8, "replay_size": 4096, "learning_starts": 256, "refit_every": 256,
    "plan_steps": 1, "plans": 64, "elites": 8, "particles": 2, "models": 3, "model_hidden": (32, 32),
    "model_lr": 1e-2, "model_batch": 64, "epoch_steps": 150,
}  # fmt: skip


def published(limit: dict[str, Any], **velocity: Any) -> dict[str, dict[str, Any]]:
    return {
        "omnisafe_navigation": NAVIGATION | limit,
        "omnisafe_velocity": VELOCITY | limit | velocity,
        "velocity": PLANS,
        "true_model": TRUE,
    }


ROWS = {
    "pets": Row(
        PETSConfig,
        make,
        "planning with an ensemble of models, no constraint",
        published({}),
        total_steps=1_000_000,
        omnisafe="PETS",
        holds="nothing",
        lever=LEVER,
    ),
    "cce_pets": Row(
        CCEConfig,
        partial(model_based, planner=CCE),
        "planning among plans of a low expected cost",
        published(LIMIT),
        total_steps=1_000_000,
        omnisafe="CCEPETS",
        lever=LEVER,
    ),
    "rce_pets": Row(
        RCEConfig,
        partial(model_based, planner=RCE),
        "planning among plans of a low cost in the worst case",
        published(LIMIT),
        total_steps=1_000_000,
        omnisafe="RCEPETS",
        lever=LEVER,
    ),
    "cap_pets": Row(
        CAPConfig,
        make_cautious,
        "planning with a cost that the model's uncertainty raises",
        published(LIMIT | {"kappa_lr": 0.1, "kappa_max": 1.0}, dual_every=20_000),
        total_steps=1_000_000,
        omnisafe="CAPPETS",
        lever=LEVER,
    ),
}
