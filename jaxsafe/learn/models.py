"""Models of an environment: an ensemble that is fitted to the replay, and the simulator itself.

A particle is one course of events that a model thinks possible. Particles have axes of their own, in
every array: [M, P, S] are P particles of each of M models for each of S plans.

The ensemble predicts (reward, [cost,] next obs - obs) from (obs, action). A particle keeps its model
for the whole plan and draws each step from that model's Gaussian: TS-infinity in the paper.

Source: Chua et al. (2018), "Deep Reinforcement Learning in a Handful of Trials using Probabilistic
    Dynamics Models", arXiv:1805.12114; the stopping rule is that of Janner et al. (2019), "When to
    Trust Your Model: Model-Based Policy Optimization", arXiv:1906.08253, and its code.
"""

from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import optax

from jaxsafe.config import Amount, Bounds, ConfigError, Iterations, Rate, Units, Weight, config
from jaxsafe.learn.batch import (
    all_finite,
    device_count,
    device_key,
    pmean,
    psum,
    select_rows,
)
from jaxsafe.learn.next_step_rollout import Stepping, arrival_record
from jaxsafe.learn.replay import Record, Span, held
from jaxsafe.learn.steps import Trainable
from jaxsafe.nn.ensemble import (
    Ensemble,
    Scale,
    draw,
    ensemble_loss,
    init_ensemble,
    outputs_of,
    unscaled,
)
from jaxsafe.types import Env, Metrics, PyTree, Shared, State

FARTHEST = 100.0  # no predicted observation is larger, as in OmniSafe
HOLDOUT_BATCH = 512  # rows of each model at once
BETTER = 0.99  # times the best hold-out error is an improvement, as in the code of Janner et al.
LEAST_STD = 1e-12  # of an input; a smaller one counts as 1, as in the code of Chua et al.


@config
class EnsembleConfig:
    """For algorithms with an ensemble that predicts where an action leads."""

    # A number that the environment reports, such as goal_met. Steps on which it is not 0 are kept from
    # the model, as a new goal does not follow from the action. As in OmniSafe.
    jump: str = "goal_met"
    models: Amount = 5  # Networks of the ensemble, as in the paper.
    # Units of the hidden layers of each, as in the paper.
    model_hidden: tuple[Units, ...] = (200, 200, 200, 200)
    # Environment steps between two refits of the model, of all environments together; rounded to whole
    # updates. OmniSafe refits every 1,200 raw steps of its only environment.
    refit_every: Annotated[int, Bounds(1, 2**30)] = 1280
    model_lr: Rate = 1e-3  # Adam's step of the model, as in the paper.
    # Transitions of a step of each model, of all devices together, drawn with replacement. As in
    # OmniSafe.
    model_batch: Amount = 256
    # The decay of the last layer's weights. The other layers have 1/4 to 3/4 of it. As in the paper.
    weight_decay: Weight = 1e-4
    # Transitions are kept from training with this probability, to measure the error. As in OmniSafe.
    holdout: Annotated[float, Bounds(0.01, 0.99)] = 0.2
    # Epochs without an improvement by 1% that end a refit, as in OmniSafe.
    patience: Iterations = 6
    max_epochs: Iterations = 1000  # Epochs that end a refit anyway. OmniSafe has no bound.
    # Steps of an epoch. 0 is as many as one pass over the data has.
    epoch_steps: Annotated[int, Bounds(0, 2**24)] = 0

    @property
    def told(self) -> tuple[str, ...]:
        """What the ensemble predicts beside the next observation."""
        return ()

    @property
    def fit_dtype(self) -> str:
        """What hidden layers are computed in while the ensemble is fitted."""
        return "float32"


@config
class ModelConfig(EnsembleConfig):
    """For algorithms with a model of the environment."""

    # Whether the model is the simulator itself, which foresees its random numbers, too. The policy
    # then needs the simulator wherever it acts.
    true_model: bool = False
    # Whether the model learns the cost. If not, the environment computes it from the observation, as
    # those of Goal 0 and 1 do with env.observation=coordinates. OmniSafe learns it in velocity tasks.
    learn_cost: bool = True
    # Whether a plan sees that an episode ends, where the environment tells that from the observation,
    # as velocity tasks do. OmniSafe's plans do not. The simulator always sees it.
    foresee_end: bool = True
    # What the model's hidden layers are computed in. bfloat16, which has 8 bits, halves what a GPU has
    # to move. On an H100 or H200 with Warp networks and draw are one kernel then, with other random
    # numbers.
    model_dtype: Literal["float32", "bfloat16"] = "float32"

    @property
    def told(self) -> tuple[str, ...]:
        return ("reward", "cost") if self.learn_cost else ("reward",)

    @property
    def fit_dtype(self) -> str:
        return self.model_dtype


class Prediction(NamedTuple):
    """What a model says of a step of particles [M, P, S].

    latent: pytree [M, P, S, ...], where they are now. reward, cost, spread: float [M, P, S]; spread is
    the length of the vector of standard deviations. end: bool [M, P, S], the episode has terminated.
    """

    latent: PyTree
    reward: jax.Array
    cost: jax.Array
    spread: jax.Array
    end: jax.Array


class Model(NamedTuple):
    """A model of an environment.

    particles(cfg) -> (M, P).
    predict(fitted, latent, action [M, P, S, A], key, cfg) -> Prediction, for a latent that was an
        observation, or the environment's State, when the plan began.
    observe(latent) -> obs [..., O].
    """

    particles: Callable[[Any], tuple[int, int]]
    predict: Callable[[PyTree, PyTree, jax.Array, jax.Array, Any], Prediction]
    observe: Callable[[PyTree], jax.Array]


# ---- the simulator -----------------------------------------------------------------------------


def simulator(env: Env) -> Model:
    """The environment as its own model. The latent is its State."""
    step = jax.vmap(jax.vmap(jax.vmap(env.step)))

    def predict(
        fitted: PyTree, latent: State, action: jax.Array, key: jax.Array, cfg: Any
    ) -> Prediction:
        after = step(latent, action)
        return Prediction(
            after, after.reward, after.cost, jnp.zeros_like(after.reward), after.terminated
        )

    return Model(lambda cfg: (1, 1), predict, lambda latent: latent.obs)


# ---- the ensemble ------------------------------------------------------------------------------


@flax.struct.dataclass
class Fitted:
    """An ensemble, and the scale of its inputs."""

    ensemble: Ensemble
    scale: Scale


def learned_model(env: Env) -> Model:
    """The ensemble as a model. The latent is an observation, which may tell the end of an episode."""
    ends = getattr(env, "observed_end", None)

    def predict(
        fitted: Fitted, latent: jax.Array, action: jax.Array, key: jax.Array, cfg: Any
    ) -> Prediction:
        inputs = jnp.concatenate([latent, jnp.clip(action, -1.0, 1.0)], -1)
        out, spread = draw(fitted.ensemble, fitted.scale, inputs, key, cfg.model_dtype)
        obs = jnp.clip(latent + out[..., -env.obs_size :], -FARTHEST, FARTHEST)
        cost = out[..., 1] if cfg.learn_cost else observed_cost(env)(obs)
        end = ends(obs) if ends and cfg.foresee_end else jnp.zeros(cost.shape, bool)
        return Prediction(obs, out[..., 0], cost, spread, end)

    return Model(lambda cfg: (cfg.models, cfg.particles), predict, lambda latent: latent)


def observed_cost(env: Env) -> Callable[[jax.Array], jax.Array]:
    """What gives the cost [...] of a step after which [..., O] is observed.

    Raises:
        ConfigError: the environment does not say.
    """
    cost = getattr(env, "observed_cost", None)
    if cost is None:
        raise ConfigError(
            "learn_cost=False: observations of this environment do not tell the cost; those of Goal 0 "
            "and 1 do with env.observation=coordinates; in Goal 2 vases cost, too"
        )
    return cost


def init_model(key: jax.Array, env: Env, cfg: Any) -> Trainable:
    """What is fitted of a model, `Fitted`, and its optimiser's state; () of the simulator."""
    if cfg.true_model:
        return Trainable((), ())
    if not cfg.learn_cost:
        observed_cost(env)
    return init_fitted(key, env, cfg)


def init_fitted(key: jax.Array, env: Env, cfg: Any) -> Trainable:
    """An ensemble, `Fitted`, and its optimiser's state."""
    inputs, outputs = env.obs_size + env.action_size, len(cfg.told) + env.obs_size
    ensemble: PyTree = init_ensemble(key, cfg.models, inputs, cfg.model_hidden, outputs)
    opt_state = jax.vmap(optimiser_of(cfg).init)(ensemble)
    return Trainable(Fitted(ensemble, unscaled(inputs)), opt_state)


def optimiser_of(cfg: Any) -> optax.GradientTransformation:
    """Of one model. Over the models its functions are mapped, so that each has a count of its own."""
    return optax.adam(cfg.model_lr)


def model_of(nets: Trainable) -> Trainable:
    """The model among what a learner trains."""
    return Trainable(nets.params["model"], nets.opt_state["model"])


def with_model(nets: Trainable, model: Trainable) -> Trainable:
    return Trainable(nets.params | {"model": model.params}, nets.opt_state | {"model": model.opt_state})


# ---- data --------------------------------------------------------------------------------------


@flax.struct.dataclass
class ModelRecord(Record):
    """jump: bool [...], `obs` does not follow from what came before, as where a new goal is drawn."""

    jump: jax.Array


def record_by(cfg: Any) -> Callable[[Stepping, jax.Array], ModelRecord]:
    """What makes rows for a replay that a model learns from."""

    def record(stepping: Stepping, action: jax.Array) -> ModelRecord:
        row = arrival_record(stepping, action)
        jump = stepping.rollout.state.info.get(cfg.jump, jnp.zeros_like(row.reward)) != 0
        return ModelRecord(**vars(row), jump=jump)

    return record


def learnable(ring: ModelRecord, span: Span) -> jax.Array:
    """Where the ring holds a transition that the model can learn from, bool [R, N]: it leads to the
    next row, within an episode, without a jump and to something finite."""
    rows = ring.reward.shape[1]
    position = (jnp.arange(rows) - span.oldest) % rows
    has_next = position < span.count - 1
    arrives = ~ring.jump & jnp.isfinite(ring.reward) & jnp.isfinite(ring.cost)
    return (has_next & ~ring.last & jnp.roll(arrives, -1, axis=1)).T


def transitions_at(ring: ModelRecord, flat: jax.Array, cfg: Any) -> tuple[jax.Array, jax.Array]:
    """Inputs [..., I] and targets [..., K] of the transitions that begin at entries `flat` [...] of a
    ring, counted row by row: first row 0 of every environment."""
    num_envs, rows = ring.reward.shape
    row, env = flat // num_envs, flat % num_envs
    now = jax.tree.map(lambda x: x[env, row], (ring.obs, ring.action))
    kept = (ring.obs, *(getattr(ring, name) for name in cfg.told))
    obs, *told = jax.tree.map(lambda x: x[env, (row + 1) % rows], kept)
    inputs = jnp.concatenate([now[0], jnp.clip(now[1], -1.0, 1.0)], -1)
    return inputs, jnp.concatenate([*(x[..., None] for x in told), obs - now[0]], -1)


def scale_of(ring: ModelRecord, mask: jax.Array, axis_name: str | None) -> Scale:
    """Mean and standard deviation of the inputs where `mask` [R, N] holds, over all devices."""
    count = jnp.maximum(psum(mask.sum(), axis_name), 1)
    mask = mask.T[..., None]  # as in the ring

    def mean(x: jax.Array) -> jax.Array:
        return psum(jnp.where(mask, x, 0.0).sum((0, 1)), axis_name) / count

    def mean_and_std(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        centre = mean(x)
        return centre, jnp.sqrt(mean((x - centre) ** 2))

    parts = mean_and_std(ring.obs), mean_and_std(jnp.clip(ring.action, -1.0, 1.0))
    centre, std = (jnp.concatenate(x) for x in zip(*parts, strict=True))
    return Scale(centre, jnp.where(std < LEAST_STD, 1.0, std))


# ---- fitting -----------------------------------------------------------------------------------


class Rows(NamedTuple):
    """Some entries of a ring: the first `count` [] of `flat`, int32 [R N]. What follows is padding."""

    flat: jax.Array
    count: jax.Array


def rows_where(mask: jax.Array) -> Rows:
    flat = jnp.nonzero(mask.reshape(-1), size=mask.size, fill_value=0)[0]
    return Rows(flat.astype(jnp.int32), mask.sum())


class Fit(NamedTuple):
    """A refit so far. best, error [M]: each model where its hold-out error was least. stale: int32 [],
    epochs since any model became better."""

    ensemble: Ensemble
    opt_state: PyTree
    best: Ensemble
    error: jax.Array
    stale: jax.Array
    epochs: jax.Array
    skipped: jax.Array


def fit(
    model: Trainable,
    ring: ModelRecord,
    span: Span,
    key: jax.Array,
    cfg: Any,
    axis_name: str | None = None,
) -> tuple[Trainable, Metrics]:
    """`model`, as of `init_model`, after training on all that the ring holds, from where it is.

    Epoch by epoch, until for `patience` epochs no model's hold-out error has fallen below 99% of its
    least. Each model is then put back to where its error was least. An epoch does not move a model that
    is not finite at its end.
    """
    split_key, key = jax.random.split(device_key(key, axis_name))
    usable = learnable(ring, span)
    kept = jax.random.uniform(split_key, usable.shape) < cfg.holdout
    train, held_out = rows_where(usable & ~kept), rows_where(usable & kept)
    scale = scale_of(ring, usable & ~kept, axis_name)
    batch = (cfg.models, cfg.model_batch // device_count(axis_name))
    steps = jnp.maximum(psum(train.count, axis_name) // cfg.model_batch, 1)
    steps = jnp.int32(cfg.epoch_steps) if cfg.epoch_steps else steps
    update = jax.vmap(optimiser_of(cfg).update)

    def errors(ensemble: Ensemble) -> jax.Array:
        """Of each model on all that is held out: mean squared error, float [M]."""

        def more(i: jax.Array, total: jax.Array) -> jax.Array:
            at = i * HOLDOUT_BATCH + jnp.arange(HOLDOUT_BATCH)
            x, y = transitions_at(ring, held_out.flat.at[at].get(mode="clip"), cfg)
            every = jnp.broadcast_to(x, (cfg.models, *x.shape))
            off = ((outputs_of(ensemble, scale, every).mean - y) ** 2).mean(-1)  # [M, B]
            return total + jnp.where(at < held_out.count, off, 0.0).sum(-1)

        batches = -(-held_out.count // HOLDOUT_BATCH)
        total = jax.lax.fori_loop(0, batches, more, jnp.zeros(cfg.models))
        return psum(total, axis_name) / jnp.maximum(psum(held_out.count, axis_name), 1)

    def epoch(now: Fit) -> Fit:
        epoch_key = jax.random.fold_in(key, now.epochs)

        def step(i: jax.Array, nets: Trainable) -> Trainable:
            drawn = jax.random.randint(
                jax.random.fold_in(epoch_key, i), batch, 0, jnp.maximum(train.count, 1)
            )
            x, y = transitions_at(ring, train.flat[drawn], cfg)
            grads = jax.grad(ensemble_loss)(nets.params, scale, x, y, cfg.weight_decay, cfg.fit_dtype)
            change, state = update(pmean(grads, axis_name), nets.opt_state)
            return Trainable(optax.apply_updates(nets.params, change), state)

        start = Trainable(now.ensemble, now.opt_state)
        moved = jax.lax.fori_loop(0, steps, step, start)
        # A gradient that is not finite stays in Adam's moments. To look for it once spares kernels.
        finite = jax.vmap(all_finite)(moved)  # [M]
        ensemble, opt_state = select_rows(finite, moved, start)
        error = errors(ensemble)
        better = error < BETTER * now.error
        return Fit(
            ensemble=ensemble,
            opt_state=opt_state,
            best=select_rows(better, ensemble, now.best),
            error=jnp.where(better, error, now.error),
            stale=jnp.where(better.any(), 0, now.stale + 1),
            epochs=now.epochs + 1,
            skipped=now.skipped + jnp.where(finite.all(), 0, steps),
        )

    none, old = jnp.int32(0), model.params.ensemble
    begin = Fit(old, model.opt_state, old, jnp.full(cfg.models, jnp.inf), none, none, none)
    end = jax.lax.while_loop(
        lambda now: (now.stale < cfg.patience) & (now.epochs < cfg.max_epochs), epoch, begin
    )
    metrics = {
        "train/model_error": end.error.mean(),
        "train/model_epochs": end.epochs.astype(jnp.float32),
        "train/model_steps": (end.epochs * steps).astype(jnp.float32),
        "train/nonfinite": end.skipped.astype(jnp.float32),
    }
    return Trainable(Fitted(end.best, scale), end.opt_state), metrics


def refit(
    nets: Trainable,
    replay: ModelRecord,
    shared: Shared,
    key: jax.Array,
    cfg: Any,
    axis_name: str | None = None,
) -> tuple[Trainable, Metrics]:
    """`nets` with the model refitted, if that is due at the end of this update: see `when_due`."""
    if cfg.true_model:
        return nets, {"train/nonfinite": jnp.zeros(())}

    def learn(span: Span) -> tuple[Trainable, Metrics]:
        model, metrics = fit(model_of(nets), replay, span, key, cfg, axis_name)
        return with_model(nets, model), metrics

    return when_due(learn, nets, replay, shared, cfg, axis_name)


def when_due(
    learn: Callable[[Span], tuple[Trainable, Metrics]],
    nets: Trainable,
    replay: ModelRecord,
    shared: Shared,
    cfg: Any,
    axis_name: str | None,
) -> tuple[Trainable, Metrics]:
    """What `learn` makes of the rows that the replay holds, if a refit is due at the end of this
    update; else `nets`, with metrics of NaN.

    It is due at the update that ends the warm-up, and then whenever `refit_every` environment steps
    have passed. A resumed run without its replay fills that first.
    """
    devices = device_count(axis_name)
    if cfg.model_batch % devices:
        raise ConfigError(f"model_batch={cfg.model_batch} does not split over {devices} devices")
    steps = cfg.num_envs * devices * cfg.horizon  # of an update
    warm_up, period = max(1, -(-cfg.learning_starts // steps)), max(1, round(cfg.refit_every / steps))
    filled = jnp.asarray(shared.iteration) - shared.since + 1  # updates
    due = (filled >= warm_up) & ((filled - warm_up) % period == 0)
    rows = replay.reward.shape[1]
    span = held(rows, cfg.horizon, cfg.horizon, jnp.asarray(shared.iteration), shared.since)
    like = jax.eval_shape(learn, span)[1]

    def leave(span: Span) -> tuple[Trainable, Metrics]:
        none = {k: jnp.full(x.shape, jnp.nan) for k, x in like.items()}
        return nets, none | {"train/nonfinite": jnp.zeros(())}

    return jax.lax.cond(due, learn, leave, span)
