"""SEditor's parts by hand: its Beta policies, edits, returns, gradients and price."""

import dataclasses
import functools
import math
import operator
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from compiling import EXACT, FAST
from scipy.special import betainc, psi
from scipy.stats import beta as scipy_beta
from scipy.stats import kstest
from toys import START, Lever, Patch, momentum

from jaxsafe.algos import ALGOS, seditor
from jaxsafe.algos.seditor import Scene
from jaxsafe.config import ConfigError
from jaxsafe.learn.acting import Learned
from jaxsafe.learn.critics import Values
from jaxsafe.learn.learner import GradientStep
from jaxsafe.learn.normalise import averaged, no_moments, standard
from jaxsafe.learn.replay import Record
from jaxsafe.learn.sequences import SequenceBatch, lambda_returns
from jaxsafe.learn.timetable import timetable_of
from jaxsafe.nn import beta
from jaxsafe.types import Shared

CFG = seditor.SEditorConfig(hidden=(), layer_norm=False)


# ---- Beta policies -----------------------------------------------------------------------------


def test_a_policy_begins_as_beta_2_2_on_each_component():
    cfg = seditor.SEditorConfig(hidden=(8, 8))
    net = beta.init_beta(jax.random.key(0), 3, 2, cfg)
    obs = jax.random.normal(jax.random.key(1), (20_000, 3))
    dist = beta.beta_policy(net, obs, cfg)
    np.testing.assert_allclose(dist.up, 2, rtol=1e-6)
    np.testing.assert_allclose(dist.down, 2, rtol=1e-6)
    np.testing.assert_allclose(beta.beta_mode(dist), 0, atol=1e-6)
    action, log_prob = beta.beta_sample(dist, jax.random.key(2))
    entropy = math.log(1 / 6) - 2 * psi(2) + 2 * psi(4) + math.log(2)
    assert abs(entropy - 0.5681) < 1e-4
    np.testing.assert_allclose(-log_prob.mean(), 2 * entropy, atol=0.02)
    np.testing.assert_allclose(action.mean(0), 0, atol=0.02)
    np.testing.assert_allclose(action.std(0), 2 / math.sqrt(20), atol=0.01)
    assert abs(2 * math.log(2 * cfg.min_prob) + 3.2189) < 1e-4


def test_log_probabilities_are_scipys_and_the_mode_is_where_they_are_highest():
    up, down = np.array([1.001, 2.0, 30.0]), np.array([4.0, 1.5, 40.0])
    x = np.random.default_rng(0).uniform(0.02, 0.98, (50, 3))
    dist = beta.Beta(jnp.float32(up), jnp.float32(down))
    found = beta.beta_log_prob(dist, jnp.float32(x))
    expected = (scipy_beta.logpdf(x, up, down) - math.log(2)).sum(-1)
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-4)
    mode, log_prob = beta.beta_sample(dist, None)
    np.testing.assert_allclose(mode, 2 * (up - 1) / (up + down - 2) - 1, atol=1e-5)
    assert (log_prob >= found).all()


SHAPES = [(1.0, 1.0), (1.001, 300.0), (2.0, 2.0), (30.0, 4.0), (500.0, 700.0), (5000.0, 1.0)]


@pytest.mark.parametrize("up, down", SHAPES)
def test_draws_have_their_distribution(up, down):
    many = jnp.ones((50_000, 1))
    action, _ = jax.jit(beta.beta_sample)(beta.Beta(up * many, down * many), jax.random.key(1))
    x = (np.float64(action[:, 0]) + 1) / 2
    assert kstest(x, scipy_beta(up, down).cdf).pvalue > 1e-3


@pytest.mark.parametrize("up, down", SHAPES)
def test_a_draw_moves_with_its_concentrations_as_scipys_quantiles_do(up, down):
    share = np.array([0.001, 0.05, 0.3, 0.5, 0.7, 0.95, 0.999])
    x = np.float64(np.float32(scipy_beta.ppf(share, up, down)))
    share = betainc(up, down, x)
    found = jax.jit(jax.vmap(jax.grad(beta.following, 1), (0, None)))(
        jnp.float32(x), beta.Beta(jnp.float32(up), jnp.float32(down))
    )
    h = 1e-5

    def quantile(up, down):
        return scipy_beta.ppf(share, up, down)

    slopes = (
        (quantile(up * (1 + h), down) - quantile(up * (1 - h), down)) / (2 * h * up),
        (quantile(up, down * (1 + h)) - quantile(up, down * (1 - h))) / (2 * h * down),
    )
    np.testing.assert_allclose(found.up, slopes[0], rtol=5e-3)
    np.testing.assert_allclose(found.down, slopes[1], rtol=5e-3)


def test_the_mean_of_draws_moves_as_it_should():
    """The mean of Beta(a, b) is a / (a + b), so that its slope in a at (2, 2) is 1 / 8."""

    def mean(a):
        many = jnp.full((20_000, 1), 1.0)
        action, _ = beta.beta_sample(beta.Beta(a * many, 2 * many), jax.random.key(0))
        return (action + 1).mean() / 2

    slope = jax.jit(jax.grad(mean), compiler_options=FAST)(jnp.float32(2))
    np.testing.assert_allclose(slope, 0.125, atol=3e-3)


def test_the_gradient_of_concentrations_is_short():
    x = jnp.array([[3.0, 4.0], [0.003, 0.004], [0.0, 0.0]])
    slope = jax.grad(lambda x: (x**2 / 2).sum())
    clipped = jax.grad(lambda x: (beta.short_gradient(x, 0.01) ** 2 / 2).sum())(x)
    np.testing.assert_allclose(slope(x), x)
    np.testing.assert_allclose(clipped, [[0.006, 0.008], [0.003, 0.004], [0, 0]], rtol=1e-5)


# ---- edits -------------------------------------------------------------------------------------


def test_an_edit_reaches_every_action_from_every_proposal():
    rng = np.random.default_rng(0)
    proposal, action = jnp.float32(rng.uniform(-1, 1, (2, 100, 2)))
    np.testing.assert_array_equal(seditor.edit(proposal, jnp.zeros(2), CFG), proposal)
    np.testing.assert_allclose(seditor.edit(proposal, (action - proposal) / 2, CFG), action, atol=1e-6)
    wild = seditor.edit(proposal, jnp.float32(rng.uniform(-1, 1, (100, 2))), CFG)
    assert (jnp.abs(wild) <= 1).all() and (jnp.abs(wild) == 1).any()
    slope = jax.grad(lambda v: seditor.edit(jnp.float32(0.5), v, CFG))
    assert slope(0.1) == 2 and slope(0.4) == 0
    alone = dataclasses.replace(CFG, edit="overwrite")
    np.testing.assert_array_equal(seditor.edit(proposal, action, alone), action)


def critic(obs_size, weights, bias=0.0, count=2):
    """`count` linear critics that agree: Q(s, a) = weights . a + bias."""
    kernel = jnp.concatenate([jnp.zeros(obs_size), jnp.float32(weights)])[:, None]
    dense = {"kernel": jnp.stack([kernel] * count), "bias": jnp.full((count, 1), bias)}
    return {"params": {"Dense_0": dense}}


def nets(obs_size=1, size=1, **changes):
    keys = jax.random.split(jax.random.key(0), 2)
    return {
        "proposer": beta.init_beta(keys[0], obs_size, size, CFG),
        "editor": beta.init_beta(keys[1], obs_size + size, size, CFG),
        "critic_r": critic(obs_size, jnp.ones(size)),
        "critic_c": critic(obs_size, jnp.zeros(size)),
        "log_alpha": -jnp.inf,
        "log_alpha_editor": -jnp.inf,
    } | changes


class Price:
    def __init__(self, lam):
        self.lam = jnp.float32(lam)


@pytest.mark.parametrize("distance", ["hinge", "action", "reward"])
def test_an_edit_is_charged_for_the_reward_that_it_loses(distance):
    """Q_r is the action itself, so that it loses what the action falls."""
    cfg = dataclasses.replace(CFG, distance=distance, concentration_clip=float("inf"))
    params, obs = nets(), jnp.zeros((200, 1))
    params["critic_c"] = critic(1, [0.0], bias=3.0)

    def gain(editor):
        return seditor.editor_gain(editor, Scene(params, Price(0.5), obs, cfg), jax.random.key(3))

    worth, drawn, lost = jax.jit(gain)(params["editor"])
    fall = drawn.proposal[:, 0] - drawn.action[:, 0]
    np.testing.assert_allclose(lost, jnp.maximum(fall, 0), atol=1e-6)
    charge = {"hinge": lost, "action": fall**2, "reward": -drawn.action[:, 0]}[distance]
    np.testing.assert_allclose(worth, (-charge - 0.5 * 3.0) / 1.5, atol=1e-5)
    assert 20 < (fall > 0).sum() < 180
    if distance == "hinge":  # no gradient where nothing is lost
        slope = jax.jit(jax.grad(lambda editor, mask: (gain(editor)[0] * mask).sum()))
        norms = [optax.tree.norm(slope(params["editor"], mask)) for mask in (fall < 0, fall > 0)]
        assert norms[0] == 0 and norms[1] > 0.1


def test_the_proposer_feels_its_own_action_and_what_the_editor_makes_of_it():
    cfg = dataclasses.replace(CFG, concentration_clip=float("inf"))
    params, obs = nets(), jnp.zeros((500, 1))

    @jax.jit
    def slope(proposer, editor):
        def gain(proposer):
            given = params | {"editor": editor}
            scene = Scene(given, None, obs, cfg)
            return seditor.proposer_gain(proposer, scene, jax.random.key(1))[0].mean()

        return jax.grad(gain)(proposer)["params"]["Dense_0"]["bias"]

    heedless = slope(params["proposer"], params["editor"])
    head = params["editor"]["params"]["Dense_0"]
    kernel = head["kernel"].at[1].set(jnp.array([-2.0, 2.0]))  # draws back what was proposed
    opposed = slope(params["proposer"], {"params": {"Dense_0": head | {"kernel": kernel}}})
    assert heedless[0] > 0.01 and heedless[1] < -0.01  # up
    assert opposed[0] < heedless[0] - 0.01


@pytest.fixture
def hill(monkeypatch):
    """Q_r = -(a - s)^2, and Q_c = a+ costs from 0 on."""

    def worth(params, obs, action, cfg):
        return -((action[..., 0] - obs[..., 0]) ** 2)

    def both(params, obs, action, names, cfg):
        return Values(worth(params, obs, action, cfg)[None], jax.nn.relu(action[..., 0]))

    monkeypatch.setattr(seditor, "reward_value", worth)
    monkeypatch.setattr(seditor, "with_reduced_cost", both)


def test_the_editor_brings_unsafe_proposals_to_the_bound_as_the_price_grows(hill):
    """The proposals stay where reward is."""
    params, obs, rule = nets(), jnp.full((64, 1), 0.5), optax.adam(0.1)  # without entropy

    def train(lam):
        def loss(own, key):
            given = params | jax.lax.stop_gradient(own)
            scene = Scene(given, Price(lam), obs, CFG)
            of_proposer, _ = seditor.proposer_gain(own["proposer"], scene, key)
            of_editor, *_ = seditor.editor_gain(own["editor"], scene, key)
            return -of_proposer.mean() - of_editor.mean()

        def step(carry, key):
            own, state = carry
            change, state = rule.update(jax.grad(loss)(own, key), state)
            moved: Any = optax.apply_updates(own, change)
            return (moved, state), None

        own: Any = {name: params[name] for name in ("proposer", "editor")}
        keys = jax.random.split(jax.random.key(0), 250)
        (own, _), _ = jax.lax.scan(step, (own, rule.init(own)), keys)
        many = jnp.full((1000, 1), 0.5)
        return seditor.edited(own["proposer"], own["editor"], many, jax.random.key(9), CFG)

    drawn = jax.jit(jax.vmap(train), compiler_options=FAST)(jnp.array([0.0, 1.0, 5.0]))
    assert (drawn.proposal.mean((1, 2)) > 0.5).all()
    mean, unsafe = drawn.action.mean((1, 2)), (drawn.action > 0.05).mean((1, 2))
    assert mean[0] > 0.4 and 0 < mean[1] < mean[0] - 0.3 and -0.4 < mean[2] < 0
    assert unsafe[0] > 0.8 and unsafe[2] < 0.3


def test_the_editor_leaves_safe_proposals_alone(hill):
    """Proposals are near s, where reward is: at 1/2 they are unsafe, and at -1/2 safe."""
    cfg = dataclasses.replace(CFG, hidden=(16,))
    head = jnp.outer(jnp.ones(16), jnp.array([1.35, -1.35]))  # Beta(31, 11) at 1/2
    layers = {
        "Dense_0": {"kernel": jnp.ones((1, 16)), "bias": jnp.zeros(16)},
        "Dense_1": {"kernel": head, "bias": jnp.full(2, 20.0)},
    }
    params = nets(proposer={"params": layers})
    obs, rule = jnp.repeat(jnp.array([[0.5], [-0.5]]), 64, axis=0), optax.adam(0.1)

    def step(carry, key):
        editor, state = carry

        def loss(editor):
            scene = Scene(params, Price(5.0), obs, cfg)
            return -seditor.editor_gain(editor, scene, key)[0].mean()

        change, state = rule.update(jax.grad(loss)(editor), state)
        return (optax.apply_updates(editor, change), state), None

    def train(editor):
        keys = jax.random.split(jax.random.key(0), 300)
        (editor, _), _ = jax.lax.scan(step, (editor, rule.init(editor)), keys)
        many = jnp.repeat(obs[::64], 1000, axis=0)
        return seditor.edited(params["proposer"], editor, many, jax.random.key(9), cfg)

    editor = beta.init_beta(jax.random.key(1), 2, 1, cfg)
    drawn = jax.jit(train, compiler_options=FAST)(editor)
    edit = (drawn.action - drawn.proposal).reshape(2, 1000)
    assert edit[0].mean() < -0.4
    assert abs(edit[1].mean()) < 0.1 and abs(edit[1]).mean() < 0.25


# ---- returns and scales ------------------------------------------------------------------------


def rows(reward, terminated, truncated, first, obs=None, action=None, cost=None) -> Record:
    reward = jnp.float32(reward)
    cost = jnp.zeros_like(reward) if cost is None else jnp.float32(cost)
    flags = {"terminated": terminated, "truncated": truncated, "first": first}
    return Record(
        obs=jnp.zeros((*reward.shape, 1)) if obs is None else obs,
        action=jnp.zeros((*reward.shape, 1)) if action is None else action,
        reward=reward,
        cost=cost,
        costs=cost[..., None],
        **{name: jnp.asarray(x, bool) for name, x in flags.items()},
    )


def test_lambda_returns_by_hand():
    """Four rows: in one go; with an end at row 2 that is out of time, or terminates; and across the
    newest row, between 1 and 2. Discount 1/2, lambda 1/4."""
    no = [0, 0, 0, 0]
    flags = {
        "terminated": [no, no, [0, 0, 1, 0], no],
        "truncated": [no, [0, 0, 1, 0], no, no],
        "first": [no, [0, 0, 0, 1], [0, 0, 0, 1], [0, 0, 1, 0]],
    }
    r, v = np.array([9.0, 1, 2, 4]), np.array([10.0, 20, 40, 80])
    found = rows([r] * 4, **flags)
    batch = SequenceBatch(jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), found), jnp.full(4, 0.25))
    value = jnp.float32(np.stack([v] * 4, axis=1))
    returns = lambda_returns(
        batch, batch.rows.reward, value, batch.rows.terminated, discount=0.5, decay=0.25
    )
    g2 = 4 + 0.5 * 80
    whole = 2 + 0.5 * (0.75 * 40 + 0.25 * g2)
    np.testing.assert_allclose(
        returns[:, 0], [1 + 0.5 * (0.75 * 20 + 0.25 * whole), whole, g2], rtol=1e-6
    )
    cut = 2 + 0.5 * 40
    np.testing.assert_allclose(returns[:2, 1], [1 + 0.5 * (0.75 * 20 + 0.25 * cut), cut], rtol=1e-6)
    np.testing.assert_allclose(returns[:2, 2], [1 + 0.5 * (0.75 * 20 + 0.25 * 2), 2], rtol=1e-6)
    np.testing.assert_allclose(returns[jnp.array([0, 2]), 3], [1 + 0.5 * 20, g2], rtol=1e-6)
    bounded = lambda_returns(batch, batch.rows.reward, value, batch.rows.last, discount=0.5, decay=0.25)
    np.testing.assert_array_equal(bounded[:2, 1], returns[:2, 2])  # running out of time is an end
    follows = np.asarray(batch.follows).T
    np.testing.assert_array_equal(follows, [[1, 1, 1], [1, 1, 0], [1, 1, 0], [1, 0, 1]])
    one_step = lambda_returns(
        batch, batch.rows.reward, value, batch.rows.terminated, discount=0.5, decay=0.0
    )
    np.testing.assert_allclose(one_step[:, 0], r[1:] + 0.5 * v[1:], rtol=1e-6)


def test_the_scale_of_rewards_forgets_slowly():
    first = jnp.array([[[1.0, 0.0], [3.0, 0.0]]])  # [T, B, S]
    second = jnp.array([[[10.0, 0.0], [10.0, 2.0]]])
    weight = jnp.array([0.5, 0.5])
    moments = averaged(no_moments(2), first, weight, None)
    np.testing.assert_allclose(moments.mean, [2, 0])  # the first has rate 1
    np.testing.assert_allclose(standard(moments, first, centre=True)[0, :, 0], [-1, 1], rtol=1e-6)
    moments = averaged(moments, second, weight, None)  # the second has 8/9
    np.testing.assert_allclose(moments.mean, [2 / 9 + 10 * 8 / 9, 8 / 9], rtol=1e-6)
    np.testing.assert_allclose(moments.square, [5 / 9 + 100 * 8 / 9, 2 * 8 / 9], rtol=1e-6)
    deviation = math.sqrt(16 / 9 - 64 / 81)
    scaled = standard(moments, second, centre=False)[0, :, 1]
    np.testing.assert_allclose(scaled, [0, 2 / deviation], rtol=1e-6)
    assert standard(moments, jnp.full(2, 1e9), centre=True).tolist() == [10, 10]


# ---- the price ---------------------------------------------------------------------------------


def test_the_multiplier_begins_at_one_and_takes_adams_steps_of_l():
    cfg = jax.tree.map(jnp.float32, seditor.SEditorConfig(cost_limit=0.5))
    dual = seditor.soft_lagrangian.init(cfg)
    np.testing.assert_allclose(dual.raw, math.log(math.e - 1), rtol=1e-6)
    np.testing.assert_allclose(dual.lam, 1, rtol=1e-6)
    adv = seditor.soft_lagrangian.advantage(dual, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(adv, [0.5, -0.5], rtol=1e-6)
    for cost, step in ((0.75, 0.01), (0.25, -0.01), (0.5, 0.0)):
        after = seditor.soft_lagrangian.update(dual, jnp.float32(cost), cfg, 0)
        np.testing.assert_allclose(after.raw - dual.raw, step, rtol=1e-4, atol=1e-7)
    capped = dataclasses.replace(cfg, lam_max=jnp.float32(1.005))
    for _ in range(5):
        dual = seditor.soft_lagrangian.update(dual, jnp.float32(9.0), capped, 0)
    np.testing.assert_allclose(dual.lam, 1.005, rtol=1e-5)


def test_the_scale_of_replayed_costs_does_not_move_the_price():
    """It is told what the steps of the rollout have cost, as they are."""
    algo = ALGOS["seditor"].make(Lever())
    cfg = ALGOS["seditor"].config(
        num_envs=4, horizon=4, learn_every=4, learning_starts=0, batch_size=8, replay_ratio=0.5,
        replay_size=64, n_step=3, hidden=(), dual_every=16, cost_limit=2.0, stagger=False,
    )  # fmt: skip

    @functools.partial(jax.jit, compiler_options=FAST)
    def price(scale):
        ts = algo.init(jax.random.key(0), cfg, START)
        moments = jax.tree.map(lambda x: jnp.full_like(x, scale), ts.opt_state["moments"])
        ts = dataclasses.replace(ts, opt_state=ts.opt_state | {"moments": moments})
        return ts.dual, algo.update(ts, START)[0].dual

    (before, one), (_, two) = price(1.0), price(100.0)
    assert one.raw != before.raw
    chex.assert_trees_all_equal(one, two)


# ---- the gradient step -------------------------------------------------------------------------


def batch_of(key) -> SequenceBatch:
    """Three sequences of 4 rows: one whole, one with an end, one that does not count."""
    keys = jax.random.split(key, 4)
    end = jnp.zeros((4, 3), bool).at[1, 1].set(True)
    found = rows(
        jax.random.normal(keys[0], (4, 3)),
        terminated=jnp.zeros((4, 3)),
        truncated=end,
        first=jnp.roll(end, 1, axis=0),
        obs=jax.random.normal(keys[1], (4, 3, 2)),
        action=jnp.tanh(jax.random.normal(keys[2], (4, 3, 2))),
        cost=(jax.random.uniform(keys[3], (4, 3)) > 0.5),
    )
    return SequenceBatch(found, jnp.array([0.5, 0.5, 0.0]))


def moved(nets):
    """Policies and targets that differ from those at the start."""
    leaves, structure = jax.tree.flatten(nets.params)
    keys = jax.random.split(jax.random.key(8), len(leaves))
    other = [x + 0.3 * jax.random.normal(k, x.shape) for k, x in zip(keys, leaves, strict=True)]
    return nets._replace(params=jax.tree.unflatten(structure, other))


def test_each_network_moves_along_its_own_objective_alone():
    """Adam's first moments are a tenth of the gradients: those of the critics by hand, of linear ones,
    and of the policies and temperatures one by one."""
    cfg = jax.tree.map(
        jnp.float32,
        dataclasses.replace(CFG, n_step=3, batch_size=8, max_grad_norm=float("inf"), tau=0.1,
                            discount=0.9, cost_discount=0.8, td_lambda=0.7, editor_min_prob=0.25),
    )  # fmt: skip
    learner, batch = seditor.seditor_learner(Lever()), batch_of(jax.random.key(5))
    dual = seditor.init_soft_multiplier(dataclasses.replace(cfg, lam_init=jnp.float32(2)))
    at = GradientStep(jnp.int32(0), jnp.float32(1), jax.random.key(7), dual)

    seen = batch.rows
    target_key, proposer_key, editor_key = jax.random.split(at.key, 3)

    def mean(x):
        return (batch.weight * x.mean(0)).sum()

    @functools.partial(jax.jit, compiler_options=EXACT)
    def run(key):
        before = moved(learner.init(key, 2, 2, cfg))
        p = before.params
        scene = Scene(p, dual, seen.obs, cfg)

        def proposer(net):
            return mean(seditor.proposer_gain(net, scene, proposer_key)[0])

        def editor(net):
            return mean(seditor.editor_gain(net, scene, editor_key)[0])

        slopes = {
            "proposer": jax.grad(proposer)(p["proposer"]),
            "editor": jax.grad(editor)(p["editor"]),
        }
        drawn = seditor.edited(p["proposer"], p["editor"], seen.obs, target_key, cfg)
        return before, *learner.step(before, batch, at, cfg, None), slopes, drawn

    before, after, metrics, slopes, drawn = run(jax.random.key(6))
    params = before.params

    # critics
    moments = averaged(no_moments(2), jnp.stack([seen.reward, seen.cost], -1), batch.weight, None)
    paid = standard(moments, jnp.stack([seen.reward, seen.cost], -1), centre=True)
    pair = np.concatenate([seen.obs, drawn.action], -1)
    taken = np.concatenate([seen.obs, seen.action], -1)
    counts = np.array([[0.5, 0.5, 0]] * 3) * np.asarray(batch.follows)
    counts /= counts.sum()
    for name, kind, discount, pick in (("critic_r", 0, 0.9, np.min), ("critic_c", 1, 0.8, np.max)):
        dense = params["targets"][name]["params"]["Dense_0"]
        values = pick(np.einsum("tbi,cij->ctb", pair, dense["kernel"]) + dense["bias"][:, :, None], 0)
        reward = np.asarray(paid[..., kind])
        y = np.zeros((3, 3))
        for b in range(3):
            following = values[3, b]
            for t in (2, 1, 0):
                if seen.last[t + 1, b]:
                    following = values[t + 1, b]
                y[t, b] = reward[t + 1, b] + discount * (0.3 * values[t + 1, b] + 0.7 * following)
                following = y[t, b]
        own = params[name]["params"]["Dense_0"]
        error = np.einsum("tbi,cij->ctb", taken[:3], own["kernel"]) + own["bias"][:, :, None] - y
        loss = (counts * (error**2).sum(0)).sum()
        np.testing.assert_allclose(metrics["train/critic_loss" + "_c" * kind], loss, rtol=1e-4)
        grad = {
            "kernel": np.einsum("tb,ctb,tbi->ci", counts, 2 * error, taken[:3])[..., None],
            "bias": np.einsum("tb,ctb->c", counts, 2 * error)[:, None],
        }
        mu = momentum(after, name)["params"]["Dense_0"]
        for leaf, x in grad.items():
            np.testing.assert_allclose(mu[leaf], 0.1 * x, rtol=1e-3, atol=1e-5)
        old, new = (x.params["targets"][name]["params"]["Dense_0"] for x in (before, after))
        fresh = after.params[name]["params"]["Dense_0"]["bias"]
        np.testing.assert_allclose(new["bias"], 0.9 * old["bias"] + 0.1 * fresh, rtol=1e-5)

    # policies and temperatures
    for name, expected in slopes.items():
        found = momentum(after, name)
        for x, y in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
            np.testing.assert_allclose(-0.1 * x, y, rtol=1e-3, atol=1e-6)
            assert jnp.abs(y).max() > 1e-5
    for name, entropy, share in (
        ("log_alpha", "train/entropy", 0.2),
        ("log_alpha_editor", "train/entropy_editor", 0.5),
    ):
        aim = 2 * math.log(share)
        np.testing.assert_allclose(
            after.opt_state[name][0].mu, 0.1 * (metrics[entropy] - aim), rtol=1e-5
        )


def test_two_devices_take_the_step_of_one_with_gradients_as_short(monkeypatch):
    """Without chance: the policies take their modes."""
    sampled = seditor.beta_sample
    monkeypatch.setattr(seditor, "beta_sample", lambda dist, key: sampled(dist, None))
    learner = seditor.seditor_learner(Lever())
    here = batch_of(jax.random.key(5))
    whole = SequenceBatch(
        jax.tree.map(lambda x: jnp.concatenate([x, x[:, :1]], 1), here.rows),
        jnp.array([1 / 3, 1 / 3, 0, 1 / 3]),
    )
    halves = SequenceBatch(
        jax.tree.map(lambda x: jnp.stack(jnp.split(x, 2, 1)), whole.rows),
        2 * whole.weight.reshape(2, 2),
    )

    def momenta(batch, clip, axis_name=None):
        cfg = dataclasses.replace(CFG, n_step=3, batch_size=8, concentration_clip=clip)
        cfg = jax.tree.map(jnp.float32, cfg)
        dual = seditor.init_soft_multiplier(cfg)
        at = GradientStep(jnp.int32(0), jnp.float32(1), jax.random.key(7), dual)
        before = moved(learner.init(jax.random.key(6), 2, 2, cfg))
        after, _ = learner.step(before, batch, at, cfg, axis_name)
        return {name: momentum(after, name) for name in seditor.optimisers(cfg, 1.0)}

    def on_two(half, clip):
        return momenta(half, clip, "devices")

    one = jax.jit(momenta, compiler_options=EXACT)
    two = jax.jit(jax.vmap(on_two, (0, None), axis_name="devices"), compiler_options=EXACT)
    short, free, found = one(whole, 0.01), one(whole, jnp.inf), two(halves, 0.01)
    for i in range(2):
        of_device = jax.tree.map(operator.itemgetter(i), found)
        chex.assert_trees_all_close(of_device, short, rtol=1e-3, atol=1e-6)
    for name in ("proposer", "editor"):
        assert optax.tree.norm(short[name]) < 0.9 * optax.tree.norm(free[name])


@pytest.mark.parametrize("failed", [False, True])
def test_without_an_editor_one_policy_pays_and_its_entropy_counts_in_all_returns(failed):
    """Linear critics by hand: alpha H is reward and takes away from cost, but not beyond a failure. The
    policy's momentum is a tenth of the gradient of what it earns less what it pays."""
    cfg = jax.tree.map(
        jnp.float32,
        dataclasses.replace(CFG, edit="none", n_step=3, batch_size=8, max_grad_norm=float("inf"),
                            discount=0.9, cost_discount=0.8, td_lambda=0.0, alpha_init=0.5,
                            concentration_clip=float("inf")),
    )  # fmt: skip
    learner, batch = seditor.seditor_learner(Lever()), batch_of(jax.random.key(5))
    if failed:
        ended = dataclasses.replace(batch.rows, terminated=batch.rows.truncated)
        batch = batch._replace(rows=ended)
    dual = seditor.init_soft_multiplier(dataclasses.replace(cfg, lam_init=jnp.float32(2)))
    at = GradientStep(jnp.int32(0), jnp.float32(1), jax.random.key(7), dual)
    seen, (target_key, proposer_key, _) = batch.rows, jax.random.split(at.key, 3)

    @functools.partial(jax.jit, compiler_options=EXACT)
    def run(key):
        before = learner.init(key, 2, 2, cfg)
        params = before.params

        def earned(net):
            action, log_prob = beta.beta_sample(
                beta.beta_policy(net, seen.obs, cfg), jax.random.split(proposer_key)[0]
            )
            inputs = jnp.concatenate([seen.obs, action], -1)
            q, q_c = (
                jnp.einsum("tbi,cij->ctb", inputs, x["kernel"]) + x["bias"][:, :, None]
                for x in (params[name]["params"]["Dense_0"] for name in ("critic_r", "critic_c"))
            )
            gain = (jnp.minimum(*q) - 2 * jnp.maximum(*q_c)) / 3 - 0.5 * log_prob
            return (batch.weight * gain.mean(0)).sum()

        drawn = beta.beta_sample(
            beta.beta_policy(params["proposer"], seen.obs, cfg), jax.random.split(target_key)[0]
        )
        return (
            before,
            *learner.step(before, batch, at, cfg, None),
            jax.grad(earned)(params["proposer"]),
            drawn,
        )

    before, after, metrics, slope, (action, log_prob) = run(jax.random.key(6))
    assert before.params["editor"] == () and "log_alpha_editor" not in before.params
    assert "train/edit" not in metrics and "train/alpha_editor" not in metrics
    for x, y in zip(jax.tree.leaves(slope), jax.tree.leaves(momentum(after, "proposer")), strict=True):
        np.testing.assert_allclose(-0.1 * x, y, rtol=1e-3, atol=1e-6)
        assert jnp.abs(y).max() > 1e-5

    moments = averaged(no_moments(2), jnp.stack([seen.reward, seen.cost], -1), batch.weight, None)
    paid = standard(moments, jnp.stack([seen.reward, seen.cost], -1), centre=True)
    pair, taken = (np.concatenate([seen.obs, x], -1) for x in (action, seen.action))
    counts = np.array([[0.5, 0.5, 0]] * 3) * np.asarray(batch.follows)
    counts /= counts.sum()
    goes_on = 1.0 - np.asarray(seen.terminated[1:])
    bonus = -0.5 * np.asarray(log_prob)[1:]
    for name, kind, discount, sign, pick in (
        ("critic_r", 0, 0.9, 1, np.min), ("critic_c", 1, 0.8, -1, np.max)
    ):  # fmt: skip
        dense = before.params["targets"][name]["params"]["Dense_0"]
        value = pick(np.einsum("tbi,cij->ctb", pair, dense["kernel"]) + dense["bias"][:, :, None], 0)
        y = np.asarray(paid[1:, :, kind]) + discount * goes_on * (value[1:] + sign * bonus)
        own = before.params[name]["params"]["Dense_0"]
        error = np.einsum("tbi,cij->ctb", taken[:3], own["kernel"]) + own["bias"][:, :, None] - y
        loss = (counts * (error**2).sum(0)).sum()
        np.testing.assert_allclose(metrics["train/critic_loss" + "_c" * kind], loss, rtol=1e-4)


@pytest.mark.parametrize("edit", ["add", pytest.param("none", marks=pytest.mark.slow)])
def test_the_critics_alone_train_the_encoder(edit, monkeypatch):
    """Its gradient is the same where those of the policies are stopped."""
    cfg = jax.tree.map(
        jnp.float32,
        dataclasses.replace(CFG, encoder="cnn", edit=edit, n_step=3, batch_size=8),
    )
    env, batch = Patch(), batch_of(jax.random.key(5))
    obs = jax.vmap(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), (4, 3))).obs
    seen = dataclasses.replace(batch.rows, obs=obs, action=batch.rows.action[..., :1])
    learner, batch = seditor.seditor_learner(env), batch._replace(rows=seen)
    at = GradientStep(
        jnp.int32(0), jnp.float32(1), jax.random.key(7), seditor.init_soft_multiplier(cfg)
    )

    def momenta():
        def run(key):
            after, _ = learner.step(moved(learner.init(key, 1, 1, cfg)), batch, at, cfg, None)
            return [momentum(after, name) for name in ("encoder", "proposer")]

        encoder, proposer = jax.jit(run, compiler_options=FAST)(jax.random.key(6))
        return encoder, optax.tree.norm(proposer)

    encoder, of_proposer = momenta()
    for name in ("proposer_gain", "editor_gain"):
        gain = getattr(seditor, name)
        stopped = functools.partial(lambda gain, *args: jax.lax.stop_gradient(gain(*args)), gain)
        monkeypatch.setattr(seditor, name, stopped)
    alone, of_none = momenta()
    chex.assert_trees_all_close(encoder, alone, rtol=1e-4, atol=1e-7)
    assert all(jnp.abs(x).max() > 1e-6 for x in jax.tree.leaves(encoder))
    assert of_proposer > 1e-4 and of_none == 0


def test_without_an_editor_the_mode_of_the_only_policy_acts():
    cfg = dataclasses.replace(CFG, edit="none")
    bias = jnp.array([1.0, 3.0])
    net = {"params": {"Dense_0": {"kernel": jnp.zeros((1, 2)), "bias": bias}}}
    learned = Learned(cfg, {"proposer": net, "editor": ()}, (), ())
    found = seditor.act(learned, jnp.zeros((1, 1)), None)
    up, down = 1 + np.log1p(np.exp(bias))
    np.testing.assert_allclose(found, [[2 * (up - 1) / (up + down - 2) - 1]], rtol=1e-5)
    many = seditor.act(learned, jnp.zeros((4000, 1)), jax.random.key(0))
    np.testing.assert_allclose(many.mean(), 2 * up / (up + down) - 1, atol=0.03)


def test_the_published_settings_are_one_step_of_1024_sequences_for_160_environment_steps():
    row = ALGOS["seditor"]
    cfg = row.config(**row.published["paper"])
    algo = row.make(Lever())
    assert algo.clocks(cfg) == (160, 1) and cfg.batch_size == 1024 * 8
    assert algo.clocks(row.config()) == (5120, 32)
    assert cfg.n_step + 1 == 8 and cfg.dual_every == 160
    rounds = jnp.arange(5_000_000 // 160)
    at = jax.vmap(lambda i: timetable_of(cfg, None).at(0, Shared(i)))(rounds)
    assert at.ready.sum() == 31_188  # gradient steps; the price moves in all 31,250 rounds


def test_the_settings_of_racing_are_one_step_of_256_sequences_for_80_environment_steps():
    row = ALGOS["seditor"]
    cfg = row.config(**row.published["racing"])
    assert row.make(Patch()).clocks(cfg) == (80, 1) and cfg.batch_size == 256 * 8
    assert cfg.n_step + 1 == 8 and cfg.dual_every == 80
    rounds = jnp.arange(5_000_000 // 80)
    at = jax.vmap(lambda i: timetable_of(cfg, None).at(0, Shared(i)))(rounds)
    assert at.ready.sum() == 62_500 - 624  # the 625th round ends with 50,000 steps


def test_a_batch_that_is_no_number_of_sequences_is_refused():
    algo: Any = ALGOS["seditor"].make(Lever())
    cfg = ALGOS["seditor"].config(n_step=4)
    with pytest.raises(ConfigError, match=r"batch_size=8192: expected a multiple of n_step \+ 1 = 5"):
        jax.eval_shape(lambda key: algo.init(key, cfg, START), jax.random.key(0))
