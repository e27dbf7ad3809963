"""Dreamer's losses by hand, and the augmented Lagrangian."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from toys import Corridor

from jaxsafe.algos import ALGOS, dreamer
from jaxsafe.learn.dreaming import Judged, Range, Scene, no_range
from jaxsafe.learn.treatments import CappedPID
from jaxsafe.learn.world_model import CHANCE
from jaxsafe.nn.two_hot import BINS
from jaxsafe.run.settings import first_published

CFG = dreamer.DreamerLagConfig(mu_least=1.0, cost_limit=3.0)
BATCH: Any = SimpleNamespace(rows=SimpleNamespace(cost=jnp.full((3, 2), 2.0)))


class Averaging(Scene):
    """A scene whose dreams all weigh the same."""

    def over_dreams(self, x: jax.Array) -> jax.Array:
        return x.mean()


def test_advantages_are_divided_by_the_range_that_their_own_returns_have_moved():
    """A range of 2 moves by a hundredth towards that of the returns, which is 50 wide."""
    returns, value = jnp.linspace(0, 50 / 0.9, 101)[None], jnp.full((2, 101), 0.5)
    heard: list[jax.Array] = []

    def actor_loss(dreams, advantage):
        heard.append(advantage)
        return jnp.float32(3)

    scene: Any = SimpleNamespace(
        cfg=dreamer.DreamerConfig(),
        axis_name=None,
        batch=SimpleNamespace(rows=SimpleNamespace(reward=jnp.zeros((3, 2)))),
        dream=lambda actor, key: SimpleNamespace(read={"reward": value}, entropy=returns),
        judge=lambda *args: Judged(returns, value),
        actor_loss=actor_loss,
        critic_loss_with_rows=lambda *args: jnp.float32(4),
        over_dreams=jnp.mean,
    )
    past = Range(jnp.float32(0), jnp.float32(2))
    found = dreamer.learn_reward({"actor": ()}, past, scene, jax.random.key(0))
    np.testing.assert_allclose(heard[0], (returns - 0.5) / 2.48, rtol=1e-5)
    np.testing.assert_allclose(found.range.scale(0.0), 2.48, rtol=1e-5)
    np.testing.assert_allclose(found.metrics["train/return_scale"], 2.48, rtol=1e-5)
    assert found.loss == 7


def test_the_multiplier_rises_by_the_violation_from_the_second_step_on():
    """lam_0 + mu_0 + n, where every step violates by 1; and it falls to 0, no further."""
    dual = dreamer.Augmented(jnp.float32(0.01), jnp.float32(5e-9))
    for n in range(5):
        dual = dual.raised(jnp.float32(1.0), CFG)
        np.testing.assert_allclose(dual.lam, 0.01 + n, rtol=1e-5)
        np.testing.assert_allclose(dual.mu, 1 + 1e-6 * n, rtol=1e-6)
    for _ in range(5):
        dual = dual.raised(jnp.float32(-1.5), CFG)
    assert dual.lam == 0
    paper = dataclasses.replace(CFG, mu_least=0.0, mu_growth=0.5)
    dual = dreamer.Augmented(jnp.float32(1.0), jnp.float32(2.0)).raised(jnp.float32(0.5), paper)
    np.testing.assert_allclose(dual, (2.0, 3.0))


def test_the_penalty_is_smooth_where_it_ends():
    dual = dreamer.Augmented(jnp.float32(0.6), jnp.float32(2.0))  # ends at g = -0.3
    g = jnp.array([-5.0, -0.3, -0.2, 0.0, 1.0])
    np.testing.assert_allclose(dual.psi(g), [-0.09, -0.09, -0.08, 0.0, 1.6], rtol=1e-5, atol=1e-7)
    slope = jax.vmap(jax.grad(dual.psi))(g)
    np.testing.assert_allclose(slope, dual.price(g), atol=1e-6)
    np.testing.assert_allclose(slope, [0, 0, 0.2, 0.6, 2.6], atol=1e-6)
    none = dreamer.Augmented(jnp.float32(0.0), jnp.float32(1.0))
    assert jax.grad(none.psi)(-1e-3) == 0


def test_by_reinforce_the_actor_descends_the_expected_penalty():
    """Of returns R ~ N(m, 1): d/dm E[psi(R - d)], where psi is quadratic above -0.3, whatever V is."""
    dual = dreamer.Augmented(jnp.float32(0.6), jnp.float32(2.0))
    noise = jax.random.normal(jax.random.key(0), (1, 400_000))
    for mean, limit, value in ((2.0, 0.5, 0.0), (0.2, 0.5, 1.5)):
        returns, limit = mean + noise, jnp.float32(limit)
        costs = Judged(returns, jnp.full((2, 400_000), value))
        found = (dual.advantage(costs, limit) * noise).mean()  # the score of m is R - m
        slope = jax.vmap(jax.grad(dual.psi))(returns[0] - limit).mean()
        np.testing.assert_allclose(found, slope, rtol=0.03)


def test_the_limit_of_an_episode_is_that_of_a_steady_stream_of_cost():
    """2 in 20 steps are 0.1 a step, which come to 0.1 / (1 - 0.75) discounted."""
    cfg = dataclasses.replace(CFG, cost_limit=2.0, cost_discount=0.75)
    np.testing.assert_allclose(dreamer.discounted_limit(Corridor(), cfg), 0.4)
    env = Corridor(episode_length=1000)
    np.testing.assert_allclose(dreamer.discounted_limit(env, CFG), 1.0, rtol=1e-4)


def test_the_preset_of_ambs_has_the_numbers_of_its_lagrangian():
    """Of the released settings of Safety Gym: d = 1 in an episode of 500 steps, lam = 0.01 and
    mu = 5e-9 at first, and a mu that grows by 1e-6 and is at least 1 later."""
    row = ALGOS["dreamer_lag"]
    cfg = row.config(**row.published["ambs"])
    limit = dreamer.discounted_limit(Corridor(episode_length=500), cfg)
    np.testing.assert_allclose(limit, 1, rtol=1e-4)
    np.testing.assert_array_equal(dreamer.priced.memory(cfg)["dual"], [0.01, 5e-9])
    numbers = (cfg.mu_growth, cfg.mu_least, cfg.cost_discount, cfg.td_lambda, cfg.replay_value)
    assert numbers == (1e-6, 1.0, 0.997, 0.95, 0.0)
    assert (cfg.actor_grad, cfg.limit_ends, cfg.overshoot) == ("backprop", True, 0)


def test_the_preset_of_pictures_is_ours_and_so_never_the_published_one():
    rows = {name: row for name, row in ALGOS.items() if "pixels" in row.published}
    published = {name: first_published(row) for name, row in rows.items()}
    assert published == {"ambs": "plpg", "dreamer_lag": "ambs", "dreamer_pid": ""}
    assert all(row.config(**row.published["pixels"]).encoder == "cnn" for row in rows.values())


def test_the_model_says_what_a_step_costs_or_with_ambs_preset_how_likely_it_costs():
    row = ALGOS["dreamer_lag"]
    rows: Any = SimpleNamespace(cost=jnp.array([0.0, 0.5, 2.0]))
    for cfg, outputs, target in (
        (row.config(), BINS, [0.0, 0.5, 2.0]),
        (row.config(**row.published["ambs"]), CHANCE, [0.0, 1.0, 1.0]),
    ):
        assert dreamer.priced.all_heads(cfg) == {"reward": BINS, "cont": CHANCE, "cost": outputs}
        told = dreamer.priced.targets(Corridor(), rows, cfg)
        np.testing.assert_array_equal(told["cost"], target)


def test_the_multiplier_s_actor_pays_for_its_dreams_and_the_multiplier_moves_by_their_mean(monkeypatch):
    """Two dreams of two steps, with lam = 0.5, mu = 2 and d = 0.75: by backprop psi(R - d), whose slope
    is lam + mu (R - d) >= 0, in no unit but its own; by reinforce its advantage times log pi."""
    returns = jnp.array([[1.0, 4.0], [2.0, 0.0]])
    value = jnp.array([[3.0, 1.0], [2.0, 1.0], [9.0, 9.0]])
    weight = jnp.array([[1.0, 1.0], [0.5, 0.5], [0.25, 0.25]])
    dual = dreamer.Augmented(jnp.float32(0.5), jnp.float32(2.0))
    cfg = dataclasses.replace(CFG, cost_limit=0.75, cost_discount=0.95)  # of 20 steps: d = 0.75
    paid_to_critic: list[jax.Array] = []

    def outcome(actor_grad: str, log_prob: jax.Array, returns: jax.Array) -> Any:
        dreams: Any = SimpleNamespace(weight=weight, log_prob=log_prob)
        wishes = dreamer.Wishes(dreams, no_range(), jnp.float32(7), {})
        of = dataclasses.replace(cfg, actor_grad=actor_grad)
        nothing: Any = None
        scene = Averaging(Corridor(), nothing, nothing, BATCH, nothing, (), of, None)
        monkeypatch.setattr(dreamer, "learn_reward", lambda *args: wishes)
        found = Judged(returns, value), jnp.float32(2), {}

        def learn_cost(trained, dreams, scene, cost):
            paid_to_critic.append(cost)
            return found

        monkeypatch.setattr(dreamer, "learn_cost", learn_cost)
        memory = {"range": no_range(), "dual": dual}
        return dreamer.learn_priced({}, memory, scene, jax.random.key(0))

    def loss(*args: Any) -> jax.Array:
        return outcome(*args).loss

    log_prob = jnp.array([[-1.0, -2.0], [-3.0, -4.0]])
    psi = jnp.array([[0.1875, 12.1875], [2.1875, -0.0625]])  # lam g + mu g^2 / 2, or -lam^2 / (2 mu)
    price = jnp.array([[1.0, 7.0], [3.0, 0.0]])
    paid = weight[:2] * psi
    np.testing.assert_allclose(loss("backprop", log_prob, returns), 9 + paid.mean(), rtol=1e-5)
    slopes = jax.grad(loss, argnums=(1, 2))("backprop", log_prob, returns)
    np.testing.assert_allclose(slopes, [jnp.zeros((2, 2)), weight[:2] * price / 4], rtol=1e-5)
    beyond = weight[:2] * (psi - jnp.array([[6.1875, 0.1875], [2.1875, 0.1875]]))  # psi(V - d)
    expected = 9 + (beyond * log_prob).mean()
    np.testing.assert_allclose(loss("reinforce", log_prob, returns), expected, rtol=1e-5)
    slopes = jax.grad(loss, argnums=(1, 2))("reinforce", log_prob, returns)
    np.testing.assert_allclose(slopes, [beyond / 4, jnp.zeros((2, 2))], rtol=1e-5)
    assert (paid_to_critic[-1] == 2).all()
    cfg = dataclasses.replace(cfg, cost_head="chance")
    after = outcome("backprop", log_prob, returns).memory["dual"]  # R - d is 1 on average
    np.testing.assert_allclose(after, (0.5 + 2 * 1.0, 2 * (1 + 1e-6)), rtol=1e-5)
    assert (paid_to_critic[-1] == 1).all()


def test_at_a_price_the_actor_pays_for_what_its_dreams_cost_beyond_the_mean(monkeypatch):
    """Two dreams of two steps at a price of 0.5: by reinforce (R - V) log pi, by backprop R - V."""
    returns = jnp.array([[1.0, 4.0], [2.0, 0.0]])
    value = jnp.array([[3.0, 1.0], [2.0, 1.0], [9.0, 9.0]])
    weight = jnp.array([[1.0, 1.0], [0.5, 0.5], [0.25, 0.25]])

    def loss(actor_grad: str, log_prob: jax.Array, returns: jax.Array) -> jax.Array:
        dreams: Any = SimpleNamespace(weight=weight, log_prob=log_prob)
        metrics: Any = {"a": 1}
        wishes = dreamer.Wishes(dreams, no_range(), jnp.float32(7), metrics)
        cfg = SimpleNamespace(actor_grad=actor_grad)
        price = CappedPID(*(jnp.float32(x) for x in (0.5, 0, 0)))
        nothing: Any = None
        scene = Averaging(nothing, nothing, nothing, BATCH, nothing, price, cfg, None)
        monkeypatch.setattr(dreamer, "learn_reward", lambda *args: wishes)
        found = Judged(returns, value), jnp.float32(2), {"b": 2}
        monkeypatch.setattr(dreamer, "learn_cost", lambda *args: found)
        outcome = dreamer.learn_at_a_price({}, {"range": no_range()}, scene, jax.random.key(0))
        assert outcome.metrics == {"a": 1, "b": 2}
        return outcome.loss

    log_prob = jnp.array([[-1.0, -2.0], [-3.0, -4.0]])
    pays = 0.5 * weight[:2] * (returns - value[:2])  # [[-1, 1.5], [0, -0.25]]
    np.testing.assert_allclose(loss("reinforce", log_prob, returns), 9 + (pays * log_prob).mean())
    slopes = jax.grad(loss, argnums=(1, 2))("reinforce", log_prob, returns)
    np.testing.assert_allclose(slopes, [pays / 4, jnp.zeros((2, 2))])
    slopes = jax.grad(loss, argnums=(1, 2))("backprop", log_prob, returns)
    np.testing.assert_allclose(slopes, [jnp.zeros((2, 2)), 0.5 * weight[:2] / 4])
