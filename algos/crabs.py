"""CRABS: soft actor-critic within a set of states that a learned certificate finds safe."""

import dataclasses
import math
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import optax

from jaxsafe.algos import sac
from jaxsafe.config import (
    Amount,
    Bounds,
    ConfigError,
    Iterations,
    Rate,
    Share,
    Units,
    Weight,
    config,
)
from jaxsafe.learn.acting import Learned
from jaxsafe.learn.actor_critic import at_every
from jaxsafe.learn.batch import select
from jaxsafe.learn.certificate import (
    CertificateConfig,
    Core,
    System,
    begun,
    certify,
    decayed_adam,
    guarded,
    init_barrier,
    safe_set,
    violating,
    volume,
    walk,
)
from jaxsafe.learn.critics import Values, critic_loss, init_all_critics, targets_of
from jaxsafe.learn.learner import GradientStep, Learner
from jaxsafe.learn.models import (
    FARTHEST,
    EnsembleConfig,
    Fitted,
    ModelRecord,
    fit,
    init_fitted,
    model_of,
    record_by,
    when_due,
    with_model,
)
from jaxsafe.learn.off_policy import off_policy
from jaxsafe.learn.replay import Span, Transitions
from jaxsafe.learn.row import Row
from jaxsafe.learn.steps import Trainable, adam, descend_each, follow
from jaxsafe.learn.treatments import no_treatment
from jaxsafe.nn.critics import q_values, smallest
from jaxsafe.nn.ensemble import outputs_of
from jaxsafe.nn.squashed import squashed_mean, squashed_policy
from jaxsafe.types import Algorithm, Env, Metrics, PyTree, Shared

REFUSED = 1000.0  # what an action with u > 0 is worth less than any other, as in the authors' code
LEAST, MOST = 0.1, 10.0  # adversarial steps for each gradient step, likewise


@config
class CRABSConfig(EnsembleConfig, CertificateConfig, sac.SACConfig):
    """CRABS: soft actor-critic within a set of states that a learned certificate finds safe.

        h(s) = softplus(f(s) - f(s_0)) + B(s) - 1,   C = {s: h(s) < 0}
        u(s, a) = max_m h(T_m(s, a)),                T_m(s, a) the mean of model m
        a certificate (h, pi, T):  u(s, pi(s)) + margin <= 0 for all s in C,  pi(s) the mean action

        acts by       the first of `candidates` actions with u(s, a) <= 0, else pi(s), with h, pi, T of
                      the last certificate
        y           = r + discount (min_i Q'_i(s', a') - alpha log pi(a' | s'))
        minimise_Q    E[1{u(s', a') <= 0} sum_i (Q_i(s, a) - y)^2],                      a' ~ pi(s')
        maximise_pi   E[min_i Q_i(s, a) if u(s, a) <= 0 else -1000 - u(s, a)] + entropy, a ~ pi(s)
        minimise_pi   the mean of u(s, pi(s)) over those s in C that violate the condition
        minimise_f    the mean of u - lam(s) h(s) over those s,  lam = |grad_s u| / |grad_s h|

    The environment gives B, which is at most 1 where a state is safe. Episodes begin at s_0. At each
    refit of the models, f is trained until no violation is found among `chains` states that climb u
    within C. Then h, the policy and the models are the next certificate, and the policy takes fewer of
    its steps against violations. If that takes more than `barrier_steps`, f goes back to that of the
    last certificate, and the policy takes more of these steps. Nothing is proved for all states of C: a
    step can be unsafe where the models are wrong, or where a violation was not found.

    Only the reward and the certificate steer the policy. Where an unsafe step would pay, the reward
    has to charge for it, as those of Move and Swing do.

    The paper is given a safe policy that earns little. Its code loads one for Swing, with models and a
    certificate, which seem to come from training on Upright. Violations before that do not count. Here
    a run of its own makes all three. Until its first certificate CRABS is SAC, and unsafe. Another run
    begins with what the first one has learned, and acts within its certificate from the first step on:

        jaxsafe train algo=crabs env=pendulum_upright run_dir=runs/start
        jaxsafe train algo=crabs env=pendulum_tilt init_from=runs/start

    Both need the same safe set, observations and networks. Move and Swing can begin with a run of the
    same task and `env.task=upright`.

    Source: Luo and Ma (2021), "Learning Barrier Certificates: Towards Safe Reinforcement Learning with
    Zero Training-time Violations", arXiv:2108.01846, and the authors' code, roosephu/crabs @823da6c.
    Differs from it: the models are those of PETS, without gates. States outside of C jump into it; the
    code moves them there by gradient steps. Walks are corrected by the density of their noise; the code
    takes its square. A step into an unsafe state counts for the critics. There are several
    environments, and updates are short. By default the networks are small, and so are the searches.
    `preset=published` has the sizes of the code.
    """

    TAKES_PICTURES: ClassVar = False

    encoder: Literal["none"] = "none"  # There are no pictures: the models learn vectors.
    # Environments side by side, of all devices together. The paper has 1.
    num_envs: Amount = 12
    horizon: Amount = 40  # Steps of each environment in an update. Four updates have those of a refit.
    learn_every: Amount = 4  # Steps of each environment between two rounds of gradient steps.
    # Transitions replayed for each environment step. The paper's code has 85.
    replay_ratio: Amount | Annotated[float, Bounds(1e-6, 1e6)] = 128
    batch_size: Amount = 256  # Transitions of a gradient step, as in the paper.
    # Transitions kept, rounded to whole updates. The paper keeps all of a run.
    replay_size: Annotated[int, Bounds(1, 2**31 - 1)] = 200_000
    # Environment steps before anything is learned, with random actions if there is no certificate. The
    # paper's code has 10,000.
    learning_starts: Annotated[int, Bounds(0, 2**31 - 1)] = 1_920
    hidden: tuple[Units, ...] = (64, 64)  # Units of policy and critics. The paper's critics have 256.
    # Observations are not normalised, because a certificate is for fixed inputs.
    obs_normalize: bool = False
    tau: Share = 0.005  # The share of the critics that their targets take on, as in the paper.
    lr: Rate = 1e-3  # The policy's learning rate, by Adam. The paper has 3e-4.
    critic_lr: Rate = 1e-3  # The critics' learning rate, by Adam. The paper has 3e-4.
    # Whether both learning rates fall linearly to 0 at `total_iterations`.
    lr_decay: bool = False
    # The entropy that SAC's temperature aims at, in nats for each dimension of the action, as in the
    # paper.
    target_entropy: Annotated[float, Bounds(-100, 100)] = -1.0
    # The temperature at first. The paper's code has 1, where rewards are larger.
    alpha_init: Annotated[float, Bounds(1e-10, 1e6)] = 0.1
    cost_limit: Weight = 0.0  # Of an episode, drawn in plots: there is to be no cost.
    model_hidden: tuple[Units, ...] = (64, 64)  # Units of each model. The paper has four layers of 256.
    # Environment steps between two searches for a certificate. The paper's code has 6,000.
    refit_every: Annotated[int, Bounds(1, 2**30)] = 1_920
    max_epochs: Iterations = 1  # Epochs that end a refit anyway.
    # Steps of an epoch. The paper's code has 1,000.
    epoch_steps: Annotated[int, Bounds(0, 2**24)] = 500
    # Actions that are tried before the certified policy takes over. The paper's code has 100.
    candidates: Amount = 20
    adversary_lr: Rate = 3e-4  # Adam's step against violations, as in the paper's code.
    # Gradient steps against violations for each other gradient step, before the first search, as in the
    # paper's code. Searches that fail double it, also those before the first certificate.
    adversary_init: Annotated[float, Bounds(LEAST, MOST)] = 2.0


def candidates_of(
    dist: Any, key: jax.Array, scale: jax.Array, uniform: jax.Array, cfg: Any
) -> jax.Array:
    """Actions to try, float [C, ..., A]: of the policy, ever nearer to its mean action.

        tanh(mean + scale 10^(-3 i / (C - 1)) std noise_i),   i = 0 .. C - 1

    Where `uniform` [..., 1] holds, they are random.
    """
    noise_key, random_key = jax.random.split(key)
    shape = (cfg.candidates, *dist.mean.shape)
    nearer = jnp.logspace(0.0, -3.0, cfg.candidates).reshape(-1, *(1,) * dist.mean.ndim)
    noise = jax.random.normal(noise_key, shape)
    drawn = jnp.tanh(dist.mean + scale * nearer * jnp.exp(dist.log_std) * noise)
    return jnp.where(uniform, jax.random.uniform(random_key, shape, minval=-1.0, maxval=1.0), drawn)


def foresee(model: Fitted, obs: jax.Array, action: jax.Array, cfg: Any) -> jax.Array:
    """Where each model of the ensemble leads on average, float [M, ..., O]."""
    inputs = jnp.concatenate([obs, jnp.clip(action, -1.0, 1.0)], -1)
    every = jnp.broadcast_to(inputs, (cfg.models, *inputs.shape))
    change = outputs_of(model.ensemble, model.scale, every).mean
    return jnp.clip(obs + change, -FARTHEST, FARTHEST)


# ---- violations and certificates ---------------------------------------------------------------


def core_of(params: dict[str, PyTree]) -> Core:
    return Core(params["barrier"], params["actor"], params["model"])


def resist(here: System, nets: Trainable, cfg: Any) -> tuple[Trainable, Metrics]:
    """A step of the search for violations, and the policy's steps against them that are due."""
    state = nets.opt_state
    optimiser = decayed_adam(cfg.adversary_lr, cfg.barrier_decay)
    search = walk(here, core_of(nets.params), state["search"], cfg)

    def against(_: jax.Array, now: tuple) -> tuple:
        policy, opt_state, _ = now
        core = core_of(nets.params | {"actor": policy})

        def loss(policy: PyTree) -> tuple[jax.Array, jax.Array]:
            h, u = here.judge(dataclasses.replace(core, actor=policy), search.obs, cfg)
            counts = violating(h, u)
            return jnp.where(counts, u, 0.0).sum() / jnp.maximum(counts.sum(), 1), counts.mean()

        grads, violated = jax.grad(loss, has_aux=True)(policy)
        change, new_state = optimiser.update(grads, opt_state, policy)
        moved = (optax.apply_updates(policy, change), new_state)
        return *select(violated > 0, moved, (policy, opt_state)), violated

    owed = state["owed"] + state["pressure"] * nets.params["certified"]
    due = jnp.floor(owed)
    begin = nets.params["actor"], state["adversary"], jnp.float32(jnp.nan)
    policy, adversary, violated = jax.lax.fori_loop(0, due.astype(jnp.int32), against, begin)
    params = nets.params | {"actor": policy}
    state = state | {"search": search, "adversary": adversary, "owed": owed - due}
    return Trainable(params, state), {"train/violating": violated}


def renew(here: System, nets: Trainable, cfg: Any) -> tuple[Trainable, Metrics]:
    """The next certificate, of the present policy and models, if one is found; else the last one."""
    params, state = nets
    core, safe, certified = core_of(params), params["safe"], params["certified"]
    keep = cfg.barrier_keep * certified
    found = certify(here, core, safe.barrier, keep, state["barrier"], state["search"], cfg)
    new = dataclasses.replace(core, barrier=found.barrier)
    # back to the last certificate, if there is one
    rejected = select(certified > 0, safe.barrier, found.barrier)
    factor = jnp.where(found.at_once, 1 / 2, 1 / 1.2)
    pressure = state["pressure"] * jnp.where(found.certified, factor, 2.0)
    params = params | {
        "barrier": select(found.certified, found.barrier, rejected),
        "safe": select(found.certified, new, safe),
        "certified": jnp.maximum(certified, found.certified),
    }
    state = state | {
        "barrier": found.opt_state,
        "search": found.search,
        "pressure": jnp.clip(pressure, LEAST, MOST),
    }
    found_volume = volume(here, found.barrier, found.search, cfg)
    return Trainable(params, state), {
        "train/certified": found.certified.astype(jnp.float32),
        "train/certified_volume": jnp.where(found.certified, found_volume, jnp.nan),
        "train/barrier_steps": found.steps.astype(jnp.float32),
        "train/pressure": state["pressure"],
    }


# ---- the learner -------------------------------------------------------------------------------


def crabs(env: Env) -> Learner:
    actor = sac.soft_actor(env.action_size)

    def system(cfg: Any) -> System:
        if cfg.obs_normalize:
            raise ConfigError("obs_normalize=True: a certificate is for observations as they are")
        safe, start = safe_set(env), env.reset(jax.random.key(0)).obs

        def mean_action(actor: PyTree, obs: jax.Array, cfg: Any) -> jax.Array:
            return squashed_mean(squashed_policy(actor, obs, env.action_size, cfg))

        return System(safe, start, mean_action, foresee)

    def init(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> Trainable:
        actor_key, critic_key, model_key, barrier_key, search_key = jax.random.split(key, 5)
        parts = actor.init(actor_key, obs_size, action_size, cfg)
        critics = init_all_critics(critic_key, (obs_size, action_size), 2, no_treatment, cfg)
        barrier = init_barrier(barrier_key, obs_size, cfg)
        model = init_fitted(model_key, env, cfg)
        trained = parts | critics
        optimisers = actor.optimisers(cfg, 1.0) | {"critic_r": adam(cfg.critic_lr, cfg)}
        params = trained | {"targets": critics, "model": model.params, "barrier": barrier}
        params |= {"safe": core_of(params), "certified": jnp.zeros(())}
        opt_state = {name: optimisers[name].init(part) for name, part in trained.items()}
        opt_state |= {
            "model": model.opt_state,
            "barrier": decayed_adam(0.0, 0.0).init(barrier),
            "adversary": decayed_adam(0.0, 0.0).init(parts["actor"]),
            "search": begun(system(cfg), barrier, search_key, cfg),
            "pressure": jnp.asarray(cfg.adversary_init, jnp.float32),
            "owed": jnp.zeros(()),
        }
        return Trainable(params, opt_state)

    # ---- acting --------------------------------------------------------------------------------

    def kept(learned: Learned, obs: jax.Array, tried: jax.Array) -> jax.Array:
        """The first of `tried` [C, ..., A] that the certificate allows; without one, the first."""
        cfg, params = learned.config, learned.params
        action, _ = guarded(system(cfg), params["safe"], obs, tried, cfg)
        return jnp.where(params["certified"] > 0, action, tried[0])

    def act(learned: Learned, obs: jax.Array, key: jax.Array | None) -> jax.Array:
        cfg = learned.config
        dist = squashed_policy(learned.params["actor"], obs, env.action_size, cfg)
        if key is None:
            return kept(learned, obs, squashed_mean(dist)[None])
        no = jnp.zeros((*obs.shape[:-1], 1), bool)
        return kept(learned, obs, candidates_of(dist, key, jnp.ones(()), no, cfg))

    def explore(learned: Learned, obs: jax.Array, key: jax.Array, remaining: jax.Array) -> jax.Array:
        """A third of the environments each has the policy's noise, twice that, and random actions."""
        cfg = learned.config
        dist = squashed_policy(learned.params["actor"], obs, env.action_size, cfg)
        third = (jnp.arange(len(obs)) % 3)[:, None]
        scale = jnp.where(third == 1, 2.0, 1.0)
        # without a certificate nothing holds random actions back, so that episodes would be short
        uniform = (third == 2) & (learned.params["certified"] > 0)
        return kept(learned, obs, candidates_of(dist, key, scale, uniform, cfg))

    def random_start(learned: Learned) -> jax.Array:
        return learned.params["certified"] == 0

    # ---- learning ------------------------------------------------------------------------------

    def step(
        nets: Trainable, batch: Transitions, at: GradientStep, cfg: Any, axis_name: str | None
    ) -> tuple[Trainable, Metrics]:
        critic_key, policy_key = jax.random.split(at.key)
        share = at.remaining if cfg.lr_decay else 1.0
        here, params = system(cfg), nets.params

        action, bonus = actor.next_action(params, params["targets"], batch.next_obs, critic_key, cfg)
        v = q_values(params["targets"]["critic_r"], batch.next_obs, action, cfg).min(0) + bonus
        y = targets_of(batch, jnp.zeros_like(v), Values(v, jnp.zeros_like(v)), (), cfg)
        free = params["certified"] == 0
        allowed = here.u(core_of(params), batch.next_obs, action, cfg) <= 0
        counted = batch._replace(weight=batch.weight * (allowed | batch.terminated | free))

        def errors(critics: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            return critic_loss(critics, counted, y, (), cfg)

        optimisers = {"critic_r": adam(cfg.critic_lr * share, cfg)}
        nets, metrics = descend_each(errors, nets, optimisers, axis_name)

        def loss(parts: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            made = actor.propose(parts, batch.obs, policy_key, cfg)
            q = smallest(q_values(nets.params["critic_r"], batch.obs, made.action, cfg))
            u = here.u(core_of(params), batch.obs, made.action, cfg)
            refused = (u > 0) & ~free
            climbed = batch.mean(jnp.where(refused, -REFUSED - u, q) + made.bonus)
            found = made.metrics | {"train/refused": refused.astype(jnp.float32)}
            metrics = {"train/actor_loss": -climbed, **jax.tree.map(batch.mean, found)}
            return batch.mean(made.extra) - climbed, metrics

        def improve(nets: Trainable) -> tuple[Trainable, Metrics]:
            nets, found = descend_each(loss, nets, actor.optimisers(cfg, share), axis_name)
            return follow(nets, cfg.tau), found

        nets, found = at_every(cfg.policy_delay, at.number, improve, nets)
        nets, more = resist(here, nets, cfg)
        return nets, metrics | found | more

    def refit(
        nets: Trainable,
        replay: ModelRecord,
        shared: Shared,
        key: jax.Array,
        cfg: Any,
        axis_name: str | None,
    ) -> tuple[Trainable, Metrics]:
        here = system(cfg)

        def learn(span: Span) -> tuple[Trainable, Metrics]:
            model, metrics = fit(model_of(nets), replay, span, key, cfg, axis_name)
            renewed, found = renew(here, with_model(nets, model), cfg)
            return renewed, metrics | found

        return when_due(learn, nets, replay, shared, cfg, axis_name)

    return Learner(init, step, act, explore, random_start, refit=refit, record=record_by)


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return off_policy(env, crabs(env), no_treatment, axis_name)


# roosephu/crabs @823da6c, configs/Swing-train_policy.json5 and run/main.py, for one environment
PUBLISHED: dict[str, Any] = {
    "num_envs": 1, "horizon": 60, "learn_every": 3, "stagger": False, "replay_size": 1_000_000,
    "replay_ratio": 256 / 3, "learning_starts": 10_000, "hidden": (256, 256), "layer_norm": False,
    "lr": 3e-4, "critic_lr": 3e-4, "alpha_init": 1.0, "alpha_lr": 3e-4, "max_grad_norm": math.inf,
    "model_hidden": (256, 256, 256, 256), "refit_every": 6000, "epoch_steps": 1000, "candidates": 100,
    "barrier_hidden": (256, 256), "barrier_lr": 3e-4, "chains": 10_000, "barrier_steps": 20_000,
    "quiet_steps": 1000, "check_steps": 4000,
}  # fmt: skip

ROWS = {
    "crabs": Row(
        CRABSConfig,
        make,
        "soft actor-critic within a set that a learned certificate finds safe",
        {"published": PUBLISHED},
        omnisafe="CRABS",
        total_steps=600_000,
        holds="episode",
    ),
}
