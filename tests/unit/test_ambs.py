"""The shield by hand: what a dream counts for, what is learned of it, and where it overrules."""

import dataclasses
import operator
import re
from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from compiling import FAST
from jax.flatten_util import ravel_pytree
from toys import SHIELDED, START, Corridor, Ledge, Ticker

from jaxsafe import envs
from jaxsafe.algos import ALGOS, ambs, dreamer
from jaxsafe.config import ConfigError
from jaxsafe.learn import dreaming
from jaxsafe.learn.acting import Learned, Player, course
from jaxsafe.learn.dreaming import Judged, Range, Scene, no_range
from jaxsafe.learn.next_step_rollout import collect_records, started
from jaxsafe.learn.replay import Record
from jaxsafe.learn.rollout import init_rollout
from jaxsafe.learn.sequences import SequenceBatch
from jaxsafe.learn.world_model import Dreams, dream, dream_returns, world_of
from jaxsafe.nn.gaussian import Gaussian
from jaxsafe.nn.rssm import Latent
from jaxsafe.report import evaluation
from jaxsafe.run.evaluate import make_play
from jaxsafe.types import Algorithm, Policy

CFG = ambs.AMBSConfig(
    discount=1 - 1 / 333, least_penalty_scale=1.0, rule="hoeffding", delta=0.1,
    shield_rollouts=512, shield_horizon=30, shield_steps=15,
)  # fmt: skip


@cache
def newborn() -> tuple[Algorithm, Any]:
    """The shield in the corridor with four dreams, and what it has learned before the first step."""
    algo = ALGOS["ambs"].make(Corridor())
    sizes: dict[str, Any] = {"num_envs": 4, "replay_ratio": 32, "shield_rollouts": 4}
    cfg = ambs.AMBSConfig(**SHIELDED | sizes)
    init = jax.jit(lambda key: algo.init(key, cfg, START), compiler_options=FAST)
    return algo, algo.learned(init(jax.random.key(0)))


# ---- the bounds --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "eps, confidence, rollouts",
    [(0.1, 0.05, 185), (0.1, 0.01, 265), (0.09, 0.01, 328), (0.05, 0.01, 1060), (0.02, 0.05, 4612),
     (0.01, 0.05, 18445)],
)  # fmt: skip
def test_the_dreams_that_an_estimate_takes_to_be_off_on_neither_side(eps, confidence, rollouts):
    assert ambs.required_rollouts(eps, confidence / 2) == rollouts


def test_one_side_takes_fewer_dreams_and_a_learned_model_four_times_as_many():
    assert ambs.required_rollouts(0.09, 0.01) == 285
    assert ambs.required_rollouts(0.09, 0.01 / 2, learned=True) == 1309
    assert ambs.required_rollouts(0.09, 0.01, learned=True) == 1138
    line = ambs.note(CFG)
    assert "from 6 of 512 dreams" in line and "half the time where that has P = 0.011" in line
    assert "285 with an exact model (512 are enough)" in line
    assert "and 1138 with" in line
    assert "none of this holds" in line
    assert "none of" not in ambs.note(dataclasses.replace(CFG, verdict="drawn"))
    assert "too few" in ambs.note(dataclasses.replace(CFG, shield_rollouts=200))


def test_of_a_shield_in_the_simulator_nothing_is_told_of_a_model():
    cfg = dataclasses.replace(CFG, shield="true_dynamics")
    line = ambs.note(cfg)
    assert "copies of the simulator" in line and line.endswith("takes 285 (512 are enough)")
    exact = ambs.note(dataclasses.replace(cfg, rule="binomial"))
    assert exact.endswith("lets the policy act with probability 0.01 at most where P >= 0.1")
    assert "model" not in line + exact


@pytest.mark.parametrize(
    "rollouts, delta, eps, least",
    [(100, 0.1, 0.09, 2), (200, 0.1, 0.09, 3), (512, 0.1, 0.09, 6), (500, 0.3, 0.09, 106),
     (65_536, 0.3, 0.05, 16_385)],
)  # fmt: skip
def test_hoeffdings_bound_is_in_a_run_what_is_told_of_it(rollouts, delta, eps, least):
    """A share of delta - eps is not above it, however 32 bits round the three. m = 65,536 is the most
    that a run takes."""
    cfg = dataclasses.replace(CFG, shield_rollouts=rollouts, delta=delta, eps=eps)
    assert ambs.overruled_from(cfg) == least
    assert ambs.overruled_from(jax.tree.map(jnp.float32, cfg)) == least


@pytest.mark.parametrize("rollouts, allowed", [(44, 0), (64, 1), (128, 5), (256, 14), (512, 35)])
def test_the_exact_bound_allows_more_than_hoeffdings(rollouts, allowed):
    cfg = dataclasses.replace(CFG, rule="binomial", shield_rollouts=rollouts)
    shares = jnp.arange(rollouts + 1) / rollouts
    overruled = np.asarray(ambs.overrules(shares, cfg))
    np.testing.assert_array_equal(overruled, np.arange(rollouts + 1) > allowed)
    exact = scipy.stats.binom.cdf(np.arange(rollouts + 1), rollouts, cfg.delta) > cfg.confidence
    np.testing.assert_array_equal(overruled, exact)
    assert not ambs.overrules(shares, dataclasses.replace(cfg, delta=jnp.inf)).any()
    line = ambs.note(cfg)
    assert f"from {allowed + 1} of {rollouts} dreams" in line
    half = scipy.optimize.brentq(lambda p: scipy.stats.binom.sf(allowed, rollouts, p) - 0.5, 0, 1)
    assert f"P = {half:.2g};" in line


@pytest.mark.parametrize(
    "options, told",
    [({"delta": 0.05}, "delta=0.05: expected at least eps=0.09"),
     ({"rule": "binomial", "shield_rollouts": 43},
      "delta=0.1: expected at least 0.11 with shield_rollouts=43, or shield_rollouts of at least 44,"),
     ({"rule": "binomial", "delta": 0.0}, "at least 0.009 with shield_rollouts=512, or the shield"),
     ({"rule": "binomial", "confidence": 1.0}, "confidence=1: expected less"),
     ({"discount": 0.99999}, "discount=0.99999: expected at most 0.9999, as verdict=summed")],
)  # fmt: skip
def test_a_shield_that_always_or_never_acts_is_refused(options, told):
    ambs.check(CFG, Corridor())
    with pytest.raises(ConfigError, match=told):
        ambs.check(dataclasses.replace(CFG, **options), Corridor())


@pytest.mark.parametrize("rollouts, delta", [(1, 0.9), (64, 0.05), (200, 0.003)])
def test_the_settings_that_a_refusal_names_are_the_first_to_be_accepted(rollouts, delta):
    cfg = dataclasses.replace(CFG, rule="binomial", shield_rollouts=rollouts, delta=delta)
    with pytest.raises(ConfigError) as refused:
        ambs.check(cfg, Corridor())
    least, more = re.findall(r"least ([\d.]+)", str(refused.value))
    ambs.check(dataclasses.replace(cfg, delta=float(least)), Corridor())
    ambs.check(dataclasses.replace(cfg, shield_rollouts=int(more)), Corridor())
    for fewer in ({"delta": 0.9 * float(least)}, {"shield_rollouts": int(more) - 1}):
        with pytest.raises(ConfigError, match="or the shield always acts"):
            ambs.check(dataclasses.replace(cfg, **fewer), Corridor())


@pytest.mark.parametrize("hazard, share, summed", [(0.01, 0.26, False), (0.03, 0.6, True)])
def test_means_that_are_summed_tell_no_probability_and_drawn_violations_do(hazard, share, summed):
    """Where each step has a violation with the same probability, R of the means is always the same."""
    steps, c, discount = CFG.shield_steps, CFG.violation_cost, CFG.discount
    value = c * hazard / (1 - discount * (1 - hazard))
    alive = jnp.ones((CFG.shield_horizon, 4096), bool)
    hit = jax.random.bernoulli(jax.random.key(0), hazard, alive.shape)
    dreams = ambs.Dreamt(c * hazard * alive, alive, value * jnp.ones(4096), hit)
    short = ambs.Dreamt(dreams.cost[:steps], alive[:steps], dreams.value, hit[:steps])
    assert (ambs.unsafe(short, CFG) == summed).all()
    drawn = ambs.unsafe(dreams, dataclasses.replace(CFG, verdict="drawn"))
    np.testing.assert_allclose(drawn.mean(), share, atol=0.02)


# ---- what a dream counts for -------------------------------------------------------------------


def one_dream(costs: dict[int, float], value: float = 0.0, ends: int = 99, steps: int = 40) -> bool:
    """Whether a dream is unsafe that costs so much in these steps, from 1 on, and ends after one."""
    cost = (
        jnp.zeros((steps, 1))
        .at[jnp.array([k - 1 for k in costs] or [0]), 0]
        .set(jnp.array([*costs.values()] or [0.0]))
    )
    alive = (jnp.arange(1, steps + 1) < ends)[:, None]
    dreams = ambs.Dreamt(cost, alive, jnp.array([value]), jnp.zeros_like(alive))
    return bool(ambs.unsafe(dreams, CFG)[0])


def test_a_violation_counts_within_the_horizon_and_not_a_step_later():
    np.testing.assert_allclose(ambs.threshold(CFG), 9.13725, rtol=1e-5)
    assert [k for k in range(1, 36) if one_dream({k: 10.0})] == [*range(1, 31)]


def test_sums_that_are_taken_backwards_are_the_direct_ones():
    """R_t = sum_i discount^i c_{t+1+i}, and the critics' part last, until a state has k = 0. Half of
    the 400 dreams of 15 steps end."""
    keys = jax.random.split(jax.random.key(0), 3)
    cost = 10 * jax.random.uniform(keys[0], (16, 400)) ** 12
    alive = jax.random.bernoulli(keys[1], 0.95, (16, 400))
    value = 10 * jax.random.uniform(keys[2], (16, 400))
    given = np.concatenate([cost[1:], value[-1:]]).astype(np.float64)
    runs = np.asarray(alive[1:], np.float64)

    def direct(t: int) -> np.ndarray:
        counts = np.cumprod(np.concatenate([np.ones((1, 400)), runs[t:]]), axis=0)
        return (CFG.discount ** np.arange(16 - t)[:, None] * counts * given[t:]).sum(0)

    args = cost, value, jnp.float32(alive)
    found = dream_returns(*args, discount=CFG.discount, decay=1.0)
    np.testing.assert_allclose(found, [direct(t) for t in range(15)], rtol=1e-4)
    dreams = ambs.Dreamt(cost[1:], alive[1:], value[-1], jnp.zeros((15, 400), bool))
    expected = direct(0) > 10 * CFG.discount**30
    np.testing.assert_array_equal(ambs.unsafe(dreams, CFG), expected)
    assert 100 < expected.sum() < 300 and 100 < (runs.min(0) == 0).sum() < 300


def test_costs_add_up_and_end_with_the_episode():
    assert one_dream({1: 3.2, 2: 3.2, 3: 3.2}) and not one_dream({1: 3.0, 2: 3.0, 3: 3.0})
    assert not one_dream({1: 3.2, 2: 3.2, 3: 3.2}, ends=1)
    assert one_dream({5: 10.0}, ends=5) and not one_dream({5: 10.0}, ends=4)
    assert not one_dream({})


def test_the_critics_stand_for_the_steps_that_are_not_dreamed():
    """V counts from 10 discount^30 / discount^15 = 9.5589 on."""
    assert one_dream({}, value=9.56, steps=15) and not one_dream({}, value=9.558, steps=15)


def test_a_drawn_violation_counts_until_the_episode_ends():
    """Four dreams of three steps: none, one in the last step, and one in and one after the step that
    ends the episode."""
    hit = jnp.array([[0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 1]], bool)
    alive = jnp.array([[1, 1, 1, 1], [1, 1, 0, 0], [1, 1, 1, 1]], bool)
    dreams = ambs.Dreamt(jnp.zeros((3, 4)), alive, jnp.zeros(4), hit)
    drawn = dataclasses.replace(CFG, verdict="drawn")
    assert ambs.unsafe(dreams, drawn).tolist() == [False, True, True, False]


def test_six_of_512_unsafe_dreams_overrule_and_five_do_not():
    overruled = ambs.overrules(jnp.array([5, 6]) / 512, jax.tree.map(jnp.float32, CFG))
    assert overruled.tolist() == [False, True]


def test_the_value_of_costs_ends_with_the_first_violation():
    """C at step 1, and nothing of what comes after: the target is C."""
    cost, value = jnp.array([[0.0], [10.0], [10.0]]), jnp.full((3, 1), 7.0)
    safe = jnp.array([[1.0], [0.0], [0.0]])
    until = dream_returns(cost, value, safe, discount=CFG.discount, decay=CFG.td_lambda)
    np.testing.assert_array_equal(until, [[10.0], [10.0]])


class Heard:
    """What `ambs.learn` says to its scene.

    judged: of each critic that is asked, the dreams, their rewards and the discount.
    climbed: of each actor, its dreams and their advantages.
    told: of each critic, the dreams that it learns from, and their returns.
    with_rows: the critics that also learn from the rows.
    found: the advantages before penalties.
    loss: the sum of losses, each of which is 1.
    memory: what is remembered.
    """

    def __init__(self) -> None:
        self.judged: dict[str, tuple[Any, Any, Any]] = {}
        self.climbed: list[tuple[Any, Any]] = []
        self.told: dict[str, tuple[Any, Any]] = {}
        self.with_rows: list[str] = []
        self.found: list[ambs.Advantages] = []
        self.loss: Any = None
        self.memory: Any = None


def listen(monkeypatch, says: dict[str, Any], cfg: Any, past: Any = None, **critics: Any) -> Heard:
    """`ambs.learn`, where the actor number i dreams `says`, float [2, H + 1, S] by name, at i: 0 is the
    task's policy, 1 the safe one. `features` are i everywhere. A critic of cost says what `critics` has
    under its name, or 0. The safe policy's critic says the features."""
    heard, shape = Heard(), says["reward"].shape[1:]

    class Listening(Scene):
        def dream(self, actor, key):
            of = jax.tree.map(lambda x: x[actor.astype(int)], says)
            full = jnp.full(shape, actor)
            return Dreams(full, full[1:], full[1:], full[1:], of, full)

        def value(self, critic, features):
            return features

        def judge(self, name, dreams, reward, discount):
            heard.judged[name] = dreams, reward, discount
            return Judged(reward[1:], jnp.full(shape, 0.5))

        def over_dreams(self, x):
            return x.mean()

        def actor_loss(self, dreams, advantage):
            heard.climbed.append((dreams, advantage))
            return jnp.ones(())

        def critic_loss(self, trained, name, dreams, returns):
            heard.told[name] = dreams, returns
            return jnp.ones(())

        def critic_loss_with_rows(self, trained, name, dreams, returns, reward, discount):
            heard.with_rows.append(name)
            return self.critic_loss(trained, name, dreams, returns)

    def kept(found, cfg):
        heard.found.append(found)
        return penalised(found, cfg)

    penalised = ambs.penalised
    monkeypatch.setattr(ambs, "penalised", kept)
    monkeypatch.setattr(ambs, "value_of", lambda critic, features, cfg: critic)
    params = {name: critics.get(name, jnp.zeros(shape)) for name in ("critic_safe", *ambs.PAIR)}
    batch: Any = SimpleNamespace(rows=SimpleNamespace(reward=jnp.zeros(shape)))
    unused: Any = None
    scene = Listening(unused, unused, params, batch, unused, (), cfg, None)
    actors = {"actor": jnp.float32(0), "safe": jnp.float32(1)}
    past = past or ambs.shielded_behaviour.memory(cfg)
    heard.loss, heard.memory, _ = ambs.learn(actors, past, scene, jax.random.key(0))
    return heard


def test_each_policy_and_critic_learns_of_the_dreams_that_are_its_own(monkeypatch):
    """The safe policy climbs -c alone. The task's climbs its reward, and -c of its own dreams. Of these
    dreams the critics of cost learn as well: the shield asks them what the task's policy does."""
    keys = jax.random.split(jax.random.key(1), 2)
    reward, cost = jax.random.normal(keys[0], (2, 3, 6)), jax.random.uniform(keys[1], (2, 3, 6))
    says = {"reward": reward, "cost": cost, "cont": jnp.ones((2, 3, 6)), "safe": jnp.ones((2, 3, 6))}
    cfg = dataclasses.replace(CFG, penalty="penl", penalty_coef=2.0, cost_discount=0.9)
    heard = listen(monkeypatch, says, cfg)
    whose = {name: int(dreams.features[0, 0]) for name, (dreams, _) in heard.told.items()}
    assert whose == {"critic_safe": 1} | dict.fromkeys(("critic_r", "critic_p", *ambs.PAIR), 0)
    assert heard.with_rows == ["critic_r"]
    assert heard.loss == 7  # of two actors and five critics
    expected = {
        "critic_safe": (-cost[1], cfg.cost_discount),
        "critic_r": (reward[0], cfg.discount),
        "critic_p": (-cost[0], cfg.cost_discount),
    }
    for name, (signal, discount) in expected.items():
        _, judged, found_discount = heard.judged[name]
        np.testing.assert_array_equal(judged, signal)
        assert found_discount == discount
        np.testing.assert_array_equal(heard.told[name][1], signal[1:])
    (safe_dreams, safe), (task_dreams, task) = heard.climbed
    assert (safe_dreams.features == 1).all() and (task_dreams.features == 0).all()
    # the ranges have just begun and are below least_scale, so advantages are not scaled
    np.testing.assert_allclose(safe, -cost[1, 1:] - 0.5, rtol=1e-6)
    np.testing.assert_allclose(task, reward[0, 1:] - 0.5 + 2 * (-cost[0, 1:] - 0.5), rtol=1e-5)
    (found,) = heard.found
    assert (found.value_safe == 0).all()  # V_safe in the task's dreams


def test_each_advantage_is_divided_by_the_range_of_its_own_returns(monkeypatch):
    """Ranges of 2, 3 and 4 move by a hundredth towards those of the rewards, which are 50 wide, and of
    the costs of either policy, 8 and 6 wide."""
    ramp = jnp.linspace(0, 1, 101).reshape(1, 1, 101) / 0.9 * jnp.ones((2, 2, 1))
    cost = ramp * jnp.array([8.0, 6.0]).reshape(2, 1, 1)
    ones = jnp.ones_like(ramp)
    says = {"reward": 50 * ramp, "cost": cost, "cont": ones, "safe": ones}
    widths = {"reward": 2.0, "penalty": 3.0, "safe": 4.0}
    past = {name: Range(jnp.float32(0), jnp.float32(x)) for name, x in widths.items()}
    cfg = dataclasses.replace(CFG, penalty="none", least_scale=1e-3)
    heard = listen(monkeypatch, says, cfg, past)
    now = {"reward": 2 + 0.01 * 48, "penalty": 3 + 0.01 * 5, "safe": 4 + 0.01 * 2}
    for name, width in now.items():
        np.testing.assert_allclose(heard.memory[name].scale(0.0), width, rtol=1e-5)
    (found,), (_, safe) = heard.found, heard.climbed[0]
    np.testing.assert_allclose(found.reward, (50 * ramp[0, 1:] - 0.5) / now["reward"], rtol=1e-5)
    np.testing.assert_allclose(found.penalty, (-cost[0, 1:] - 0.5) / now["penalty"], rtol=1e-5)
    np.testing.assert_allclose(safe, (-cost[1, 1:] - 0.5) / now["safe"], rtol=1e-5)


def test_the_scale_of_the_penalty_alone_has_a_least_one_so_that_rare_violations_cost_no_more_reward(
    monkeypatch,
):
    """Costs of either policy are in no dream but one of 101, so their returns have no range."""
    rare = jnp.zeros((2, 2, 101)).at[..., 50].set(9.0)
    ones = jnp.ones_like(rare)
    says = {"reward": ones, "cost": rare, "cont": ones, "safe": ones}
    for least in (1.0, 20.0):
        cfg = dataclasses.replace(CFG, penalty="none", least_scale=2.0, least_penalty_scale=least)
        heard = listen(monkeypatch, says, cfg)
        (found,), (_, safe) = heard.found, heard.climbed[0]
        np.testing.assert_allclose(found.penalty, (-rare[0, 1:] - 0.5) / least, rtol=1e-6)
        np.testing.assert_allclose(safe, (-rare[1, 1:] - 0.5) / 2.0, rtol=1e-6)
        np.testing.assert_allclose(found.reward, 0.25)


def test_what_copt_sums_goes_on_after_a_violation(monkeypatch):
    """Three steps, each with a violation, and then what the critics say, which counts 10 at most."""
    ones = jnp.ones((2, 4, 1))
    says = {"reward": ones, "cost": 10 * ones, "cont": ones, "safe": jnp.zeros((2, 4, 1))}
    thirty = dict.fromkeys(ambs.PAIR, jnp.full((4, 1), 30.0))
    (found,) = listen(monkeypatch, says, CFG, **thirty).found
    powers = CFG.discount ** np.arange(4)
    expected = [10 * powers[:n].sum() for n in (4, 3, 2)]
    np.testing.assert_allclose(found.returns_c[:, 0], expected, rtol=1e-5)


def test_what_critics_of_cost_are_told_is_cut_at_a_violation_and_at_most_its_cost(monkeypatch):
    """By hand, of five dreams of two steps: four have ended or had a violation in the first, and what
    follows is anything. And within [0, C] of many more, whatever the networks say."""
    draws = [jax.random.normal(key, (3, 1000)) for key in jax.random.split(jax.random.key(0), 5)]
    (cost, first, second), (cont, safe) = (20 * x for x in draws[:3]), map(jax.nn.sigmoid, draws[3:])
    cost = cost.at[1, :5].set(jnp.array([10.0, 25.0, -3.0, 4.0, 0.0])).at[2, 4].set(25.0)
    cont = cont.at[1, :5].set(jnp.array([1.0, 1.0, 1.0, 0.0, 1.0]))
    safe = safe.at[1, :5].set(jnp.array([0.0, 0.0, 0.0, 1.0, 1.0])).at[2, 4].set(0.0)
    first, second = first.at[1, 4].set(30.0), second.at[1, 4].set(5.0)
    says = {"cost": cost, "cont": cont, "safe": safe, "reward": cost}
    both = jax.tree.map(lambda x: jnp.stack([x, x]), says)
    told = listen(monkeypatch, both, CFG, critic_c1=first, critic_c2=second).told
    np.testing.assert_array_equal(told["critic_c1"][1], told["critic_c2"][1])
    until = told["critic_c1"][1]
    np.testing.assert_array_equal(until[0, :4], [10, 10, 0, 4])
    np.testing.assert_allclose(until[0, 4], CFG.discount * (0.05 * 5 + 0.95 * 10), rtol=1e-5)
    assert until.min() == 0 and until.max() == CFG.violation_cost


def test_labels_say_which_costs_are_violations():
    costs = jnp.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    rows: Any = SimpleNamespace(cost=costs.sum(-1), costs=costs)
    env = Corridor(cost_names=("wall", "floor"))
    labelled = partial(dataclasses.replace, CFG)
    assert ambs.violated(env, rows, CFG).tolist() == [False, True, True]
    assert ambs.violated(env, rows, labelled(labels=("floor",))).tolist() == [False, False, True]
    both = ambs.targets(env, rows, labelled(labels=("floor", "wall")))
    np.testing.assert_array_equal(both["cost"], [0, 10, 10])
    np.testing.assert_array_equal(both["safe"], [1, 0, 0])
    with pytest.raises(ConfigError, match="labels: unknown cost 'wal'; did you mean 'wall'"):
        ambs.check(labelled(labels=("wal",)), env)


def test_a_run_counts_the_steps_that_its_labels_call_violations(monkeypatch):
    """For `train/violations`, the sum of which is how many there were while it learned."""
    monkeypatch.setattr(ambs, "off_policy", lambda env, learner, **_: learner)
    env = Corridor(cost_names=("wall", "floor"))
    steps: Any = SimpleNamespace(cost=jnp.array([0.0, 2.0]), costs=jnp.array([[0.0, 0.0], [2.0, 0.0]]))
    made: Any = ambs.make(env)
    for labels, expected in (
        ((), [False, True]),
        (("wall",), [False, True]),
        (("floor",), [False] * 2),
    ):
        found = made.counted(env, steps, dataclasses.replace(CFG, labels=labels))
        assert found.keys() == {"violations"} and found["violations"].tolist() == expected


# ---- the penalties -----------------------------------------------------------------------------


@pytest.mark.parametrize("penalty, coef", [("penl", 1.0), ("plpg", 0.8), ("copt", 1.0)])
def test_the_presets_of_the_penalties_have_the_numbers_of_the_paper_and_its_code(penalty, coef):
    row = ALGOS["ambs"]
    cfg = row.config(**row.published[penalty])
    assert (cfg.penalty, cfg.penalty_coef, cfg.kappa) == (penalty, coef, 10.0)
    shield = (cfg.shield_rollouts, cfg.shield_steps, cfg.shield_horizon, cfg.violation_cost)
    assert shield == (512, 15, 30, 10.0)
    assert (cfg.delta, cfg.eps, cfg.confidence) == (0.1, 0.09, 0.01)
    assert (cfg.rule, cfg.verdict, cfg.verify_action) == ("hoeffding", "summed", False)
    assert ambs.overruled_from(cfg) == 6
    learning = (cfg.cost_discount, cfg.td_lambda, cfg.replay_value, cfg.imagine_steps, cfg.tau)
    assert learning == (0.997, 0.95, 0.0, 15, 0.02)
    assert (cfg.batch_size, cfg.model_lr, cfg.lr, cfg.critic_lr) == (1024, 1e-4, 3e-5, 3e-5)
    assert (cfg.least_scale, cfg.least_penalty_scale) == (1.0, 1.0)
    assert (cfg.actor_grad, cfg.limit_ends, cfg.overshoot) == ("backprop", True, 0)


def advantages(key: jax.Array, shape: tuple[int, ...] = (4, 3)) -> ambs.Advantages:
    keys, states = jax.random.split(key, 5), (shape[0] + 1, *shape[1:])
    shapes = (shape, shape, states, states, shape)
    return ambs.Advantages(*(jax.random.normal(k, s) for k, s in zip(keys, shapes, strict=True)))


def test_the_weights_by_hand():
    """Of an advantage of 1, at changes of V_safe - c by 0, -1, 3 and -50, and sums of costs."""
    ones, zero = jnp.ones((4, 1)), jnp.zeros((4, 1))
    value = jnp.array([[0.0], [0.0], [-1.0], [2.0], [2.0]])
    cost = jnp.array([[9.0], [0.0], [0.0], [0.0], [50.0]])
    returns_c = jnp.array([[0.0], [9.13725], [10.0], [5.0]])
    found = ambs.Advantages(ones, zero, cost, value, returns_c)
    got = {name: ambs.penalised(found, dataclasses.replace(CFG, penalty=name))[:, 0] for name in NAMES}
    np.testing.assert_allclose(got["plpg"], [1, np.exp(-1), 1, 1e-6], rtol=1e-5)
    np.testing.assert_allclose(got["copt"], [1, 0.5, 1.8e-4, 1], atol=1e-4)
    np.testing.assert_array_equal(got["penl"], [1, 1, 1, 1])


NAMES = ("penl", "plpg", "copt", "none")


def test_without_a_weight_penl_is_dreamer():
    found = advantages(jax.random.key(0))
    for name in ("penl", "none"):
        cfg = dataclasses.replace(CFG, penalty=name, penalty_coef=0.0)
        np.testing.assert_array_equal(ambs.penalised(found, cfg), found.reward)
    cfg = dataclasses.replace(CFG, penalty="none", penalty_coef=5.0)
    np.testing.assert_array_equal(ambs.penalised(found, cfg), found.reward)


@pytest.mark.parametrize("actor_grad", ["reinforce", pytest.param("backprop", marks=pytest.mark.slow)])
def test_without_a_weight_the_task_s_actor_learns_what_dreamer_s_does(actor_grad):
    """From the same networks, rows and random numbers, but for rounding: AMBS's two actors dream in one
    program, which adds up in another order."""
    (_, learned), env, key = newborn(), Corridor(), jax.random.key(1)
    options: dict[str, Any] = {"actor_grad": actor_grad, "penalty": "penl", "imagine_steps": 3}
    world = world_of(env, ambs.shielded_behaviour.all_heads(learned.config), learned.config)
    start: Any = world.apply({}, method="start")
    no, reward = jnp.zeros((4, 2), bool), jax.random.normal(key, (4, 2))
    zeros = jnp.zeros((4, 2, 4))
    rows = Record(zeros, zeros[..., :2], reward, reward, reward[..., None], no, no, no)
    memory = ambs.shielded_behaviour.memory(learned.config)

    @jax.jit
    def slopes(coef):
        """Of the loss of AMBS and of Dreamer by the actor's parameters; and what both remember."""
        cfg = dataclasses.replace(learned.config, penalty_coef=coef, **options)
        params = jax.tree.map(
            lambda x: x + 0.01 * jnp.sin(jnp.arange(x.size)).reshape(x.shape), learned.params
        )  # heads and critics are 0 at first
        latents = jax.tree.map(lambda x: jax.random.normal(key, (4, 2, *x.shape)), start)
        scene = Scene(env, world, params, SequenceBatch(rows, jnp.full(2, 0.5)), latents, (), cfg, None)

        def shielded(actor):
            found = ambs.learn(params | {"actor": actor}, memory, scene, key)
            return found.loss, found.memory["reward"]

        def plain(actor):
            dream_key = jax.random.split(key)[0]  # the task's
            found = dreamer.learn(params | {"actor": actor}, {"range": no_range()}, scene, dream_key)
            return found.loss, found.memory["range"]

        found = [jax.grad(f, has_aux=True)(params["actor"]) for f in (shielded, plain)]
        return [(ravel_pytree(x)[0], jnp.stack(y)) for x, y in found]

    def distance(x, y):
        return jnp.linalg.norm(x - y) / jnp.linalg.norm(y)

    ours, dreamers = slopes(jnp.float32(0))
    assert all(distance(x, y) < 1e-4 for x, y in zip(ours, dreamers, strict=True))
    assert distance(slopes(jnp.float32(1))[0][0], dreamers[0]) > 0.1


class Slope:
    """A smooth model: a state rolls on by the action; it earns x and costs x^2."""

    def apply(self, params: Any, *args: Any, method: str) -> Any:
        return getattr(self, method)(*args)

    def imagine(self, latent, action, key):
        return Latent(0.9 * latent.deter + 0.3 * action, latent.stoch)

    def read(self, features):
        return {"cont": jnp.ones((*features.shape[:-1], 1)), "cost": features[..., :1] ** 2}


@pytest.mark.parametrize("penalty", ["penl", "plpg", "copt"])
def test_the_gradients_of_the_penalties_are_those_of_finite_differences(penalty):
    """Of an actor's two numbers, through a dream of five steps. copt's factor has none: it is kept. The
    actor does not look at the state, whose own gradient stops before an actor, as in the authors' code.
    """
    cfg = dataclasses.replace(CFG, penalty=penalty, imagine_steps=5, actor_grad="backprop", kappa=1.0)
    start = Latent(jnp.array([[0.2], [-0.4], [0.7]]), jnp.zeros((3, 1)))
    world: Any = Slope()

    def actor(params, features):
        shape = (*features.shape[:-1], 1)
        return Gaussian(jnp.full(shape, params[0]), jnp.full(shape, params[1]))

    def climbed(params, factor=None):
        dreams = dream(world, {}, actor, params, start, jnp.ones(3), jax.random.key(0), cfg)
        x, cost = dreams.features[..., 0], dreams.read["cost"]
        discounts = {"discount": cfg.discount, "decay": 0.95}
        cont = jnp.full(x.shape, 0.9)
        earned = dream_returns(x, jnp.sin(x), cont, **discounts) - jnp.sin(x)[:-1]
        paid = dream_returns(-cost, jnp.cos(x), cont, **discounts) - jnp.cos(x)[:-1]
        found = ambs.Advantages(earned, paid, cost, -x, 9 + cost[1:])
        if factor is not None:  # copt's, without the gradient that it does not have
            return (factor * found.reward + cfg.penalty_coef * found.penalty).sum(), None
        kept = 1 - jax.nn.sigmoid(cfg.kappa * (found.returns_c - ambs.threshold(cfg)))
        return ambs.penalised(found, cfg).sum(), kept

    params = jnp.array([0.5, -0.2])
    value, factor = climbed(params)
    grad = jax.grad(lambda p: climbed(p)[0])(params)
    fixed = factor if penalty == "copt" else None
    np.testing.assert_allclose(climbed(params, fixed)[0], value, rtol=1e-5)
    h = 1e-2
    by_hand = [
        (climbed(params + h * e, fixed)[0] - climbed(params - h * e, fixed)[0]) / (2 * h)
        for e in jnp.eye(2)
    ]
    assert jnp.abs(grad).min() > 1e-2
    np.testing.assert_allclose(grad, by_hand, rtol=5e-3, atol=5e-3)


# ---- the shield --------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Chain:
    """States 0 .. 5 in `deter`. A step goes one up with probability `up`, or stays; 5 is unsafe."""

    up: float = 0.3

    def apply(self, params: Any, *args: Any, method: str) -> Any:
        return getattr(self, method)(*args)

    def imagine(self, latent, action, key):
        goes = jax.random.bernoulli(key, self.up, latent.deter.shape)
        return Latent(jnp.minimum(latent.deter + goes, 5), latent.stoch)

    def exact(self, state: int, steps: int) -> float:
        """The probability that 5 is reached within so many steps."""
        safe = (1 - self.up) * np.eye(5) + self.up * np.eye(5, k=1)
        return 1 - np.linalg.matrix_power(safe, steps)[state].sum()


def estimates(monkeypatch, chain: Chain, cfg: Any) -> list[np.ndarray]:
    """p by 200 shields whose model is `chain`, at each of the states 0 .. 4."""
    monkeypatch.setattr(ambs, "world_of", lambda *_: chain)
    dreamer = {"actor": jnp.zeros(2)}  # the task's policy alone dreams
    monkeypatch.setattr(ambs, "chosen", lambda env, learned, name, *_: dreamer[name])
    monkeypatch.setattr(ambs, "safety_value", lambda params, features, cfg: jnp.zeros(len(features)))

    def says(world, params, x):
        bad = x[..., 0] == 5
        return {"cost": 10.0 * bad, "safe": 1.0 - bad, "cont": jnp.ones(bad.shape)}

    monkeypatch.setattr(ambs, "read", says)
    learned = Learned(cfg, {"model": ()}, (), ())

    @jax.jit
    def at(state):
        latent = Latent(jnp.array([state], jnp.float32), jnp.zeros(1))
        keys = jax.random.split(jax.random.key(0), 200)
        return jax.vmap(lambda key: ambs.risk(Corridor(), learned, latent, jnp.zeros(2), key))(keys)

    return [np.asarray(at(state)) for state in range(5)]


def check_misses(found: np.ndarray, exact: float, cfg: Any) -> None:
    """Estimates may be off by more than eps with a probability of `confidence`. As many misses as there
    are must be no less likely than 1 in 1,000."""
    misses = int((np.abs(found - exact) > cfg.eps).sum())
    test = scipy.stats.binomtest(misses, len(found), cfg.confidence, alternative="greater")
    assert test.pvalue > 1e-3, misses


@pytest.mark.parametrize("verdict", ["summed", "drawn"])
def test_on_a_known_chain_it_overrules_where_the_bound_says(monkeypatch, verdict):
    """With as many dreams as an error of eps takes: always above delta, and never below delta - 2 eps.
    On average over shields the probability is the exact one, within five deviations of all dreams."""
    chain, known = Chain(), {"shield_steps": 15, "shield_horizon": 15, "delta": 0.8}
    rollouts = ambs.required_rollouts(CFG.eps, CFG.confidence / 2)
    cfg = dataclasses.replace(CFG, verdict=verdict, shield_rollouts=rollouts, **known)
    overruled = []
    for state, found in enumerate(estimates(monkeypatch, chain, cfg)):
        exact = chain.exact(state, 15)  # 0.48, 0.70, 0.87, ..
        check_misses(found, exact, cfg)
        deviation = np.sqrt(exact * (1 - exact) / (len(found) * rollouts))
        assert abs(found.mean() - exact) < 5 * deviation + 1e-6
        overruled.append((found > cfg.delta - cfg.eps).mean())
    assert overruled[0] == 0 and overruled[2:] == [1, 1, 1]
    assert 0 < overruled[1] < 1  # between the two bounds it may do either


def test_a_wrong_model_misleads_by_no_more_than_half_of_eps(monkeypatch):
    """If the differences of its next states' probabilities add up to eps / T at most. The other half is
    for the error of as many dreams as that takes."""
    steps, eps, confidence = 15, 0.18, 0.01
    known = {"shield_steps": steps, "shield_horizon": steps, "verdict": "drawn", "eps": eps}
    rollouts = ambs.required_rollouts(eps, confidence / 2, learned=True)
    cfg = dataclasses.replace(CFG, shield_rollouts=rollouts, **known)
    alpha = eps / steps  # |P' - P| summed over next states: `up` is off by half of that
    truth, model = Chain(0.0), Chain(alpha / 2)
    off = [abs(truth.exact(s, steps) - model.exact(s, steps)) for s in range(5)]
    assert 0.08 < max(off) <= eps / 2  # one step from what is unsafe
    for state, found in enumerate(estimates(monkeypatch, model, cfg)):
        check_misses(found, truth.exact(state, steps), cfg)


def test_dreams_begin_with_the_proposed_action_if_told_to(monkeypatch):
    """In a model that adds two actions up, beyond 2 is unsafe. The policy goes by 3. It has proposed 1,
    and -2."""

    class Adding(Chain):
        def imagine(self, latent, action, key):
            return Latent(latent.deter + action, latent.stoch)

    def says(world, params, x):
        return {"cost": 0 * x[..., 0], "safe": 1.0 * (x[..., 0] <= 2), "cont": jnp.ones(x.shape[:-1])}

    monkeypatch.setattr(ambs, "world_of", lambda *_: Adding())
    monkeypatch.setattr(ambs, "chosen", lambda *_: jnp.full(1, 3.0))
    monkeypatch.setattr(ambs, "safety_value", lambda params, features, cfg: jnp.zeros(len(features)))
    monkeypatch.setattr(ambs, "read", says)

    def p(proposed, **settings):
        short = {"shield_horizon": 2, "shield_rollouts": 8, "verdict": "drawn"}
        learned = Learned(dataclasses.replace(CFG, **short, **settings), {"model": ()}, (), ())
        latent, proposed = Latent(jnp.zeros(1), jnp.zeros(1)), jnp.array([proposed])
        return ambs.risk(Corridor(), learned, latent, proposed, jax.random.key(0))

    assert (p(1.0), p(-2.0)) == (1, 1)
    assert (p(1.0, verify_action=True), p(-2.0, verify_action=True)) == (1, 0)


def test_a_dream_is_read_state_by_state_and_the_critics_are_asked_at_its_end(monkeypatch):
    """In a model that counts steps: a cost lies within [0, C], and the episode goes on where that is
    likelier than not."""

    class Counting(Chain):
        def imagine(self, latent, action, key):
            return Latent(latent.deter + 1, latent.stoch)

    def says(world, params, x):
        of_steps = {"cost": [-5.0, 4.0, 25.0], "cont": [0.51, 0.49, 1.0], "safe": [1.0, 1.0, 1.0]}
        return {name: jnp.array(told)[x[..., 0].astype(int) - 1] for name, told in of_steps.items()}

    monkeypatch.setattr(ambs, "world_of", lambda *_: Counting())
    monkeypatch.setattr(ambs, "chosen", lambda *_: jnp.zeros(2))
    monkeypatch.setattr(ambs, "safety_value", lambda params, features, cfg: features[..., 0])
    monkeypatch.setattr(ambs, "read", says)
    cfg = dataclasses.replace(CFG, shield_steps=3, shield_rollouts=2)
    learned, latent = Learned(cfg, {"model": ()}, (), ()), Latent(jnp.zeros(1), jnp.zeros(1))
    found = ambs.dreamt(Corridor(), learned, latent, jnp.zeros(2), jax.random.key(0))
    np.testing.assert_array_equal(found.cost, [[0, 0], [4, 4], [10, 10]])
    np.testing.assert_array_equal(found.alive, [[True, True], [False, False], [True, True]])
    np.testing.assert_array_equal(found.value, [3, 3])
    # no dream goes beyond the steps within which a violation counts
    near = dataclasses.replace(learned, config=dataclasses.replace(cfg, shield_horizon=2))
    found = ambs.dreamt(Corridor(), near, latent, jnp.zeros(2), jax.random.key(0))
    np.testing.assert_array_equal(found.cost, [[0, 0], [4, 4]])
    np.testing.assert_array_equal(found.value, [2, 2])


def test_violations_and_ends_are_drawn_apart(monkeypatch):
    """Both half the time, in two steps: 1/2 + 1/2 1/2 1/2. The second end comes too late to count."""
    cfg = dataclasses.replace(CFG, verdict="drawn", shield_horizon=2, shield_rollouts=4096)
    monkeypatch.setattr(ambs, "world_of", lambda *_: Chain())
    monkeypatch.setattr(ambs, "chosen", lambda *_: jnp.zeros(2))
    monkeypatch.setattr(ambs, "safety_value", lambda params, features, cfg: jnp.zeros(len(features)))
    half = dict.fromkeys(("cost", "safe", "cont"), jnp.full((2, 4096), 0.5))
    monkeypatch.setattr(ambs, "read", lambda *_: half)
    learned, latent = Learned(cfg, {"model": ()}, (), ()), Latent(jnp.zeros(1), jnp.zeros(1))
    p = ambs.risk(Corridor(), learned, latent, jnp.zeros(2), jax.random.key(0))
    np.testing.assert_allclose(p, 0.625, atol=0.03)


def test_in_the_simulator_it_knows_what_comes(monkeypatch):
    """Two steps to the right go beyond the ledge, and one does not."""
    env, algo = Ledge(), ALGOS["ambs"].make(Ledge())
    cfg = ambs.AMBSConfig(size="tiny", shield="true_dynamics", delta=0.1)
    learned = algo.learned(jax.eval_shape(lambda key: algo.init(key, cfg, START), jax.random.key(0)))
    assert algo.policy.privileged(dataclasses.replace(learned, config=cfg))
    monkeypatch.setattr(ambs, "chosen", lambda *_: jnp.ones(1))
    monkeypatch.setattr(ambs, "seen", lambda *_: Latent(jnp.zeros(1), jnp.zeros(1)))
    latent, state = Latent(jnp.zeros(1), jnp.zeros(1)), env.reset(jax.random.key(0))
    for horizon, back, expected in ((1, 1.0, 0.0), (2, 1.0, 1.0), (2, -1.0, 0.0)):
        of = dataclasses.replace(cfg, shield_horizon=horizon, verify_action=True)
        known = Learned(of, {}, (), ())
        p = ambs.true_risk(env, known, latent, jnp.array([back]), state, jax.random.key(1))
        assert p == expected


@pytest.mark.parametrize("turns_at, p", [(0.2, 0.0), (0.4, 1.0)])
def test_in_the_simulator_the_policy_knows_what_it_did_and_where_it_got(monkeypatch, turns_at, p):
    """It goes on as it last went, to the right, and is at 0.3 after a step. Beyond `turns_at` it turns
    back. If it does not, the next step is a violation."""

    class Glass:
        """Remembers the action, and sees the place."""

        def apply(self, params, *args, method):
            return getattr(self, method)(*args)

        def embed(self, obs):
            return obs

        def observe(self, latent, action, embedded, key):
            return Latent(action, embedded)

    def goes_on(env, learned, name, latent, key):
        assert name == "actor"  # and not the safe policy
        return jnp.where(latent.stoch < turns_at, latent.deter, -latent.deter)

    monkeypatch.setattr(dreaming, "world_of", lambda *_: Glass())
    monkeypatch.setattr(ambs, "chosen", goes_on)
    cfg = dataclasses.replace(CFG, shield_horizon=2, shield_rollouts=2)
    env, learned = Ledge(), Learned(cfg, {"model": ()}, (), ())
    here, state = Latent(jnp.ones(1), jnp.zeros(1)), env.reset(jax.random.key(0))
    assert ambs.true_risk(env, learned, here, jnp.ones(1), state, jax.random.key(1)) == p


def test_in_the_simulator_what_comes_after_an_end_is_no_violation(monkeypatch):
    """The second step has one, and counts unless the first one ends the episode."""

    @dataclasses.dataclass(frozen=True)
    class Late(Ticker):
        ends: str = ""

        def step(self, state, action):
            after = super().step(state, action)
            cost = jnp.float32(after.obs[1] >= 2)
            ended = {self.ends: after.obs[1] >= 1} if self.ends else {}
            return dataclasses.replace(after, cost=cost, **ended)

    monkeypatch.setattr(ambs, "chosen", lambda *_: jnp.ones(1))
    monkeypatch.setattr(ambs, "seen", lambda *_: Latent(jnp.zeros(1), jnp.zeros(1)))
    cfg = dataclasses.replace(CFG, shield_horizon=2, shield_rollouts=4)
    latent = Latent(jnp.zeros(1), jnp.zeros(1))
    for ends, expected in (("", 1), ("terminated", 0), ("truncated", 0)):
        env, known = Late(ends=ends), Learned(cfg, {}, (), ())
        state, key = env.reset(jax.random.key(0)), jax.random.key(1)
        assert ambs.true_risk(env, known, latent, jnp.zeros(1), state, key) == expected


def test_the_executed_action_is_one_of_the_two_and_is_what_is_remembered():
    """What the shield does in an environment does not depend on its neighbours, either. Of four
    environments it overrules in two. Then all of them observe what the first one does."""
    (algo, learned), env = newborn(), Corridor()
    config = dataclasses.replace(learned.config, verdict="drawn", shield_horizon=2, shield_rollouts=64)
    params = jax.tree.map(
        lambda x: x + 0.1 * jnp.sin(jnp.arange(x.size)).reshape(x.shape), learned.params
    )  # heads are 0 at first
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(1), 4))
    state = dataclasses.replace(state, obs=state.obs + jnp.array([[-3.0], [-1.0], [1.0], [3.0]]))

    @jax.jit
    def acted(delta, state):
        at = dataclasses.replace(config, delta=delta, eps=jnp.float32(0))
        of = dataclasses.replace(learned, config=at, params=params)
        player = Player(algo.policy, of, env)
        carry = jax.tree.map(lambda x: jnp.zeros((4, *x.shape)), player.begin())
        return player.act_in_all(carry, state, jnp.ones(4, bool), jax.random.key(2))

    task, memory, said = acted(jnp.float32(jnp.inf), state)
    safe, memory_safe, said_safe = acted(jnp.float32(-1), state)
    assert not said["overruled"].any() and said_safe["overruled"].all()
    assert (task != safe).all()
    np.testing.assert_array_equal(memory.action, task)
    np.testing.assert_array_equal(memory_safe.action, safe)
    np.testing.assert_array_equal(memory.latent.features, memory_safe.latent.features)
    np.testing.assert_array_equal(said["risk"], said_safe["risk"])

    between = jnp.sort(said["risk"])[1:3].mean()
    action, memory, said = acted(between, state)
    overruled = said["overruled"] > 0
    np.testing.assert_array_equal(overruled, said["risk"] > between)
    assert overruled.sum() == 2
    np.testing.assert_array_equal(action, jnp.where(overruled[:, None], safe, task))
    np.testing.assert_array_equal(memory.action, action)

    first = jnp.broadcast_to(state.obs[:1], state.obs.shape)
    alone, _, said_alone = acted(between, dataclasses.replace(state, obs=first))
    np.testing.assert_array_equal(alone[0], action[0])
    assert said_alone["risk"][0] == said["risk"][0]
    assert said_alone["overruled"][0] == said["overruled"][0]
    assert (said_alone["risk"][1:] != said["risk"][1:]).any() and (alone[1:] != action[1:]).any()


def test_the_safe_policy_acts_where_the_shield_overrules_and_the_tasks_policy_elsewhere():
    (algo, learned), env = newborn(), Corridor()
    state = env.reset(jax.random.key(1))
    actors = {
        "actor": learned.params["actor"],
        "safe": jax.tree.map(lambda x: x + 0.3, learned.params["actor"]),
    }
    learned = dataclasses.replace(learned, params=learned.params | actors)

    @jax.jit
    def acted(delta):
        at = dataclasses.replace(learned.config, delta=delta, eps=jnp.float32(0))
        player = Player(algo.policy, dataclasses.replace(learned, config=at), env)
        action, memory, said = player.decide(player.begin(), state, None)
        latent = memory.latent
        of_both = {name: ambs.chosen(env, learned, name, latent, None) for name in actors}
        return action, said["overruled"], of_both

    for delta, name in ((jnp.inf, "actor"), (-1.0, "safe")):
        action, overruled, of_both = acted(jnp.float32(delta))
        assert overruled == (name == "safe")
        np.testing.assert_allclose(action, of_both[name], atol=1e-6)
        assert jnp.abs(of_both["actor"] - of_both["safe"]).max() > 1e-2


def test_an_evaluation_takes_the_sampled_actions_that_training_takes():
    """With the same keys, over six steps of four environments, in each of which violations are drawn
    with probability 1/2: the shield acts where two of four dreams have one."""
    (algo, learned), env = newborn(), Corridor()
    luck: dict[str, Any] = {"verdict": "drawn", "shield_horizon": 1, "delta": jnp.float32(0.4)}
    learned = dataclasses.replace(learned, config=dataclasses.replace(learned.config, **luck))
    player, keys = Player(algo.policy, learned, env), jax.random.split(jax.random.key(2), 6)

    @jax.jit
    def both():
        rollout = init_rollout(env, jax.random.key(1), 4, stagger=False)
        carry = jax.tree.map(lambda x: jnp.zeros((4, *x.shape)), player.begin())
        stepping = started(dataclasses.replace(rollout, carry=carry))
        rows, steps = collect_records(env, player.act_in_all, stepping, keys)[1]

        def evaluated(x):
            """One environment alone, from the same start, with its keys of the rollout."""

            def step(now, key):
                state, carry = now
                action, carry = player.act(carry, state, key)
                return (env.step(state, action), carry), (state.obs, action)

            state, number = x
            of_all = jax.vmap(lambda key: jax.random.split(jax.random.split(key)[0], 4))(keys)
            return jax.lax.scan(step, (state, player.begin()), of_all[:, number])[1]

        alone = jax.lax.map(evaluated, (rollout.state, jnp.arange(4)))
        return (rows.obs, rows.action), steps.said["overruled"], alone

    training, overruled, evaluation = both()
    assert 4 < overruled.sum() < 20
    for x, y in zip(training, evaluation, strict=True):
        np.testing.assert_allclose(x, jnp.swapaxes(y, 0, 1), atol=1e-5)


def numbers(state: Any) -> list[np.ndarray]:
    """Copies of all arrays of a state, and of its random keys."""
    arrays = jax.tree.leaves(state)
    keys = [jnp.issubdtype(x.dtype, jax.dtypes.prng_key) for x in arrays]
    return [np.array(jax.random.key_data(x) if k else x) for x, k in zip(arrays, keys, strict=True)]


@pytest.mark.slow
def test_a_shield_in_the_simulator_of_a_real_task_leaves_the_world_as_it_was():
    """In point_goal1 with a hazard just ahead, five steps under a shield that never overrules are those
    without one. p is the share of worlds with a violation, stepped one by one with the same keys."""
    places: dict[str, Any] = {"robot_locations": ((0.0, 0.0),), "hazards_locations": ((0.21, 0.0),)}
    near: dict[str, Any] = {"robot_keepout": 0.0, "hazards_keepout": 0.0, "robot_rot": 0.0}
    env = envs.make("point_goal1", engine="c", **near, **places)
    behaviour, horizon, rollouts = ambs.shielded_behaviour, 6, 8
    cfg = ambs.AMBSConfig(
        size="tiny", shield="true_dynamics", overshoot=0, delta=jnp.inf, verify_action=True,
        shield_horizon=horizon, shield_rollouts=rollouts,
    )  # fmt: skip
    init = dreaming.dreaming_learner(env, behaviour).init
    params = jax.jit(lambda key: init(key, env.obs_size, env.action_size, cfg).params)(
        jax.random.key(0)
    )
    learned = Learned(cfg, params, (), ())
    bare = dreaming.dreaming_policy(env, behaviour)
    begun, keys = jax.jit(env.reset)(jax.random.key(1)), jax.random.split(jax.random.key(2), 5)
    before = numbers(begun)

    def played(policy, keys):
        player = Player(policy, learned, env)

        def step(now, key):
            state, carry = now
            action, carry, said = player.decide(carry, state, key)
            after = env.step(state, action)
            return (after, carry), (after, carry, said)

        return jax.jit(lambda: jax.lax.scan(step, (begun, player.begin()), keys)[1])()

    states, carries, said = played(ambs.shielded(env, bare), keys)
    act_keys, shield_keys = jnp.moveaxis(jax.vmap(jax.random.split)(keys), 1, 0)
    plain, _, _ = played(bare, act_keys)
    for x, y in zip(numbers(states) + numbers(begun), numbers(plain) + before, strict=True):
        np.testing.assert_array_equal(x, y)

    step_one = jax.jit(env.step)
    see = jax.jit(lambda memory, obs, key: dreaming.seen(env, behaviour, learned, memory, obs, key))
    act = jax.jit(lambda latent, key: ambs.chosen(env, learned, "actor", latent, key))
    for t in range(len(keys)):
        state = begun if t == 0 else jax.tree.map(operator.itemgetter(t - 1), states)
        latent, action = jax.tree.map(operator.itemgetter(t), (carries.latent, carries.action))
        dream_key = jax.random.split(shield_keys[t])[1]
        unsafe = []
        for key in jax.random.split(dream_key, rollouts):
            world, here, doing, hit = state, latent, action, False
            for h, step_key in enumerate(jax.random.split(key, horizon)):
                act_key, latent_key = jax.random.split(step_key)
                doing = doing if h == 0 else act(here, act_key)
                world = step_one(world, doing)
                here = see(dreaming.Memory(here, doing, jnp.int32(h)), world.obs, latent_key)
                hit |= bool(world.cost > 0)
            unsafe.append(hit)
        assert said["risk"][t] == np.mean(unsafe)
    assert ((said["risk"] > 0) & (said["risk"] < 1)).any()


# ---- evaluation --------------------------------------------------------------------------------


@pytest.mark.parametrize("sampled", [False, True])
def test_without_a_shield_the_same_policy_plays_the_same_episodes(sampled):
    """A shield that dreams and never acts changes nothing, and one that acts does."""
    algo, learned = newborn()
    keys = jax.random.split(jax.random.key(3), 3)

    def play(**settings: Any) -> Any:
        changed = dataclasses.replace(learned.config, **settings)
        player = Player(algo.policy, dataclasses.replace(learned, config=changed), algo.task(learned))
        played = jax.vmap(lambda key: course(player, key, sampled))
        return jax.jit(played, compiler_options=FAST)(keys)

    none, idle = play(shield="none"), play(delta=jnp.float32(jnp.inf))
    acting = play(rule="hoeffding", delta=jnp.float32(0))
    assert not idle.said["overruled"].any() and "overruled" not in none.said
    assert (acting.said["overruled"] & acting.alive).any()
    np.testing.assert_allclose(none.reward, idle.reward, atol=1e-5)
    assert np.abs(none.reward - acting.reward).max() > 1e-3
    assert len({*none.reward.sum(1).tolist()}) > 1


def test_with_mean_actions_the_shield_draws_other_dreams_at_each_step(monkeypatch):
    """And the same ones in the same step of each evaluation."""
    algo, learned = newborn()
    monkeypatch.setattr(ambs, "risk", lambda *args: jax.random.uniform(args[-1]))
    obs = Corridor().reset(jax.random.key(0)).obs
    act = jax.jit(lambda carry: algo.policy.act(learned, carry, obs, None), compiler_options=FAST)
    begin = algo.policy.init(learned)
    (_, after, first), (_, _, again) = act(begin), act(begin)
    _, _, second = act(after)
    assert first["risk"] == again["risk"] != second["risk"]


def test_nothing_counts_after_the_end_of_an_episode():
    """It fails with its second step of five. Each step is a violation, and the shield overrules."""
    said = {"risk": jnp.float32(1), "overruled": jnp.bool_(True)}
    policy = Policy(lambda learned: (), lambda learned, carry, obs, key: (jnp.zeros(1), carry, said))
    algo: Any = SimpleNamespace(policy=policy, task=lambda learned: Ticker(lives=(2, 2)))
    learned = Learned(jax.tree.map(lambda x: jnp.full(1, x), CFG), {}, (), ())
    keys = jax.random.split(jax.random.key(0), (1, 1))
    play = make_play(algo, keys)
    shielded = play(learned, False)
    np.testing.assert_array_equal(shielded.alive, [[[1, 1, 0, 0, 0]]])
    np.testing.assert_array_equal(shielded.terminated, [[[0, 1, 0, 0, 0]]])
    found = ambs.examine(algo, learned, shielded, play, False)
    assert [(k, x.item()) for k, x in found.measures.items()] == [  # in the order of the table
        ("override rate", 1), ("violations", 2), ("violations, no shield", 2),
        ("return, no shield", 2), ("Brier score", 0),
    ]  # fmt: skip
    np.testing.assert_array_equal(np.asarray(found.calibration)[0, :, -1], 2)


def test_without_a_shield_evaluation_counts_violations_alone():
    algo, learned = newborn()
    learned = jax.tree.map(lambda x: jnp.asarray(x)[None], learned)
    bare = dataclasses.replace(learned, config=dataclasses.replace(learned.config, shield="none"))
    keys = jax.random.split(jax.random.key(0), (1, 2))
    play = make_play(algo, keys)
    found = ambs.examine(algo, bare, play(bare, False), play, False)
    assert found.calibration is None and [*found.measures] == ["violations"]
    assert ambs.note(bare.config) == ""
    ambs.check(dataclasses.replace(CFG, shield="none", delta=0.0), Corridor())  # it has no bound


@pytest.mark.parametrize("sampled, violations", [(False, 0), (True, 9)])
def test_the_risk_is_scored_by_sampled_actions_without_the_shield(sampled, violations):
    """A sampled action goes beyond the ledge, and the shield's goes back. A mean action stays, and is
    never overruled. The policy says that a violation is certain, which is right for sampled actions
    alone."""

    def act(learned, carry, obs, key):
        proposed = jnp.full(1, 0.0 if key is None else 1.0)
        if learned.config.shield == "none":
            return proposed, carry, {}
        overruled = (learned.config.delta < 1) & (key is not None)
        action = jnp.where(overruled, -1.0, proposed)
        return action, carry, {"risk": jnp.float32(1), "overruled": overruled}

    policy = Policy(lambda learned: (), act)
    algo: Any = SimpleNamespace(policy=policy, task=lambda learned: Ledge())
    cfg = jax.tree.map(lambda x: jnp.full(1, x), dataclasses.replace(CFG, shield_horizon=4))
    keys = jax.random.split(jax.random.key(0), (1, 2))
    learned = Learned(cfg, {}, (), ())
    play = make_play(algo, keys)
    found = ambs.examine(algo, learned, play(learned, sampled), play, sampled)
    measures = found.measures
    assert (measures["Brier score"] == 0).all()
    assert (measures["violations, no shield"] == violations).all()
    assert (measures["violations"] == 0).all() and (measures["override rate"] == sampled).all()
    steps, risk, violated = np.asarray(found.calibration)[0]
    assert steps[-1] > 9 and (steps == risk).all() and (steps == violated).all()
    assert not steps[:-1].any()


def test_the_brier_score_by_hand():
    """Six steps, a violation in step 4, a horizon of 2: e = 0 0 1 1, and then nothing is known but of
    step 5, after which two steps are left."""
    yes, no = jnp.ones(6, bool), jnp.zeros(6, bool)
    violation = no.at[3].set(True)
    risk = jnp.array([0.0, 0.5, 1.0, 0.5, 0.2, 0.9])
    found = ambs.Foreseen(yes, risk, violation, no)
    errors = [0.0, 0.25, 0.0, 0.25, 0.04]
    np.testing.assert_allclose(ambs.brier_score(found, 2), np.mean(errors), rtol=1e-6)
    failed = found._replace(failed=no.at[5].set(True))  # then it is known that no violation follows
    np.testing.assert_allclose(ambs.brier_score(failed, 2), np.mean([*errors, 0.81]), rtol=1e-6)
    short = found._replace(alive=yes.at[4:].set(False))
    np.testing.assert_allclose(ambs.brier_score(short, 2), np.mean(errors[:3]), rtol=1e-6)
    assert jnp.isnan(ambs.brier_score(found._replace(violation=no), 9))


def test_the_risk_is_compared_with_what_came_part_by_part():
    """The steps of the test above: risks of 0, 0.5, 1, 0.5 and 0.2, after which 0 0 1 1 0 came."""
    yes, no = jnp.ones(6, bool), jnp.zeros(6, bool)
    risk = jnp.array([0.0, 0.5, 1.0, 0.5, 0.2, 0.9])
    counts = ambs.calibration(ambs.Foreseen(yes, risk, no.at[3].set(True), no), 2)
    expected = np.zeros((3, ambs.PARTS))
    for part, of in {0: (1, 0, 0), 2: (1, 0.2, 0), 5: (2, 1, 1), 9: (1, 1, 1)}.items():
        expected[:, part] = of
    np.testing.assert_allclose(counts, expected, atol=1e-6)
    assert evaluation.calibrated(2 * np.asarray(counts)) == {
        "steps": [2, 2, 4, 2],
        "risk": pytest.approx([0, 0.2, 0.5, 1]),
        "violated": [0, 0, 0.5, 1],
    }
