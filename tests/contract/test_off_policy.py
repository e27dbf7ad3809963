"""What every off-policy algorithm must do, on toys, and SAC's equations by hand."""

import dataclasses
import operator
import os
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import FAST
from toys import START, Corridor, Lever, Ticker

from jaxsafe.algos import ALGOS, sac
from jaxsafe.config import ConfigError
from jaxsafe.learn.acting import Player
from jaxsafe.learn.learner import GradientStep
from jaxsafe.learn.next_step_rollout import collect_records
from jaxsafe.learn.off_policy import OffPolicyConfig
from jaxsafe.learn.replay import Transitions
from jaxsafe.learn.steps import Trainable
from jaxsafe.nn.critics import q_values
from jaxsafe.types import Env, Shared, State

NAMES = [name for name, entry in ALGOS.items() if issubclass(entry.config, OffPolicyConfig)]
TINY: dict[str, Any] = {
    "num_envs": 8,
    "horizon": 6,
    "learn_every": 2,
    "batch_size": 32,
    "replay_ratio": 4,
    "replay_size": 8 * 18,
    "learning_starts": 8 * 7,  # one iteration, and a row
    "hidden": (8,),
}


@cache
def build(name, env: Env = Corridor(), **settings):  # noqa: B008
    """The algorithm, and its update compiled as the training loop does, which uses up its argument."""
    algo = ALGOS[name].make(env)
    cfg = ALGOS[name].config(**TINY | settings)
    like = jax.eval_shape(lambda key: algo.init(key, cfg, START), jax.random.key(0))
    return algo, jax.jit(algo.update, donate_argnums=0).lower(like, START).compile(FAST)


@cache
def together(name):
    """Four members of the same sizes at once: their states and the compiled update."""
    algo, cfg = ALGOS[name].make(Corridor()), ALGOS[name].config(**TINY)

    def init(key, discount):
        return algo.init(key, dataclasses.replace(cfg, discount=discount), START)

    keys, discounts = jax.random.split(jax.random.key(3), 4), jnp.array([0.99, 0.9, 0.99, 0.5])
    ts = jax.jit(jax.vmap(init), compiler_options=FAST)(keys, discounts)
    update = jax.jit(jax.vmap(algo.update, in_axes=(0, None)), donate_argnums=0)
    return ts, update.lower(ts, START).compile(FAST)


def copy(tree):
    return jax.tree.map(jnp.copy, tree)


def start(name, seed=0, env: Env = Corridor(), **settings):  # noqa: B008
    algo, cfg = ALGOS[name].make(env), ALGOS[name].config(**TINY | settings)
    return jax.jit(lambda key: algo.init(key, cfg, START), compiler_options=FAST)(jax.random.key(seed))


def at(iteration, since=0):
    return Shared(np.int32(iteration), np.int32(since))


def row(tree, i):
    return jax.tree.map(operator.itemgetter(i), tree)


def numbers(tree):
    """Leaves as arrays, keys as their data."""
    keys = jax.dtypes.prng_key
    return [
        jax.random.key_data(x) if jnp.issubdtype(x.dtype, keys) else x for x in jax.tree.leaves(tree)
    ]


def differ(a, b):
    return [bool((x != y).any()) for x, y in zip(numbers(a), numbers(b), strict=True)]


# ---- the contract ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_an_update_keeps_the_structure_and_learns_once_the_warm_up_is_over(name):
    before, update = start(name), build(name)[1]
    ts = copy(before)
    for iteration in range(2):
        ts, metrics = update(ts, at(iteration))
        assert all(x.dtype == jnp.float32 and x.shape == () for x in metrics.values())
        assert metrics["train/nonfinite"] == 0
        assert any(differ(before.params, ts.params)) == (iteration > 0)
        assert jnp.isnan(metrics["train/critic_loss"]) == (iteration == 0)
    assert jax.tree.structure(before) == jax.tree.structure(ts)
    assert [x.aval for x in jax.tree.leaves(before)] == [x.aval for x in jax.tree.leaves(ts)]
    assert all(differ(before.params, ts.params))
    learned = (ts.params, ts.opt_state, ts.normaliser, ts.replay)
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(learned))


@pytest.mark.parametrize("name", NAMES)
def test_the_first_actions_are_uniform_and_a_resumed_run_acts_by_its_policy_while_it_refills(name):
    ts, update = start(name), build(name)[1]
    fixed = jax.tree.map(lambda x: jnp.full_like(x, -5.0), ts.params)  # acts by the lower bounds
    ts = dataclasses.replace(ts, params=fixed)
    fresh, _ = update(copy(ts), at(0))
    again, metrics = update(copy(ts), at(40, since=40))
    random, chosen = np.asarray(fresh.replay.action)[:6], np.asarray(again.replay.action)[6:12]
    assert abs(np.mean(random > 0.5) - 0.25) < 0.15 and abs(np.mean(random < -0.5) - 0.25) < 0.15
    assert (chosen < -0.99).all()
    assert not any(differ(fixed, again.params)) and jnp.isnan(metrics["train/critic_loss"])
    later, metrics = update(copy(again), at(41, since=40))
    assert any(differ(fixed, later.params)) and jnp.isfinite(metrics["train/critic_loss"])


@pytest.mark.parametrize("name", NAMES)
def test_seeds_and_floats_side_by_side_are_the_lone_ones(name):
    ts, vmapped = together(name)
    ts, update = copy(ts), build(name)[1]
    lone = [row(ts, i) for i in range(4)]
    for iteration in range(4):  # the ring is full after three
        ts, metrics = vmapped(ts, at(iteration))
        for i in range(4):
            lone[i], alone = update(lone[i], at(iteration))
            for x, y in zip(numbers(row(ts, i)), numbers(lone[i]), strict=True):
                np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-4)
            for x, y in zip(numbers(row(metrics, i)), numbers(alone), strict=True):
                np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("members", [1, 4])
@pytest.mark.parametrize("name", NAMES)
def test_the_compiled_update_writes_into_the_ring_in_place(name, members):
    """No scatter, and no second ring."""
    ts, compiled = (start(name), build(name)[1]) if members == 1 else together(name)
    text: Any = compiled.as_text()
    shapes = {f"[{','.join(map(str, x.shape))}]" for x in jax.tree.leaves(ts.replay)}
    made = [line for line in text.splitlines() if any(s in line.partition("(")[0] for s in shapes)]
    assert any(" dynamic-update-slice(" in line for line in made)
    assert not any(" copy(" in line for line in made)
    assert " scatter(" not in text
    memory: Any = compiled.memory_analysis()
    size = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(ts.replay))
    assert memory.alias_size_in_bytes > size


@pytest.mark.parametrize("name", NAMES)
def test_a_world_that_is_not_finite_costs_the_others_nothing_and_is_counted(name):
    ts, update = start(name), build(name)[1]
    rollout = ts.stepping.rollout
    state = dataclasses.replace(
        rollout.state,
        physics=rollout.state.physics.at[0].set(jnp.nan),
        obs=rollout.state.obs.at[0].set(jnp.nan),
    )
    rollout = dataclasses.replace(rollout, state=state)
    before = dataclasses.replace(ts, stepping=dataclasses.replace(ts.stepping, rollout=rollout))
    ts = copy(before)
    for iteration in range(2):
        ts, metrics = update(ts, at(iteration))
        assert metrics["train/bad_worlds"] == (iteration == 0)  # it is reset
    assert metrics["train/nonfinite"] > 0 and jnp.isnan(ts.replay.reward[:, 0]).any()
    assert jnp.isfinite(metrics["train/critic_loss"])
    learned = (ts.params, ts.opt_state, ts.normaliser, ts.episode_length)
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(learned))
    assert all(differ(before.params, ts.params))


@pytest.mark.parametrize("name", NAMES)
def test_what_acts_is_small_and_its_mean_action_needs_no_key(name):
    algo = ALGOS[name].make(Corridor())
    learned = algo.learned(start(name))
    player = Player(algo.policy, learned, algo.task(learned))
    state = Corridor().reset(jax.random.key(0))
    mean, carry = player.act(player.begin(), state)
    assert mean.shape == (2,) and carry == () and (jnp.abs(mean) < 1).all()
    np.testing.assert_array_equal(mean, player.act((), state)[0])
    keys = jax.random.split(jax.random.key(1), 2000)
    draws = jax.vmap(lambda key: player.act((), state, key)[0])(keys)
    np.testing.assert_allclose(np.median(draws, axis=0), mean, atol=0.1)
    assert draws.std(0).min() > 0.05
    parts = {f.name for f in dataclasses.fields(learned)}
    assert parts == {"config", "params", "dual", "normaliser"}


@pytest.mark.parametrize("name", NAMES)
def test_published_settings_build(name):
    algo = ALGOS[name].make(Corridor())
    for settings in ALGOS[name].published.values():
        cfg = ALGOS[name].config(**settings)
        before = jax.eval_shape(lambda key, cfg=cfg: algo.init(key, cfg, START), jax.random.key(0))
        after, _ = jax.eval_shape(algo.update, before, START)
        assert jax.tree.structure(before) == jax.tree.structure(after)


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"batch_size": 24}, r"replay_ratio=4.*replay_ratio=3 or batch_size=32"),
        ({"batch_size": 96}, r"replay_ratio=6 or batch_size=64 or learn_every=3"),
        ({"learn_every": 4}, r"learn_every=4: expected a divisor of horizon=6; the nearest is 3"),
        ({"replay_ratio": 0}, "replay_ratio=0: expected a whole number between 1 and"),
        ({"replay_size": 1, "batch_size": 64}, "replay_size=1 holds 6 steps of 8 environments"),
        ({"n_step": 18}, "more than n_step=18 steps"),
        ({"learning_starts": -1}, "learning_starts=-1: expected a whole number between 0 and"),
    ],
)
def test_sizes_that_do_not_fit_are_refused_with_the_nearest_that_do(settings, message):
    with pytest.raises(ConfigError, match=message):
        start("sac", **settings)


def test_the_clocks_count_environment_steps_and_gradient_steps():
    cfg = ALGOS["sac"].config(**TINY)
    assert ALGOS["sac"].make(Corridor()).clocks(cfg) == (8 * 6, 3 * (4 * 8 * 2 // 32))
    fast = ALGOS["sac"].config()
    assert ALGOS["sac"].make(Corridor()).clocks(fast) == (1024 * 16, 16 * 4)


@dataclass(frozen=True)
class Sized(Ticker):
    """As large as point_goal1 to a replay."""

    obs_size: int = 60
    action_size: int = 2
    cost_names: tuple[str, ...] = ("hazards", "vases")

    def reset(self, key: jax.Array) -> State:
        state = super().reset(key)
        return dataclasses.replace(state, obs=jnp.zeros(60))


def test_a_million_transitions_of_point_goal1_take_little_room():
    algo, cfg = ALGOS["sac"].make(Sized()), ALGOS["sac"].config(num_envs=1000, replay_size=1_000_000)
    cfg = dataclasses.replace(cfg, batch_size=4000)
    ts = jax.eval_shape(lambda key: algo.init(key, cfg, START), jax.random.key(0))
    transitions = ts.replay.reward.size
    size = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(ts.replay))
    assert abs(transitions - 1_000_000) <= 16 * 1000
    assert size == transitions * (4 * (60 + 2 + 1 + 1 + 2) + 3) and size < 0.28e9


# ---- environments that reset on the next step --------------------------------------------------


def test_the_last_observation_of_an_episode_has_a_row_and_the_next_row_is_a_reset():
    env = Ticker(episode_length=4, lives=(2, 6))  # terminates after 2 to 4 steps, or is out of time
    ts = start("sac", env=env, num_envs=5, horizon=40, learn_every=40, replay_ratio=1, batch_size=200,
               replay_size=400, stagger=False)  # fmt: skip
    keys = jax.random.split(jax.random.key(1), 40)
    act = lambda obs, key: jnp.zeros((5, 1))  # noqa: E731
    _, (rows, steps) = jax.jit(lambda x: collect_records(env, act, x, keys))(ts.stepping)
    name, clock, life = np.moveaxis(np.asarray(rows.obs), -1, 0)
    last = np.asarray(rows.terminated | rows.truncated)
    assert rows.first[0].all() and (np.asarray(rows.first[1:]) == last[:-1]).all()
    assert (np.asarray(rows.terminated) == (clock == np.minimum(life, 9)) & (clock > 0)).all()
    assert (np.asarray(rows.truncated) == (clock == 4) & (life > 4)).all()
    assert (np.asarray(rows.reward) == ~np.asarray(rows.first)).all()
    same = name[1:] == name[:-1]
    assert (same == ~last[:-1]).all() and (clock[1:][same] == clock[:-1][same] + 1).all()
    assert (clock[np.asarray(rows.first)] == 0).all()
    ended = np.asarray(steps.ended)
    assert (ended[:-1] == last[1:]).all() and (np.asarray(steps.real) == ~last).all()
    np.testing.assert_array_equal(np.asarray(steps.episode.ret)[ended], np.asarray(steps.length)[ended])


def test_metrics_are_of_the_episodes_that_ended():
    env = Ticker(episode_length=5, lives=(3, 3))
    sizes = {"horizon": 16, "learn_every": 16, "stagger": False, "replay_size": 8 * 32}
    _, m = build("sac", env, **sizes)[1](start("sac", env=env, **sizes), START)
    expected = {"episodes": 4 * 8, "return": 3, "cost": 6, "cost_a": 1.5, "cost_b": 4.5, "ticks": 3}
    expected |= {"episode_length": 3, "cost_rate": 2}  # per step: a reset is none
    for name, x in expected.items():
        np.testing.assert_allclose(m[f"train/{name}"], x, rtol=1e-6)


# ---- SAC by hand -------------------------------------------------------------------------------


class ByHand:
    """SAC's gradient step in float64, with linear networks and numerical gradients."""

    def __init__(self, params, batch, noise, discount, alpha):
        self.p = jax.tree.map(np.float64, params)
        self.b, self.noise, self.discount, self.alpha = batch, noise, discount, alpha

    def pi(self, actor, obs, noise):
        out = obs @ actor["kernel"] + actor["bias"]
        mean, log_std = np.split(out, 2, axis=-1)
        u = mean + np.exp(log_std) * noise
        log_prob = -0.5 * noise**2 - log_std - 0.5 * np.log(2 * np.pi) - np.log(1 - np.tanh(u) ** 2)
        return np.tanh(u), log_prob.sum(-1)

    def q(self, critics, obs, action):
        pair = np.concatenate([obs, action], -1)
        return (np.einsum("bi,nij->nbj", pair, critics["kernel"]) + critics["bias"][:, None])[..., 0]

    def target(self):
        action, log_prob = self.pi(self.p["actor"], self.b.next_obs, self.noise[0])
        v = self.q(self.p["target_r"], self.b.next_obs, action).min(0) - self.alpha * log_prob
        return self.b.reward + self.discount**self.b.steps * (1 - self.b.terminated) * v

    def critic_loss(self, critics):
        errors = self.q(critics, self.b.obs, self.b.action) - self.target()
        return (self.b.weight * errors**2).sum()

    def actor_loss(self, actor, critics):
        action, log_prob = self.pi(actor, self.b.obs, self.noise[1])
        best = self.q(critics, self.b.obs, action).min(0)
        return (self.b.weight * (self.alpha * log_prob - best)).sum()


def numerical(loss, params, eps=1e-6):
    """The gradient of `loss` by central differences."""

    def one(name, index):
        def moved(by):
            x = params[name].copy()
            x[index] += by
            return loss({**params, name: x})

        return (moved(eps) - moved(-eps)) / (2 * eps)

    return {
        name: np.array([one(name, i) for i in np.ndindex(x.shape)]).reshape(x.shape)
        for name, x in params.items()
    }


def adam_by_hand(params, grads, lr, count, mu, nu):
    mu = {k: 0.9 * mu[k] + 0.1 * grads[k] for k in grads}
    nu = {k: 0.999 * nu[k] + 0.001 * grads[k] ** 2 for k in grads}
    scale = {k: np.sqrt(nu[k] / (1 - 0.999**count)) + 1e-8 for k in grads}
    return {k: params[k] - lr * mu[k] / (1 - 0.9**count) / scale[k] for k in grads}, mu, nu


NARROW = {"f": np.float32, "i": np.int32}


def dense(params):
    return params["params"]["Dense_0"]


def test_two_gradient_steps_are_those_of_the_paper():
    """A batch with a plain step, one of two steps, one that terminated, one that was truncated, and
    one that does not count."""
    cfg = sac.SACConfig(hidden=(), layer_norm=False, lr=0.01, critic_lr=0.02, alpha_lr=0.03,
                        alpha_init=0.3, tau=0.1, discount=0.9)  # fmt: skip
    cfg = jax.tree.map(jnp.float32, cfg)
    learner, rng = sac.learner(2), np.random.default_rng(0)
    made: Any = Transitions
    fit = learner.init(jax.random.key(0), 3, 2, cfg)
    terminated = np.array([0, 0, 1, 0, 0], bool)  # the truncated one bootstraps like any other
    batch = made(
        obs=rng.normal(size=(5, 3)), action=np.tanh(rng.normal(size=(5, 2))), reward=rng.normal(size=5),
        cost=np.zeros(5), costs=np.zeros((5, 1)), next_obs=rng.normal(size=(5, 3)),
        steps=np.array([1, 2, 1, 1, 1]), terminated=terminated,
        weight=np.array([0.25, 0.25, 0.25, 0.25, 0]),
    )  # fmt: skip
    narrow = jax.tree.map(lambda x: jnp.asarray(x, NARROW.get(x.dtype.kind, x.dtype)), batch)
    step = jax.jit(lambda fit, turn: learner.step(fit, narrow, turn, cfg, None), compiler_options=FAST)
    names = ("actor", "critic_r")
    zeros = {n: jax.tree.map(np.zeros_like, dense(fit.params[n])) for n in names}
    mu, nu = dict(zeros), dict(zeros)
    alpha_mu = alpha_nu = 0.0
    hand = {n: jax.tree.map(np.float64, dense(fit.params[n])) for n in (*names, "target_r")}
    log_alpha = np.log(0.3)
    for count in (1, 2):
        key = jax.random.key(count)
        noise = [np.float64(jax.random.normal(k, (5, 2))) for k in jax.random.split(key)]
        p = ByHand(hand, batch, noise, 0.9, np.exp(log_alpha))
        old = dict(hand)
        critic_loss = p.critic_loss(hand["critic_r"])
        grads = numerical(p.critic_loss, hand["critic_r"])
        hand["critic_r"], mu["critic_r"], nu["critic_r"] = adam_by_hand(
            hand["critic_r"], grads, 0.02, count, mu["critic_r"], nu["critic_r"]
        )
        grads = numerical(lambda a, p=p: p.actor_loss(a, hand["critic_r"]), hand["actor"])
        hand["actor"], mu["actor"], nu["actor"] = adam_by_hand(
            hand["actor"], grads, 0.01, count, mu["actor"], nu["actor"]
        )
        log_prob = p.pi(old["actor"], batch.obs, noise[1])[1]
        slope = {"a": -(batch.weight * (log_prob - 2.0)).sum()}  # H = -1 for each of two actions
        moved, alpha_mu, alpha_nu = adam_by_hand(
            {"a": log_alpha}, slope, 0.03, count, {"a": alpha_mu}, {"a": alpha_nu}
        )
        log_alpha, alpha_mu, alpha_nu = moved["a"], alpha_mu["a"], alpha_nu["a"]
        hand["target_r"] = {
            k: 0.9 * old["target_r"][k] + 0.1 * hand["critic_r"][k] for k in old["target_r"]
        }
        fit, metrics = step(fit, GradientStep(jnp.int32(count - 1), jnp.float32(1), key))
        np.testing.assert_allclose(metrics["train/critic_loss"], critic_loss, rtol=1e-5)
        np.testing.assert_allclose(fit.params["log_alpha"], log_alpha, atol=1e-6)
        for name, expected in hand.items():
            for leaf, x in expected.items():
                np.testing.assert_allclose(dense(fit.params[name])[leaf], x, rtol=1e-6, atol=2e-6)
        for name in names:  # Adam's first steps have one size: this is the gradient's own
            seen = dense(fit.opt_state[name][1][0].mu)
            for leaf, x in mu[name].items():
                np.testing.assert_allclose(seen[leaf], x, rtol=1e-5, atol=1e-6)


def test_a_delayed_policy_and_its_targets_move_at_every_second_step():
    cfg = jax.tree.map(jnp.float32, sac.SACConfig(hidden=(), policy_delay=2))
    learner = sac.learner(1)
    fit = learner.init(jax.random.key(0), 2, 1, cfg)
    batch = Transitions(
        obs=jnp.ones((4, 2)), action=jnp.ones((4, 1)), reward=jnp.arange(4.0), cost=jnp.zeros(4),
        costs=jnp.zeros((4, 1)), next_obs=jnp.ones((4, 2)), steps=jnp.ones(4, int),
        terminated=jnp.zeros(4, bool), weight=jnp.full(4, 0.25),
    )  # fmt: skip
    step = jax.jit(
        lambda fit, turn: learner.step(fit, batch, turn, cfg, None)[0], compiler_options=FAST
    )
    for count in range(4):
        before, fit = (
            fit,
            step(fit, GradientStep(jnp.int32(count), jnp.float32(1), jax.random.key(count))),
        )
        due = count % 2 == 1
        for name in ("actor", "target_r", "log_alpha"):
            assert any(differ(before.params[name], fit.params[name])) == due
        assert any(differ(before.params["critic_r"], fit.params["critic_r"]))
    assert isinstance(fit, Trainable)


@dataclass(frozen=True)
class Chain:
    """States 0, 1, 2 as one-hot observations, one after the other; leaving state i earns i + 1.

    Beyond state 2 it terminates or, if it is a circle, begins anew at 0. Ignores actions.
    """

    circle: bool
    episode_length: int
    obs_size: int = 3
    action_size: int = 1
    cost_names: tuple[str, ...] = ("a",)

    def reset(self, key: jax.Array) -> State:
        place = jax.random.randint(key, (), 0, 3)
        return self._at(place, jnp.float32(0), jnp.bool_(False))

    def step(self, state: State, action: jax.Array) -> State:
        place = (state.physics + 1) % 3
        return self._at(place, state.physics + 1.0, (place == 0) & (not self.circle))

    def _at(self, place: jax.Array, reward: jax.Array, terminated: jax.Array) -> State:
        zero = jnp.zeros(())
        return State(place, jax.nn.one_hot(place, 3), reward, zero, zero[None], terminated, {})


@pytest.mark.parametrize("circle, n_step", [(False, 1), (True, 3)])
def test_the_critics_find_the_values_of_a_chain(circle, n_step):
    """Episodes of the circle are cut after 2 steps, which takes nothing from their values."""
    env = Chain(circle, episode_length=2 if circle else 9)
    settings = {"hidden": (), "obs_normalize": False, "layer_norm": False, "discount": 0.5,
                "alpha_init": 1e-6, "alpha_lr": 0.0, "critic_lr": 0.02, "tau": 0.2, "n_step": n_step,
                "replay_ratio": 32}  # fmt: skip
    ts = start("sac", env=env, **settings)
    algo = ALGOS["sac"].make(env)

    def train(ts):
        return jax.lax.scan(lambda ts, i: algo.update(ts, Shared(i)), ts, jnp.arange(150))

    ts, metrics = jax.jit(train, compiler_options=FAST)(ts)
    # 1 + (2 + 3 / 2) / 2, 2 + 3 / 2, 3; round and round, 1 / (1 - 1 / 8) times as much of each start
    values = np.array([2.75, 3.5, 3.0])
    if circle:
        values = np.array([1 + 2 / 2 + 3 / 4, 2 + 3 / 2 + 1 / 4, 3 + 1 / 2 + 2 / 4]) / (1 - 1 / 8)
    for action in (-0.9, 0.0, 0.9):
        q = q_values(ts.params["critic_r"], jnp.eye(3), jnp.full((3, 1), action), ts.config)
        np.testing.assert_allclose(q, np.stack([values] * 2), atol=1e-2)
    assert metrics["train/nonfinite"].sum() == 0


@pytest.mark.parametrize("name", [name for name in NAMES if ALGOS[name].holds == "nothing"])
def test_without_a_constraint_all_the_reward_is_taken_and_the_cost_paid(name):
    """20 at best, 12.5 by chance."""
    algo, cfg = ALGOS[name].make(Lever()), ALGOS[name].config(**ALGOS[name].lever)

    def train(key):
        ts = algo.init(key, cfg, START)
        return jax.lax.scan(lambda ts, i: algo.update(ts, Shared(i)), ts, jnp.arange(50))[1]

    metrics = jax.jit(jax.vmap(train), compiler_options=FAST)(jax.random.split(jax.random.key(0), 2))
    ret, cost = (np.asarray(metrics[f"train/{k}"])[:, -10:].mean(1) for k in ("return", "cost"))
    assert (ret > 18).all() and (cost > 7).all()
    assert (np.asarray(metrics["train/alpha"])[:, -1] < 0.1).all()


# ---- devices -----------------------------------------------------------------------------------

DEVICES = """
import sys; sys.path.insert(0, sys.argv[1])
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import AxisType, PartitionSpec as P
from compiling import FAST
from toys import START, Lever
from jaxsafe.algos import ALGOS
from jaxsafe.types import Shared

UPDATES = 40

def split(fn, devices=2):
    def one(x):
        return jax.tree.map(lambda y: y[None], fn(jax.tree.map(lambda y: y[0], x)))
    spec = P("devices")
    parts = {"devices": jax.devices()[:devices], "axis_types": (AxisType.Auto,)}
    mesh = jax.make_mesh((devices,), ("devices",), **parts)
    sharded = jax.shard_map(one, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    return jax.jit(sharded, compiler_options=FAST)

def training(name, axis_name, num_envs, updates):
    algo = ALGOS[name].make(Lever(), axis_name)
    cfg = ALGOS[name].config(
        num_envs=num_envs, horizon=8, learn_every=4, batch_size=256, replay_size=20_000, hidden=(32,),
        learning_starts=256, discount=0.9, lr=3e-3, critic_lr=3e-3, alpha_init=0.1, alpha_lr=3e-3,
    )
    def train(key):
        ts = algo.init(key, cfg, START)
        return jax.lax.scan(lambda ts, i: algo.update(ts, Shared(i)), ts, jnp.arange(updates))
    return train

for name in sys.argv[2:]:
    keys = jnp.stack([jax.random.key(0)] * 2)
    ts, metrics = split(training(name, "devices", 16, UPDATES))(keys)  # one seed, 2 x 16 environments
    for x in jax.tree.leaves((ts.params, ts.opt_state, ts.normaliser, ts.episode_length, metrics)):
        np.testing.assert_array_equal(x[0], x[1])  # the devices agree
    rings = np.asarray(ts.replay.obs)
    assert rings.shape[2] == 16 and (rings[0] != rings[1]).any()  # each with a ring of its own
    alone = split(training(name, None, 32, UPDATES), devices=1)
    late = [np.asarray(m["train/return"])[..., -10:].mean() for m in (metrics, alone(keys[:1])[1])]
    assert min(late) > 17 and abs(late[0] - late[1]) < 1, late
    print(name, "one seed ok")
    keys = jax.random.split(jax.random.key(1))  # two seeds, one a device
    both = split(training(name, None, 32, UPDATES))
    here, there = both(keys), both(keys[::-1])
    for i in range(2):  # neither the neighbour nor the device matters, bit for bit
        for x, y in zip(*(jax.tree.leaves(run[0].params) for run in (here, there))):
            np.testing.assert_array_equal(x[i], y[1 - i])
        lone = alone(keys[i : i + 1])  # another program, which XLA fuses otherwise: alike at first
        x, y = (run[1]["train/critic_loss"] for run in (here, lone))
        np.testing.assert_allclose(x[i, :6], y[0, :6], rtol=1e-3)
    print(name, "two seeds ok")
"""


def test_one_seed_over_two_devices_learns_alike_and_two_seeds_are_the_lone_ones():
    env = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    here = os.path.dirname(os.path.dirname(__file__))
    out = subprocess.run(
        [sys.executable, "-c", DEVICES, here, *NAMES], env=env, capture_output=True, text=True
    )
    assert out.returncode == 0, out.stderr[-3000:]
    assert out.stdout.splitlines() == [
        f"{n} {what} ok" for n in NAMES for what in ("one seed", "two seeds")
    ]
