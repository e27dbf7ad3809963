"""CRABS on toys: what it does before its first certificate, and after it."""

import dataclasses
from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import BUSY, FAST
from learners import at
from toys import START, Corridor, Ticker, momentum, training

from jaxsafe.algos import ALGOS, crabs
from jaxsafe.config import ConfigError
from jaxsafe.learn.acting import Player
from jaxsafe.learn.certificate import Core, Found, decayed_adam, interval_barrier
from jaxsafe.learn.learner import GradientStep
from jaxsafe.learn.replay import Transitions
from jaxsafe.learn.steps import Trainable
from jaxsafe.types import State

ROW = ALGOS["crabs"]
TINY: dict[str, Any] = {
    "num_envs": 6, "horizon": 4, "learn_every": 2, "batch_size": 16, "replay_ratio": 4,
    "replay_size": 6 * 12, "learning_starts": 6 * 5, "refit_every": 6 * 8, "hidden": (8,), "models": 2,
    "model_hidden": (8,), "model_batch": 8, "epoch_steps": 4, "barrier_hidden": (8,), "chains": 16,
    "barrier_steps": 12, "quiet_steps": 2, "check_steps": 3, "candidates": 5,
}  # fmt: skip


@cache
def begun():
    """The algorithm, and how it begins at a given margin."""
    algo, cfg = ROW.make(Corridor()), ROW.config(**TINY)

    def init(margin):
        return algo.init(jax.random.key(3), dataclasses.replace(cfg, margin=margin), START)

    return algo, jax.jit(init, compiler_options=FAST)


@cache
def compiled():
    """The update, which uses up its argument."""
    algo, start = begun()
    like = jax.eval_shape(start, jnp.zeros(()))
    return jax.jit(algo.update, donate_argnums=0).lower(like, START).compile(FAST)


def differ(a, b):
    return [bool((x != y).any()) for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True)]


@pytest.mark.parametrize("settings", [{}, *ROW.published.values()])
def test_an_update_keeps_the_structure(settings):
    algo, cfg = ROW.make(Corridor()), ROW.config(**settings)
    before = jax.eval_shape(lambda: algo.init(jax.random.key(0), cfg, START))
    after, metrics = jax.eval_shape(algo.update, before, START)
    assert jax.tree.structure(before) == jax.tree.structure(after)
    assert jax.tree.leaves(before) == jax.tree.leaves(after)
    assert all(x.dtype == jnp.float32 and x.shape == () for x in metrics.values())
    assert {"train/certified", "train/violating", "train/refused", "train/nonfinite"} <= metrics.keys()
    learned = jax.eval_shape(algo.learned, before)
    assert {*learned.params} >= {"actor", "model", "barrier", "safe", "certified"}
    assert "search" not in learned.params


@pytest.mark.parametrize(
    "env, settings, message",
    [
        (Ticker(), {}, r"which observations are safe, by a method `barrier\(obs\)`"),
        (Corridor(), {"obs_normalize": True}, "a certificate is for observations as they are"),
    ],
)
def test_what_cannot_have_a_certificate_is_refused(env, settings, message):
    algo, cfg = ROW.make(env), ROW.config(**TINY | settings)
    with pytest.raises(ConfigError, match=message):
        jax.eval_shape(lambda: algo.init(jax.random.key(0), cfg, START))


@pytest.mark.slow
@pytest.mark.parametrize("margin, succeeds", [(-1e5, True), (1e5, False)])
def test_certificates_come_by_the_clock_and_are_the_networks_of_that_moment(margin, succeeds):
    """With a margin so wide that nothing violates the condition, or so that everything does."""
    (_, start), update = begun(), compiled()
    before = start(jnp.float32(margin))
    ts = jax.tree.map(jnp.copy, before)
    for iteration in range(6):  # the warm-up is two updates, refits are two updates apart
        models = jax.tree.map(jnp.copy, ts.params["model"].ensemble)
        ts, metrics = update(ts, at(iteration))
        due = iteration in (1, 3, 5)
        assert jnp.isnan(metrics["train/certified"]) == (not due)
        assert all(differ(models, ts.params["model"].ensemble)) == due
        assert metrics["train/nonfinite"] == 0
        if due:
            safe, now = ts.params["safe"], ts.params
            found = (now["barrier"], now["actor"], now["model"])
            assert metrics["train/certified"] == ts.params["certified"] == succeeds
            assert any(differ((safe.barrier, safe.actor, safe.model), found)) == (not succeeds)
    assert any(differ(before.params["safe"], ts.params["safe"])) == succeeds
    # with every certificate the steps against violations become fewer, with every failure more
    assert ts.opt_state["pressure"] < 2 if succeeds else ts.opt_state["pressure"] == 10
    learned = (ts.params, ts.opt_state, ts.replay)
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(learned))


@pytest.mark.slow
def test_the_compiled_update_writes_into_the_ring_in_place():
    (_, start), update = begun(), compiled()
    ring = jax.eval_shape(start, jnp.zeros(())).replay
    text: Any = update.as_text()
    shape = f"[{','.join(map(str, ring.obs.shape))}]"
    made = [line for line in text.splitlines() if shape in line.partition("(")[0]]
    assert any(" dynamic-update-slice(" in line for line in made)
    assert not any(" copy(" in line for line in made)


def test_it_acts_by_its_policy_until_there_is_a_certificate_and_then_within_it():
    """All weights of the certificate are 0. So h = log 2 + B - 1, its models say that nothing moves,
    and its policy stands still."""
    algo, start = begun()
    free = algo.learned(start(jnp.zeros(())))
    safe = jax.tree.map(jnp.zeros_like, free.params["safe"])
    scale = safe.model.scale.replace(std=jnp.ones(6))
    safe = safe.replace(model=safe.model.replace(scale=scale))
    bound = dataclasses.replace(free, params=free.params | {"safe": safe, "certified": jnp.ones(())})
    within = Corridor().reset(jax.random.key(0))
    beyond = dataclasses.replace(within, obs=within.obs.at[1].set(0.49))
    h = [interval_barrier(state.obs[1], 0.5) + np.log(2) - 1 for state in (within, beyond)]
    assert h[0] < 0 < h[1]

    @jax.jit
    def act(learned, state):
        return Player(algo.policy, learned, Corridor()).act((), state)[0]

    np.testing.assert_allclose(act(bound, within), act(free, within))
    np.testing.assert_allclose(act(bound, beyond), 0.0)
    assert (jnp.abs(act(free, beyond)) > 0).all() and (jnp.abs(act(free, within)) > 0).all()


def steady(learned):
    """`learned` with a policy that takes 0, but for noise of less than 1e-4."""
    actor = jax.tree.map(jnp.zeros_like, learned.params["actor"])
    last = sorted(actor["params"])[-1]
    bias = jnp.array([0.0, 0.0, -10.0, -10.0])
    actor["params"][last] = actor["params"][last] | {"bias": bias}
    return dataclasses.replace(learned, params=learned.params | {"actor": actor})


def test_exploration_keeps_to_the_certificate_and_is_random_in_a_third_of_the_environments():
    algo, start = begun()
    learner: Any = crabs.crabs(Corridor())
    free = steady(algo.learned(start(jnp.zeros(()))))
    safe = jax.tree.map(jnp.zeros_like, free.params["safe"])
    scale = safe.model.scale.replace(std=jnp.ones(6))
    # what the certificate's own policy does: 0.25 of the first action
    actor = jax.tree.map(jnp.zeros_like, free.params["actor"])
    last = sorted(actor["params"])[-1]
    actor["params"][last]["bias"] = actor["params"][last]["bias"].at[0].set(jnp.arctanh(0.25))
    safe = safe.replace(model=safe.model.replace(scale=scale), actor=actor)
    bound = dataclasses.replace(free, params=free.params | {"safe": safe, "certified": jnp.ones(())})
    within = jnp.broadcast_to(Corridor().reset(jax.random.key(0)).obs, (6, 4))
    explore = jax.jit(learner.explore)
    key, remaining = jax.random.key(1), jnp.ones(())

    action = explore(bound, within, key, remaining)
    assert (jnp.abs(action[jnp.array([0, 1, 3, 4])]) < 1e-3).all()
    assert (jnp.abs(action[jnp.array([2, 5])]) > 1e-2).all()
    # where no action helps, all take the certificate's own
    np.testing.assert_allclose(
        explore(bound, within.at[:, 1].set(0.49), key, remaining), [[0.25, 0.0]] * 6, atol=1e-6
    )
    # without a certificate nothing is random beyond the policy's noise
    assert (jnp.abs(explore(free, within, key, remaining)) < 1e-3).all()
    assert learner.random_start(free) and not learner.random_start(bound)


@pytest.mark.slow
@pytest.mark.parametrize("certified", [0.0, 1.0])
def test_a_run_that_starts_with_a_certificate_does_not_begin_with_random_actions(certified):
    (algo, start), update = begun(), compiled()
    ts = start(jnp.float32(-1e5))
    learned = steady(algo.learned(ts))
    params = ts.params | {"actor": learned.params["actor"], "certified": jnp.float32(certified)}
    ring = update(dataclasses.replace(ts, params=params), at(0))[0].replay
    taken = ring.action[jnp.array([0, 1, 3, 4]), :4]  # of environments that are not random later
    assert (jnp.abs(taken).max() < 1e-3) == bool(certified)


# ---- after a search, and against violations ----------------------------------------------------


@pytest.mark.parametrize(
    "certified, at_once, before, after",
    [
        (True, True, 2.0, 1.0),
        (True, True, 0.15, 0.1),
        (True, False, 6.0, 5.0),
        (False, False, 2.0, 4.0),
        (False, False, 6.0, 10.0),
    ],
)
@pytest.mark.parametrize("earlier", [True, False])
def test_a_search_that_succeeds_makes_the_certificate_and_the_policy_takes_fewer_steps_then(
    certified, at_once, before, after, earlier, monkeypatch
):
    new, old = Core(*jnp.array([5.0, 2.0, 3.0])), Core(*-jnp.ones(3))
    nothing: Any = ()
    found = Found(new.barrier, nothing, nothing, *map(jnp.asarray, (certified, at_once, 7)))
    monkeypatch.setattr(crabs, "certify", lambda *_: found)
    monkeypatch.setattr(crabs, "volume", lambda *_: jnp.float32(0.25))
    params = {"barrier": jnp.float32(1), "actor": new.actor, "model": new.model, "safe": old}
    state = {"pressure": jnp.float32(before), "barrier": nothing, "search": nothing}
    nets = Trainable(params | {"certified": jnp.float32(earlier)}, state)
    here: Any = None  # nobody asks it
    (params, state), metrics = crabs.renew(here, nets, ROW.config())
    assert state["pressure"] == pytest.approx(after)
    assert params["certified"] == (certified or earlier)
    assert params["safe"] == (new if certified else old)
    assert params["barrier"] == (old.barrier if earlier and not certified else new.barrier)
    assert metrics["train/certified"] == certified


def test_the_policy_takes_all_steps_against_violations_that_it_owes(monkeypatch):
    """Of two states one violates the condition, by the policy's only number and 1. Adam moves that by
    `adversary_lr` each time."""
    search = SimpleNamespace(obs=jnp.zeros((2, 1)))
    monkeypatch.setattr(crabs, "walk", lambda *_: search)
    here: Any = SimpleNamespace(
        judge=lambda core, *_: (jnp.array([-1.0, 1.0]), core.actor + jnp.ones(2))
    )
    cfg, zero = ROW.config(adversary_lr=1e-3), jnp.zeros(())
    adversary = decayed_adam(0.0, 0.0).init(zero)
    state = {"search": search, "adversary": adversary, "owed": zero, "pressure": jnp.float32(1.25)}
    params = dict.fromkeys(("barrier", "actor", "model"), zero)
    free, metrics = crabs.resist(here, Trainable(params | {"certified": zero}, state), cfg)
    assert free.params["actor"] == 0 and jnp.isnan(metrics["train/violating"])
    nets = Trainable(params | {"certified": jnp.ones(())}, state)
    for taken in (1, 2, 3, 5):
        nets, metrics = crabs.resist(here, nets, cfg)
        assert nets.params["actor"] == pytest.approx(-1e-3 * taken, rel=1e-3)
        assert metrics["train/violating"] == 0.5


# ---- a gradient step by hand -------------------------------------------------------------------

GAINS = np.array([[0.1], [0.4]])  # of the models, by which the second action moves y


def u_by_hand(obs, action):
    """log 2 + B - 1, because f is 0, of the farther one of the two y."""
    x = np.abs(obs[:, 1] + GAINS * action[:, 1]).max(0) / 0.5
    inside = np.minimum(x, 1)
    log = np.log((1.01 + inside) * (1.01 - inside) / 1.01**2) / np.log(0.01 * 2.01 / 1.01**2)
    return np.log(2) - 1 + np.where(x < 1, log, 1 + 2 * (x - 1) / (0.01 * 2.01))


def linear(params, x):
    layer = jax.tree.map(np.float64, params["params"]["Dense_0"])
    return x @ layer["kernel"] + layer["bias"][..., None, :]


def value(critics, obs, action):
    """The critics' values, float [2, B]."""
    return linear(critics, np.concatenate([obs, action], -1))[..., 0]


def drawn(params, obs, key):
    """Actions of the policy, and their log probabilities."""
    noise = np.float64(jax.random.normal(key, (len(obs), 2)))
    mean, log_std = np.split(linear(params, obs), 2, -1)
    action = np.tanh(mean + np.exp(log_std) * noise)
    log_prob = -0.5 * noise**2 - log_std - 0.5 * np.log(2 * np.pi) - np.log(1 - action**2)
    return action, log_prob.sum(-1)


def transitions() -> Transitions:
    """Eight steps: the next y is near the middle, or near or beyond an end. One of these terminated,
    and one does not count."""
    rng = np.random.default_rng(0)
    obs, next_obs = 0.1 * rng.normal(size=(2, 8, 4))
    obs[:, 1] = [0, 0.1, -0.2, 0.3, -0.35, 0.4, 0.45, 0.6]
    next_obs[:, 1] = [0.05, -0.1, 0.6, 0.7, 0.35, 0.3, -0.3, 0.2]
    cost = np.array([0, 0, 1, 1, 0, 0.5, 0, 0])
    fields: dict[str, Any] = {
        "obs": obs, "action": np.tanh(rng.normal(size=(8, 2))), "reward": rng.normal(size=8),
        "cost": cost, "costs": cost[:, None], "next_obs": next_obs, "steps": np.array([1.0, 2] * 4),
        "terminated": np.arange(8) == 3, "weight": np.array([1 / 7] * 7 + [0]),
    }  # fmt: skip
    return Transitions(**fields)


@cache
def gradient_step():
    """Networks with f = 0 and models by hand, and (certified) -> what a step makes of them."""
    settings: dict[str, Any] = {
        "hidden": (), "layer_norm": False, "model_hidden": (), "discount": 0.9,
        "alpha_init": 0.3, "adversary_init": 0.1, "max_grad_norm": float("inf"),
    }  # fmt: skip
    cfg = jax.tree.map(jnp.float32, ROW.config(**TINY | settings))
    learner, batch = crabs.crabs(Corridor()), transitions()
    batch = jax.tree.map(lambda x: jnp.asarray(x, bool if x.dtype == bool else jnp.float32), batch)
    nets = jax.jit(lambda key: learner.init(key, 4, 2, cfg), compiler_options=FAST)(jax.random.key(3))
    params = nets.params
    model = jax.tree.map(jnp.zeros_like, params["model"])
    layer = model.ensemble.layers[0]
    layer = layer.replace(weight=layer.weight.at[:, 5, 1].set(GAINS[:, 0]))
    scale = model.scale.replace(std=jnp.ones(6))
    params = params | {
        "barrier": jax.tree.map(jnp.zeros_like, params["barrier"]),
        "model": model.replace(ensemble=model.ensemble.replace(layers=(layer,)), scale=scale),
        "targets": jax.tree.map(lambda x: 2 * x + 0.1, params["targets"]),
    }
    at = GradientStep(jnp.int32(0), jnp.float32(1), jax.random.key(7))

    @partial(jax.jit, compiler_options=FAST)
    def step(certified):
        now = nets._replace(params=params | {"certified": certified})
        return learner.step(now, batch, at, cfg, None)

    return params, step


@pytest.mark.parametrize("certified", [True, False])
def test_a_gradient_step_counts_what_the_certificate_allows_and_charges_for_no_cost(certified):
    """The policy's value is -1000 - u where u > 0. Without a certificate the step is SAC's."""
    b, (params, step) = transitions(), gradient_step()
    after, metrics = step(jnp.float32(certified))
    critic_key, policy_key = jax.random.split(jax.random.key(7))

    # critics
    action, log_prob = drawn(params["actor"], b.next_obs, critic_key)
    worth = value(params["targets"]["critic_r"], b.next_obs, action).min(0) - 0.3 * log_prob
    y = b.reward + 0.9**b.steps * ~b.terminated * worth
    allowed = u_by_hand(b.next_obs, action) <= 0
    assert not allowed[2:4].any() and 2 < allowed[:7].sum() < 6
    counted = b.weight * (allowed | b.terminated | (not certified))
    error = value(params["critic_r"], b.obs, b.action) - y
    np.testing.assert_allclose(metrics["train/critic_loss"], (counted * error**2).sum(), rtol=1e-5)
    slope = momentum(after, "critic_r")["params"]["Dense_0"]["bias"][:, 0]
    np.testing.assert_allclose(slope, 0.1 * (2 * counted * error).sum(1), rtol=1e-4, atol=1e-6)

    # the policy, which climbs the new critics
    def loss(actor):
        action, log_prob = drawn(actor, b.obs, policy_key)
        u = u_by_hand(b.obs, action)
        q = value(after.params["critic_r"], b.obs, action).min(0)
        refused = (u > 0) & certified
        return -(b.weight * (np.where(refused, -1000 - u, q) - 0.3 * log_prob)).sum(), refused

    found, refused = loss(params["actor"])
    assert (0 < refused[:7].sum() < 7) == certified
    np.testing.assert_allclose(metrics["train/actor_loss"], found, rtol=1e-5)
    np.testing.assert_allclose(metrics["train/refused"], (b.weight * refused).sum(), rtol=1e-5)
    layer = jax.tree.map(np.float64, params["actor"]["params"]["Dense_0"])

    def moved(by):
        return loss({"params": {"Dense_0": layer | {"bias": layer["bias"] + by}}})[0]

    slope = [(moved(by) - moved(-by)) / 2e-6 for by in 1e-6 * np.eye(4)]
    bias = momentum(after, "actor")["params"]["Dense_0"]["bias"]
    np.testing.assert_allclose(bias, 0.1 * np.array(slope), rtol=1e-4, atol=1e-6)


# ---- learning ----------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Ledge:
    """The farther to the right, the more it earns. Beyond 1 it falls, which ends the episode.

    Observation [1]: x, 0 at first. Action [1]: a fifth of it is added to x. Standing still earns
    nothing, and 18 is the most that an episode without a fall earns.
    """

    obs_size: int = 1
    action_size: int = 1
    episode_length: int = 20
    cost_names: tuple[str, ...] = ("fall",)

    def barrier(self, obs: jax.Array) -> jax.Array:
        return interval_barrier(obs[..., 0], 1.0)

    def reset(self, key: jax.Array) -> State:
        return self._state(jnp.zeros(1))

    def step(self, state: State, action: jax.Array) -> State:
        return self._state(state.physics + 0.2 * jnp.clip(action, -1.0, 1.0))

    def _state(self, x: jax.Array) -> State:
        fall = jnp.abs(x[0]) > 1
        cost = fall.astype(jnp.float32)
        return State(x, x, x[0], cost, cost[None], fall, {})


def test_it_falls_until_it_has_a_certificate_and_earns_without_a_fall_after():
    settings: dict[str, Any] = {
        "num_envs": 8, "horizon": 20, "batch_size": 64, "replay_ratio": 32, "replay_size": 6400,
        "learning_starts": 320, "refit_every": 320, "hidden": (16,), "discount": 0.9, "tau": 0.02,
        "lr": 3e-3, "critic_lr": 3e-3, "models": 2, "model_hidden": (16,), "model_lr": 3e-3,
        "model_batch": 64, "epoch_steps": 200, "barrier_hidden": (16,), "barrier_lr": 3e-3,
        "chains": 64, "barrier_steps": 600, "quiet_steps": 20, "check_steps": 60, "candidates": 10,
    }  # fmt: skip
    algo, cfg = ROW.make(Ledge()), ROW.config(**settings)
    train = jax.jit(jax.vmap(training(algo, cfg, 30)), compiler_options=BUSY)
    _, metrics = train(jax.random.split(jax.random.key(0)))
    metrics = jax.tree.map(np.asarray, metrics)
    ret, cost, certified = (metrics[f"train/{k}"] for k in ("return", "cost", "certified"))
    certified = np.nancumsum(certified, axis=1) > 0
    assert not certified[:, 0].any() and certified[:, 7].all()
    assert (cost[:, :7].sum(1) > 0).all() and (cost[:, 8:] == 0).all()
    assert (ret[:, -10:].mean(1) > 7).all()
