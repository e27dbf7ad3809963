"""Twin delayed deep deterministic policy gradients, and with each treatment of the constraint.

The parts of a deterministic policy are shared with DDPG.
"""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, ClassVar

import jax
import jax.numpy as jnp
import optax

from jaxsafe.algos import sac
from jaxsafe.config import Bounds, Iterations, Weight, config
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
from jaxsafe.nn.networks import coarse_mlp
from jaxsafe.types import Algorithm, Env, PyTree

Noise = Annotated[float, Bounds(0, 10)]  # a standard deviation; actions lie in [-1, 1]
SATURATED = 0.999  # beyond this an action counts as saturated: tanh has 1/500 of its slope at 0


@config
class DeterministicConfig(ActorCriticConfig):
    """What methods with a deterministic policy share."""

    # Standard deviation of the noise on actions in training, in the calmest environment. The others
    # lie evenly between this and `noise_max`. OmniSafe has 0.1 in all.
    noise_min: Noise = 0.05
    # Standard deviation of the noise on actions in training, in the boldest environment.
    noise_max: Noise = 0.5
    # Whether the noise falls linearly to 0 by the end of training, so that the price is learned for the
    # policy without noise, as it is used. OmniSafe keeps the noise.
    noise_decay: bool = False
    # The weight of the mean square of what tanh makes actions of, in the policy's loss. Where tanh is
    # flat the policy has no gradient, and stays as it is for good.
    saturation_coef: Weight = 0.0


@config
class TD3Config(DeterministicConfig):
    """TD3: twin delayed deterministic policy gradients, blind to cost.

        a' = clip(mu'(s') + clip(noise, +-clip), +-1),   noise ~ N(0, smoothing^2)
        y = r + discount (1 - terminated) min_i Q'_i(s', a')
        minimise_Q   E[sum_i (Q_i(s, a) - y)^2]
        maximise_mu  E[Q_1(s, mu(s))],   at every `policy_delay`-th step, and then
        Q' <- Q' + tau (Q - Q'),   mu' <- mu' + tau (mu - mu')

    i = 1, 2. Actions in training are clip(mu(s) + N(0, sigma^2), +-1), with a sigma for each
    environment. With `n_step` n, r is the discounted sum of up to n rewards and s' the state after
    them.

    Source: Fujimoto, van Hoof and Meger (2018), "Addressing Function Approximation Error in
    Actor-Critic Methods", arXiv:1802.09477, algorithm 1.
    Differs from it: the defaults are for two thousand environments, each with noise of its own, as in
    Li et al. (2023), "Parallel Q-Learning", arXiv:2307.12983. Gradient steps are few and large, the
    targets follow faster, the critics have layer norm, and observations are normalised.
    """

    policy_delay: Iterations = 2  # As in the paper.
    smoothing: Noise = 0.2  # Standard deviation of the noise on next actions, as in the paper.
    smoothing_clip: Noise = 0.5  # The largest such noise, as in the paper.


@config
class TD3LagConfig(MultiplierConfig, TD3Config):
    """TD3-Lagrangian: TD3 whose policy pays for cost at an adaptive price.

        y_c = c + cost_discount (1 - terminated) reduce_j Q'_cj(s', a'),   a' as for y
        minimise_Q    E[sum_j (Q_cj(s, a) - y_c)^2], and the loss of Q as in TD3
        maximise_mu   E[(Q_1(s, mu(s)) / unit - lam Q_c(s, mu(s))) / (1 + lam)]
        lam = (l + dual_damping (J_c - cost_limit))+
        minimise_l    -l (J_c - cost_limit),  l >= 0,  by Adam, once every `dual_every` steps

    J_c is what an episode has cost since lam last moved. unit is the standard deviation of what it
    divides over the batch, or 1 with `price_unit=reward`. With `cost_floor`
    a Q_c or Q'_c below 0 counts as 0. The rest is as in TD3.

    Source: Ray, Achiam and Amodei (2019), "Benchmarking Safe Exploration in Deep Reinforcement
    Learning", for the multiplier; Platt and Barr (1987), "Constrained Differential Optimization", for
    its damping.
    Differs from OmniSafe: there lam is l, without damping, and moves at every gradient step, so that
    its speed depends on `replay_ratio`. There is one critic of cost, without a floor, whose target
    takes mu(s') without noise, and unit is 1.
    """

    SUITS: ClassVar = {"decay": ("halfcheetah_velocity", "ant_velocity")}  # docs/results/td3

    # Standard deviation of the noise on actions in training, in the boldest environment. OmniSafe has
    # 0.1, too, and `td3` here 0.5. The price is learned for actions with noise, and with so much of it
    # policies without noise cost more on Goal.
    noise_max: Noise = 0.1


@config
class TD3PIDConfig(ControllerConfig, TD3Config):
    """TD3-PID: TD3 whose price on cost is the output of a PID controller.

        maximise_mu  E[(Q_1(s, mu(s)) / unit - lam Q_c(s, mu(s))) / (1 + lam)]
        lam <- (K_p P + I + K_d D)+,   I <- (I + K_i (J_c - cost_limit))+

    once every `dual_every` steps. P is the smoothed J_c - cost_limit. D is what the smoothed J_c rose
    over `pid_delay` moves, and 0 if it fell. unit and the critics are those of TD3-Lagrangian.

    Source: Stooke, Achiam and Abbeel (2020), "Responsive Safety in Reinforcement Learning by PID
    Lagrangian Methods", arXiv:2007.03964, algorithm 2, for the controller.
    Differs from OmniSafe: there the controller runs at every gradient step, on a J_c that only changes
    when an episode ends.
    """


def init(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> dict[str, PyTree]:
    return {"actor": coarse_mlp(cfg, action_size).init(key, jnp.zeros(obs_size))}


def optimisers(cfg: Any, share: jax.Array | float) -> dict[str, optax.GradientTransformation]:
    return {"actor": adam(cfg.lr * share, cfg)}


def followed(params: dict[str, PyTree], targets: dict[str, PyTree], cfg: Any) -> PyTree:
    return targets["actor"]


def deterministic_actor(
    action_size: int,
    critics: int,
    noise: Callable[[jax.Array, tuple[int, ...], Any], jax.Array],
    next_actor: Callable[[dict[str, PyTree], dict[str, PyTree], Any], PyTree] = followed,
) -> Actor:
    """mu(s) = tanh of a network.

    Args:
        noise: (key, shape, cfg) -> what is added to mu'(s').
        next_actor: (params, targets, cfg) -> mu'.
    """

    def before_tanh(actor: PyTree, obs: jax.Array, cfg: Any) -> jax.Array:
        out: Any = coarse_mlp(cfg, action_size).apply(actor, obs)
        return out

    def mu(actor: PyTree, obs: jax.Array, cfg: Any) -> jax.Array:
        return jnp.tanh(before_tanh(actor, obs, cfg))

    def noisy(action: jax.Array, noise: jax.Array) -> jax.Array:
        return jnp.clip(action + noise, -1.0, 1.0)

    def explore(
        params: PyTree, obs: jax.Array, key: jax.Array, cfg: Any, remaining: jax.Array
    ) -> jax.Array:
        sigma = jnp.linspace(cfg.noise_min, cfg.noise_max, obs.shape[0])[:, None]
        sigma *= remaining if cfg.noise_decay else 1.0
        noise = sigma * jax.random.normal(key, (obs.shape[0], action_size))
        return noisy(mu(params["actor"], obs, cfg), noise)

    def act(params: dict[str, PyTree], obs: jax.Array, key: jax.Array | None, cfg: Any) -> jax.Array:
        """Sampled actions have the noise of any environment of training, a new one at each step."""
        action = mu(params["actor"], obs, cfg)
        if key is None:
            return action
        sigma_key, noise_key = jax.random.split(key)
        share = jax.random.uniform(sigma_key, (*action.shape[:-1], 1))
        sigma = cfg.noise_min + (cfg.noise_max - cfg.noise_min) * share
        return noisy(action, sigma * jax.random.normal(noise_key, action.shape))

    def next_action(
        params: dict[str, PyTree], targets: PyTree, obs: jax.Array, key: jax.Array, cfg: Any
    ) -> tuple[jax.Array, jax.Array]:
        action = mu(next_actor(params, targets, cfg), obs, cfg)
        return noisy(action, noise(key, action.shape, cfg)), jnp.zeros(obs.shape[0])

    def propose(params: dict[str, PyTree], obs: jax.Array, key: jax.Array, cfg: Any) -> Proposal:
        x = before_tanh(params["actor"], obs, cfg)
        action = jnp.tanh(x)
        return Proposal(
            action,
            bonus=jnp.zeros(obs.shape[0]),
            extra=cfg.saturation_coef * jnp.mean(x**2, -1),
            metrics={"train/saturated": jnp.mean(jnp.abs(action) > SATURATED, -1)},
        )

    return Actor(
        critics=critics,
        followed=("actor",),
        init=init,
        optimisers=optimisers,
        act=act,
        next_action=next_action,
        propose=propose,
        pick=lambda q: q[0],
        explore=explore,
    )


def smoothing(key: jax.Array, shape: tuple[int, ...], cfg: Any) -> jax.Array:
    noise = cfg.smoothing * jax.random.normal(key, shape)
    return jnp.clip(noise, -cfg.smoothing_clip, cfg.smoothing_clip)


def make(env: Env, axis_name: str | None = None, treatment: Treatment = no_treatment) -> Algorithm:
    actor = deterministic_actor(env.action_size, critics=2, noise=smoothing)
    return off_policy(env, actor_critic(env, actor, treatment), treatment, axis_name)


# OmniSafe @15603dd, configs/off-policy/TD3.yaml and DDPG.yaml: as SAC.yaml, but for the policy's part.
ONE_NOISE: dict[str, Any] = {"noise_min": 0.1, "noise_max": 0.1, "learning_starts": 25_000}


def published(
    base: dict[str, Any],
    navigation: dict[str, Any] | None = None,
    parallel: dict[str, Any] = sac.PARALLEL,
) -> dict[str, Any]:
    """The settings of a row with the treatment's in `base`, if it has one: OmniSafe's for velocity and
    for navigation, and ours for 64 environments, `parallel`."""
    of_sac = {"alpha_init", "alpha_lr", "target_entropy", "policy_delay"}
    omnisafe = {k: v for k, v in sac.OMNISAFE.items() if k not in of_sac} | ONE_NOISE
    rates = {"lr": 5e-6, "critic_lr": 1e-3}
    return {
        "omnisafe": omnisafe | base,
        "omnisafe_navigation": omnisafe | rates | (base if navigation is None else navigation),
        **(sac.priced_parallel(parallel, navigation) if navigation else {"parallel": parallel}),
    }


# The noise that the presets of TD3-Lagrangian for 64 environments were measured with.
BOLD: dict[str, Any] = sac.PARALLEL | {"noise_max": 0.5}

# for a problem of two levers
LEVER: dict[str, Any] = {
    k: v for k, v in sac.LEVER.items() if k not in ("alpha_init", "alpha_lr", "target_entropy")
}

ROWS = {
    "td3": Row(
        TD3Config,
        make,
        "deterministic policy, twin critics, no constraint",
        published({}),
        total_steps=5_000_000,
        holds="nothing",
        omnisafe="TD3",
        lever=LEVER,
    ),
    "td3_lag": Row(
        TD3LagConfig,
        partial(make, treatment=damped_lagrangian),
        "TD3 with an adaptive price on cost",
        published(sac.LAG, sac.LAG_NAVIGATION, BOLD) | {"decay": {"lr_decay": True}},
        total_steps=5_000_000,
        omnisafe="TD3Lag",
        lever=LEVER | sac.LEVER_LAG,
    ),
    "td3_pid": Row(
        TD3PIDConfig,
        partial(make, treatment=pid),
        "TD3 with a price on cost from a PID controller",
        published(sac.PID, sac.PID_NAVIGATION),
        total_steps=5_000_000,
        omnisafe="TD3PID",
        lever=LEVER | sac.LEVER_PID,
    ),
}
