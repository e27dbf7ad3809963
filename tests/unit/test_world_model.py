"""DreamerV3's parts by hand, and that every number meets the latent it belongs to."""

import dataclasses
from functools import cache, partial
from types import SimpleNamespace
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.stats
from compiling import FAST
from jax.flatten_util import ravel_pytree
from learners import likeliest_latents
from toys import START, Corridor, Ticker

from jaxsafe.algos import ALGOS, ambs, dreamer
from jaxsafe.learn import dreaming, world_model
from jaxsafe.learn.acting import Player
from jaxsafe.learn.dreaming import Behaviour, Outcome, Range, Scene, dreaming_learner, moved
from jaxsafe.learn.learner import GradientStep
from jaxsafe.learn.next_step_rollout import collect_records, started
from jaxsafe.learn.replay import Record, Source, Span
from jaxsafe.learn.rollout import init_rollout
from jaxsafe.learn.sequences import SequenceBatch, drawn_sequences
from jaxsafe.learn.world_model import Dreams
from jaxsafe.nn import coders, recurrent, rssm, two_hot
from jaxsafe.nn.gaussian import Gaussian

FLOAT32 = {jnp.dtype("float32")}
THREE: dict[str, Any] = dreamer.LEVER | {"num_envs": 3, "replay_ratio": 16, "stagger": False}

# ---- two-hot -----------------------------------------------------------------------------------


def test_a_fixed_value_is_one_hot_and_others_are_mixtures_of_their_neighbours():
    of_values = two_hot.two_hot(jnp.asarray(two_hot.VALUES))
    np.testing.assert_array_equal(of_values, np.eye(two_hot.BINS))
    low, high = two_hot.VALUES[127], two_hot.VALUES[128]  # 0, and e^(20 / 127) - 1
    np.testing.assert_allclose([low, high], [0, np.expm1(20 / 127)], rtol=1e-6)
    between = two_hot.two_hot(jnp.asarray(high / 4))
    np.testing.assert_allclose(between[127:129], [0.75, 0.25], rtol=1e-6)
    assert (between > 0).sum() == 2
    np.testing.assert_array_equal(two_hot.two_hot(jnp.array([-1e12, 1e12])).argmax(-1), [0, 254])


@pytest.mark.parametrize("x", [0.0, 1e-3, -0.3, 1.0, -17.5, 1e4])
def test_the_mean_of_a_two_hot_is_the_number(x):
    logits = jnp.log(two_hot.two_hot(jnp.float32(x)) + 1e-30)
    np.testing.assert_allclose(two_hot.two_hot_mean(logits), x, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(two_hot.symexp(two_hot.symlog(jnp.float32(x))), x, rtol=1e-5)


def test_equal_logits_are_exactly_0_and_cost_the_logarithm_of_their_number():
    logits = jnp.full((3, two_hot.BINS), 0.7)
    assert (two_hot.two_hot_mean(logits) == 0).all()
    loss = two_hot.two_hot_loss(logits, jnp.array([0.0, 2.5, -900.0]))
    np.testing.assert_allclose(loss, np.log(two_hot.BINS), rtol=1e-6)


def test_symlog_by_hand():
    x = jnp.array([0.0, np.e - 1, 1 - np.e, np.e**3 - 1])
    np.testing.assert_allclose(two_hot.symlog(x), [0, 1, -1, 3], rtol=1e-6)


# ---- latents -----------------------------------------------------------------------------------


def test_a_hundredth_of_each_draw_is_uniform():
    log_p = rssm.log_probs(jnp.array([[100.0, 0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(jnp.exp(log_p), [[0.9925, 0.0025, 0.0025, 0.0025]], rtol=1e-5)


def test_a_draw_is_one_hot_and_has_the_gradient_of_its_probabilities():
    logits = jax.random.normal(jax.random.key(0), (5, 3, 4))
    weight = jax.random.normal(jax.random.key(1), (5, 12))

    def drawn(logits):
        return (weight * rssm.draw(rssm.log_probs(logits), jax.random.key(2))).sum()

    def expected(logits):
        return (weight * jnp.exp(rssm.log_probs(logits)).reshape(5, 12)).sum()

    z = rssm.draw(rssm.log_probs(logits), jax.random.key(2)).reshape(5, 3, 4)
    np.testing.assert_allclose(np.sort(z, -1)[..., -1], 1, rtol=1e-6)
    np.testing.assert_allclose(z.sum(-1), 1, rtol=1e-6)
    np.testing.assert_allclose(jax.grad(drawn)(logits), jax.grad(expected)(logits), atol=1e-6)
    likeliest = rssm.draw(rssm.log_probs(logits), None).reshape(5, 3, 4)
    np.testing.assert_array_equal(likeliest.argmax(-1), logits.argmax(-1))


def test_the_divergence_of_latents_is_summed_over_them():
    p, q = jnp.log(jnp.array([[0.5, 0.5], [0.9, 0.1]])), jnp.log(jnp.array([[0.25, 0.75], [0.9, 0.1]]))
    np.testing.assert_allclose(rssm.kl(p, q), 0.5 * np.log(2) + 0.5 * np.log(2 / 3), rtol=1e-5)
    assert rssm.kl(p, p) == 0


def test_the_memory_by_hand():
    """Two blocks of two units: h <- s(g - 1) tanh(s(r) c) + (1 - s(g - 1)) h."""
    size = rssm.Size(4, 3, classes=2, units=3, channels=(), latents=2, layers=1, blocks=2)
    unit, keys = rssm.Memory(size), jax.random.split(jax.random.key(0), 4)
    h, z, a = (jax.random.normal(key, (n,)) for key, n in zip(keys, (4, 4, 1), strict=False))
    latent = rssm.Latent(h, z)
    flat, unravel = ravel_pytree(unit.init(keys[3], latent, a))
    params: Any = unravel(jax.random.normal(keys[3], flat.shape))
    found: Any = unit.apply(params, latent, a)
    p = params["params"]

    def sigmoid(x):
        return 1 / (1 + np.exp(-x))

    def normed(x, norm):
        x = x / np.sqrt((x**2).mean() + 1e-4) * norm["scale"]
        return x * sigmoid(x)

    def hidden(x, layer):
        return normed(x @ layer["Dense_0"]["kernel"] + layer["Dense_0"]["bias"], layer["RMSNorm_0"])

    def of_blocks(x, layer):
        rows = zip(x, layer["kernel"], layer["bias"], strict=True)
        return np.array([x @ kernel + bias for x, kernel, bias in rows])

    u = np.concatenate([hidden(x, p[f"Hidden_{i}"]) for i, x in enumerate((h, z, a))])
    inputs = np.array([np.concatenate([x, u]) for x in h.reshape(2, 2)])
    y = normed(of_blocks(inputs, p["BlockDense_0"]).reshape(4), p["RMSNorm_0"]).reshape(2, 2)
    r, c, g = of_blocks(y, p["BlockDense_1"]).reshape(2, 3, 2).swapaxes(0, 1).reshape(3, 4)
    expected = sigmoid(g - 1) * np.tanh(sigmoid(r) * c) + (1 - sigmoid(g - 1)) * h
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_the_model_takes_actions_as_environments_do_with_a_gradient_beyond_the_bounds():
    action = jnp.array([-3.0, -1.0, 0.5, 4.0])
    np.testing.assert_array_equal(rssm.within(action), [-1, -1, 0.5, 1])
    slope = jax.grad(lambda x: rssm.within(x).sum())(action)
    np.testing.assert_allclose(slope, [1 / 3, 1, 1, 1 / 4], rtol=1e-6)


def test_an_actor_s_outputs_are_a_mean_within_bounds_and_a_deviation_from_a_tenth_to_1():
    """tanh, and 0.1 + 0.9 sigmoid(x + 2)."""
    found = world_model.policy_of(jnp.array([0.5, -9.0, 0.0, -2.0]))
    np.testing.assert_allclose(found.mean, np.tanh([0.5, -9.0]), rtol=1e-5)
    std = 0.1 + 0.9 / (1 + np.exp([-2.0, 0.0]))
    np.testing.assert_allclose(jnp.exp(found.log_std), std, rtol=1e-5)


# ---- returns, weights, percentiles, steps ---------------------------------------------------------


def test_the_returns_of_dreams_by_hand():
    """R_1 = 3 + .5 * .5 * 6 = 4.5 and R_0 = 2 + .5 * 1 * (.25 * 4 + .75 * 4.5) = 4.1875."""
    reward, value, cont = ([[9.0], [2.0], [3.0]], [[7.0], [4.0], [6.0]], [[0.1], [1.0], [0.5]])
    args = (jnp.array(x) for x in (reward, value, cont))
    got = world_model.dream_returns(*args, discount=0.5, decay=0.75)
    np.testing.assert_allclose(got, [[4.1875], [4.5]])


def test_dreams_are_judged_by_the_critic_that_is_asked_as_far_as_td_lambda_says(monkeypatch):
    """The returns above, of a critic that says the state's number times its own."""
    monkeypatch.setattr(Scene, "value", lambda self, critic, features: critic * features[..., 0])
    cfg = dreamer.DreamerConfig(td_lambda=0.75, discount=0.9)
    unused: Any = None
    critics: Any = {"critic_r": 7.0, "critic_c": 2.0}
    scene = Scene(Corridor(), unused, critics, unused, unused, (), cfg, None)
    reward, value, cont = ([[9.0], [2.0], [3.0]], [[3.5], [2.0], [3.0]], [[0.1], [1.0], [0.5]])
    dreams: Any = SimpleNamespace(features=jnp.array(value)[..., None], read={"cont": jnp.array(cont)})
    judged = scene.judge("critic_c", dreams, jnp.array(reward), 0.5)
    np.testing.assert_allclose(judged.returns, [[4.1875], [4.5]])
    np.testing.assert_allclose(judged.advantage, [[4.1875 - 7], [4.5 - 4]])


def test_a_dream_weighs_how_likely_it_still_goes_on():
    """k_0 is what happened, 1 or 0, and not what a head says. Then 0.5 k of each state."""

    class Fading:
        def apply(self, params, *args, method):
            return getattr(self, method)(*args)

        def imagine(self, latent, action, key):
            return rssm.Latent(latent.deter + 1, latent.stoch)

        def read(self, features):
            k = jnp.array([0.9, 0.8, 0.25])[features[..., 0].astype(int)]
            return {"cont": jnp.log(k / (1 - k))[..., None]}

    def stands(params, features):
        return Gaussian(jnp.zeros((*features.shape[:-1], 1)), jnp.zeros((*features.shape[:-1], 1)))

    world: Any = Fading()
    cfg = dreamer.DreamerConfig(imagine_steps=2, discount=0.5)
    start = rssm.Latent(jnp.zeros((2, 1)), jnp.zeros((2, 1)))
    args = world, {}, stands, (), start, jnp.array([1.0, 0.0]), jax.random.key(0), cfg
    dreams = world_model.dream(*args)
    np.testing.assert_allclose(dreams.weight, [[1, 0], [0.4, 0], [0.4 * 0.125, 0]], rtol=1e-5)
    np.testing.assert_allclose(dreams.read["cont"], [[1, 0], [0.8, 0.8], [0.25, 0.25]], rtol=1e-5)


class Adding:
    """A model that adds the actions up, and says that an episode goes on by as much."""

    start = rssm.Latent(jnp.linspace(-3, 3, 6)[:, None], jnp.zeros((6, 1)))

    def apply(self, params, *args, method):
        return getattr(self, method)(*args)

    def imagine(self, latent, action, key):
        return rssm.Latent(latent.deter + action, latent.stoch)

    def read(self, features):
        return {"cont": features[..., :1]}


def test_a_dream_tells_of_each_state_the_action_that_leads_on_from_it():
    """In a model that adds the actions up, by an actor whose mean and deviation depend on the state."""

    def actor(params, features):
        x = features[..., :1]
        return Gaussian(jnp.sin(x), 0.1 * x)

    world: Any = Adding()
    args = Adding.start, jnp.ones(6), jax.random.key(0), dreamer.DreamerConfig(imagine_steps=4)
    dreams = world_model.dream(world, {}, actor, (), *args)
    x, action = np.asarray(dreams.features[..., 0]), np.asarray(dreams.action[..., 0])
    np.testing.assert_allclose(x[1:] - x[:-1], action, atol=1e-5)
    dist = np.sin(x[:-1]), np.exp(0.1 * x[:-1])
    log_prob = scipy.stats.norm.logpdf(action, *dist)
    np.testing.assert_allclose(dreams.log_prob, log_prob, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(dreams.entropy, scipy.stats.norm.entropy(*dist), rtol=1e-4)


def test_what_a_dream_tells_of_its_actions_is_a_function_of_the_actor_alone():
    """Also by backprop, where states and actions are functions of the actor as well: the slopes of log
    probabilities and entropies are those of reinforce, whose states and actions are fixed."""

    def actor(params, features):
        x = params * features[..., :1]
        return Gaussian(jnp.sin(x), 0.1 * x)

    world: Any = Adding()

    def told(params, actor_grad):
        cfg = dreamer.DreamerConfig(imagine_steps=4, actor_grad=actor_grad)
        args = Adding.start, jnp.ones(6), jax.random.key(0), cfg
        dreams = world_model.dream(world, {}, actor, params, *args)
        return jnp.stack([x.sum() for x in (dreams.log_prob, dreams.entropy, dreams.features)])

    slopes = {by: jax.jacobian(told)(jnp.float32(0.7), by) for by in ("reinforce", "backprop")}
    np.testing.assert_allclose(slopes["backprop"][:2], slopes["reinforce"][:2], rtol=1e-5)
    assert slopes["reinforce"][2] == 0 and abs(slopes["backprop"][2]) > 0.1


@pytest.mark.parametrize("limit_ends", [False, True])
def test_a_critic_is_told_of_each_state_the_return_that_follows_it(monkeypatch, limit_ends):
    """A critic that says the state's first number has nothing to learn, in dreams and of rows, where
    the returns and rewards are those that make it right. An episode ends in one of the rows, or runs
    out of time there, where that is an end. What stands in the next row is of another episode."""

    def error(scene, trained, name, features, returns):
        return (features[..., 0] - returns) ** 2

    monkeypatch.setattr(Scene, "_loss", error)
    value = jax.random.normal(jax.random.key(0), (4, 2))  # of the rows
    no = jnp.zeros((4, 2), bool)
    ends = no.at[2, 0].set(True)
    discount = 0.5
    earned = value[:-1] - discount * value[1:] * ~ends[1:]
    reward = jnp.concatenate([jnp.full((1, 2), 9.0), earned]).at[3, 0].set(9.0)
    first = no.at[3, 0].set(True)
    zeros, terminated, truncated = jnp.zeros((4, 2, 1)), ends & (not limit_ends), ends & limit_ends
    rows = Record(zeros, zeros, reward, reward, zeros, first, terminated, truncated)
    latents = rssm.Latent(value[..., None], zeros)
    cfg = dreamer.DreamerConfig(replay_value=1.0, limit_ends=limit_ends)
    batch = SequenceBatch(rows, jnp.array([0.75, 0.25]))
    unused: Any = None
    scene: Any = Scene(Corridor(), unused, {}, batch, latents, (), cfg, None)
    features = jax.random.normal(jax.random.key(1), (4, 8, 1)).at[0, :, 0].set(value.reshape(-1))
    dreams = SimpleNamespace(features=features, weight=jnp.ones((4, 8)))

    def losses(returns):
        found = scene.critic_loss({}, "critic_r", dreams, returns)
        both = scene.critic_loss_with_rows({}, "critic_r", dreams, returns, reward, discount)
        return [float(found), float(both)]

    np.testing.assert_allclose(losses(features[:-1, :, 0]), 0, atol=1e-10)
    assert min(losses(features[1:, :, 0])) > 0.1


def test_a_critic_is_held_back_by_what_its_slow_copy_says(monkeypatch):
    """-log p(R) - log p(V'), where V' is that of the copy and no function of the critic."""
    keys = jax.random.split(jax.random.key(0), 2)
    critic, returns = jax.random.normal(keys[0], (5, two_hot.BINS)), jax.random.normal(keys[1], (5,))
    monkeypatch.setattr(Scene, "logits", lambda self, critic, features: critic)
    monkeypatch.setattr(Scene, "value", lambda self, critic, features: critic.mean(-1))
    copy = jnp.arange(5.0)
    params: Any = {
        "critic_r": 9 * critic,
        "targets": {"critic_r": jnp.tile(copy[:, None], two_hot.BINS)},
    }
    unused: Any = None
    scene = Scene(Corridor(), unused, params, unused, unused, (), dreamer.DreamerConfig(), None)
    found = scene._loss({"critic_r": critic}, "critic_r", unused, returns)
    log_p = jax.nn.log_softmax(critic)
    expected = -((two_hot.two_hot(returns) + two_hot.two_hot(copy)) * log_p).sum(-1)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_a_gradient_step_is_the_same_with_the_gradients_of_sequences_and_dreams_at_once(monkeypatch):
    """As GPUs take them. The model learns along rows and in dreams, the actor through its dreams."""
    cfg = dreamer.DreamerConfig(size="tiny", actor_grad="backprop", imagine_steps=3, overshoot=2)
    rows, env = recorded(Ticker(episode_length=5, lives=(3, 9)), 8), Ticker()
    monkeypatch.setattr(dreaming, "laprop", lambda lr, cfg: optax.sgd(1.0))
    learner = dreaming_learner(env, dreamer.blind)
    at = GradientStep(jnp.int32(0), jnp.float32(1), jax.random.key(1))
    batch = SequenceBatch(rows, jnp.full(3, 1 / 3))
    nets = jax.jit(lambda key: learner.init(key, 3, 1, cfg), compiler_options=FAST)(jax.random.key(0))
    params = jax.tree.map(lambda x: x + 0.1 * jnp.sin(jnp.arange(x.size)).reshape(x.shape), nets.params)
    nets = nets._replace(params=params)

    def moved_by(run):
        monkeypatch.setattr(world_model, "states_along", run)
        step = jax.jit(lambda nets: learner.step(nets, batch, at, cfg, None)[0], compiler_options=FAST)
        after = step(nets).params
        return {x: ravel_pytree(after[x])[0] - ravel_pytree(params[x])[0] for x in ("model", "actor")}

    one_by_one, at_once = moved_by(recurrent.scanned), moved_by(recurrent.gradient_at_once)
    for name, moves in one_by_one.items():
        assert jnp.abs(moves).max() > 1e-3
        np.testing.assert_allclose(at_once[name], moves, rtol=1e-3, atol=1e-5)


def test_each_network_learns_of_its_own_loss_alone(monkeypatch):
    """By backprop, where what actors and critics learn is a function of latents and of one another.
    Without the actor's loss model and critic learn the same, and without the critic's model and actor
    do. The slow copy takes on a share of the critic."""
    cfg = dreamer.DreamerConfig(
        size="tiny", actor_grad="backprop", imagine_steps=2, replay_value=0.5, tau=0.25
    )
    rows, env = recorded(Ticker(episode_length=5, lives=(3, 9)), 8), Ticker()
    monkeypatch.setattr(dreaming, "laprop", lambda lr, cfg: optax.sgd(1.0))
    learner = dreaming_learner(env, dreamer.blind)
    at = GradientStep(jnp.int32(0), jnp.float32(1), jax.random.key(1))

    def stepped(nets):
        batch = SequenceBatch(rows, jnp.full(3, 1 / 3))
        return learner.step(nets, batch, at, cfg, None)[0].params

    init = jax.jit(lambda key: learner.init(key, 3, 1, cfg), compiler_options=FAST)
    nets = init(jax.random.key(0))
    params = jax.tree.map(
        lambda x: x + 0.1 * jnp.sin(jnp.arange(x.size)).reshape(x.shape), nets.params
    )  # heads and critics are 0 at first
    nets, names = nets._replace(params=params), ("model", "actor", "critic_r")

    def moves():
        after = jax.jit(lambda nets: stepped(nets), compiler_options=FAST)(nets)
        moved = {x: ravel_pytree(after[x])[0] - ravel_pytree(params[x])[0] for x in names}
        return moved, after

    whole, after = moves()
    assert all(jnp.linalg.norm(x) > 1e-3 for x in whole.values())
    slow, before = after["targets"]["critic_r"], params["targets"]["critic_r"]
    share = jax.tree.map(lambda x, y: 0.75 * x + 0.25 * y, before, after["critic_r"])
    np.testing.assert_allclose(ravel_pytree(slow)[0], ravel_pytree(share)[0], rtol=1e-4, atol=1e-5)
    for name, loss in (("actor", "actor_loss"), ("critic_r", "critic_loss_with_rows")):
        with monkeypatch.context() as without:
            without.setattr(Scene, loss, lambda *args: jnp.zeros(()))
            rest, _ = moves()
        assert not rest.pop(name).any()
        for other, found in rest.items():
            apart = jnp.linalg.norm(found - whole[other]) / jnp.linalg.norm(whole[other])
            assert apart < 1e-4, (name, other)


def test_actors_and_critics_learn_from_a_dream_as_much_as_it_weighs(monkeypatch):
    """And dreams begin at all rows of the batch, with k_0 = 0 where an episode failed, and 1 where it
    ran out of time."""
    keys = jax.random.split(jax.random.key(0), 6)
    advantage, log_prob, entropy, of_critic = (jax.random.normal(key, (2, 6)) for key in keys[:4])
    weight = jax.random.uniform(keys[4], (3, 6))
    cfg, no = dreamer.DreamerConfig(entropy_coef=0.5), jnp.zeros((3, 2), bool)
    zeros = jnp.zeros((3, 2))
    rows = Record(
        obs=zeros[..., None], action=zeros[..., None], reward=zeros, cost=zeros, costs=zeros[..., None],
        first=no, terminated=no.at[1, 0].set(True), truncated=no.at[1, 1].set(True),
    )  # fmt: skip
    share = jnp.array([0.75, 0.25])  # of the two sequences
    latents = rssm.Latent(jax.random.normal(keys[5], (3, 2, 5)), jnp.zeros((3, 2, 4)))
    unused: Any = None
    scene = Scene(Corridor(), unused, {"model": ()}, SequenceBatch(rows, share), latents, (), cfg, None)
    dreams = Dreams(zeros, advantage, log_prob, entropy, {}, weight)
    each = jnp.tile(share, 3) / 3  # of a dream: those of the first rows come first
    loss = -(weight[:2] * (advantage * log_prob + 0.5 * entropy) * each).sum() / 2
    np.testing.assert_allclose(scene.actor_loss(dreams, advantage), loss, rtol=1e-5)
    monkeypatch.setattr(Scene, "_loss", lambda *args: of_critic)
    loss = (weight[:2] * of_critic * each).sum() / 2
    np.testing.assert_allclose(scene.critic_loss({}, "critic_r", dreams, zeros), loss, rtol=1e-5)

    def asked(world, params, policy, actor, start, alive, *_):
        return start, alive

    monkeypatch.setattr(dreaming, "dream", asked)
    found: Any = scene.dream((), keys[0])
    start, alive = found
    np.testing.assert_array_equal(start.deter, latents.deter.reshape(6, 5))
    np.testing.assert_array_equal(alive, [1, 1, 0, 1, 1, 1])


def test_returns_are_scaled_by_their_running_percentiles_but_not_magnified_beyond_the_least_scale():
    returns = jnp.arange(101.0)  # P5 = 5, P95 = 95
    one = moved(Range(jnp.float32(0), jnp.float32(0)), returns, None)
    np.testing.assert_allclose(one, [0.05, 0.95], rtol=1e-5)
    assert one.scale(1.0) == 1
    np.testing.assert_allclose(one.scale(0.1), 0.9, rtol=1e-5)
    two = moved(one, returns, None)
    np.testing.assert_allclose(two.scale(1.0), 0.9 * (1 + 0.99), rtol=1e-5)


def test_only_long_gradients_are_shortened_array_by_array():
    params = {"a": jnp.array([3.0, 4.0]), "b": jnp.zeros(2)}
    grads = {"a": jnp.array([0.9, 1.2]), "b": jnp.array([3.0, 4.0])}  # lengths 1.5 and 5
    clip = world_model.clip_by_share(0.3)
    got: Any
    got, _ = clip.update(grads, clip.init(params), params)
    np.testing.assert_allclose(got["a"], grads["a"], rtol=1e-6)  # just within 0.3 * 5
    np.testing.assert_allclose(jnp.linalg.norm(got["b"]), 0.3 * 1e-3, rtol=1e-5)


def test_the_lengths_of_arrays_of_one_size_of_others_and_of_large_ones(monkeypatch):
    monkeypatch.setattr(world_model, "SMALL", 6)
    shapes = [(7,), (7,), (3,), (2, 3), (0,), (3,), (6,)]
    keys = jax.random.split(jax.random.key(0), len(shapes))
    arrays = [jax.random.normal(key, shape) for key, shape in zip(keys, shapes, strict=True)]
    found = world_model.lengths(arrays)
    np.testing.assert_allclose(found, [np.linalg.norm(x) for x in arrays], rtol=1e-6)


def test_steps_rise_to_the_learning_rate_and_forget_the_size_of_gradients():
    cfg = dreamer.DreamerConfig(lr_warmup=4, clip=1e9)
    rule = world_model.laprop(0.1, cfg)
    state, params = rule.init(jnp.ones(2)), jnp.ones(2)
    for step in range(6):
        change: Any
        change, state = rule.update(jnp.array([1e-4, -50.0]), state, params)
        lr = 0.1 * min(1, (step + 1) / 4)
        np.testing.assert_allclose(change, [-lr, lr], rtol=1e-4)


# ---- what meets what ---------------------------------------------------------------------------


class Glass:
    """A model one can look through: its latent is the observation, what was observed before, and the
    action in between. It foretells the clock of `Ticker` from what was observed before, and what `Echo`
    earns and costs. It stands for `WorldModel` in the loss, in its latents and in the policy."""

    decoder = SimpleNamespace(loss=lambda decoded, obs: ((decoded - obs) ** 2).sum(-1))

    def apply(self, params: Any, *args: Any, method: str) -> Any:
        return getattr(self, method)(*args)

    def init(self, key, obs, action, method):
        return {"nothing": jnp.zeros(1)}

    def embed(self, obs):
        return obs

    def start(self):
        return rssm.Latent(jnp.zeros(4), jnp.zeros(3))  # name, clock, life before; action; all now

    def observe(self, latent, action, embedded, key):
        before = jnp.concatenate([latent.stoch, action], -1)
        return rssm.Latent(before, embedded)

    def decode(self, latent):
        return latent.stoch

    def beliefs(self, deter, embedded):
        """What is believed of the clock, of two classes, before and after it is seen."""
        of_clock = [jnp.stack([clock, -clock], -1) for clock in (deter[..., 1] + 1, embedded[..., 1])]
        return [jax.nn.log_softmax(x[..., None, :]) for x in of_clock]

    def read(self, features):
        reward = echoed(rssm.Latent(features[..., :4], features[..., 4:]))
        _, clock, life = jnp.moveaxis(features[..., 4:], -1, 0)
        safe = jnp.float32(reward <= DEAR)
        cost = ambs.AMBSConfig.violation_cost * (1 - safe)
        return {"reward": reward, "cost": cost, "safe": safe, "cont": jnp.float32(clock < life)}


GLASS: Any = Glass()
DEAR = 20.5


@dataclasses.dataclass(frozen=True)
class Echo(Ticker):
    """A ticker that earns its name, its clock and the action. It costs 1 where that is above `DEAR`."""

    def step(self, state, action):
        after = super().step(state, action)
        reward = state.obs[0] + 10 * state.obs[1] + action[0]
        return dataclasses.replace(after, reward=reward, cost=jnp.float32(reward > DEAR))


def echoed(latents: rssm.Latent) -> jax.Array:
    """The reward that a latent of `Glass` foretells."""
    name, clock, _, action = jnp.moveaxis(latents.deter, -1, 0)
    return name + 10 * clock + action


@cache
def recorded(env: Any, steps: int) -> Record:
    """Rows [T, N] of three environments with random actions, of the loop's own rollout."""

    def act(carry, state, first, key):
        return jax.random.uniform(key, (3, 1), minval=-1.0), carry, {}

    def play(key):
        stepping = started(init_rollout(env, key, 3, stagger=False))
        return collect_records(env, act, stepping, jax.random.split(key, steps))[1][0]

    return jax.jit(play, compiler_options=FAST)(jax.random.key(1))


def test_a_reward_meets_the_latent_of_the_observation_that_it_came_with():
    """And a reward a step late, an observation a step late or a forgotten start is noticed."""
    rows = recorded(Echo(episode_length=5, lives=(3, 9)), 24)
    ring = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), rows)
    source = Source(ring, Span(jnp.int32(0), jnp.int32(24)), (), 64 * 8, 7)
    batch, _ = drawn_sequences(jax.random.key(2), source, None, None)
    assert batch.rows.first[1:].any() and batch.rows.terminated.any() and batch.rows.truncated.any()

    def worst(rows: Any, **changes: Any) -> jax.Array:
        """The largest error where there was a step: not in a sequence's first row, nor at a start."""
        rows = rows.replace(**changes)
        latents = likeliest_latents(GLASS, {}, rows)
        known = ~batch.rows.first[1:]
        return jnp.where(known, jnp.abs(echoed(latents)[1:] - rows.reward[1:]), 0).max()

    rows: Any = batch.rows
    assert worst(rows) < 1e-5
    assert worst(rows, reward=jnp.roll(rows.reward, -1, axis=0)) > 1
    assert worst(rows, obs=jnp.roll(rows.obs, 1, axis=0)) > 1
    assert worst(rows, action=jnp.roll(rows.action, 1, axis=0)) > 0.5

    latents = likeliest_latents(GLASS, {}, rows)
    starts = rows.first.at[0].set(True)
    assert (latents.deter[starts] == 0).all()  # nothing is remembered
    forgotten: Any = rows.replace(first=jnp.zeros_like(rows.first))
    latents = likeliest_latents(GLASS, {}, forgotten)
    assert (jnp.abs(latents.deter[starts]) > 0).any()

    cfg = dreamer.DreamerConfig()
    cont = world_model.goes_on(rows, cfg)
    np.testing.assert_array_equal(cont, ~rows.terminated)
    ends = world_model.goes_on(rows, dataclasses.replace(cfg, limit_ends=True))
    np.testing.assert_array_equal(ends, ~rows.last)


def test_the_model_s_loss_meets_each_row_with_its_own_latent(monkeypatch):
    """Through `Glass` nothing is left to learn of `Echo` but where a memory begins: there the clock was
    believed to be 1. A target, an observation or a belief a step off is noticed."""
    rows: Any = recorded(Echo(episode_length=5, lives=(3, 9)), 24)
    starts = rows.first.at[0].set(True)
    known: Any = rows.replace(reward=jnp.where(starts, 0.0, rows.reward))
    monkeypatch.setattr(world_model, "head_loss", lambda outputs, target: (outputs - target) ** 2)
    weight = jnp.array([0.5, 0.25, 0.25])
    cfg = dreamer.DreamerConfig(free_nats=0.0)

    def losses(**changes: Any) -> dict[str, jax.Array]:
        of: Any = known.replace(**changes)
        args = SequenceBatch(of, weight), {"reward": of.reward}, jax.random.key(0), cfg
        return world_model.model_loss(GLASS, {}, *args)[1][1]

    found = losses()
    np.testing.assert_allclose(found["train/model_reward_loss"], 0, atol=1e-6)
    np.testing.assert_array_equal(found["train/model_obs_loss"], 0)
    believed, seen = GLASS.beliefs(jnp.zeros((*starts.shape, 4)), rows.obs)
    nats = rssm.kl(seen, believed)
    expected = (weight * jnp.where(starts, nats, 0.0).mean(0)).sum()
    np.testing.assert_allclose(found["train/model_kl"], expected, rtol=1e-4)
    late = losses(reward=jnp.roll(known.reward, 1, axis=0))
    assert late["train/model_reward_loss"] > 1


def test_a_gradient_step_gives_each_head_of_the_model_the_target_of_its_row(monkeypatch):
    """Through `Glass` nothing is left to learn of `Echo`: of its reward, of the costs that the shield
    foresees, and of its ends. The latents that the behaviour is given are those of the rows, too."""
    monkeypatch.setattr(world_model, "head_loss", lambda outputs, target: (outputs - target) ** 2)
    monkeypatch.setattr(dreaming, "world_of", lambda *_: GLASS)
    rows: Any = recorded(Echo(episode_length=5, lives=(3, 9)), 24)
    starts = rows.first.at[0].set(True)  # there nothing is remembered
    reward, cost = (jnp.where(starts, 0.0, x) for x in (rows.reward, rows.cost))
    known: Any = rows.replace(reward=reward, cost=cost)
    assert 0.1 < known.cost.mean() < 0.9 and known.terminated.any()

    def idle(trained, memory, scene, key):
        worst = jnp.abs(echoed(scene.latents) - scene.batch.rows.reward).max()
        return Outcome(jnp.zeros(()), memory, {"worst": worst})

    behaviour = ambs.shielded_behaviour._replace(learn=idle, actors=(), critics=())
    learner, cfg = dreaming_learner(Echo(), behaviour), ambs.AMBSConfig(size="tiny", overshoot=0)
    nets = learner.init(jax.random.key(0), 3, 1, cfg)
    at = GradientStep(jnp.int32(0), jnp.float32(1), jax.random.key(1))
    _, metrics = learner.step(nets, SequenceBatch(known, jnp.full(3, 1 / 3)), at, cfg, None)
    heads = [f"train/model_{name}_loss" for name in behaviour.all_heads(cfg)]
    found = jnp.stack([metrics[name] for name in ("worst", *heads)])
    np.testing.assert_allclose(found, 0, atol=1e-6)


def test_the_policy_remembers_what_the_model_learns_from():
    """Acting through episodes and their ends, and going through the rows, give the same latents."""
    env = Ticker(episode_length=5, lives=(3, 9))
    algo, cfg = ALGOS["dreamer"].make(env), dreamer.DreamerConfig(**THREE)
    ts = jax.jit(lambda key: algo.init(key, cfg, START), compiler_options=FAST)(jax.random.key(0))
    learned = algo.learned(ts)
    player = Player(algo.policy, learned, env)

    def act(learned, carry, obs, key):
        return algo.policy.act(learned, carry, obs, None)

    likeliest = player._replace(policy=algo.policy._replace(act=act))

    @jax.jit
    def both(stepping, keys):
        def step(stepping, key):
            stepping, (rows, _) = collect_records(env, likeliest.act_in_all, stepping, key[None])
            row = jax.tree.map(lambda x: x[0], rows)
            return stepping, (row, stepping.rollout.carry.latent)

        return jax.lax.scan(step, stepping, keys)[1]

    rows, acted = both(ts.stepping, jax.random.split(jax.random.key(1), 16))
    assert rows.first[1:].any()
    world = world_model.world_of(env, dreamer.blind.all_heads(cfg), cfg)
    latents = likeliest_latents(world, learned.params["model"], rows)
    np.testing.assert_allclose(acted.features, latents.features, atol=1e-5)
    late = rows.replace(action=jnp.roll(rows.action, 1, axis=0))
    other = likeliest_latents(world, learned.params["model"], late)
    assert jnp.abs(other.features - latents.features).max() > 1e-3


@cache
def tiny() -> tuple[rssm.WorldModel, Any]:
    """The smallest model of Ticker, and its parameters."""
    cfg = dreamer.DreamerConfig(size="tiny")
    world = world_model.world_of(Ticker(), dreamer.blind.all_heads(cfg), cfg)
    init = jax.jit(partial(world.init, method="everything"), compiler_options=FAST)
    return world, init(jax.random.key(0), jnp.zeros(3), jnp.zeros(1))


@pytest.mark.parametrize("method", ["observe", "imagine"])
def test_what_was_done_beyond_the_bounds_is_remembered_as_the_bound(method):
    """Both with and without an observation, so that dreams go on as the world does."""
    world, params = tiny()
    embedded: Any = world.apply(params, jnp.zeros(3), method="embed")
    start: Any = jax.tree.map(lambda x: x + 0.5, world.apply(params, method="start"))
    seen = (embedded,) if method == "observe" else ()

    def after(action):
        args = start, jnp.array([action]), *seen, jax.random.key(1)
        found: Any = world.apply(params, *args, method=method)
        return np.asarray(found.deter)

    np.testing.assert_array_equal(after(3.0), after(1.0))
    assert np.abs(after(3.0) - after(-1.0)).max() > 1e-3


def test_a_sequence_that_begins_anew_is_two_sequences():
    rows = recorded(Ticker(episode_length=5), 12)
    begins = int(jnp.argmax(rows.first[1:, 0])) + 1
    world, params = tiny()
    through = jax.jit(lambda rows: likeliest_latents(world, params, rows))
    whole, alone = through(rows), through(jax.tree.map(lambda x: x[begins:], rows))
    np.testing.assert_array_equal(whole.features[begins:, 0], alone.features[:, 0])


def test_divergences_below_a_nat_are_left_alone_row_by_row():
    """KL(posterior || prior) of each row; the prior has the gradient of its own loss alone."""
    rows = recorded(Ticker(episode_length=5), 12)
    cfg = dreamer.DreamerConfig(size="tiny")
    world, params = tiny()
    batch = SequenceBatch(rows, jnp.array([0.5, 0.25, 0.25]))

    def loss(params, free, dyn, rep):
        of = dataclasses.replace(cfg, free_nats=free, dyn_scale=dyn, rep_scale=rep)
        return world_model.model_loss(world, params, batch, {}, jax.random.key(1), of)

    found = jax.jit(jax.value_and_grad(loss, has_aux=True), compiler_options=FAST)

    def of_prior(free, dyn, rep):
        return jax.tree.leaves(found(params, free, dyn, rep)[1]["params"]["before"])

    (without, (latents, _)), _ = found(params, 0.0, 0.0, 0.0)
    embedded = world.apply(params, rows.obs, method="embed")
    believed: Any = world.apply(params, latents.deter, embedded, method="beliefs")
    prior, posterior = believed
    divergence = (np.exp(posterior) * (posterior - prior)).sum((-2, -1))
    free = float(np.median(divergence))
    total = found(params, free, 2.0, 0.5)[0][0]
    counted = (np.maximum(free, divergence).mean(0) * batch.weight).sum()
    np.testing.assert_allclose(total - without, 2.5 * counted, rtol=1e-4)

    assert all((x == 0).all() for x in of_prior(100.0, 2.0, 0.5))
    assert any((x != 0).any() for x in of_prior(free, 2.0, 0.5))
    for x, y in zip(of_prior(free, 2.0, 0.5), of_prior(free, 2.0, 5.0), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-6)


def test_overshooting_reads_dreams_of_the_replayed_actions_until_an_episode_ends():
    """Against a loop over starts and steps, with sequences that begin anew. No two rows earn the same,
    and the heads tell them apart. So a target or an action a step off is noticed."""
    rows = recorded(Echo(episode_length=5, lives=(3, 9)), 12)
    world, params = tiny()
    params = jax.tree.map(
        lambda x: x + 0.3 * jnp.sin(jnp.arange(x.size)).reshape(x.shape), params
    )  # the heads are 0 at first
    cfg, ahead = dreamer.DreamerConfig(size="tiny", n_step=11, overshoot=4), 4
    weight, key = jnp.array([0.5, 0.25, 0.25]), jax.random.key(3)
    batch = SequenceBatch(rows, weight)
    latents = likeliest_latents(world, params, rows)
    targets = {"reward": rows.reward, "cont": world_model.goes_on(rows, cfg)}
    loss = jax.jit(lambda p: world_model.overshoot_loss(world, p, batch, latents, targets, key, cfg))

    starts, total = 12 - ahead, np.zeros(3)
    now, counts = jax.tree.map(lambda x: x[:starts], latents), np.ones((starts, 3), bool)
    for k, step_key in enumerate(jax.random.split(key, ahead)):
        action = rows.action[k : k + starts]
        now: Any = world.apply(params, now, action, step_key, method="imagine")
        says: Any = world.apply(params, now.features, method="read")
        for i in range(starts):
            ended, begun = rows.last[i + k], rows.first[i + k + 1]
            counts[i] &= ~np.asarray(ended | begun)
            for name, target in targets.items():
                of = world_model.head_loss(says[name][i], target[i + k + 1])
                total += np.where(counts[i], of, 0.0) / (starts * ahead)
    assert 0 < counts.sum() < counts.size  # some dreams go over an end
    np.testing.assert_allclose(loss(params), (weight * total).sum(), rtol=1e-4)
    grads = jax.jit(jax.grad(lambda p: loss(p)))(params)["params"]
    assert all((x == 0).all() for x in jax.tree.leaves(grads["encoder"]))  # the rows are given
    assert any((x != 0).any() for x in jax.tree.leaves(grads["before"]))


def test_the_model_s_loss_has_what_heads_say_in_dreams_only_if_told_to():
    rows, (world, params) = recorded(Ticker(episode_length=5), 12), tiny()
    batch, key = SequenceBatch(rows, jnp.full(3, 1 / 3)), jax.random.key(1)

    @partial(jax.jit, static_argnums=0)
    def found(overshoot, params):
        cfg = dreamer.DreamerConfig(size="tiny", n_step=11, overshoot=overshoot)
        total, (_, metrics) = world_model.model_loss(
            world, params, batch, {"reward": rows.reward}, key, cfg
        )
        return total, metrics

    (without, plain), (whole, metrics) = found(0, params), found(3, params)
    assert "train/model_overshoot_loss" not in plain
    np.testing.assert_allclose(whole - without, metrics["train/model_overshoot_loss"], rtol=1e-3)


@pytest.mark.slow
def test_the_model_foresees_a_deterministic_toy():
    """A point mass: ten steps ahead, unseen, within a quarter of the error of standing still."""
    env, cfg = Corridor(), dreamer.DreamerConfig(size="tiny", lr_warmup=20, free_nats=0.3)
    env = dataclasses.replace(env, dt=0.2, half_width=2.0)
    world = world_model.world_of(env, {"reward": two_hot.BINS}, cfg)
    rule = world_model.laprop(5e-3, cfg)

    def play(key):  # 16 sequences of 16 rows
        reset_key, act_key = jax.random.split(key)
        action = jnp.repeat(jax.random.uniform(act_key, (4, 16, 2), minval=-1.0), 4, axis=0)
        state = jax.vmap(env.reset)(jax.random.split(reset_key, 16))

        def step(state, action):
            return jax.vmap(env.step)(state, action), (state.obs, state.reward)

        obs, reward = jax.lax.scan(step, state, action)[1]
        no = jnp.zeros((16, 16), bool)
        return Record(obs, action, reward, reward, reward[..., None], no, no, no)

    def improve(now, key):
        params, opt_state = now
        rows = play(key)
        batch = SequenceBatch(rows, jnp.full(16, 1 / 16))

        def loss(params):
            return world_model.model_loss(world, params, batch, {"reward": rows.reward}, key, cfg)

        grads = jax.grad(loss, has_aux=True)(params)[0]
        change, opt_state = rule.update(grads, opt_state, params)
        return (optax.apply_updates(params, change), opt_state), None

    @jax.jit
    def trained(key):
        begin = world.init(key, jnp.zeros(4), jnp.zeros(2), method="everything")
        end: Any = jax.lax.scan(improve, (begin, rule.init(begin)), jax.random.split(key, 900))[0]
        params = end[0]
        rows = play(jax.random.key(9))
        latents = likeliest_latents(world, params, rows)
        seen = jax.tree.map(lambda x: x[5], latents)

        def blind(latent, x):
            after: Any = world.apply(params, latent, *x, method="imagine")
            decoded: Any = world.apply(params, after, method="decode")
            return after, two_hot.symexp(decoded)

        keys = jax.random.split(jax.random.key(3), 10)
        foreseen = jax.lax.scan(blind, seen, (rows.action[5:15], keys))[1]
        return foreseen, rows.obs[6:16], rows.obs[5]

    foreseen, came, stood = trained.lower(jax.random.key(0)).compile(FAST)(jax.random.key(0))
    error, still = (jnp.sqrt(((x - came) ** 2).mean((1, 2))) for x in (foreseen, stood))
    assert error[-1] < 0.25 * still[-1], (error, still)


def test_a_task_without_failures_is_foreseen_to_go_on_beyond_its_time_limit():
    """The head `cont` after 60 gradient steps on episodes of 5 steps, of which each sixth row is the
    last. On average k is above 0.9995, and about 5/6 where time limits are learned as failures."""
    env = Ticker(episode_length=5)
    cfg = dreamer.DreamerConfig(size="tiny", lr_warmup=1, model_lr=0.02)
    rows: Any = recorded(env, 12)
    assert rows.truncated.any() and not rows.terminated.any()
    fails = rows.replace(terminated=rows.truncated, truncated=rows.terminated)
    ends = world_model.goes_on(rows, dataclasses.replace(cfg, limit_ends=True))
    np.testing.assert_array_equal(ends, world_model.goes_on(fails, cfg))

    def idle(trained, memory, scene, key):
        return Outcome(jnp.zeros(()), memory, {})

    # without actor and critics, of which the model learns nothing
    model_alone = Behaviour(idle, lambda cfg: (), actors=(), critics=())
    learner = dreaming_learner(env, model_alone)
    world = world_model.world_of(env, model_alone.all_heads(cfg), cfg)
    init = jax.jit(lambda key: learner.init(key, env.obs_size, env.action_size, cfg))

    @jax.jit
    def improved(nets, rows, key):
        batch = SequenceBatch(rows, jnp.full(3, 1 / 3))
        at = GradientStep(jnp.int32(0), jnp.float32(1), key)
        return learner.step(nets, batch, at, cfg, None)[0]

    @jax.jit
    def foreseen(params):
        latents = likeliest_latents(world, params["model"], rows)
        return world_model.read(world, params["model"], latents.features)["cont"].mean()

    def learned_from(rows):
        nets = init(jax.random.key(0))
        for key in jax.random.split(jax.random.key(1), 60):
            nets = improved(nets, rows, key)
        return foreseen(nets.params)

    assert learned_from(rows) > 0.9995
    assert learned_from(fails) < 0.9


def test_settings_take_every_size_by_its_name():
    assert get_args(world_model.SizeName) == tuple(rssm.SIZES)
    assert rssm.SIZES["medium"] is rssm.SIZES["50m"]


def test_hidden_layers_in_bfloat16_change_a_loss_and_its_gradient_little():
    """Rounding errors of 2^-9 each, some tens of them, one upon the other. Of four pixels that are
    nearly alike they make another the largest."""
    draw = jax.random.split(jax.random.key(0), 4)
    latent = rssm.Latent(jax.random.normal(draw[0], (64, 32)), jax.random.normal(draw[1], (64, 16)))
    picture = (255 * jax.random.uniform(draw[2], (64, 12, 12, 3))).astype(jnp.uint8)
    obs = {"vision": picture, "vector": jax.random.normal(draw[3], (64, 7))}

    def model(dtype):
        size = rssm.SIZES["tiny"]._replace(dtype=dtype)
        return rssm.WorldModel(size, coders.Encoder(size, 21), coders.Decoder(size, (12, 12, 3), 7), ())

    def loss(params, dtype):
        world, params = model(dtype), rssm.converted(params, dtype)
        embedded = world.apply(params, obs, method="embed")
        after: Any = world.apply(params, latent, jnp.ones((64, 2)), embedded, None, method="observe")
        believed: Any = world.apply(params, after.deter, embedded, method="beliefs")
        # z of the latent that was given: a rounding would turn over some of its likeliest classes
        seen = rssm.Latent(after.deter, latent.stoch)
        decoded = world.apply(params, seen, method="decode")
        assert {x.dtype for x in jax.tree.leaves((after, believed, decoded))} == FLOAT32
        return world.decoder.loss(decoded, obs).mean() + rssm.kl(*believed).mean()

    init = jax.jit(partial(model("bfloat16").init, method="everything"), compiler_options=FAST)
    params = init(jax.random.key(1), jax.tree.map(lambda x: x[0], obs), jnp.ones(2))
    assert {x.dtype for x in jax.tree.leaves(params)} == FLOAT32
    (rounded, slopes), (exact, exact_slopes) = (
        jax.jit(jax.value_and_grad(partial(loss, dtype=dtype)), compiler_options=FAST)(params)
        for dtype in ("bfloat16", "float32")
    )
    assert 1e-6 < abs(rounded - exact) / exact < 1e-2
    flat, exact_flat = (
        np.concatenate([np.ravel(x) for x in jax.tree.leaves(g)]) for g in (slopes, exact_slopes)
    )
    assert 1e-4 < np.linalg.norm(flat - exact_flat) / np.linalg.norm(exact_flat) < 0.1


def test_weights_are_converted_before_a_loop_and_not_by_its_steps():
    size = rssm.SIZES["tiny"]._replace(dtype="bfloat16")
    world = rssm.WorldModel(size, coders.VectorEncoder(size, 21), coders.VectorDecoder(size, 7), ())
    action, key = jnp.ones(2), jax.random.key(0)
    params = jax.eval_shape(partial(world.init, method="everything"), key, jnp.ones(7), action)
    latent, seen = world.apply({}, method="start"), jnp.ones(size.units)

    def step(params):
        observed: Any = world.apply(params, latent, action, seen, key, method="observe")
        imagined: Any = world.apply(params, latent, action, key, method="imagine")
        return observed, imagined

    def conversions(params):
        program = jax.make_jaxpr(step)(params).jaxpr
        casts = [e for e in program.eqns if e.primitive.name == "convert_element_type"]
        return sum(e.invars[0] in program.invars for e in casts)

    converted = jax.eval_shape(partial(rssm.converted, dtype="bfloat16"), params)
    layers = (5 + 1) + (5 + 2)  # of the memory, and what follows it
    assert conversions(params) == 2 * layers and conversions(converted) == 0
    assert jax.tree.map(jnp.shape, converted) == jax.tree.map(jnp.shape, params)
    assert rssm.converted(params, "float32") is params
