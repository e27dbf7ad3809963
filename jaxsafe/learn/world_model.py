"""Learning a world model from sequences of rows, and dreaming with it.

A row of the replay describes the arrival at an observation, and then the action taken from it. So the
latent of row t is that of obs_t. It follows from the latent of row t - 1 and the action of row t - 1.
It foretells reward_t, the cost of that step, and whether the episode goes on from obs_t. Where row t is
the first of an episode, what came before is forgotten.
"""

from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxsafe.config import Amount, Bounds, Iterations, Norm, Rate, Share, Weight, config
from jaxsafe.learn.observations import EncoderConfig, observation_like
from jaxsafe.learn.replay import Record
from jaxsafe.learn.sequences import SequenceBatch
from jaxsafe.learn.timetable import RoundConfig
from jaxsafe.nn.coders import Decoder, Encoder, VectorDecoder, VectorEncoder, check_picture
from jaxsafe.nn.gaussian import Gaussian, entropy, log_prob, sample
from jaxsafe.nn.recurrent import scanned, states_along
from jaxsafe.nn.rssm import SIZES, Head, Latent, Size, WorldModel, kl
from jaxsafe.nn.two_hot import BINS, two_hot_loss, two_hot_mean
from jaxsafe.types import Env, Metrics, PyTree

SizeName = Literal[
    "tiny", "300k", "500k", "1m", "12m", "25m", "50m", "100m", "200m",
    "small", "medium", "large", "xlarge",
]  # fmt: skip
CHANCE = 1  # outputs of a head that gives a probability; one that gives a number has BINS
STD = (0.1, 1.0)  # range of the actor's standard deviation, as in the authors' code
SMALL = 2**16  # elements of an array whose length is summed beside that of others


@config
class WorldModelConfig(EncoderConfig, RoundConfig):
    """What algorithms with a world model share."""

    # What becomes of pictures. cnn: the model sees them through convolutions, and learns to paint them.
    # none: there are no pictures.
    encoder: Literal["none", "cnn"] = "none"
    # Environments side by side, of all devices together. The authors have 16 and fewer.
    num_envs: Amount = 64
    # Steps of each environment between two rounds of gradient steps.
    learn_every: Amount = 16
    # Rows replayed for each environment step. The authors have 32 to 1024.
    replay_ratio: Amount = 32
    batch_size: Amount = 256  # Rows of a gradient step, of all devices together. The paper has 1024.
    # Steps of a replayed sequence. It has a row more: 16. The authors have 64.
    n_step: Iterations = 15
    # Environment steps with random actions and without learning.
    learning_starts: Amount = 5_000
    # The discount of rewards: 1 - 1/333, as in the paper.
    discount: Share = 0.997
    cost_discount: Share = 0.997  # The discount of costs where one is limited, and in evaluations.
    # The networks' size: about the number of parameters, if pictures are observed. The paper's is 200m.
    # small is 12m, medium 50m, large 100m and xlarge 200m, the nearest to what AMBS's code has by these
    # names.
    size: SizeName = "300k"
    # What hidden layers are computed in. bfloat16 has 8 bits, and is meant for large networks on a GPU:
    # those of 50 million weights learn with it. What it gains there over float32 was not measured.
    hidden_dtype: Literal["float32", "bfloat16"] = "float32"
    model_lr: Rate = 1e-3  # The model's learning rate, by LaProp. The authors have 4e-5.
    lr: Rate = 5e-4  # The actor's learning rate, by LaProp. The authors have 4e-5.
    critic_lr: Rate = 1e-3  # The critics' learning rate, by LaProp. The authors have 4e-5.
    # Gradient steps in which the learning rates rise to their values. The authors have 1000.
    lr_warmup: Iterations = 500
    # The longest gradient of an array, as a share of the array's own length, as in the authors' code.
    clip: Norm = 0.3
    # Steps from -1 to 1 between which the model reads each number of a vector, beside its symlog, at
    # least 2. 0: none, as in the paper.
    obs_bins: Annotated[int, Bounds(0, 1000)] = 21
    dyn_scale: Weight = 1.0  # The weight of the prior's loss, as in the paper.
    rep_scale: Weight = 0.1  # The weight of the posterior's loss, as in the paper.
    free_nats: Weight = 1.0  # Nats below which neither loss is lowered further, as in the paper.
    # Steps ahead, at most `n_step`, for which the heads learn in dreams that take the replayed actions.
    # 0: none, as in the paper.
    overshoot: Annotated[int, Bounds(0, 1000)] = 0
    # Whether running out of time is learned as an end, as the code of AMBS does. A time limit that is
    # not observed is no end, so the default is not to.
    limit_ends: bool = False
    imagine_steps: Iterations = 10  # Steps of a dream. The paper has 15.
    td_lambda: Share = 0.95  # How far the returns of dreams reach: 0 is one step. As in the paper.
    # How the actor learns. reinforce: from its actions' advantages, as in the paper. backprop: by the
    # gradient of returns through the model.
    actor_grad: Literal["reinforce", "backprop"] = "reinforce"
    entropy_coef: Weight = 3e-4  # The weight of the actor's entropy, as in the paper.
    # The least that advantages are divided by, in units of the return, as in the paper.
    least_scale: Annotated[float, Bounds(1e-6, 1e6)] = 1.0
    # The share of a critic that its slow copy takes on at each step, as in the paper.
    tau: Share = 0.02
    # The weight of the critics' loss on replayed rewards, as in the authors' code.
    replay_value: Weight = 0.3


# ---- networks ----------------------------------------------------------------------------------


def size_of(cfg: Any) -> Size:
    return SIZES[cfg.size]._replace(dtype=cfg.hidden_dtype)


def world_of(env: Env, heads: dict[str, int], cfg: Any) -> WorldModel:
    """The model of an environment.

    heads: name -> BINS for a number, CHANCE for a probability.

    Raises:
        ConfigError: pictures whose sides do not suit the model's size.
    """
    size = size_of(cfg)
    if cfg.encoder == "none":
        encoder, decoder = VectorEncoder(size, cfg.obs_bins), VectorDecoder(size, env.obs_size)
    else:
        shape = observation_like(env)["vision"].shape
        check_picture(shape, size, cfg.size)
        encoder, decoder = Encoder(size, cfg.obs_bins), Decoder(size, shape, env.obs_size)
    return WorldModel(size, encoder, decoder, tuple(heads.items()))


def actor_of(env: Env, cfg: Any) -> Head:
    size = size_of(cfg)
    return Head(size.layers, size.units, 2 * env.action_size, scale=0.01, dtype=size.dtype)


def critic_of(cfg: Any) -> Head:
    size = size_of(cfg)
    return Head(size.layers, size.units, BINS, scale=0.0, dtype=size.dtype)


def value_of(critic: PyTree, features: jax.Array, cfg: Any) -> jax.Array:
    """What a critic says of `features` [..., F], float [...]."""
    logits: Any = critic_of(cfg).apply(critic, features)
    return two_hot_mean(logits)


def policy_of(outputs: jax.Array) -> Gaussian:
    """The action distribution [..., A] of an actor's outputs [..., 2 A]. Environments clip actions."""
    mean, std = jnp.split(outputs, 2, axis=-1)
    low, high = STD
    return Gaussian(jnp.tanh(mean), jnp.log(low + (high - low) * jax.nn.sigmoid(std + 2)))


def laprop(lr: jax.Array | float, cfg: Any) -> optax.GradientTransformation:
    """RMSProp, then momentum, on gradients no longer than a share of the arrays they belong to.

    Source: Ziyin, Wang and Ueda (2020), "LAProp: Separating Momentum and Adaptivity in Adam",
        arXiv:2002.04839; Brock et al. (2021), "High-Performance Large-Scale Image Recognition Without
        Normalization", arXiv:2102.06171, for the clip, here of whole arrays.
    """
    steps = optax.chain(
        optax.scale_by_rms(0.999, eps=1e-20, bias_correction=True),
        optax.ema(0.9),
        optax.scale_by_schedule(lambda count: -lr * jnp.minimum(1.0, (count + 1) / cfg.lr_warmup)),
    )
    return optax.chain(clip_by_share(cfg.clip), optax.flatten(steps))  # as one array: a small program


def clip_by_share(share: jax.Array | float) -> optax.GradientTransformation:
    """Shortens the gradient of each array to `share` times the array's length, which counts as 1e-3 at
    least."""

    def clip(grads: PyTree, params: PyTree) -> PyTree:
        def one(grad: jax.Array, length: jax.Array, size: jax.Array) -> jax.Array:
            longest = share * jnp.maximum(1e-3, size)
            return grad * jnp.minimum(1.0, longest / jnp.maximum(length, 1e-30))

        return jax.tree.map(one, grads, lengths(grads), lengths(params))

    return optax.stateless(clip)


def lengths(arrays: PyTree) -> PyTree:
    """The Euclidean length of each array, float []. Small ones of one size are summed side by side: a
    sum is a kernel of a GPU, and a model has a hundred small arrays."""
    leaves, tree = jax.tree.flatten(arrays)
    alike: dict[int, list[int]] = {}
    for i, x in enumerate(leaves):
        alike.setdefault(x.size if x.size <= SMALL else -1 - i, []).append(i)
    found: dict[int, jax.Array] = {}
    for group in alike.values():
        rows = jnp.stack([leaves[i].ravel() for i in group])
        found |= zip(group, jnp.sqrt(jnp.sum(rows**2, axis=1)), strict=True)
    return tree.unflatten([found[i] for i in range(len(leaves))])


# ---- the model's loss --------------------------------------------------------------------------


def latents_of(
    world: WorldModel, params: PyTree, rows: Record, embedded: jax.Array, key: jax.Array | None
) -> Latent:
    """The latents of the rows [T, B], the likeliest ones where `key` is None. The first row of each
    sequence remembers nothing.

    embedded: the observations of the rows as the model's `embed` has them, float [T, B, E].
    """
    first = rows.first.at[0].set(True)
    came_by = jnp.roll(rows.action, 1, axis=0)  # row t came of the action of row t - 1

    def step(params: PyTree, latent: Latent, embedded: jax.Array, x: Any) -> Latent:
        action, first, key = x
        latent, action = jax.tree.map(lambda x: jnp.where(first[:, None], 0.0, x), (latent, action))
        after: Any = world.apply(params, latent, action, embedded, key, method="observe")
        return after

    nothing = jax.tree.map(
        lambda x: jnp.zeros((rows.first.shape[1], *x.shape)), world.apply({}, method="start")
    )
    keys = None if key is None else jax.random.split(key, len(rows.first))
    return states_along(step, params, nothing, embedded, (came_by, first, keys))


def model_loss(
    world: WorldModel,
    params: PyTree,
    batch: SequenceBatch,
    targets: dict[str, jax.Array],
    key: jax.Array,
    cfg: Any,
) -> tuple[jax.Array, tuple[Latent, Metrics]]:
    """This device's share of the loss; the latents [T, B], and metrics.

        L = -log p(x, targets | h, z) + dyn max(free, KL(sg q || p)) + rep max(free, KL(q || sg p))

    and, if `overshoot`, what the heads say in dreams.

    targets: for each head, float [T, B].
    """
    embedded: Any = world.apply(params, batch.rows.obs, method="embed")
    latents = latents_of(world, params, batch.rows, embedded, key)
    believed: Any = world.apply(params, latents.deter, embedded, method="beliefs")
    prior, posterior = believed
    fixed = jax.lax.stop_gradient

    decoded = world.apply(params, latents, method="decode")
    read: Any = world.apply(params, latents.features, method="read")
    losses = {"obs": batch.mean(world.decoder.loss(decoded, batch.rows.obs))}
    losses |= {name: batch.mean(head_loss(read[name], target)) for name, target in targets.items()}
    dyn = batch.mean(jnp.maximum(cfg.free_nats, kl(fixed(posterior), prior)))
    rep = batch.mean(jnp.maximum(cfg.free_nats, kl(posterior, fixed(prior))))
    metrics = {f"train/model_{name}_loss": loss for name, loss in losses.items()}
    metrics |= {"train/model_kl": batch.mean(kl(posterior, prior))}
    total = sum(losses.values()) + cfg.dyn_scale * dyn + cfg.rep_scale * rep
    if cfg.overshoot:
        ahead = overshoot_loss(world, params, batch, latents, targets, jax.random.fold_in(key, 1), cfg)
        total, metrics = total + ahead, metrics | {"train/model_overshoot_loss": ahead}
    return total, (latents, metrics)


def overshoot_loss(
    world: WorldModel,
    params: PyTree,
    batch: SequenceBatch,
    latents: Latent,
    targets: dict[str, jax.Array],
    key: jax.Array,
    cfg: Any,
) -> jax.Array:
    """This device's share of the heads' losses in dreams from the rows, along the replayed actions.

        L = 1/K sum_k E_t[-log p(targets_{t+k} | h_{t+k}, z_{t+k})],   k = 1 .. K,   z from the prior

    The dreams begin at all rows that have K = `overshoot` rows after them. What comes after the end of
    an episode counts 0.

    Args:
        latents: of the rows [T, B].
        targets: for each head, float [T, B].

    Source: after Hafner et al. (2019), "Learning Latent Dynamics for Planning from Pixels",
        arXiv:1811.04551, equation 7, where the latents are compared and not what the heads read.
    """
    starts = len(batch.rows.reward) - cfg.overshoot

    def windows(x: jax.Array, first: int) -> jax.Array:
        """[K, starts, ...]: rows `first` + k of each start."""
        return jnp.stack([x[first + k : first + k + starts] for k in range(cfg.overshoot)])

    def step(params: PyTree, latent: Latent, _: tuple[()], x: Any) -> Latent:
        after: Any = world.apply(params, latent, *x, method="imagine")
        return after

    begin = jax.tree.map(lambda x: x[:starts], latents)
    keys = jax.random.split(key, cfg.overshoot)
    dreamed = states_along(step, params, begin, (), (windows(batch.rows.action, 0), keys))
    features = dreamed.features
    outputs: Any = world.apply(params, features, method="read")
    counts = jnp.cumprod(windows(batch.follows, 0), axis=0)
    losses = sum(head_loss(outputs[name], windows(x, 1)) for name, x in targets.items())
    return (batch.weight * (counts * losses).mean((0, 1))).sum()


def head_loss(outputs: jax.Array, target: jax.Array) -> jax.Array:
    """-log p(target), float [...], of a head's outputs [..., BINS] or [..., CHANCE]."""
    if outputs.shape[-1] == BINS:
        return two_hot_loss(outputs, target)
    return optax.sigmoid_binary_cross_entropy(outputs[..., 0], target)


def read(world: WorldModel, params: PyTree, features: jax.Array) -> dict[str, jax.Array]:
    """What the heads say, float [...]: the mean of numbers, and probabilities."""
    outputs: Any = world.apply(params, features, method="read")
    return {
        name: two_hot_mean(x) if x.shape[-1] == BINS else jax.nn.sigmoid(x[..., 0])
        for name, x in outputs.items()
    }


def ended(rows: Record, cfg: Any) -> jax.Array:
    """Where nothing is to come after a row, bool [T, B]."""
    return rows.last if cfg.limit_ends else rows.terminated


def goes_on(rows: Record, cfg: Any) -> jax.Array:
    """The target of the head `cont`: 1 where an episode goes on, float [T, B]."""
    return 1.0 - ended(rows, cfg)


# ---- dreams ------------------------------------------------------------------------------------


class Dreams(NamedTuple):
    """What a policy does in the model, from S latents, for H steps.

    features: float [H + 1, S, F]. action: float [H, S, A].
    log_prob, entropy: float [H, S], of the actions, as functions of the actor alone.
    read: what the heads say, float [H + 1, S] each.
    weight: float [H + 1, S], without gradient: how likely the dream still goes on, discounted.
    """

    features: jax.Array
    action: jax.Array
    log_prob: jax.Array
    entropy: jax.Array
    read: dict[str, jax.Array]
    weight: jax.Array


def dream(
    world: WorldModel,
    params: PyTree,
    actor: Callable[[PyTree, jax.Array], Gaussian],
    actor_params: PyTree,
    start: Latent,
    alive: jax.Array,
    key: jax.Array,
    cfg: Any,
) -> Dreams:
    """Dreams from `start` [S, ...]. With `actor_grad` 'backprop' they are functions of the actor.

    Args:
        actor: (its parameters, features) -> the action distribution.
        alive: float [S], 1 where the episode goes on at the start.
    """
    fixed = jax.lax.stop_gradient
    params, start = fixed(params), fixed(start)

    def step(
        both: tuple[PyTree, PyTree], state: tuple[Latent, jax.Array], _: tuple[()], key: jax.Array
    ) -> tuple[Latent, jax.Array]:
        """(latent, the action that led to it) -> the same, a step on."""
        (player, params), latent, (act_key, model_key) = both, state[0], jax.random.split(key)
        action = sample(actor(player, fixed(latent.features)), act_key)
        after: Any = world.apply(params, latent, action, model_key, method="imagine")
        return after, action

    begin = start, jnp.zeros_like(actor(actor_params, start.features).mean)
    keys = jax.random.split(key, cfg.imagine_steps)
    if cfg.actor_grad == "backprop":
        later, action = states_along(step, (actor_params, params), begin, (), keys)
    else:
        later, action = scanned(step, (fixed(actor_params), params), begin, (), keys)
    features = jnp.concatenate([start.features[None], later.features])
    dist = actor(actor_params, fixed(features[:-1]))
    says = read(world, params, features)
    says["cont"] = says["cont"].at[0].set(alive)
    return Dreams(
        features=features,
        action=action,
        log_prob=log_prob(dist, fixed(action)),
        entropy=entropy(dist),
        read=says,
        weight=fixed(jnp.cumprod(says["cont"].at[1:].multiply(cfg.discount), axis=0)),
    )


def dream_returns(
    reward: jax.Array,
    value: jax.Array,
    cont: jax.Array,
    *,
    discount: jax.Array | float,
    decay: jax.Array | float,
) -> jax.Array:
    """TD(lambda) returns of the first H states, float [H, S].

        R_t = r_{t+1} + discount k_{t+1} ((1 - decay) V_{t+1} + decay R_{t+1}),   R_H = V_H

    Args:
        reward, value, cont: float [H + 1, S], of each state; `cont` is k, the probability that the
            episode goes on from there.
    """

    def backward(later: jax.Array, x: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        reward, value, cont = x
        now = reward + discount * cont * ((1 - decay) * value + decay * later)
        return now, now

    after = (reward[1:], value[1:], cont[1:])
    return jax.lax.scan(backward, value[-1], after, reverse=True)[1]
