"""Deep deterministic policy gradients, and with each treatment of the constraint."""

from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from jaxsafe.algos import sac, td3
from jaxsafe.config import config
from jaxsafe.learn.actor_critic import ControllerConfig, MultiplierConfig, actor_critic
from jaxsafe.learn.conventions import Convention
from jaxsafe.learn.off_policy import off_policy
from jaxsafe.learn.row import Row
from jaxsafe.learn.treatments import Treatment, damped_lagrangian, no_treatment, pid
from jaxsafe.types import Algorithm, Env, PyTree


@config
class DDPGConfig(td3.DeterministicConfig):
    """DDPG: deep deterministic policy gradients, blind to cost.

        y = r + discount (1 - terminated) Q'(s', mu'(s'))
        minimise_Q   E[(Q(s, a) - y)^2]
        maximise_mu  E[Q(s, mu(s))]
        Q' <- Q' + tau (Q - Q'),   mu' <- mu' + tau (mu - mu')

    Actions in training are clip(mu(s) + N(0, sigma^2), +-1), with a sigma for each environment. With
    `n_step` n, r is the discounted sum of up to n rewards and s' the state after them.

    Source: Lillicrap et al. (2016), "Continuous control with deep reinforcement learning",
    arXiv:1509.02971, algorithm 1.
    Differs from it: the noise is Gaussian and has no memory, as in OmniSafe, and each environment has
    its own, as in Li et al. (2023), "Parallel Q-Learning", arXiv:2307.12983. The defaults are for two
    thousand environments, as in TD3. OmniSafe's y has mu for mu' (`target_policy`).
    """

    CONVENTIONS: ClassVar = (
        Convention(
            {"target_policy": False},
            "targets take the policy's own next action",
            "targets take that of the target policy",
        ),
    )

    # Whether targets take the target policy's action, as in the paper. OmniSafe's take the policy's.
    target_policy: bool = True


@config
class DDPGLagConfig(MultiplierConfig, DDPGConfig):
    """DDPG-Lagrangian: DDPG whose policy pays for cost at an adaptive price.

        y_c = c + cost_discount (1 - terminated) reduce_j Q'_cj(s', mu'(s'))
        minimise_Q    E[sum_j (Q_cj(s, a) - y_c)^2], and the loss of Q as in DDPG
        maximise_mu   E[(Q(s, mu(s)) / unit - lam Q_c(s, mu(s))) / (1 + lam)]
        lam = (l + dual_damping (J_c - cost_limit))+
        minimise_l    -l (J_c - cost_limit),  l >= 0,  by Adam, once every `dual_every` steps

    J_c is what an episode has cost since lam last moved. unit is the standard deviation of what it
    divides over the batch, or 1 with `price_unit=reward`. With `cost_floor`
    a Q_c or Q'_c below 0 counts as 0. The rest is as in DDPG.

    Source: Ray, Achiam and Amodei (2019), "Benchmarking Safe Exploration in Deep Reinforcement
    Learning", for the multiplier; Platt and Barr (1987), "Constrained Differential Optimization", for
    its damping.
    Differs from OmniSafe: there lam is l, without damping, and moves at every gradient step, so that
    its speed depends on `replay_ratio`. There is one critic of cost, without a floor, whose target
    takes mu(s'), and unit is 1.
    """


@config
class DDPGPIDConfig(ControllerConfig, DDPGConfig):
    """DDPG-PID: DDPG whose price on cost is the output of a PID controller.

        maximise_mu  E[(Q(s, mu(s)) / unit - lam Q_c(s, mu(s))) / (1 + lam)]
        lam <- (K_p P + I + K_d D)+,   I <- (I + K_i (J_c - cost_limit))+

    once every `dual_every` steps. P is the smoothed J_c - cost_limit. D is what the smoothed J_c rose
    over `pid_delay` moves, and 0 if it fell. unit and the critics are those of DDPG-Lagrangian.

    Source: Stooke, Achiam and Abbeel (2020), "Responsive Safety in Reinforcement Learning by PID
    Lagrangian Methods", arXiv:2007.03964, algorithm 2, for the controller.
    Differs from OmniSafe: there the controller runs at every gradient step, on a J_c that only changes
    when an episode ends.
    """


def no_noise(key: jax.Array, shape: tuple[int, ...], cfg: Any) -> jax.Array:
    return jnp.zeros(shape)


def next_actor(params: dict[str, PyTree], targets: dict[str, PyTree], cfg: Any) -> PyTree:
    return targets["actor"] if cfg.target_policy else params["actor"]


def make(env: Env, axis_name: str | None = None, treatment: Treatment = no_treatment) -> Algorithm:
    actor = td3.deterministic_actor(env.action_size, 1, no_noise, next_actor)
    return off_policy(env, actor_critic(env, actor, treatment), treatment, axis_name)


PRICED = td3.published(sac.LAG, sac.LAG_NAVIGATION)
# OmniSafe @15603dd, configs/off-policy/DDPGLag.yaml: there costs are normalised, unlike for TD3, SAC.
PRICED["omnisafe_navigation"] |= {"cost_normalize": True}

ROWS = {
    "ddpg": Row(
        DDPGConfig,
        make,
        "deterministic policy, one critic, no constraint",
        td3.published({}),
        total_steps=5_000_000,
        holds="nothing",
        omnisafe="DDPG",
        lever=td3.LEVER,
    ),
    "ddpg_lag": Row(
        DDPGLagConfig,
        partial(make, treatment=damped_lagrangian),
        "DDPG with an adaptive price on cost",
        PRICED,
        total_steps=5_000_000,
        omnisafe="DDPGLag",
        lever=td3.LEVER | sac.LEVER_LAG,
    ),
    "ddpg_pid": Row(
        DDPGPIDConfig,
        partial(make, treatment=pid),
        "DDPG with a price on cost from a PID controller",
        td3.published(sac.PID, sac.PID_NAVIGATION),
        total_steps=5_000_000,
        omnisafe="DDPGPID",
        lever=td3.LEVER | sac.LEVER_PID,
    ),
}
