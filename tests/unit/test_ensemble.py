"""The ensemble knows the noise of what it is fitted to, and where it does not know."""

import dataclasses
import operator
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import BUSY, FAST
from toys import Ticker

from jaxsafe.config import config
from jaxsafe.learn.acting import Learned
from jaxsafe.learn.models import (
    Fitted,
    ModelConfig,
    ModelRecord,
    fit,
    init_model,
    learnable,
    learned_model,
    record_by,
    scale_of,
    transitions_at,
)
from jaxsafe.learn.next_step_rollout import collect_records, started
from jaxsafe.learn.planning import PlanConfig, imagine
from jaxsafe.learn.replay import Span
from jaxsafe.learn.rollout import init_rollout
from jaxsafe.learn.steps import Trainable
from jaxsafe.nn.ensemble import draw as draw_of_ensemble
from jaxsafe.nn.ensemble import ensemble_loss, init_ensemble, outputs_of, unscaled

ROWS, ENVS = 640, 8


@config
class Config(PlanConfig, ModelConfig):
    models: int = 3
    model_hidden: tuple[int, ...] = (32, 32)
    learn_cost: bool = False
    model_lr: float = 1e-2
    epoch_steps: int = 200


@dataclass(frozen=True)
class Line:
    obs_size: int = 1
    action_size: int = 1

    def observed_cost(self, obs):
        return jnp.zeros(obs.shape[:-1])


LINE: Any = Line()  # as much of an environment as a model needs


def ring_of(x, reward, **marks):
    """A ring whose step from x [R, N] pays `reward`, which stands in the row that follows."""
    no = jnp.zeros(x.shape, bool)
    fields = dict.fromkeys(("first", "terminated", "truncated", "jump"), no) | marks
    number = jnp.zeros(x.shape)
    arrived = jnp.roll(reward, 1, axis=0)
    rows = ModelRecord(
        obs=x[..., None], action=number[..., None], reward=arrived, cost=number,
        costs=number[..., None], **fields,
    )  # fmt: skip
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), rows)


def noise_at(x):
    return 0.1 + 0.2 * jnp.abs(x)


def draw(key, shape):
    x_key, noise_key = jax.random.split(key)
    x = jax.random.uniform(x_key, shape, minval=-2.0, maxval=2.0)
    return x, jnp.sin(x) + noise_at(x) * jax.random.normal(noise_key, shape)


@cache
def fitted():
    """The ensemble before and after a fit to sin x with noise, and the metrics."""
    cfg = Config()
    x, y = draw(jax.random.key(0), (ROWS, ENVS))
    ring, span = ring_of(x, y), Span(jnp.int32(0), jnp.int32(ROWS))

    def train(key):
        model = init_model(key, LINE, cfg)
        after, metrics = fit(model, ring, span, key, cfg)
        return model.params, *after, metrics

    return jax.jit(train, compiler_options=BUSY)(jax.random.key(1))


def predicted(model: Fitted, x):
    """Mean and deviation of the reward by each model, [M, B]."""
    inputs = jnp.stack([x, jnp.zeros_like(x)], -1)
    dist = outputs_of(model.ensemble, model.scale, jnp.broadcast_to(inputs, (3, *inputs.shape)))
    return dist.mean[..., 0], jnp.exp(dist.log_std[..., 0])


def test_the_fit_knows_the_noise_everywhere():
    _, model, _, metrics = fitted()
    x, y = draw(jax.random.key(2), (20_000,))
    mean, std = predicted(model, x)
    assert metrics["train/nonfinite"] == 0 and 7 <= metrics["train/model_epochs"] < 1000

    def nll(mean, std):
        return np.mean(0.5 * ((y - mean) / std) ** 2 + np.log(std))

    truth = nll(np.sin(x), noise_at(x))
    for m in range(3):
        assert nll(mean[m], std[m]) < truth + 0.05
        covered = np.mean(np.abs(y - mean[m]) < 1.6449 * std[m])
        assert 0.88 < covered < 0.92


def test_models_disagree_where_there_was_no_data():
    _, model, _, _ = fitted()
    seen, unseen = draw(jax.random.key(3), (500,))[0], jnp.linspace(4.0, 8.0, 100)
    inside, outside = (predicted(model, x)[0].std(0).mean() for x in (seen, unseen))
    assert outside > 5 * inside


def test_the_bounds_of_the_variance_move_towards_the_data():
    before, after, _, _ = fitted()
    for name in ("low", "high"):
        old, new = getattr(before.ensemble, name), getattr(after.ensemble, name)
        assert (old != new).all()
    assert (after.ensemble.high[:, 0] < before.ensemble.high[:, 0]).all()  # the noise is 0.5 at most


def test_the_loss_by_hand():
    """One model of one linear layer: mu = w x + b, and a log variance in the middle of its range."""
    ensemble: Any = init_ensemble(jax.random.key(0), 1, 1, (), 1)
    layer = ensemble.layers[0].replace(weight=jnp.array([[[2.0, 0.0]]]), bias=jnp.array([[0.5, -3.0]]))
    ensemble = ensemble.replace(layers=(layer,))
    x, y = jnp.array([[[1.0], [2.0]]]), jnp.array([[[3.0], [4.0]]])
    high = 0.5 - np.log1p(np.exp(0.5 + 3.0))
    log_var = -10 + np.log1p(np.exp(high + 10))
    errors = (0.25 + 0.25) / 2 * np.exp(-log_var) + log_var
    expected = errors + 0.01 * 10.5 + 0.3 / 2 * 4.0  # one layer: the last, whose share is 1
    np.testing.assert_allclose(ensemble_loss(ensemble, unscaled(1), x, y, 0.3), expected, rtol=1e-5)


@pytest.mark.parametrize("hidden, shares", [(1, (0.25, 1)), (4, (0.25, 0.5, 0.75, 0.75, 1))])
def test_layers_have_their_shares_of_the_weight_decay(hidden, shares):
    """The paper's network has four hidden layers."""
    ensemble = init_ensemble(jax.random.key(0), 2, 3, (5,) * hidden, 2)
    x, y = jax.random.normal(jax.random.key(1), (2, 2, 4, 3))
    loss = [ensemble_loss(ensemble, unscaled(3), x, y[..., :2], decay) for decay in (0.0, 10.0)]
    squares = [(layer.weight**2).sum() for layer in ensemble.layers]
    expected = 10 / 2 * np.dot(shares, squares)
    np.testing.assert_allclose(loss[1] - loss[0], expected, rtol=1e-4)


def test_the_spread_is_the_length_of_the_vector_of_deviations():
    ensemble = init_ensemble(jax.random.key(0), 2, 3, (5,), 4)
    x = jax.random.normal(jax.random.key(1), (2, 6, 3))
    _, spread = draw_of_ensemble(ensemble, unscaled(3), x, jax.random.key(2))
    std = np.exp(outputs_of(ensemble, unscaled(3), x).log_std)
    np.testing.assert_allclose(spread, np.sqrt((std**2).sum(-1)), rtol=1e-5)


def test_the_bounds_of_the_variance_follow_the_likelihood_too():
    """One linear layer says v = 0, with high = 0 and low = -log 2. Then log sigma^2 is 0. Its slope is
    1/4 in `high` and 1/2 in `low`. At errors of 2 that of the likelihood's part is 1 - 2^2 in it."""
    ensemble: Any = init_ensemble(jax.random.key(0), 1, 1, (), 1)
    layer = jax.tree.map(jnp.zeros_like, ensemble.layers[0])
    zero = jnp.zeros((1, 1))
    ensemble = ensemble.replace(layers=(layer,), low=zero - jnp.log(2.0), high=zero)
    x, y = jnp.ones((1, 2, 1)), jnp.array([[[2.0], [-2.0]]])
    grad = jax.grad(ensemble_loss)(ensemble, unscaled(1), x, y, 0.0)
    np.testing.assert_allclose(grad.high, [[-3 / 4 + 0.01]], rtol=1e-5)
    np.testing.assert_allclose(grad.low, [[-3 / 2 - 0.01]], rtol=1e-5)


def test_predictions_in_bfloat16_round_to_8_bits_and_stay_float32():
    """Rounding errors of 2^-9 each, some ten of them, one upon the other."""
    ensemble = init_ensemble(jax.random.key(0), 3, 5, (64, 64, 64), 4)
    x = jax.random.normal(jax.random.key(1), (3, 500, 5))
    exact, rounded = (outputs_of(ensemble, unscaled(5), x, dtype) for dtype in ("float32", "bfloat16"))
    assert rounded.mean.dtype == rounded.log_std.dtype == jnp.float32
    for a, b in ((exact.mean, rounded.mean), (exact.log_std, rounded.log_std)):
        varies = jnp.linalg.norm(a - a.mean((0, 1)))  # log std is nearly constant at first
        assert 1e-4 < jnp.linalg.norm(a - b) / varies < 0.1


def test_weights_begin_small_and_are_cut_off():
    layer = init_ensemble(jax.random.key(0), 2, 100, (300,), 1).layers[0]
    std = 1 / (2 * 100**0.5)
    assert jnp.abs(layer.weight).max() <= 2 * std and jnp.abs(layer.weight).max() > 1.9 * std
    np.testing.assert_allclose(layer.weight.std(), 0.88 * std, rtol=0.02)  # of N(0, 1) within +-2
    assert (layer.weight[0] != layer.weight[1]).all()


def test_the_model_learns_from_steps_within_an_episode_without_a_jump_and_finite():
    x = jnp.arange(12.0).reshape(6, 2)
    no = np.zeros((6, 2), bool)
    last, jump = no.copy(), no.copy()
    last[3, 0] = True  # of environment 0; the next row is a reset
    jump[3, 1] = True  # a new goal appears there
    reward = jnp.ones((6, 2)).at[0, 1].set(jnp.nan)  # of the step from row 0
    ring = ring_of(x, reward, truncated=jnp.array(last), jump=jnp.array(jump))
    span = Span(jnp.int32(1), jnp.int32(6))  # full: row 1 is the oldest, row 0 the newest
    mask = learnable(ring, span)
    expected = ~no
    expected[0] = False  # nothing follows the newest row
    expected[3, 0] = False
    expected[2, 1] = False
    np.testing.assert_array_equal(mask, expected)
    inputs, targets = transitions_at(ring, jnp.array([2 * 5 + 1, 2 * 1]), Config())
    np.testing.assert_array_equal(inputs, [[11.0, 0.0], [2.0, 0.0]])
    np.testing.assert_array_equal(targets[1], [1.0, 2.0])  # reward, and 4 - 2
    np.testing.assert_array_equal(targets[0, 1], 1.0 - 11.0)  # the ring goes on at row 0
    scale = scale_of(ring, jnp.asarray(expected), None)
    kept = x[expected]
    np.testing.assert_allclose(scale.mean, jnp.array([kept.mean(), 0.0]), rtol=1e-6)
    np.testing.assert_allclose(scale.std, jnp.array([kept.std(), 1.0]), rtol=1e-6)


def test_a_row_says_whether_what_the_environment_reports_made_it_jump():
    env, keys = Ticker(episode_length=3), jax.random.split(jax.random.key(1), 8)
    stepping = started(init_rollout(env, jax.random.key(0), 2, stagger=False))

    def act(carry, state, first, key):
        return jnp.zeros((2, 1)), carry, {}

    ticks = record_by(dataclasses.replace(Config(), jump="ticks"))  # it reports a tick of each step
    run = jax.jit(lambda x: collect_records(env, act, x, keys, ticks), compiler_options=FAST)
    rows: Any = run(stepping)[1][0]
    np.testing.assert_array_equal(rows.jump, ~rows.first)
    assert rows.first.sum() == 2 * 2
    assert not record_by(Config())(stepping, jnp.zeros((2, 1))).jump.any()  # and no goal_met


def test_a_model_is_put_back_to_its_best():
    """The last `patience` epochs did not help, so the fit that stops before them is the same."""
    cfg = dataclasses.replace(Config(), models=1, patience=3, epoch_steps=0)
    x, y = draw(jax.random.key(0), (64, ENVS))
    ring, span = ring_of(x, y), Span(jnp.int32(0), jnp.int32(64))

    def train(epochs):
        model = init_model(jax.random.key(1), LINE, cfg)
        most = dataclasses.replace(cfg, max_epochs=epochs)
        after, metrics = fit(model, ring, span, jax.random.key(2), most)
        return *after, metrics

    def run(epochs):
        return jax.jit(train, static_argnums=0, compiler_options=BUSY)(epochs)

    model, _, metrics = run(1000)
    early, _, before = run(int(metrics["train/model_epochs"]) - 3)
    for a, b in zip(jax.tree.leaves(model), jax.tree.leaves(early), strict=True):
        np.testing.assert_array_equal(a, b)
    assert metrics["train/model_error"] == before["train/model_error"]
    assert metrics["train/model_epochs"] == before["train/model_epochs"] + 3


def test_a_fit_goes_on_as_long_as_any_model_becomes_better_by_a_hundredth():
    """The first model learns a little in each epoch. The second is not finite, and never does."""
    cfg = dataclasses.replace(
        Config(), models=2, model_hidden=(), patience=2, max_epochs=7, epoch_steps=20
    )
    x, _ = draw(jax.random.key(0), (64, ENVS))
    whole = init_model(jax.random.key(1), LINE, cfg)
    layers = jax.tree.map(lambda w: w.at[1].set(jnp.nan), whole.params.ensemble.layers)
    ensemble = whole.params.ensemble.replace(layers=layers)
    model = whole._replace(params=whole.params.replace(ensemble=ensemble))
    span = Span(jnp.int32(0), jnp.int32(64))

    def train(x, model_lr):
        paced = dataclasses.replace(cfg, model_lr=model_lr)
        return fit(model, ring_of(x, x), span, jax.random.key(2), paced)[1]

    train = jax.jit(train, compiler_options=FAST)
    metrics = train(x, 1e-3)
    assert metrics["train/model_epochs"] == 7 and jnp.isinf(metrics["train/model_error"])
    assert train(x, 1e-6)["train/model_epochs"] == 1 + 2  # the first is better than none


def rows_that_count(rows, **options):
    """Which of `rows` rows train each model, bool [rows, M], and which measure the error, bool [rows];
    their x [rows], and the scale of the inputs.

    A row counts if its reward makes a difference: to Adam's moments or, as the learning rate is 0, to
    the error of models that stay what they are.
    """
    small: dict[str, Any] = {"model_hidden": (), "model_lr": 0.0, "max_epochs": 1, "holdout": 0.5}
    cfg = dataclasses.replace(Config(), **small | options)
    x, y = draw(jax.random.key(0), (rows + 1, 1))  # nothing follows the last row
    span, model = Span(jnp.int32(0), jnp.int32(rows + 1)), init_model(jax.random.key(1), LINE, cfg)

    def found(y):
        after, metrics = fit(model, ring_of(x, y), span, jax.random.key(2), cfg)
        moment = after.opt_state[0].mu.layers[0].bias
        return moment, metrics["train/model_error"], after.params.scale

    rewards = y + 10 * jnp.eye(rows + 1)[:, :, None]  # another one of each row; the last does not count
    moments, error, scale = jax.jit(jax.vmap(found), compiler_options=FAST)(rewards)
    of_one = jax.tree.map(operator.itemgetter(0), scale)
    return (moments[:-1] != moments[-1]).any(-1), error[:-1] != error[-1], x[:-1, 0], of_one


def test_rows_either_train_all_models_and_scale_the_inputs_or_measure_the_error():
    trained, held_out, x, scale = rows_that_count(40, epoch_steps=20, model_batch=64)
    assert 10 < held_out.sum() < 30
    np.testing.assert_array_equal(trained, np.stack([~held_out] * 3, 1))
    seen = x[~held_out]
    np.testing.assert_allclose((scale.mean[0], scale.std[0]), (seen.mean(), seen.std()), rtol=1e-5)


def test_each_model_has_batches_of_its_own_in_each_epoch():
    trained, *_ = rows_that_count(40, epoch_steps=1, model_batch=4)
    count = trained.sum(0)
    assert (count >= 1).all() and (count <= 4).all()
    assert all((trained[:, i] != trained[:, j]).any() for i, j in ((0, 1), (0, 2), (1, 2)))
    trained, *_ = rows_that_count(40, epoch_steps=1, model_batch=4, max_epochs=2)
    assert (trained.sum(0) > 4).all()


def test_an_epoch_with_a_gradient_that_is_not_finite_moves_nothing():
    cfg = dataclasses.replace(Config(), models=1, max_epochs=1, epoch_steps=5)
    x, y = draw(jax.random.key(0), (64, ENVS))
    span = Span(jnp.int32(0), jnp.int32(64))
    before = init_model(jax.random.key(1), LINE, cfg)
    after, metrics = fit(before, ring_of(x, 1e30 * y), span, jax.random.key(2), cfg)
    assert metrics["train/nonfinite"] == 5
    start = before.params.ensemble, before.opt_state
    end = after.params.ensemble, after.opt_state
    for a, b in zip(jax.tree.leaves(start), jax.tree.leaves(end), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("kind", ["huge weights", "a huge gradient"])
def test_a_model_that_does_not_stay_finite_leaves_the_others_to_learn(kind):
    """A gradient of 1e20 moves no weight, but its square is infinite in Adam's moments."""
    cfg = dataclasses.replace(Config(), max_epochs=1, epoch_steps=20)
    x, y = draw(jax.random.key(0), (64, ENVS))
    whole = init_model(jax.random.key(1), LINE, cfg)
    ensemble = whole.params.ensemble
    if kind == "huge weights":
        layers = jax.tree.map(lambda w: w.at[1].multiply(1e18), ensemble.layers)
        broken = ensemble.replace(layers=layers)
    else:
        low, high = (bound.at[1].set(-46.0) for bound in (ensemble.low, ensemble.high))
        broken = ensemble.replace(low=low, high=high)

    def train(ensemble):
        ring, span = ring_of(x, y), Span(jnp.int32(0), jnp.int32(64))
        params = whole.params.replace(ensemble=ensemble)
        return fit(Trainable(params, whole.opt_state), ring, span, jax.random.key(2), cfg)

    run = jax.jit(train, compiler_options=FAST)
    (good, _), clean = run(ensemble)
    (kept, state), metrics = run(broken)
    assert clean["train/nonfinite"] == 0 and metrics["train/nonfinite"] == 20
    leaves = [jax.tree.leaves(tree) for tree in (good.ensemble, broken, kept.ensemble)]
    for learned, start, end in zip(*leaves, strict=True):
        np.testing.assert_array_equal(learned[::2], end[::2])
        np.testing.assert_array_equal(start[1], end[1])
    assert (good.ensemble.layers[0].weight != ensemble.layers[0].weight).any()
    assert state[0].count.tolist() == [20, 0, 20]
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(state))


def test_a_fit_in_bfloat16_moves_float32_weights_by_nearly_the_same():
    ensemble = init_ensemble(jax.random.key(0), 3, 2, (32, 32), 1)
    x, y = jax.random.normal(jax.random.key(1), (2, 3, 256, 2))
    losses = [
        jax.value_and_grad(ensemble_loss)(ensemble, unscaled(2), x, y[..., :1], 1e-4, dtype)
        for dtype in ("float32", "bfloat16")
    ]
    (exact, grads), (near, near_grads) = losses
    assert 0 < abs(near - exact) < 0.01 * exact
    for a, b in zip(jax.tree.leaves(grads), jax.tree.leaves(near_grads), strict=True):
        assert b.dtype == jnp.float32
        np.testing.assert_allclose(b, a, atol=0.02 * np.abs(a).max())


@pytest.mark.parametrize("foresees", [True, False])
def test_a_plan_earns_nothing_after_an_end_that_the_observation_tells(foresees):
    """The ensemble is sure that a step goes 1 ahead and pays 2. Beyond 1.5 the episode ends."""

    @dataclass(frozen=True)
    class Ending(Line):
        episode_length: int = 5

        def observed_end(self, obs):
            return obs[..., 0] > 1.5

    env: Any = Ending()
    cfg = dataclasses.replace(Config(), foresee_end=foresees, particles=2)
    model = init_model(jax.random.key(0), env, cfg).params
    *layers, last = jax.tree.map(jnp.zeros_like, model.ensemble.layers)
    means = jnp.zeros_like(last.bias).at[:, 0].set(2.0).at[:, 1].set(1.0)
    sure = jnp.full_like(model.ensemble.low, -30.0)
    ensemble = model.ensemble.replace(
        layers=(*layers, last.replace(bias=means)), low=sure, high=sure + 1e-3
    )
    learned = Learned(cfg, {"model": model.replace(ensemble=ensemble)}, (), ())
    plans = jnp.zeros((1, 4, 1))
    imagined = imagine(learned_model(env), learned, jnp.zeros(1), plans, jax.random.key(1))
    paid = [2, 2, 0, 0] if foresees else [2, 2, 2, 2]
    np.testing.assert_allclose(imagined.reward.mean((1, 2, 3)), paid, atol=1e-4)
    assert ((imagined.spread > 0).all((1, 2, 3)) == (jnp.array(paid) > 0)).all()
    assert (imagined.alive == (not foresees)).all()


def test_a_particle_follows_its_own_model_from_where_it_is():
    """Model m is sure that a step goes m + a ahead, and pays what x was before it."""
    cfg = dataclasses.replace(Config(), model_hidden=(), particles=2)
    model = init_model(jax.random.key(0), LINE, cfg).params
    weight = jnp.broadcast_to(jnp.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0]]), (3, 2, 4))  # of x and of a
    bias = jnp.zeros((3, 4)).at[:, 1].set(jnp.arange(3.0))
    low = jnp.full_like(model.ensemble.low, -30.0)
    layers = (model.ensemble.layers[0].replace(weight=weight, bias=bias),)
    ensemble = model.ensemble.replace(layers=layers, low=low, high=low + 1e-3)
    learned = Learned(cfg, {"model": model.replace(ensemble=ensemble)}, (), ())
    action = np.array([-0.5, 0.0, 1.0])
    plans = jnp.broadcast_to(jnp.asarray(action)[:, None, None], (3, 4, 1))
    imagined = imagine(learned_model(LINE), learned, jnp.ones(1), plans, jax.random.key(1))
    ahead = np.arange(3)[:, None, None] + np.stack([action] * 2)  # [M, P, S]
    np.testing.assert_allclose(imagined.obs[..., 0], 1 + 4 * ahead, atol=1e-4)
    np.testing.assert_allclose(imagined.reward, [1 + h * ahead for h in range(4)], atol=1e-4)


def test_a_cost_that_is_not_learned_is_that_of_where_a_step_leads():
    """Every model is sure that a step goes 1 ahead. Beyond 1.5 it costs 7."""

    @dataclass(frozen=True)
    class Costly(Line):
        def observed_cost(self, obs):
            return 7.0 * (obs[..., 0] > 1.5)

    env: Any = Costly()
    cfg = dataclasses.replace(Config(), model_hidden=(), particles=2)
    model = init_model(jax.random.key(0), env, cfg).params
    (layer,) = jax.tree.map(jnp.zeros_like, model.ensemble.layers)
    layer = layer.replace(bias=layer.bias.at[:, 1].set(1.0))
    low = jnp.full_like(model.ensemble.low, -30.0)
    ensemble = model.ensemble.replace(layers=(layer,), low=low, high=low + 1e-3)
    learned = Learned(cfg, {"model": model.replace(ensemble=ensemble)}, (), ())
    plans = jnp.zeros((1, 3, 1))
    imagined = imagine(learned_model(env), learned, jnp.zeros(1), plans, jax.random.key(1))
    np.testing.assert_array_equal(imagined.cost[:, 0, 0, 0], [0, 7, 7])
    assert (imagined.cost == imagined.cost[:, :1, :1]).all()


def test_no_predicted_observation_is_farther_than_100():
    """Every model is sure that a step goes 60 back: from 1 to -59, and no farther than -100."""
    cfg = dataclasses.replace(Config(), model_hidden=(), particles=2)
    model = init_model(jax.random.key(0), LINE, cfg).params
    (layer,) = jax.tree.map(jnp.zeros_like, model.ensemble.layers)
    layer = layer.replace(bias=layer.bias.at[:, 1].set(-60.0))
    low = jnp.full_like(model.ensemble.low, -30.0)
    ensemble = model.ensemble.replace(layers=(layer,), low=low, high=low + 1e-3)
    learned = Learned(cfg, {"model": model.replace(ensemble=ensemble)}, (), ())
    for steps, x in ((1, -59.0), (2, -100.0), (3, -100.0)):
        plans = jnp.zeros((1, steps, 1))
        imagined = imagine(learned_model(LINE), learned, jnp.ones(1), plans, jax.random.key(1))
        np.testing.assert_allclose(imagined.obs, x, atol=1e-4)
