"""Soft actor-critic, alone and with each treatment of the constraint."""

from functools import partial
from typing import Annotated, Any, ClassVar

import jax
import jax.numpy as jnp
import optax

from jaxsafe.config import Bounds, Rate, config
from jaxsafe.learn.actor_critic import (
    Actor,
    ActorCriticConfig,
    ControllerConfig,
    MultiplierConfig,
    Proposal,
    actor_critic,
)
from jaxsafe.learn.off_policy import off_policy
from jaxsafe.learn.row import Row
from jaxsafe.learn.steps import adam
from jaxsafe.learn.treatments import Treatment, damped_lagrangian, no_treatment, pid
from jaxsafe.nn.critics import smallest
from jaxsafe.nn.squashed import init_squashed, squashed_mean, squashed_policy, squashed_sample
from jaxsafe.types import Algorithm, Env, PyTree


@config
class SACConfig(ActorCriticConfig):
    """SAC: soft actor-critic, blind to cost.

        y = r + discount (1 - terminated) (min_i Q'_i(s', a') - alpha log pi(a' | s')),   a' ~ pi(s')
        minimise_Q      E[sum_i (Q_i(s, a) - y)^2]
        maximise_pi     E[min_i Q_i(s, a) - alpha log pi(a | s)],                         a ~ pi(s)
        minimise_alpha  -log alpha E[log pi(a | s) + H],        H = target_entropy * action size
        Q' <- Q' + tau (Q - Q')

    in this order at each gradient step; i = 1, 2. With `n_step` n, r is the discounted sum of up to n
    rewards and s' the state after them.

    Source: Haarnoja et al. (2018), "Soft Actor-Critic Algorithms and Applications", arXiv:1812.05905,
    algorithm 1; the loss of the temperature is that of the authors' code.
    Differs from it: the defaults are for two thousand environments. Gradient steps are few and large,
    the targets follow faster, learning rates decay, alpha aims at a lower entropy, the critics have
    layer norm, and observations are normalised.
    """

    # The temperature at first, low because rewards of Safety Gym are some hundredths. The authors' code
    # has 1.
    alpha_init: Annotated[float, Bounds(1e-10, 1e6)] = 0.01
    # The learning rate of log alpha, by Adam. The authors' code has 3e-4. With 0, alpha stays as it is.
    alpha_lr: Rate = 1e-3
    # The entropy that alpha aims at, in nats for each dimension of the action. The paper has -1. With
    # -2 sampled and mean actions differ less, and the mean ones are those that are evaluated.
    target_entropy: Annotated[float, Bounds(-100, 100)] = -2.0
    # Whether both learning rates fall linearly to 0 at `total_iterations`, so that the last policy is
    # not one of many that the price swings between. OmniSafe keeps them.
    lr_decay: bool = True


@config
class SACLagConfig(MultiplierConfig, SACConfig):
    """SAC-Lagrangian: SAC whose policy pays for cost at an adaptive price.

        y_c = c + cost_discount (1 - terminated) reduce_j Q'_cj(s', a'),   a' ~ pi(s'), as for y
        minimise_Q    E[sum_j (Q_cj(s, a) - y_c)^2], and the loss of Q as in SAC
        maximise_pi   E[((min_i Q_i(s, a) - alpha log pi(a | s)) / unit - lam Q_c(s, a)) / (1 + lam)]
        lam = (l + dual_damping (J_c - cost_limit))+
        minimise_l    -l (J_c - cost_limit),  l >= 0,  by Adam, once every `dual_every` steps

    J_c is what an episode has cost since lam last moved. unit is the standard deviation, over the
    batch, of what it divides, or 1 with `price_unit=reward`. With `cost_floor` a Q_c or Q'_c below 0
    counts as 0. The rest is as in SAC.

    Source: Ray, Achiam and Amodei (2019), "Benchmarking Safe Exploration in Deep Reinforcement
    Learning", for the multiplier; Platt and Barr (1987), "Constrained Differential Optimization", for
    its damping; Ha et al. (2020), "Learning to Walk in the Real World with Minimal Human Effort",
    arXiv:2002.08550, for SAC with one.
    Differs from OmniSafe: there lam is l, without damping, and moves at every gradient step, so that
    its speed depends on `replay_ratio`. There is one critic of cost, without a floor, whose target
    takes the policy's mean action, and unit is 1.
    """

    # Where the defaults hardly learn, or were not tried (docs/results/off_policy)
    SUITS: ClassVar = {
        "navigation": (
            "point_goal2", "car_goal2", "point_button1", "car_button1", "point_button2", "car_button2",
            "point_push1", "car_push1",
        )
    }  # fmt: skip


@config
class SACPIDConfig(ControllerConfig, SACConfig):
    """SAC-PID: SAC whose price on cost is the output of a PID controller.

        maximise_pi  E[((min_i Q_i(s, a) - alpha log pi(a | s)) / unit - lam Q_c(s, a)) / (1 + lam)]
        lam <- (K_p P + I + K_d D)+,   I <- (I + K_i (J_c - cost_limit))+

    once every `dual_every` steps. P is the smoothed J_c - cost_limit. D is what the smoothed J_c rose
    over `pid_delay` moves, and 0 if it fell. unit and the critics are those of SAC-Lagrangian.

    Source: Stooke, Achiam and Abbeel (2020), "Responsive Safety in Reinforcement Learning by PID
    Lagrangian Methods", arXiv:2007.03964, algorithm 2, for the controller.
    Differs from OmniSafe: there the controller runs at every gradient step, on a J_c that only changes
    when an episode ends.
    """


def init(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> dict[str, PyTree]:
    actor = init_squashed(key, obs_size, action_size, cfg)
    return {"actor": actor, "log_alpha": jnp.log(cfg.alpha_init)}


def optimisers(cfg: Any, share: jax.Array | float) -> dict[str, optax.GradientTransformation]:
    return {"actor": adam(cfg.lr * share, cfg), "log_alpha": optax.adam(cfg.alpha_lr)}


def soft_actor(action_size: int) -> Actor:
    def drawn(
        params: dict[str, PyTree], obs: jax.Array, key: jax.Array, cfg: Any
    ) -> tuple[jax.Array, jax.Array]:
        """An action [..., A] and its log probability [...]."""
        return squashed_sample(squashed_policy(params["actor"], obs, action_size, cfg), key)

    def act(params: dict[str, PyTree], obs: jax.Array, key: jax.Array | None, cfg: Any) -> jax.Array:
        dist = squashed_policy(params["actor"], obs, action_size, cfg)
        return squashed_mean(dist) if key is None else squashed_sample(dist, key)[0]

    def next_action(
        params: dict[str, PyTree], targets: PyTree, obs: jax.Array, key: jax.Array, cfg: Any
    ) -> tuple[jax.Array, jax.Array]:
        action, log_prob = drawn(params, obs, key, cfg)
        return action, -jnp.exp(params["log_alpha"]) * log_prob

    def propose(params: dict[str, PyTree], obs: jax.Array, key: jax.Array, cfg: Any) -> Proposal:
        action, log_prob = drawn(params, obs, key, cfg)
        log_alpha = params["log_alpha"]
        alpha = jax.lax.stop_gradient(jnp.exp(log_alpha))
        too_sure = jax.lax.stop_gradient(log_prob + cfg.target_entropy * action_size)
        metrics = {"train/entropy": -log_prob, "train/alpha": jnp.full_like(log_prob, alpha)}
        return Proposal(action, -alpha * log_prob, -log_alpha * too_sure, metrics)

    return Actor(
        critics=2,
        followed=(),
        init=init,
        optimisers=optimisers,
        act=act,
        next_action=next_action,
        propose=propose,
        pick=smallest,
    )


def make(env: Env, axis_name: str | None = None, treatment: Treatment = no_treatment) -> Algorithm:
    learner = actor_critic(env, soft_actor(env.action_size), treatment)
    return off_policy(env, learner, treatment, axis_name)


# OmniSafe @15603dd, configs/off-policy/SAC.yaml: of the velocity tasks first. Its gradient step comes
# after every environment step, as here; an update of 50 of them is ours and changes no result.
OMNISAFE: dict[str, Any] = {
    "num_envs": 1,
    "horizon": 50,
    "stagger": False,
    "replay_ratio": 256,
    "batch_size": 256,
    "tau": 0.005,
    "lr": 3e-4,
    "critic_lr": 3e-4,
    "lr_decay": False,
    "layer_norm": False,
    "obs_normalize": False,
    "alpha_init": 0.2,
    "alpha_lr": 0.0,
    "target_entropy": -1.0,
    "policy_delay": 2,
}
NAVIGATION: dict[str, Any] = OMNISAFE | {"alpha_init": 1e-5, "lr": 5e-6, "critic_lr": 1e-3}
# The published replay ratio with 64 environments: 4 gradient steps for each of their steps. These are
# 16 times fewer than OmniSafe's, on batches 16 times as large, so networks and targets move faster. Its
# critics have no layer norm either.
PARALLEL: dict[str, Any] = {
    "num_envs": 64, "replay_ratio": 256, "batch_size": 4096, "tau": 0.02, "lr": 1e-3,
    "critic_lr": 1e-3, "lr_decay": True, "layer_norm": False,
}  # fmt: skip
SAC_PARALLEL: dict[str, Any] = PARALLEL | {"policy_delay": 2}

# OmniSafe's rate of policies on navigation tasks, for batches 16 times as large
NAVIGATION_RATE: dict[str, Any] = {"lr": 16 * 5e-6, "lr_decay": False}
# and its temperature there: a goal is worth 1, and a step some hundredths
COLD: dict[str, Any] = {"alpha_init": 1e-5, "alpha_lr": 0.0}
# Ours, for navigation. With one step, as OmniSafe has, much of the return is lost while a price rises.
FAR: dict[str, Any] = {"n_step": 3}


def priced_parallel(
    parallel: dict[str, Any], price: dict[str, Any], temperature: dict[str, Any] | None = None
) -> dict[str, dict[str, Any]]:
    """`parallel` as presets of an algorithm with a price, for velocity tasks and for navigation.

    On velocity tasks a policy answers a price within some hundred gradient steps, and a price that
    waits longer swings. On navigation tasks the cost of two episodes, which are 2,000 steps, is mostly
    chance. So there `price` is OmniSafe's, and moves every 20,000 steps. Targets of three steps keep
    more of the return while it rises: see docs/results/goal_off_policy.
    """
    critics = "cost_reduce", "cost_floor"  # these stay ours
    slow = {name: value for name, value in price.items() if name not in critics}
    return {
        "parallel": parallel | {"dual_every": 2000},
        "parallel_navigation": parallel | slow | NAVIGATION_RATE | FAR | (temperature or {}),
    }


# for two cores: few environments and small batches, so that Goal is learned from few steps. Runs are
# so short that the price has to rise three times as fast.
CPU: dict[str, Any] = COLD | {
    "n_step": 5, "num_envs": 64, "batch_size": 256, "replay_ratio": 4, "tau": 0.005, "lr": 3e-4,
    "critic_lr": 3e-4, "dual_lr": 0.03,
}  # fmt: skip
# 16 gradient steps for each step of 1,024 environments: it learns from fewer steps, and takes more time
FREQUENT: dict[str, Any] = {
    "num_envs": 1024, "batch_size": 1024, "tau": 0.01, "lr": 3e-4, "critic_lr": 3e-4, "lr_decay": False,
    "target_entropy": -1.0,
}  # fmt: skip
# A price that OmniSafe moves at every step by 1e-5 moves by 0.2 in 20,000 steps; likewise the others.
LAG: dict[str, Any] = {
    "dual_starts": 200_000, "dual_lr": 0.2, "dual_damping": 0.0, "dual_eps": 1e-8,
    "cost_reduce": "one",
    "cost_floor": False, "price_unit": "reward", "cost_normalize": True,
}  # fmt: skip
LAG_NAVIGATION: dict[str, Any] = LAG | {"dual_lr": 0.01, "lam_init": 0.0, "cost_normalize": False}
PID: dict[str, Any] = {
    "dual_starts": 200_000, "pid_kp": 1e-6, "pid_ki": 2e-3, "pid_kd": 1e-7, "pid_smoothing": 0.95,
    "lr": 1e-4, "cost_reduce": "one", "cost_floor": False, "price_unit": "reward",
    "cost_normalize": True,
}  # fmt: skip
PID_NAVIGATION: dict[str, Any] = PID | {
    "pid_kp": 5e-7, "pid_ki": 2e-4, "pid_kd": 1e-8, "lr": 5e-6, "cost_normalize": False,
}  # fmt: skip
# for a problem of two levers
LEVER: dict[str, Any] = {
    "num_envs": 32, "horizon": 8, "learn_every": 2, "batch_size": 256, "replay_size": 20_000,
    "learning_starts": 256, "hidden": (32,), "discount": 0.9, "lr": 3e-3, "critic_lr": 3e-3,
    "lr_decay": False, "tau": 0.01, "alpha_init": 0.1, "alpha_lr": 3e-3, "target_entropy": -2.0,
}  # fmt: skip
# Its states are all worth the same, so that Q_r has no deviation to measure prices in.
LEVER_LAG: dict[str, Any] = {
    "price_unit": "reward", "dual_every": 2560, "dual_lr": 0.015, "dual_eps": 1e-8,
    "lam_init": 1.3,
}  # fmt: skip
LEVER_PID: dict[str, Any] = {
    "price_unit": "reward", "dual_every": 2560, "lam_init": 1.2, "pid_kp": 0.2, "pid_ki": 0.03,
    "pid_kd": 0.0, "pid_smoothing": 0.8,
}  # fmt: skip

ROWS = {
    "sac": Row(
        SACConfig,
        make,
        "soft actor-critic, no constraint",
        {
            "omnisafe": OMNISAFE,
            "omnisafe_navigation": NAVIGATION,
            "parallel": SAC_PARALLEL,
            "frequent": FREQUENT,
            "navigation": COLD | FAR,
        },
        total_steps=5_000_000,
        holds="nothing",
        omnisafe="SAC",
        lever=LEVER,
    ),
    "sac_lag": Row(
        SACLagConfig,
        partial(make, treatment=damped_lagrangian),
        "SAC with an adaptive price on cost",
        {
            "omnisafe": OMNISAFE | LAG,
            "omnisafe_navigation": NAVIGATION | LAG_NAVIGATION,
            **priced_parallel(SAC_PARALLEL, LAG_NAVIGATION, COLD),
            "navigation": COLD | FAR,
            "cpu": CPU,
        },
        total_steps=5_000_000,
        omnisafe="SACLag",
        lever=LEVER | LEVER_LAG,
    ),
    "sac_pid": Row(
        SACPIDConfig,
        partial(make, treatment=pid),
        "SAC with a price on cost from a PID controller",
        {
            "omnisafe": OMNISAFE | PID,
            "omnisafe_navigation": NAVIGATION | PID_NAVIGATION,
            **priced_parallel(SAC_PARALLEL, PID_NAVIGATION, COLD),
            "navigation": COLD | FAR,
        },
        total_steps=5_000_000,
        omnisafe="SACPID",
        lever=LEVER | LEVER_PID,
    ),
}
