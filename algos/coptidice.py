"""Constrained optimisation of a policy's visits, by their ratio to those of the data."""

from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp

from jaxsafe.algos import bc
from jaxsafe.config import Bounds, Rate, Real, Share, Weight, config
from jaxsafe.learn.acting import Learned
from jaxsafe.learn.constraints import each
from jaxsafe.learn.conventions import Convention
from jaxsafe.learn.learner import GradientStep, Learner
from jaxsafe.learn.offline import (
    OfflinePriceConfig,
    OfflineValueConfig,
    constrained,
    decaying_adam,
    need_episodes,
    offline,
)
from jaxsafe.learn.replay import Transitions
from jaxsafe.learn.row import Row
from jaxsafe.learn.steps import Trainable, descend_each, skipping_adam
from jaxsafe.learn.treatments import lagrangian, price_of
from jaxsafe.nn.bounded import bounded_action, bounded_policy, init_bounded
from jaxsafe.nn.gaussian import log_prob
from jaxsafe.nn.networks import coarse_mlp
from jaxsafe.types import Algorithm, Env, Metrics, PyTree

TAU_MIN = 1e-6  # as in the authors' code


@config
class COptiDICEConfig(OfflinePriceConfig, OfflineValueConfig):
    """COptiDICE: finds how often the best safe policy would visit each state and action of the data.

        e = r - lam c + discount (1 - terminated) nu(s') - nu(s)
        w = max(0, f'^-1(e / alpha)),   f(w) = w (log w - 1) + 1 below 1, (w - 1)^2 / 2 above
        minimise_nu   (1 - discount) E[nu(s_0)] + E[w e - alpha f(w)]
        l = (1 - discount) chi(s_0) + w (c + discount (1 - terminated) chi(s') - chi(s))
        minimise_chi  E[W l],   W = exp(l / tau) / E[exp(l / tau)]
        minimise_tau  tau (cost_divergence - E[W log W]),   tau >= 0
        minimise_lam  -lam (J_c - cost_limit),  lam >= 0,   J_c = T E[W w c]
        maximise_pi   E[w log pi(a | s)]

    all by Adam and at each gradient step. w is the ratio of the policy's visits to those of the data.
    E[w c] is then the policy's cost at a step. E[W w c] bounds it from above: W is the worst weighting
    of the batch within a KL of `cost_divergence`. T is the steps of an episode. s_0 are the first
    observations of the episodes of the data. The policy is a Gaussian about a mean in (-1, 1).

    e is of one transition. Where rewards or next states are random, a lucky one has a larger e, and w
    takes its luck for the merit of the action.

    Source: Lee et al. (2022), "COptiDICE: Offline Constrained Reinforcement Learning via Stationary
    Distribution Correction Estimation", arXiv:2204.08957, sections 3 and 4, and the authors' code.
    Differs from it: lam and tau are no exponentials, the policy is one Gaussian instead of several, and
    nu and chi have no penalty on their slopes.
    Differs from OmniSafe: there each reward of a batch is paired with the values of every other
    transition, so that e, w and l are of B x B pairs. And the multiplier is told E[w c]. The published
    numbers depend on the former (`compat=omnisafe`).
    """

    CONVENTIONS: ClassVar = (
        Convention(
            {"pairs": "all"},
            "COptiDICE pairs a reward, a cost and an end with the values of all transitions of a batch",
            "with the values of its own transition",
        ),
        Convention(
            {"price_on": "mean"},
            "COptiDICE's multiplier is told the cost of the policy's visits, E[w c]",
            "it is told a bound of that, E[W w c], as in the paper",
        ),
    )

    # Whose values a transition's reward, cost and end go with. own: its own. all: those of every
    # transition of the batch, as in OmniSafe.
    pairs: Literal["own", "all"] = "own"
    # What the price is on. bound: E[W w c], as in the paper. mean: E[w c], as in OmniSafe.
    price_on: Literal["bound", "mean"] = "bound"

    # How much it costs to depart from the data's visits, in units of reward, as in the paper's code.
    alpha: Annotated[float, Bounds(1e-8, 1e6)] = 0.01
    # The KL within which costs are weighted, in nats, as in the paper's code.
    cost_divergence: Weight = 0.01
    tau_init: Annotated[float, Bounds(TAU_MIN, 1e6)] = 1.0  # As in the paper's code.
    tau_lr: Rate = 3e-4  # The learning rate of tau, by Adam, as in the paper's code.
    lr: Rate = 3e-4  # The policy's learning rate, by Adam, as in the paper's code.
    critic_lr: Rate = 3e-4  # The learning rate of nu and chi, by Adam, as in the paper's code.
    # The log standard deviation of actions at first, as in OmniSafe.
    init_log_std: Real = 0.0
    # The discount of costs, only for evaluation's discounted cost. nu and chi both have `discount`.
    cost_discount: Share = 0.99


def f(w: jax.Array) -> jax.Array:
    """The soft chi-square divergence's generator, of w >= 0."""
    low = jnp.clip(w, 1e-10, 1.0)
    return jnp.where(w < 1, low * (jnp.log(low) - 1) + 1, 0.5 * (w - 1) ** 2)


def inverse_slope(x: jax.Array) -> jax.Array:
    """f'^-1: exp(x) below 0, x + 1 above. It is positive, and so it is w."""
    return jnp.where(x < 0, jnp.exp(jnp.minimum(x, 0.0)), x + 1)


def worst_case(ell: jax.Array, tau: jax.Array) -> tuple[jax.Array, jax.Array]:
    """W, with mean 1 over the first axis, and E[W log W], of l [B] or [B, B] and tau []."""
    log_weight = jax.nn.log_softmax(ell / tau, axis=0) + jnp.log(ell.shape[0])
    weight = jnp.exp(log_weight)
    return weight, (weight * log_weight).mean()


def learner(env: Env) -> Learner:
    names = lagrangian.constrained_costs

    def nu_of(net: PyTree, obs: jax.Array, cfg: Any) -> jax.Array:
        out: Any = coarse_mlp(cfg, 1, cfg.layer_norm).apply(net, obs)
        return out[..., 0]

    def chi_of(net: PyTree, obs: jax.Array, cfg: Any) -> jax.Array:
        """Float [B] or, of several constraints, [B, K]."""
        count = len(names(cfg))
        out: Any = coarse_mlp(cfg, count or 1, cfg.layer_norm).apply(net, obs)
        return out if count else out[..., 0]

    def init(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> Trainable:
        actor_key, nu_key, chi_key = jax.random.split(key, 3)
        count, obs = len(names(cfg)), jnp.zeros(obs_size)
        params = {
            "actor": init_bounded(actor_key, obs_size, action_size, cfg),
            "nu": coarse_mlp(cfg, 1, cfg.layer_norm).init(nu_key, obs),
            "chi": coarse_mlp(cfg, count or 1, cfg.layer_norm).init(chi_key, obs),
            "tau": jnp.full((count,) if count else (), cfg.tau_init, jnp.float32),
        }
        return Trainable(
            params, {name: skipping_adam(cfg.lr, cfg).init(x) for name, x in params.items()}
        )

    def act(learned: Learned, obs: jax.Array, key: jax.Array | None) -> jax.Array:
        return bounded_action(bounded_policy(learned.params["actor"], obs, learned.config), key)

    def step(
        nets: Trainable, batch: Transitions, at: GradientStep, cfg: Any, axis_name: str | None
    ) -> tuple[Trainable, Metrics]:
        params, several = nets.params, names(cfg)
        cost = constrained(batch, several)
        price = price_of(cost, at.dual)

        def paired(x: jax.Array) -> jax.Array:
            """What goes with values [B]: `x` [B], or [B, 1] where it goes with all of them."""
            return x[:, None] if cfg.pairs == "all" else x

        def later(value: jax.Array) -> jax.Array:
            return cfg.discount * jnp.where(paired(batch.terminated), 0.0, value)

        def surprise(nu: PyTree) -> jax.Array:
            """e, float [B] or [B, B]."""
            here, ahead = nu_of(nu, batch.obs, cfg), nu_of(nu, batch.next_obs, cfg)
            return paired(batch.reward - price) + later(ahead) - here

        def nu_loss(net: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            e = surprise(net["nu"])
            w = inverse_slope(e / cfg.alpha)
            begin = (1 - cfg.discount) * nu_of(net["nu"], at.first_obs, cfg).mean()
            loss = begin + (w * e - cfg.alpha * f(w)).mean()
            return loss, {"train/nu_loss": loss, "train/weight": w.mean()}

        w = inverse_slope(surprise(params["nu"]) / cfg.alpha)

        def chi_loss(net: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            here, ahead, begin = (
                chi_of(net["chi"], x, cfg) for x in (batch.obs, batch.next_obs, at.first_obs)
            )

            def ell_of(
                cost: jax.Array, here: jax.Array, ahead: jax.Array, begin: jax.Array
            ) -> jax.Array:
                return (1 - cfg.discount) * begin + w * (paired(cost) + later(ahead) - here)

            def mean(x: jax.Array) -> jax.Array:
                return x.mean(tuple(range(w.ndim)))

            ell = each(ell_of, several)(cost, here, ahead, begin)
            ell_now = jax.lax.stop_gradient(ell)
            weight, divergence = each(worst_case, several)(ell_now, params["tau"])
            visited = each(lambda x: w * paired(x), several)(cost)
            bound = mean(visited if cfg.price_on == "mean" else weight * visited)
            loss = mean(weight * ell)
            metrics = {
                "train/chi_loss": loss,
                "train/cost_divergence": divergence,
                "train/cost_estimate": env.episode_length * bound,
            }
            return loss.sum(), metrics

        def policy_loss(net: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            log_pi = log_prob(bounded_policy(net["actor"], batch.obs, cfg), batch.action)
            loss = -(w * log_pi).mean()
            return loss, {"train/actor_loss": loss}

        critic_adam = decaying_adam(cfg.critic_lr, at, cfg)
        nets, of_nu = descend_each(nu_loss, nets, {"nu": critic_adam})
        nets, of_chi = descend_each(chi_loss, nets, {"chi": critic_adam})
        nets, of_policy = descend_each(policy_loss, nets, {"actor": decaying_adam(cfg.lr, at, cfg)})

        def tau_loss(net: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            loss = net["tau"] * (cfg.cost_divergence - of_chi["train/cost_divergence"])
            return loss.sum(), {"train/tau": net["tau"]}

        nets, of_tau = descend_each(tau_loss, nets, {"tau": skipping_adam(cfg.tau_lr, cfg)})
        tau = jnp.maximum(nets.params["tau"], TAU_MIN)
        nets = nets._replace(params=nets.params | {"tau": tau})
        return nets, of_nu | of_chi | of_policy | of_tau

    return Learner(init=init, act=act, step=step)


def check(cfg: Any, env: Env, data: Any) -> None:
    need_episodes(data, "coptidice learns from the first observations of episodes")


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    """`axis_name` splits nothing here: there are no environments."""
    return offline(env, learner(env), lagrangian)


# OmniSafe @15603dd, configs/offline/COptiDICE.yaml: its limit of 0.06 is on the cost of a step
# of Circle's 500
OMNISAFE: dict[str, Any] = bc.OMNISAFE | {
    "alpha": 8e-4, "cost_divergence": 0.05, "tau_lr": 3e-3, "lr": 3e-3, "critic_lr": 3e-3,
    "dual_lr": 0.035, "lam_init": 0.0, "cost_limit": 30.0,
}  # fmt: skip

ROWS = {
    "coptidice": Row(
        COptiDICEConfig,
        make,
        "finds the visits of the best safe policy within a data set",
        {"omnisafe": OMNISAFE},
        omnisafe="COptiDICE",
        lever={"hidden": (64,), "discount": 0.9, "alpha": 0.03, "lr": 1e-3, "batch_size": 1024},
        check=check,
    )
}
