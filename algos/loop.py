"""LOOP, which plans with a model and goes on with a critic; and SafeLOOP."""

import math
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp

from jaxsafe.algos import pets, sac
from jaxsafe.config import Amount, Bounds, Iterations, Rate, Share, Weight, config
from jaxsafe.learn.acting import Learned
from jaxsafe.learn.actor_critic import actor_critic
from jaxsafe.learn.model_based import ModelBasedConfig, model_based
from jaxsafe.learn.models import Model
from jaxsafe.learn.normalise import network_inputs
from jaxsafe.learn.planning import (
    Imagined,
    PlanCost,
    Planner,
    Weigh,
    by_return,
    by_return_within_limit,
    no_cost,
    particles_of,
    worst_cost,
)
from jaxsafe.learn.row import Row
from jaxsafe.learn.treatments import no_treatment
from jaxsafe.nn.critics import q_values
from jaxsafe.types import Algorithm, Env, PyTree


@config
class LOOPConfig(ModelBasedConfig, sac.SACConfig):
    """LOOP: plans with an ensemble, and with a critic from where the plan ends; blind to cost.

        R(a_1 .. a_H) = mean over particles of sum_h discount^(h-1) r_h + discount^H V(s_H)
        V(s) = min_i Q_i(s, tanh mu(s)),   i = 1, 2
        w_s in proportion to exp(temperature R_s)
        mean <- sum_s w_s a_s,   var <- sum_s w_s (a_s - mean)^2,   over plans s

    Some plans are drawn, others are what the actor does in each model. The models are those of PETS.
    Actor and critics are SAC's, which learn from the same replay. Acts with the first action of the
    last mean.

    With `true_model` it plans in the simulator, whose random numbers it foresees.

    Source: Sikchi, Zhou and Held (2021), "Learning Off-Policy with Online Planning", arXiv:2008.10066.
    Differs from OmniSafe: there V is Q_1 of the last state and the action before it, the sum has no
    discount, and the actor's plans are one plan of the first model, copied. R is 1000 / H times as
    large there; `preset=omnisafe_navigation` has a temperature as much larger. In navigation,
    SAC's temperature decays to 0 there within some hundred steps, and the actor's loss is of its mean
    action.
    """

    ACTS_BY: ClassVar = ("actor_plans", "temperature")
    TAKES_PICTURES: ClassVar = False

    encoder: Literal["none"] = "none"  # There are no pictures: the model learns vectors.
    # Environments side by side, of all devices together. OmniSafe has 1.
    num_envs: Amount = 64
    horizon: Amount = 10  # Steps of each environment in an update. Two updates have those of a refit.
    # Transitions kept, rounded to whole updates. OmniSafe keeps all of a run: 200,000 in navigation.
    replay_size: Annotated[int, Bounds(1, 2**31 - 1)] = 200_000
    # Environment steps with random actions and without learning, of the planner rounded up to whole
    # updates. OmniSafe has 10,000 raw steps.
    learning_starts: Annotated[int, Bounds(0, 2**31 - 1)] = 2_000
    batch_size: Amount = 1024  # Transitions of a gradient step. OmniSafe has 256.
    lr: Rate = 3e-4  # The policy's learning rate, by Adam, as in OmniSafe.
    critic_lr: Rate = 3e-4  # The critics' learning rate, by Adam, as in OmniSafe.
    # Whether both learning rates fall linearly to 0 at `total_iterations`. OmniSafe keeps them.
    lr_decay: bool = False
    # The share of the critics that their targets take on at each step. OmniSafe has 0.005.
    tau: Share = 0.01
    # The entropy that SAC's temperature aims at, in nats for each dimension of the action, as in its
    # paper.
    target_entropy: Annotated[float, Bounds(-100, 100)] = -1.0
    replay_ratio: Amount = 64  # Transitions replayed for each environment step. OmniSafe has 256.
    model_lr: Rate = 2e-3  # Adam's step of the model. OmniSafe has 1e-3.
    # Transitions of a step of each model, of all devices together, drawn with replacement. OmniSafe has
    # 256.
    model_batch: Amount = 1024
    max_epochs: Iterations = 1  # Epochs that end a refit anyway. OmniSafe has no bound.
    # Steps of an epoch. 0 is as many as one pass over the data has, as in OmniSafe. 1000 with 1024
    # transitions are 5 passes over a full replay.
    epoch_steps: Annotated[int, Bounds(0, 2**24)] = 1000
    plans: Amount = 100  # S, plans that are drawn each time, as in OmniSafe.
    actor_plans: Amount = 1  # Plans that the actor makes in each model. OmniSafe has one plan in all.
    plan_var: Annotated[float, Bounds(0, 100)] = 0.01  # The variance at first, as in OmniSafe.
    # A plan of no larger variance is not improved any further, as in OmniSafe.
    var_stop: Weight = 1e-3
    # How strongly the better of two plans is preferred. OmniSafe multiplies it by 1000 / H.
    temperature: Annotated[float, Bounds(1e-6, 1e6)] = 10.0


@config
class SafeLOOPConfig(LOOPConfig):
    """SafeLOOP: LOOP among plans whose cost is within the limit in the worst case.

        C(a_1 .. a_H) = T / H  sum_h max over particles of c_h,   T the steps of an episode
        w_s in proportion to exp(temperature R_s) among plans with C_s <= cost_limit;
        if there are fewer of these than `elites`, to exp(-cost_temperature C_s) among all

    The rest is as in LOOP.

    Source: Sikchi, Zhou and Held (2021), "Learning Off-Policy with Online Planning", arXiv:2008.10066,
    for safety by constraints on plans; the weights are OmniSafe's.
    Differs from OmniSafe: as LOOP, and there C is the cost of 1000 steps of the planner.
    """

    ACTS_BY: ClassVar = ("elites", "cost_temperature", "cost_limit")

    # The least number of feasible plans; with fewer, the cost alone decides. As in OmniSafe.
    elites: Amount = 20
    plan_var: Annotated[float, Bounds(0, 100)] = 0.075  # The variance at first, as in OmniSafe.
    mean_momentum: Share = 0.0  # The share of the old mean that is kept, as in OmniSafe.
    # How strongly the cheaper of two plans is preferred, where too few are feasible. As in OmniSafe.
    cost_temperature: Weight = 100.0


def planner(env: Env, cost: PlanCost = no_cost, weigh: Weigh = by_return) -> Planner:
    actor = sac.soft_actor(env.action_size)

    def plan_return(imagined: Imagined, learned: Learned, key: jax.Array) -> jax.Array:
        cfg, params = learned.config, learned.params
        steps = len(imagined.reward)
        weights = (cfg.discount ** jnp.arange(steps)).reshape(-1, 1, 1, 1)
        obs = network_inputs(learned.normaliser, imagined.obs)
        action = actor.act(params, obs, None, cfg)
        v = q_values(params["critic_r"], obs, action, cfg).min(0)
        later = cfg.discount**steps * jnp.where(imagined.alive, v, 0.0)
        return ((weights * imagined.reward).sum(0) + later).mean((0, 1))

    def propose(model: Model, learned: Learned, seen: PyTree, key: jax.Array) -> tuple[jax.Array, ...]:
        """What the actor does in each model, `actor_plans` times: one array [M actor_plans, H, A]."""
        cfg, params = learned.config, learned.params

        def step(latent: PyTree, key: jax.Array) -> tuple[PyTree, jax.Array]:
            act_key, model_key = jax.random.split(key)
            obs = network_inputs(learned.normaliser, model.observe(latent))
            action = actor.act(params, obs, act_key, cfg)
            return model.predict(params["model"], latent, action, model_key, cfg).latent, action

        start = particles_of(seen, (model.particles(cfg)[0], 1, cfg.actor_plans))
        actions = jax.lax.scan(step, start, jax.random.split(key, cfg.plan_steps))[1]
        return (jnp.moveaxis(actions.reshape(cfg.plan_steps, -1, env.action_size), 0, 1),)

    return Planner(plan_return, cost, weigh, propose)


def make(env: Env, axis_name: str | None = None, **scores: Any) -> Algorithm:
    beside = actor_critic(env, sac.soft_actor(env.action_size), no_treatment)
    return model_based(env, axis_name, planner=planner(env, **scores), beside=beside)


# OmniSafe @15603dd, configs/model-based/LOOP.yaml and SafeLOOP.yaml; of navigation with
# env.wrap.action_repeat=5 and env.observation=coordinates, where 5 raw steps are one step here. SAC's
# temperature is below 1e-3 there after 530 gradient steps, but fixed in velocity tasks.
NETS: dict[str, Any] = {
    "batch_size": 256, "replay_ratio": 256, "tau": 0.005, "layer_norm": False, "obs_normalize": False,
    "alpha_init": 1e-3, "alpha_lr": 0.0,
}  # fmt: skip
NAVIGATION: dict[str, Any] = pets.NAVIGATION | NETS | {
    "horizon": 50, "learn_every": 50, "hidden": (64, 64), "lr": 1e-3,
    "critic_lr": 1e-3, "temperature": 10 * 1000 / 7, "max_grad_norm": math.inf,
}  # fmt: skip
PLANS: dict[str, Any] = {  # of velocity tasks, and the delay of the actor
    "plan_steps": 3, "plan_var": 0.1, "policy_delay": 2, "temperature": 1000 / 3, "model_lr": 1e-3,
}  # fmt: skip
VELOCITY: dict[str, Any] = pets.VELOCITY | NETS | PLANS | {"alpha_init": 0.2}
SAFE: dict[str, Any] = {"cost_limit": 1.0}
# the actor-critic's settings for a problem of two levers, and the planner's
LEVER: dict[str, Any] = sac.LEVER | pets.LEVER | {
    "learn_every": 4, "replay_ratio": 16, "plan_var": 1.0, "elites": 8,
}  # fmt: skip
UNLIMITED = {name: value for name, value in LEVER.items() if name != "elites"}

ROWS = {
    "loop": Row(
        LOOPConfig,
        make,
        "planning with an ensemble of models and a critic, no constraint",
        {"omnisafe_navigation": NAVIGATION, "omnisafe_velocity": VELOCITY, "velocity": PLANS},
        total_steps=1_000_000,
        omnisafe="LOOP",
        holds="nothing",
        lever=UNLIMITED,
    ),
    "safe_loop": Row(
        SafeLOOPConfig,
        partial(make, cost=worst_cost, weigh=by_return_within_limit),
        "LOOP among plans of a low cost in the worst case",
        {
            "omnisafe_navigation": NAVIGATION | SAFE,
            "omnisafe_velocity": VELOCITY | SAFE,
            "velocity": PLANS,
        },
        total_steps=1_000_000,
        omnisafe="SafeLOOP",
        lever=LEVER,
    ),
}
