"""Actors and critics that learn in the dreams of a world model, as a `Learner` of the off-policy loop.

A gradient step draws sequences from the replay. The model learns from them. From every latent that it
finds, the actor dreams `imagine_steps` steps ahead. Actor and critics learn from these dreams, and the
critics from the replayed rewards, too. One gradient is taken of the sum of all losses. None flows from
actor or critics into the model.

What a method adds is a `Behaviour`: further heads of the model, its critics and its losses.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxsafe.config import ConfigError
from jaxsafe.learn.acting import Learned
from jaxsafe.learn.constraints import Costs
from jaxsafe.learn.learner import GradientStep, Learner
from jaxsafe.learn.observations import blank, observation_like
from jaxsafe.learn.sequences import SequenceBatch, check_sequences, drawn_sequences, lambda_returns
from jaxsafe.learn.steps import Trainable, descend_each, follow
from jaxsafe.learn.world_model import (
    CHANCE,
    Dreams,
    actor_of,
    critic_of,
    dream,
    dream_returns,
    ended,
    goes_on,
    laprop,
    model_loss,
    policy_of,
    size_of,
    value_of,
    world_of,
)
from jaxsafe.nn.gaussian import Gaussian, sample
from jaxsafe.nn.rssm import Latent, WorldModel, converted
from jaxsafe.nn.two_hot import BINS, two_hot_loss
from jaxsafe.types import Env, Metrics, Policy, PyTree

fixed = jax.lax.stop_gradient


# ---- returns and their size --------------------------------------------------------------------


class Range(NamedTuple):
    """Running 5th and 95th percentiles of returns, float []."""

    low: jax.Array
    high: jax.Array

    def scale(self, least: jax.Array | float) -> jax.Array:
        """What advantages are divided by: the range, or `least` where that is larger."""
        return jnp.maximum(least, self.high - self.low)


def no_range() -> Range:
    return Range(jnp.zeros(()), jnp.zeros(()))


def moved(past: Range, returns: jax.Array, axis_name: str | None, rate: float = 0.01) -> Range:
    """`past`, moved by `rate` towards the percentiles of `returns` of all devices."""
    every = returns if axis_name is None else jax.lax.all_gather(returns, axis_name)
    low, high = jnp.percentile(fixed(every), jnp.array([5.0, 95.0]))
    return Range(past.low + rate * (low - past.low), past.high + rate * (high - past.high))


class Judged(NamedTuple):
    """What a critic says of dreams: returns, float [H, S], and values, float [H + 1, S]."""

    returns: jax.Array
    value: jax.Array

    @property
    def advantage(self) -> jax.Array:
        return self.returns - self.value[:-1]


# ---- a gradient step, as a behaviour sees it ---------------------------------------------------


class Scene(NamedTuple):
    """What a behaviour learns from.

    world: the model. params: all networks by name, without gradient. latents: of the rows [T, B] of
    `batch`, without gradient. dual: the state of the loop's treatment, () where it has none.
    """

    env: Env
    world: WorldModel
    params: dict[str, PyTree]
    batch: SequenceBatch
    latents: Latent
    dual: PyTree
    cfg: Any
    axis_name: str | None

    def dream(self, actor: PyTree, key: jax.Array) -> Dreams:
        """Dreams of `actor` from the latents of all rows, S = T B."""
        start = jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), self.latents)
        alive = goes_on(self.batch.rows, self.cfg).reshape(-1)
        act = actor_of(self.env, self.cfg)

        def policy(params: PyTree, features: jax.Array) -> Gaussian:
            outputs: Any = act.apply(params, features)
            return policy_of(outputs)

        return dream(self.world, self.params["model"], policy, actor, start, alive, key, self.cfg)

    def over_dreams(self, x: jax.Array) -> jax.Array:
        """This device's share of the mean of `x` [H, S]."""
        length = len(self.batch.rows.reward)
        return (jnp.tile(self.batch.weight, length) / length * x.mean(0)).sum()

    def over_rows(self, x: jax.Array) -> jax.Array:
        """This device's share of the mean of `x` [T - 1, B], which counts 0 where no row follows."""
        return (self.batch.weight * jnp.where(self.batch.follows, x, 0.0).mean(0)).sum()

    def value(self, critic: PyTree, features: jax.Array) -> jax.Array:
        return value_of(critic, features, self.cfg)

    def logits(self, critic: PyTree, features: jax.Array) -> jax.Array:
        found: Any = critic_of(self.cfg).apply(critic, features)
        return found

    def judge(
        self, name: str, dreams: Dreams, reward: jax.Array, discount: jax.Array | float
    ) -> Judged:
        """Dreams with `reward` [H + 1, S], in the eyes of the critic `name`. All are functions of the
        actor where the dreams are."""
        value = self.value(self.params[name], dreams.features)
        discounts = {"discount": discount, "decay": self.cfg.td_lambda}
        return Judged(dream_returns(reward, value, dreams.read["cont"], **discounts), value)

    def gain(self, dreams: Dreams, advantage: jax.Array) -> jax.Array:
        """E[u A] or, by `reinforce`, E[u sg A log pi], whose gradient raises A."""
        if self.cfg.actor_grad == "reinforce":
            advantage = fixed(advantage) * dreams.log_prob
        return self.over_dreams(dreams.weight[:-1] * advantage)

    def actor_loss(self, dreams: Dreams, advantage: jax.Array) -> jax.Array:
        """-E[u (A + eta H)] or, by `reinforce`, -E[u (sg A log pi + eta H)]."""
        entropy = self.over_dreams(dreams.weight[:-1] * dreams.entropy)
        return -self.gain(dreams, advantage) - self.cfg.entropy_coef * entropy

    def critic_loss(
        self, trained: dict[str, PyTree], name: str, dreams: Dreams, returns: jax.Array
    ) -> jax.Array:
        """-E[u (log p(R) + log p(V'))] of dreams, whose `returns` are float [H, S]. V' is the value of
        the critic's slow copy, which holds it back."""
        features = fixed(dreams.features[:-1])
        return self.over_dreams(dreams.weight[:-1] * self._loss(trained, name, features, returns))

    def critic_loss_with_rows(
        self,
        trained: dict[str, PyTree],
        name: str,
        dreams: Dreams,
        returns: jax.Array,
        reward: jax.Array,
        discount: jax.Array | float,
    ) -> jax.Array:
        """`critic_loss`, and `replay_value` times the same of the rows, whose own returns end with
        those of the dreams that begin there.

        Args:
            returns: of the dreams, float [H, S].
            reward: of the rows, float [T, B].
        """
        later = fixed(returns[0].reshape(reward.shape))
        discounts = {"discount": discount, "decay": self.cfg.td_lambda}
        ends = ended(self.batch.rows, self.cfg)
        of_rows = lambda_returns(self.batch, reward, later, ends, **discounts)
        on_rows = self.over_rows(self._loss(trained, name, self.latents.features[:-1], of_rows))
        return self.critic_loss(trained, name, dreams, returns) + self.cfg.replay_value * on_rows

    def _loss(
        self, trained: dict[str, PyTree], name: str, features: jax.Array, returns: jax.Array
    ) -> jax.Array:
        logits = self.logits(trained[name], features)
        slow = self.value(self.params["targets"][name], features)
        return two_hot_loss(logits, fixed(returns)) + two_hot_loss(logits, slow)


class Outcome(NamedTuple):
    """Of a behaviour's losses: their sum, this device's share; what it remembers; metrics."""

    loss: jax.Array
    memory: PyTree
    metrics: Metrics


class Behaviour(NamedTuple):
    """What a method learns in dreams.

    actors, critics: their names. The policy acts by `actor`.
    heads(cfg) -> {name: BINS for a number, CHANCE for a probability}, heads of the model besides
        `reward` and `cont`.
    targets(env, rows, cfg) -> {name: float [T, B]}, what these heads learn to say.
    memory(cfg) -> what is remembered besides networks, a pytree.
    learn(trained, memory, scene, key) -> Outcome. `trained` are the actors and critics.
    """

    learn: Callable[[dict[str, PyTree], PyTree, Scene, jax.Array], Outcome]
    memory: Callable[[Any], PyTree]
    actors: tuple[str, ...] = ("actor",)
    critics: tuple[str, ...] = ("critic_r",)
    heads: Callable[[Any], dict[str, int]] = lambda cfg: {}
    targets: Callable[[Env, Costs, Any], dict[str, jax.Array]] = lambda env, rows, cfg: {}

    def all_heads(self, cfg: Any) -> dict[str, int]:
        return {"reward": BINS, "cont": CHANCE, **self.heads(cfg)}


# ---- the policy --------------------------------------------------------------------------------


class Memory(NamedTuple):
    """What the policy remembers: where it was, what it did there, and how many steps it has acted,
    int []."""

    latent: Latent
    action: jax.Array
    step: jax.Array


def dreaming_policy(env: Env, behaviour: Behaviour) -> Policy:
    """Acts by `actor` in the latent of the present observation."""

    def init(learned: Learned) -> Memory:
        world = world_of(env, behaviour.all_heads(learned.config), learned.config)
        start: Any = world.apply({}, method="start")
        return Memory(start, jnp.zeros(env.action_size), jnp.int32(0))

    def act(
        learned: Learned, carry: Memory, obs: Any, key: jax.Array | None
    ) -> tuple[jax.Array, Memory, dict[str, Any]]:
        latent_key, act_key = (None, None) if key is None else jax.random.split(key)
        latent = seen(env, behaviour, learned, carry, obs, latent_key)
        action = chosen(env, learned, "actor", latent, act_key)
        return action, Memory(latent, action, carry.step + 1), {}

    return Policy(init=init, act=act)


def seen(
    env: Env,
    behaviour: Behaviour,
    learned: Learned,
    carry: Memory,
    obs: Any,
    key: jax.Array | None,
) -> Latent:
    """The latent of the present observation, the likeliest one where `key` is None."""
    cfg, params = learned.config, learned.params["model"]
    world = world_of(env, behaviour.all_heads(cfg), cfg)
    embedded = world.apply(params, obs, method="embed")
    latent: Any = world.apply(params, carry.latent, carry.action, embedded, key, method="observe")
    return latent


def chosen(env: Env, learned: Learned, name: str, latent: Latent, key: jax.Array | None) -> jax.Array:
    """The action [..., A] of the actor `name`, the mean one where `key` is None."""
    outputs: Any = actor_of(env, learned.config).apply(learned.params[name], latent.features)
    dist = policy_of(outputs)
    return dist.mean if key is None else sample(dist, key)


# ---- the learner -------------------------------------------------------------------------------


def dreaming_learner(
    env: Env, behaviour: Behaviour, policy: Policy | None = None, axis_name: str | None = None
) -> Learner:
    """The learner of a behaviour.

    policy: what acts, if it is not the actor alone.
    """

    def init(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> Trainable:
        check_sequences(cfg, axis_name)
        if cfg.obs_bins == 1:
            raise ConfigError("obs_bins=1: expected 2 or more, or 0 for none")
        if cfg.overshoot > cfg.n_step:
            raise ConfigError(
                f"overshoot={cfg.overshoot}: expected at most n_step={cfg.n_step}, a sequence's steps"
            )
        size = size_of(cfg)
        obs, action = blank(observation_like(env)), jnp.zeros(action_size)
        features = jnp.zeros(size.deter + size.latents * size.classes)
        model_key, actor_key, critic_key = jax.random.split(key, 3)
        world = world_of(env, behaviour.all_heads(cfg), cfg)
        params = {"model": world.init(model_key, obs, action, method="everything")}
        for i, name in enumerate(behaviour.actors):
            params[name] = actor_of(env, cfg).init(jax.random.fold_in(actor_key, i), features)
        for i, name in enumerate(behaviour.critics):
            params[name] = critic_of(cfg).init(jax.random.fold_in(critic_key, i), features)
        rules = optimisers(cfg)
        opt_state: dict[str, Any] = {name: rules[name].init(x) for name, x in params.items()}
        opt_state["memory"] = behaviour.memory(cfg)
        slow = {name: params[name] for name in behaviour.critics}
        return Trainable(params | {"targets": slow}, opt_state)

    def optimisers(cfg: Any) -> dict[str, Any]:
        actors = dict.fromkeys(behaviour.actors, laprop(cfg.lr, cfg))
        critics = dict.fromkeys(behaviour.critics, laprop(cfg.critic_lr, cfg))
        return {"model": laprop(cfg.model_lr, cfg), **actors, **critics}

    def step(
        nets: Trainable, batch: SequenceBatch, at: GradientStep, cfg: Any, axis_name: str | None
    ) -> tuple[Trainable, Metrics]:
        world = world_of(env, behaviour.all_heads(cfg), cfg)
        model_key, dream_key = jax.random.split(at.key)
        targets = {"reward": batch.rows.reward, "cont": goes_on(batch.rows, cfg)}
        targets |= behaviour.targets(env, batch.rows, cfg)

        def loss(trained: dict[str, PyTree]) -> tuple[jax.Array, dict[str, Any]]:
            trained = converted(trained, cfg.hidden_dtype)
            of_model, (latents, metrics) = model_loss(
                world, trained["model"], batch, targets, model_key, cfg
            )
            params = nets.params | fixed(trained)
            scene = Scene(env, world, params, batch, fixed(latents), at.dual, cfg, axis_name)
            found = behaviour.learn(trained, nets.opt_state["memory"], scene, dream_key)
            return of_model + found.loss, {"found": fixed((metrics | found.metrics, found.memory))}

        nets, aux = descend_each(loss, nets, optimisers(cfg), axis_name)
        metrics, memory = aux["found"]
        nets = nets._replace(opt_state=nets.opt_state | {"memory": memory})
        return follow(nets, cfg.tau), metrics

    return Learner(
        init=init,
        step=step,
        policy=policy or dreaming_policy(env, behaviour),
        replayed=drawn_sequences,
    )
