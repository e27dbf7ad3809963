"""First-order steps: of Adam, and epochs of them on minibatches, for policies and for critics.

Learners with a replay or a data set take single steps (`descend_each`). Their targets `follow`.

On-policy learners take epochs. Their policy and critics have loops of their own, so that stopping the
policy early leaves the critics' passes alone. OmniSafe alternates them on each minibatch and stops all
three together (`critics_stop`). On a shared trunk they are one network, and their loss is one.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxsafe.config import ConfigError, Iterations, KLStop, Rate, config
from jaxsafe.learn.batch import batch_mean, pmean, select
from jaxsafe.learn.conventions import Convention
from jaxsafe.nn.gaussian import Gaussian, kl
from jaxsafe.nn.networks import action_dist, outputs, value
from jaxsafe.types import Count, Metrics, PyTree

# (actor, batch) -> (this device's mean of what to maximise, metrics)
Objective = Callable[[PyTree, Any], tuple[jax.Array, Metrics]]

MOST_JOINED = 2**19  # parameters of a network that are one array to Adam on a GPU


class Pair(NamedTuple):
    """Two objectives, for steps that weigh reward against cost themselves."""

    reward: Objective
    cost: Objective  # cost per step, to be kept low; [K] of several constraints


class Context(NamedTuple):
    """What a step knows of the iteration in which it is taken.

    iteration: int32 [], updates before this one.
    cfg: the algorithm's config.
    key: a random key, for the step alone.
    axis_name: of the devices that share the batch; None means one device.
    episode_cost: float [] or [K], J_c, the undiscounted cost of an episode.
    violation: float [] or [K], J_c - cost_limit, per episode.
    episode_length: float [], mean length of an episode in steps.
    """

    iteration: Count
    cfg: Any
    key: jax.Array
    axis_name: str | None
    episode_cost: jax.Array
    violation: jax.Array
    episode_length: jax.Array


class PolicyStep(NamedTuple):
    """A rule that moves the policy.

    init(actor, cfg) -> opt_state
    update(actor, opt_state, objective, batch, context) -> (actor, opt_state, metrics), with an
        `Objective` or, for steps that weigh reward against cost themselves, a `Pair` of them.

    check(cfg) raises ConfigError for settings that the rule cannot serve.

    On a shared trunk `update` trains the critics too (`with_values`), or `check` refuses such a trunk
    (`require_separate_trunk`).
    """

    init: Callable[[PyTree, Any], PyTree]
    update: Callable[..., tuple[PyTree, PyTree, Metrics]]
    check: Callable[[Any], None] = lambda cfg: None


@config
class AdamConfig:
    """For algorithms whose policy moves by epochs of Adam."""

    CONVENTIONS: ClassVar = (
        Convention(
            {"critics_stop": True},
            "where the KL stops the policy's passes over a batch, the critics' passes stop too",
            "critics make all their passes",
        ),
    )

    lr: Rate = 3e-4  # Adam's step of the policy, as in OmniSafe and safety-starter-agents.
    # Whether lr falls on a line to 0 at `total_iterations`. OmniSafe's does.
    lr_decay: bool = False
    # Passes of the policy over a batch. With 8 minibatches they are the 80 steps of
    # safety-starter-agents.
    epochs: Iterations = 10
    target_kl: KLStop = 0.02  # Passes stop when KL(old || new) is above this (nats), as in OmniSafe.
    # Whether the critics stop when the policy does. OmniSafe's do.
    critics_stop: bool = False


def adam(lr: jax.Array | float, cfg: Any, eps: float = 1e-8) -> optax.GradientTransformation:
    """Adam on gradients no longer than `max_grad_norm`.

    On a GPU the parameters of a small network are one array to it, so that a step has a few kernels,
    not a few for the weights of each layer. To join those of a large one, or any on a CPU, would take
    longer than it saves.
    """
    return as_one_array(clipped_adam(lr, cfg, eps))


def skipping_adam(lr: jax.Array | float, cfg: Any) -> optax.GradientTransformation:
    """`adam` that leaves out a gradient that is not finite."""
    return as_one_array(skip_nonfinite(clipped_adam(lr, cfg)))


def clipped_adam(lr: jax.Array | float, cfg: Any, eps: float = 1e-8) -> optax.GradientTransformation:
    return optax.chain(optax.clip_by_global_norm(cfg.max_grad_norm), optax.adam(lr, eps=eps))


def as_one_array(steps: optax.GradientTransformation) -> optax.GradientTransformation:
    """`steps` of all parameters joined, where that is faster."""
    joined = optax.flatten(steps)

    def faster(params: PyTree) -> optax.GradientTransformation:
        few = optax.tree.size(params) <= MOST_JOINED
        return joined if few and jax.default_backend() != "cpu" else steps

    def init(params: PyTree) -> PyTree:
        return faster(params).init(params)

    def update(updates: PyTree, state: Any, params: PyTree | None = None) -> tuple[PyTree, Any]:
        return faster(updates).update(updates, state, params)

    return optax.GradientTransformation(init, update)


class Skipping(NamedTuple):
    """State of an optimiser that leaves steps out. skipped: int32 [], how many so far."""

    skipped: jax.Array
    inner: PyTree


def skip_nonfinite(optimiser: optax.GradientTransformation) -> optax.GradientTransformation:
    """`optimiser`, for which a gradient that is not finite is none at all: nothing moves, and the step
    is counted. To choose is part of the step's own kernels, unlike a choice among whole networks after
    it, which is a second pass over all of them."""

    def init(params: PyTree) -> Skipping:
        return Skipping(jnp.int32(0), optimiser.init(params))

    def update(updates: PyTree, state: Any, params: PyTree | None = None) -> tuple[PyTree, Any]:
        finite = jnp.isfinite(optax.tree.norm(updates))
        change, inner = optimiser.update(updates, state.inner, params)
        change = jax.tree.map(lambda x: jnp.where(finite, x, 0.0), change)
        return change, Skipping(state.skipped + ~finite, select(finite, inner, state.inner))

    return optax.GradientTransformation(init, update)


def skipped_steps(opt_state: PyTree) -> jax.Array:
    """The steps that all optimisers in `opt_state` left out so far, int32 []."""
    leaves = jax.tree.leaves(opt_state, is_leaf=lambda x: isinstance(x, Skipping))
    return sum((x.skipped for x in leaves if isinstance(x, Skipping)), jnp.int32(0))


def remaining(iteration: Count, cfg: Any) -> jax.Array:
    """The share of training that is left: 1 at first, 0 from `cfg.total_iterations` on."""
    total = jnp.where(cfg.total_iterations > 0, cfg.total_iterations, jnp.inf)
    return jnp.maximum(0.0, 1.0 - iteration / total)


def descend(
    optimiser: optax.GradientTransformation, params: PyTree, opt_state: PyTree, grads: PyTree
) -> tuple[PyTree, PyTree, jax.Array]:
    """One step of `optimiser`, or none if a gradient is not finite: (params, opt_state, skipped), of
    which the last is 0 or 1, int32 []."""
    before = Skipping(jnp.int32(0), opt_state)
    found: Any = skip_nonfinite(optimiser).update(grads, before, params)
    change, after = found
    return optax.apply_updates(params, change), after.inner, after.skipped


def one_pass(
    step: Callable[[PyTree, PyTree], tuple[PyTree, PyTree]],
    carry: PyTree,
    data: PyTree,
    key: jax.Array,
    minibatches: int,
) -> tuple[PyTree, PyTree]:
    """Scan `step(carry, minibatch)` over a shuffle of `data`, whose leaves are [B, ...]."""
    size = jax.tree.leaves(data)[0].shape[0]
    rows = jax.random.permutation(key, size).reshape(minibatches, size // minibatches)

    def on_rows(carry: PyTree, rows: jax.Array) -> tuple[PyTree, PyTree]:
        return step(carry, jax.tree.map(lambda x: x[rows], data))

    return jax.lax.scan(on_rows, carry, rows)


def mean_kl(old: Gaussian, new: Gaussian, axis_name: str | None) -> jax.Array:
    return batch_mean(kl(old, new), axis_name)


class Trainable(NamedTuple):
    """What gradient steps move, and their optimiser's state."""

    params: PyTree
    opt_state: PyTree


def descend_each(
    loss: Callable[[dict[str, PyTree]], tuple[jax.Array, dict[str, Any]]],
    nets: Trainable,
    optimisers: dict[str, optax.GradientTransformation],
    axis_name: str | None = None,
) -> tuple[Trainable, dict[str, Any]]:
    """`nets` after one step down `loss`. Each network that has an optimiser moves by that one.

    Args:
        loss: (those networks by name) -> this device's share of it, and metrics.
    """
    trained = {name: nets.params[name] for name in optimisers}
    grads, metrics = pmean(jax.grad(loss, has_aux=True)(trained), axis_name)
    params, states = {}, {}
    for name, optimiser in optimisers.items():
        change, states[name] = optimiser.update(grads[name], nets.opt_state[name], trained[name])
        params[name] = optax.apply_updates(trained[name], change)
    return Trainable(nets.params | params, nets.opt_state | states), metrics


def follow(nets: Trainable, tau: jax.Array | float) -> Trainable:
    """`nets` whose targets have moved by a share `tau` towards the networks of the same names."""
    targets = nets.params["targets"]
    aims = {name: nets.params[name] for name in targets}
    moved = optax.incremental_update(aims, targets, tau)
    return nets._replace(params=nets.params | {"targets": moved})


class Passes(NamedTuple):
    """Passes over a batch so far."""

    trained: Trainable
    key: jax.Array
    count: jax.Array  # int32 []
    divergence: jax.Array  # float [], KL(old || new) after the last one
    skipped: jax.Array  # int32 [], steps whose gradient was not finite


def init_adam(actor: PyTree, cfg: Any) -> PyTree:
    return adam(cfg.lr, cfg).init(actor)


def update_adam(
    actor: PyTree, opt_state: PyTree, objective: Objective, batch: Any, context: Context
) -> tuple[PyTree, PyTree, Metrics]:
    """Up to `cfg.epochs` passes over the batch, until KL(old || new) > `cfg.target_kl`.

    The KL is the mean over the whole batch, taken after each pass; there is no way back. The
    learning rate falls linearly to 0 at `cfg.total_iterations`, if `cfg.lr_decay`.
    """
    cfg, axis_name = context.cfg, context.axis_name
    objective = with_values(objective, cfg) if cfg.trunk != "separate" else objective
    share = remaining(context.iteration, cfg) if cfg.lr_decay else 1.0
    optimiser = adam(cfg.lr * share, cfg)

    def minibatch_step(trained: Trainable, batch: Any) -> tuple[Trainable, jax.Array]:
        grads = jax.grad(lambda actor: -objective(actor, batch)[0])(trained.params)
        params, state, skipped = descend(optimiser, *trained, pmean(grads, axis_name))
        return Trainable(params, state), skipped

    def next_pass(now: Passes) -> Passes:
        key, shuffle_key = jax.random.split(now.key)
        trained, skips = one_pass(minibatch_step, now.trained, batch, shuffle_key, cfg.minibatches)
        divergence = mean_kl(batch.old, action_dist(trained.params, batch.obs, cfg), axis_name)
        return Passes(trained, key, now.count + 1, divergence, now.skipped + skips.sum())

    start = Passes(Trainable(actor, opt_state), context.key, jnp.int32(0), jnp.zeros(()), jnp.int32(0))
    end = jax.lax.while_loop(
        lambda now: (now.count < cfg.epochs) & ~(now.divergence > cfg.target_kl), next_pass, start
    )
    actor, state = end.trained
    final, metrics = pmean(objective(actor, batch), axis_name)
    return (
        actor,
        state,
        {
            "train/kl": end.divergence,
            "train/passes": end.count,
            "train/objective": final,
            "train/nonfinite": end.skipped,
            **metrics,
        },
    )


adam_epochs = PolicyStep(init=init_adam, update=update_adam)


def with_values(objective: Objective, cfg: Any) -> Objective:
    """`objective` - value_coef sum_i E[(V_i - target_i)^2], over reward and costs, on a shared trunk.

    Source: Schulman et al. (2017), "Proximal Policy Optimization Algorithms", equation 9.
    """

    def joint(actor: PyTree, batch: Any) -> tuple[jax.Array, Metrics]:
        gain, metrics = objective(actor, batch)
        of_costs = batch.ret_c.reshape(*batch.ret_r.shape, -1)  # [..., K]
        targets = jnp.concatenate([batch.ret_r[..., None], of_costs], -1)
        squares = (outputs(actor, batch.obs, cfg)[1] - targets) ** 2
        errors = jnp.mean(squares.reshape(-1, squares.shape[-1]), axis=0)
        of_cost = errors[1:].reshape(batch.ret_c.shape[batch.ret_r.ndim :])
        metrics = metrics | {"train/value_loss_r": errors[0], "train/value_loss_c": of_cost}
        metrics |= {"train/objective": gain}  # the policy's part alone
        return gain - cfg.value_coef * errors.sum(), metrics

    return joint


def require_separate_trunk(cfg: Any) -> None:
    """Refuse a shared trunk, which a step that moves the policy alone would leave without critics.

    Raises:
        ConfigError: `trunk` is shared, or gru.
    """
    if cfg.trunk != "separate":
        raise ConfigError(
            f"trunk={cfg.trunk}: expected separate, for a natural gradient moves the policy alone; "
            "policy and critics share a trunk where Adam takes the steps, as in ppo_lag or focops"
        )


class CriticPasses(NamedTuple):
    """Passes of a critic over a batch so far, int32 []."""

    critic: Trainable
    count: jax.Array


def fit_critic(
    critic: Trainable,
    data: tuple[jax.Array, jax.Array],
    passes: jax.Array | int,
    key: jax.Array,
    cfg: Any,
    axis_name: str | None,
) -> tuple[Trainable, jax.Array, jax.Array]:
    """`cfg.critic_epochs` passes of Adam on mean (V - target)^2 + critic_norm_coef sum theta^2.

    Args:
        data: observations [B, O] and targets [B].
        passes: how many passes take effect. The later ones run, too, and are discarded.
    Returns:
        The critic, the mean squared error during the last pass that takes effect, and the number of
        minibatch steps up to then that were skipped because their gradient was not finite.
    """
    optimiser = adam(cfg.critic_lr, cfg)

    def loss(params: PyTree, obs: jax.Array, target: jax.Array) -> tuple[jax.Array, jax.Array]:
        error = jnp.mean((value(params, obs, cfg) - target) ** 2)
        return error + cfg.critic_norm_coef * sum(jnp.sum(x**2) for x in jax.tree.leaves(params)), error

    def minibatch_step(critic: Trainable, data: PyTree) -> tuple[Trainable, PyTree]:
        grads, error = jax.grad(loss, has_aux=True)(critic.params, *data)
        params, state, skipped = descend(optimiser, *critic, pmean(grads, axis_name))
        return Trainable(params, state), (error, skipped)

    def next_pass(now: CriticPasses, key: jax.Array) -> tuple[CriticPasses, PyTree]:
        after, metrics = one_pass(minibatch_step, now.critic, data, key, cfg.minibatches)
        return CriticPasses(select(now.count < passes, after, now.critic), now.count + 1), metrics

    end, (errors, skipped) = jax.lax.scan(
        next_pass, CriticPasses(critic, jnp.int32(0)), jax.random.split(key, cfg.critic_epochs)
    )
    counted = jnp.arange(cfg.critic_epochs) < passes
    error = errors[jnp.maximum(counted.sum(), 1) - 1]
    return end.critic, batch_mean(error, axis_name), (skipped * counted[:, None]).sum()


def critic_passes(metrics: Metrics, cfg: Any) -> jax.Array | int:
    """Passes of the critics over a batch: as many as the policy's where the KL stopped those and the
    critics stop with it, else `cfg.critic_epochs`. `metrics` are those of the policy's step."""
    passes = cfg.critic_epochs
    if isinstance(cfg, AdamConfig) and cfg.critics_stop:
        made = metrics["train/passes"]
        passes = jnp.where(made < cfg.epochs, made, passes)
    return passes
