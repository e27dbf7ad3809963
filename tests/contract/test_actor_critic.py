"""SAC, TD3 and DDPG by hand, with and without a price on cost, and the clock of the price."""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from compiling import FAST
from toys import START, Lever, Ticker, momentum, training

from jaxsafe.algos import ALGOS, ddpg, sac, td3
from jaxsafe.learn.actor_critic import Actor, actor_critic
from jaxsafe.learn.bill import charge, empty_bill, settle
from jaxsafe.learn.learner import GradientStep
from jaxsafe.learn.replay import Transitions
from jaxsafe.learn.treatments import Multiplier, lagrangian, no_treatment
from jaxsafe.nn.critics import q_values
from jaxsafe.run import compat
from jaxsafe.types import Env, State

ACTORS: dict[str, Callable[[int], Actor]] = {
    "sac": sac.soft_actor,
    "td3": lambda size: td3.deterministic_actor(size, critics=2, noise=td3.smoothing),
    "ddpg": lambda size: td3.deterministic_actor(size, 1, ddpg.no_noise, ddpg.next_actor),
}


# ---- gradient steps by hand --------------------------------------------------------------------


@dataclass
class ByHand:
    """A gradient step in float64, with linear networks. Parameters are those before the step."""

    method: str
    params: dict[str, Any]
    batch: Transitions
    noise: list[Any]
    alpha: float
    lam: float | None
    reduce: str
    price_unit: str
    omnisafe: bool = False
    discount: float = 0.9
    cost_discount: float = 0.8

    def pi(self, actor, obs, noise):
        """The action, and its log probability times -alpha."""
        out = obs @ actor["kernel"] + actor["bias"]
        if self.method != "sac":
            return np.tanh(out), 0.0
        mean, log_std = np.split(out, 2, axis=-1)
        u = mean + np.exp(log_std) * noise
        log_prob = -0.5 * noise**2 - log_std - 0.5 * np.log(2 * np.pi) - np.log(1 - np.tanh(u) ** 2)
        return np.tanh(u), -self.alpha * log_prob.sum(-1)

    def q(self, critics, obs, action):
        pair = np.concatenate([obs, action], -1)
        return (np.einsum("bi,nij->nbj", pair, critics["kernel"]) + critics["bias"][:, None])[..., 0]

    def reduced(self, q):
        q_c = q.max(0) if self.reduce == "max" else q.mean(0)
        return q_c if self.omnisafe else np.maximum(q_c, 0.0)  # no cost is negative

    def next_action(self):
        obs = self.batch.next_obs
        if self.method == "sac":
            return self.pi(self.params["actor"], obs, self.noise[0])
        online = self.omnisafe and self.method == "ddpg"
        action, _ = self.pi(self.params["actor" if online else "target_actor"], obs, None)
        noise = np.clip(0.4 * self.noise[0], -0.3, 0.3) if self.method == "td3" else 0.0
        return np.clip(action + noise, -1, 1), 0.0

    def error_r(self, critics):
        b, (action, bonus) = self.batch, self.next_action()
        v = self.q(self.params["target_r"], b.next_obs, action).min(0) + bonus
        y = b.reward + self.discount**b.steps * (1 - b.terminated) * v
        return (b.weight * (self.q(critics, b.obs, b.action) - y) ** 2).sum()

    def error_c(self, critics):
        b, (action, _) = self.batch, self.next_action()
        cost = b.cost
        if self.omnisafe:  # the mean action, and centred costs
            action, _ = self.pi(self.params["actor"], b.next_obs, 0.0)
            mean = (b.weight * cost).sum()
            spread = np.sqrt((b.weight * cost**2).sum() - mean**2)
            cost = np.clip((cost - mean) / max(spread, 0.01), -5, 5)
        v = self.reduced(self.q(self.params["target_c"], b.next_obs, action))
        y = cost + self.cost_discount**b.steps * (1 - b.terminated) * v
        return (b.weight * (self.q(critics, b.obs, b.action) - y) ** 2).sum()

    def q_r(self, actor, critic_r):
        action, bonus = self.pi(actor, self.batch.obs, self.noise[1])
        q = self.q(critic_r, self.batch.obs, action)
        return (q.min(0) if self.method == "sac" else q[0]) + bonus

    def unit(self, actor, critic_r):
        """The standard deviation of Q_r, or 1. It has no gradient."""
        weight, q_r = self.batch.weight, self.q_r(actor, critic_r)
        deviation = np.sqrt((weight * (q_r - (weight * q_r).sum()) ** 2).sum())
        return deviation if self.price_unit == "deviation" else 1.0

    def actor_loss(self, actor, critic_r, critic_c, unit):
        worth = self.q_r(actor, critic_r)
        if self.lam is not None:
            action, _ = self.pi(actor, self.batch.obs, self.noise[1])
            q_c = self.reduced(self.q(critic_c, self.batch.obs, action))
            worth = (worth / unit - self.lam * q_c) / (1 + self.lam)
        return -(self.batch.weight * worth).sum()


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


class Adam:
    def __init__(self, lr):
        self.lr, self.count = lr, 0
        self.mu: dict[str, Any] = {}
        self.nu: dict[str, Any] = {}

    def step(self, params, grads):
        self.count += 1
        zero = dict.fromkeys(grads, 0.0)
        mu, nu = self.mu or zero, self.nu or zero
        self.mu = {k: 0.9 * mu[k] + 0.1 * g for k, g in grads.items()}
        self.nu = {k: 0.999 * nu[k] + 0.001 * g**2 for k, g in grads.items()}
        scale = {k: np.sqrt(v / (1 - 0.999**self.count)) + 1e-8 for k, v in self.nu.items()}
        size = self.lr / (1 - 0.9**self.count)
        return {k: params[k] - size * self.mu[k] / scale[k] for k in grads}


NARROW = {"f": np.float32, "i": np.int32}


def dense(params):
    return params["params"]["Dense_0"]


def drawn_batch() -> Transitions:
    """A plain step, one of two steps, one that terminated, one that did not, as where time runs out,
    and one that does not count."""
    rng = np.random.default_rng(0)
    cost = rng.uniform(size=5)
    fields: dict[str, Any] = {
        "obs": rng.normal(size=(5, 3)), "action": np.tanh(rng.normal(size=(5, 2))),
        "reward": rng.normal(size=5), "cost": cost, "costs": cost[:, None],
        "next_obs": rng.normal(size=(5, 3)), "steps": np.array([1, 2, 1, 1, 1]),
        "terminated": np.array([0, 0, 1, 0, 0], bool), "weight": np.array([0.25, 0.25, 0.25, 0.25, 0]),
    }  # fmt: skip
    return Transitions(**fields)


@pytest.mark.parametrize(
    "row, lam, reduce, price_unit, omnisafe",
    [("sac", None, "", "", False), ("sac_lag", 0.7, "mean", "deviation", False),
     ("td3", None, "", "", False), ("td3_lag", 1.5, "max", "deviation", False),
     ("ddpg", None, "", "", False), ("ddpg_lag", 0.3, "one", "reward", False),
     ("sac_pid", 0.4, "max", "reward", False), ("td3_pid", 0.9, "one", "deviation", False),
     ("ddpg_pid", 1.2, "mean", "deviation", False), ("sac_lag", 0.7, "one", "reward", True),
     ("td3_lag", 1.5, "one", "reward", True), ("ddpg_lag", 0.3, "one", "reward", True)],
)  # fmt: skip
def test_two_gradient_steps_are_those_of_the_paper_or_of_omnisafe(
    row, lam, reduce, price_unit, omnisafe
):
    entry, method = ALGOS[row], row.split("_")[0]
    make: Any = entry.make
    treatment = no_treatment if lam is None else make.keywords["treatment"]
    settings: dict[str, Any] = {"hidden": (), "layer_norm": False, "lr": 0.01, "critic_lr": 0.02,
                                "tau": 0.1, "discount": 0.9, "cost_discount": 0.8,
                                "policy_delay": 1}  # fmt: skip
    if method == "sac":
        settings |= {"alpha_init": 0.3, "alpha_lr": 0.03, "target_entropy": -1.0, "lr_decay": False}
    if method == "td3":  # much of the noise is clipped
        settings |= {"smoothing": 0.4, "smoothing_clip": 0.3}
    settings |= {"cost_reduce": reduce, "price_unit": price_unit} if reduce else {}
    if omnisafe:
        conventions = compat.overrides("omnisafe", entry.config)
        assert conventions.items() >= {"cost_reduce": reduce, "price_unit": price_unit}.items()
        settings |= conventions | {"cost_normalize": True}
    cfg = jax.tree.map(jnp.float32, entry.config(**settings))
    learner = actor_critic(Lever(), ACTORS[method](2), treatment)
    init = jax.jit(lambda key: learner.init(key, 3, 2, cfg), compiler_options=FAST)
    nets = init(jax.random.key(0))
    batch = drawn_batch()
    narrow = jax.tree.map(lambda x: jnp.asarray(x, NARROW.get(x.dtype.kind, x.dtype)), batch)
    step = jax.jit(lambda nets, at: learner.step(nets, narrow, at, cfg, None), compiler_options=FAST)
    dual = () if lam is None else treatment.init(cfg)._replace(lam=jnp.float32(lam))

    trained = ["actor", "critic_r"] + ["critic_c"] * (lam is not None)
    targets = {"actor": "target_actor", "critic_r": "target_r", "critic_c": "target_c"}
    followed = [name for name in trained if name != "actor" or method != "sac"]
    hand = {name: jax.tree.map(np.float64, dense(nets.params[name])) for name in trained}
    hand |= {targets[n]: jax.tree.map(np.float64, dense(nets.params["targets"][n])) for n in followed}
    adams = {name: Adam(0.01 if name == "actor" else 0.02) for name in trained}
    alphas, log_alpha = Adam(0.03), {"a": np.log(0.3)}
    for count in (1, 2):
        key = jax.random.key(count)
        noise = [np.float64(jax.random.normal(k, (5, 2))) for k in jax.random.split(key)]
        given = dict(hand), batch, noise, np.exp(log_alpha["a"])
        p = ByHand(method, *given, lam, reduce, price_unit, omnisafe)
        critic_loss = p.error_r(hand["critic_r"])
        grads = {"critic_r": numerical(p.error_r, hand["critic_r"])}
        if lam is not None:
            critic_loss_c = p.error_c(hand["critic_c"])
            grads["critic_c"] = numerical(p.error_c, hand["critic_c"])
        for name, gradient in grads.items():
            hand[name] = adams[name].step(hand[name], gradient)
        critics = hand["critic_r"], hand.get("critic_c")
        unit = p.unit(hand["actor"], critics[0])
        gradient = numerical(lambda a, p=p, c=critics, u=unit: p.actor_loss(a, *c, u), hand["actor"])
        log_prob = p.pi(hand["actor"], batch.obs, noise[1])[1] / -p.alpha
        hand["actor"] = adams["actor"].step(hand["actor"], gradient)
        if method == "sac":  # H = -1 for each of two actions
            slope = {"a": -(batch.weight * (log_prob - 2.0)).sum()}
            log_alpha = alphas.step(log_alpha, slope)
        for name in followed:
            aim = targets[name]
            hand[aim] = {k: 0.9 * x + 0.1 * hand[name][k] for k, x in hand[aim].items()}

        nets, metrics = step(nets, GradientStep(jnp.int32(count - 1), jnp.float32(1), key, dual))
        np.testing.assert_allclose(metrics["train/critic_loss"], critic_loss, rtol=1e-5)
        if lam is not None:
            np.testing.assert_allclose(metrics["train/critic_loss_c"], critic_loss_c, rtol=1e-5)
        if method == "sac":
            np.testing.assert_allclose(nets.params["log_alpha"], log_alpha["a"], atol=1e-6)
        found = {name: nets.params[name] for name in trained}
        found |= {targets[name]: nets.params["targets"][name] for name in followed}
        assert found.keys() == hand.keys()
        for name, params in found.items():
            for leaf, x in hand[name].items():
                np.testing.assert_allclose(dense(params)[leaf], x, rtol=1e-6, atol=2e-6)
        for name in trained:  # Adam's first steps have one size: this is the gradient's own
            seen = dense(momentum(nets, name))
            for leaf, x in adams[name].mu.items():
                np.testing.assert_allclose(seen[leaf], x, rtol=1e-5, atol=1e-6)


def test_named_limits_on_the_same_cost_make_the_step_of_one():
    """Two constraints on one cost, each at half the price."""
    learner = actor_critic(Lever(), sac.soft_actor(2), lagrangian)
    small: dict[str, Any] = {"hidden": (), "cost_reduce": "max"}
    one = jax.tree.map(jnp.float32, sac.SACLagConfig(**small))
    two = dataclasses.replace(one, cost_limits={"lever": jnp.float32(1), "too": jnp.float32(2)})
    lever = dataclasses.replace(Lever(), cost_names=("lever", "too"))
    learner_2 = actor_critic(lever, sac.soft_actor(2), lagrangian)
    begin = jax.jit(lambda key: (learner.init(key, 3, 2, one), learner_2.init(key, 3, 2, two)))
    nets, nets_2 = begin(jax.random.key(0))

    def doubled(params, like):
        """Both constraints have the critics of the one."""
        critics = jax.tree.map(lambda x: jnp.stack([x, x]), params["critic_c"])
        chex.assert_trees_all_equal_shapes(critics, like["critic_c"])
        return params | {"critic_c": critics}

    params = doubled(nets.params, nets_2.params)
    params["targets"] = doubled(nets.params["targets"], nets_2.params["targets"])
    nets_2 = nets_2._replace(params=params)
    batch = drawn_batch()
    batch = jax.tree.map(lambda x: jnp.asarray(x, NARROW.get(x.dtype.kind, x.dtype)), batch)
    both = batch._replace(costs=jnp.repeat(batch.costs, 2, axis=1))
    at = GradientStep(jnp.int32(0), jnp.float32(1), jax.random.key(1))
    prices = Multiplier(jnp.float32(0.8), ()), Multiplier(jnp.array([0.4, 0.4]), ())

    @functools.partial(jax.jit, compiler_options=FAST)
    def steps(nets, nets_2):
        return (
            learner.step(nets, batch, at._replace(dual=prices[0]), one, None),
            learner_2.step(nets_2, both, at._replace(dual=prices[1]), two, None),
        )

    (alone, m), (together, m_2) = steps(nets, nets_2)
    chex.assert_trees_all_close(alone.params["actor"], together.params["actor"], atol=1e-6)
    np.testing.assert_allclose(m["train/q_c"], m_2["train/q_c_too"], rtol=1e-6)
    np.testing.assert_allclose(m["train/critic_loss_c"], m_2["train/critic_loss_c_lever"], rtol=1e-6)


def test_a_delayed_policy_and_its_targets_move_at_every_second_step():
    cfg = jax.tree.map(jnp.float32, sac.SACConfig(hidden=(), policy_delay=2))
    learner = actor_critic(Lever(), sac.soft_actor(2), no_treatment)
    nets = learner.init(jax.random.key(0), 3, 2, cfg)
    batch = drawn_batch()
    batch = jax.tree.map(lambda x: jnp.asarray(x, NARROW.get(x.dtype.kind, x.dtype)), batch)
    step = jax.jit(lambda nets, at: learner.step(nets, batch, at, cfg, None), compiler_options=FAST)
    for count in range(4):
        before = nets
        at = GradientStep(jnp.int32(count), jnp.float32(1), jax.random.key(count))
        nets, metrics = step(nets, at)
        moved = {
            name: any(
                bool((x != y).any())
                for x, y in zip(
                    jax.tree.leaves(before.params[name]), jax.tree.leaves(params), strict=True
                )
            )
            for name, params in nets.params.items()
        }
        due = count % 2 == 1
        assert moved == {"actor": due, "log_alpha": due, "targets": due, "critic_r": True}
        assert jnp.isfinite(metrics["train/critic_loss"])
        assert jnp.isfinite(metrics["train/actor_loss"]) == due  # a step that is not due has none


@pytest.mark.parametrize("delay, count", [(1, 2), (2, 3)])
def test_a_delayed_policy_is_computed_where_it_is_due_alone_by_members_too(delay, count):
    """During the warm-up one cond takes random actions and one skips learning; the delay has one more.
    Under vmap one with a member axis would be none: it computes both branches."""
    algo, cfg = ALGOS["td3_lag"].make(Lever()), ALGOS["td3_lag"].config(policy_delay=delay)
    init = jax.vmap(lambda key: algo.init(key, cfg, START))
    ts = jax.eval_shape(lambda: init(jax.random.split(jax.random.key(0), 2)))
    program = jax.make_jaxpr(jax.vmap(algo.update, in_axes=(0, None)))(ts, START)
    assert str(program).count("= cond[") == count


@pytest.mark.parametrize("decay", [True, False])
@pytest.mark.parametrize("name", ["sac_lag", "td3_lag"])
def test_the_rates_of_policy_and_critics_fall_with_what_is_left_of_training_if_asked(name, decay):
    """Adam's first step is as long as the rate. The temperature has a rate of its own."""
    settings: dict[str, Any] = {"hidden": (), "policy_delay": 1, "lr_decay": decay}
    cfg = jax.tree.map(jnp.float32, ALGOS[name].config(**settings))
    learner = actor_critic(Lever(), ACTORS[name.split("_")[0]](2), lagrangian)
    nets = jax.jit(lambda key: learner.init(key, 3, 2, cfg), compiler_options=FAST)(jax.random.key(0))
    batch = jax.tree.map(lambda x: jnp.asarray(x, NARROW.get(x.dtype.kind, x.dtype)), drawn_batch())
    dual = lagrangian.init(cfg)
    step = jax.jit(lambda nets, at: learner.step(nets, batch, at, cfg, None), compiler_options=FAST)

    def longest(left: float) -> dict[str, float]:
        at = GradientStep(jnp.int32(0), jnp.float32(left), jax.random.key(1), dual)
        moved = jax.tree.map(lambda x, y: abs(x - y).max(), step(nets, at)[0].params, nets.params)
        return {name: float(max(jax.tree.leaves(x))) for name, x in moved.items() if name != "targets"}

    whole, late = longest(1.0), longest(0.25)
    for part, rate in (("actor", cfg.lr), ("critic_r", cfg.critic_lr), ("critic_c", cfg.critic_lr)):
        np.testing.assert_allclose(whole[part], rate, rtol=1e-2)
        np.testing.assert_allclose(late[part], rate * (0.25 if decay else 1), rtol=1e-2)
    assert late.get("log_alpha") == whole.get("log_alpha")


def test_costs_are_scaled_by_all_that_were_replayed_so_far():
    """The scale after two batches, of costs from 0 to 1 and of ten times these, is that of both."""
    cfg = jax.tree.map(jnp.float32, td3.TD3LagConfig(hidden=(), cost_normalize=True))
    learner = actor_critic(Lever(), ACTORS["td3"](2), lagrangian)
    nets = jax.jit(lambda key: learner.init(key, 3, 2, cfg), compiler_options=FAST)(jax.random.key(0))
    batch = jax.tree.map(lambda x: jnp.asarray(x, NARROW.get(x.dtype.kind, x.dtype)), drawn_batch())
    at = GradientStep(jnp.int32(0), jnp.float32(1), jax.random.key(1), lagrangian.init(cfg))
    step = jax.jit(lambda nets, x: learner.step(nets, x, at, cfg, None)[0], compiler_options=FAST)
    for size in (1, 10):
        nets = step(nets, batch._replace(cost=size * batch.cost, costs=size * batch.costs))
    cost = np.concatenate([batch.cost[:4], 10 * batch.cost[:4]])  # the last one does not count
    scale = nets.opt_state["cost_scale"]
    np.testing.assert_allclose(scale.mean, [cost.mean()], rtol=1e-5)
    np.testing.assert_allclose(scale.square, [(cost**2).mean()], rtol=1e-5)


# ---- values ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Chain:
    """States 0, 1, 2 as one-hot observations, one after the other; leaving state i earns i + 1 and
    costs 3 - i.

    Beyond state 2 it terminates or, if it is a circle, begins anew at 0. Ignores actions.
    """

    circle: bool
    episode_length: int
    obs_size: int = 3
    action_size: int = 1
    cost_names: tuple[str, ...] = ("a",)

    def reset(self, key: jax.Array) -> State:
        place = jax.random.randint(key, (), 0, 3)
        return self._at(place, jnp.float32(0), jnp.float32(0), jnp.bool_(False))

    def step(self, state: State, action: jax.Array) -> State:
        place = (state.physics + 1) % 3
        earned, paid = state.physics + 1.0, 3.0 - state.physics
        return self._at(place, earned, paid, (place == 0) & (not self.circle))

    def _at(self, place: jax.Array, reward: jax.Array, cost: jax.Array, end: jax.Array) -> State:
        return State(place, jax.nn.one_hot(place, 3), reward, cost, cost[None], end, {})


def value(earned: np.ndarray, discount: float, circle: bool) -> np.ndarray:
    """Of the three states: v = r + discount P v."""
    forward = np.eye(3, k=1)
    forward[2, 0] = circle
    return np.linalg.solve(np.eye(3) - discount * forward, earned)


@pytest.mark.parametrize(
    "name, circle, n_step",
    [
        ("sac", False, 1),
        ("td3_lag", True, 3),
        ("ddpg_lag", False, 2),
        *(
            pytest.param(name, circle, n_step, marks=pytest.mark.slow)
            for name, circle, n_step in [
                ("sac_lag", True, 2),
                ("sac_pid", False, 3),
                ("td3", True, 1),
                ("td3_pid", False, 2),
                ("ddpg", True, 3),
                ("ddpg_pid", True, 1),
            ]
        ),
    ],
)
def test_the_critics_find_the_values_of_a_chain(name, circle, n_step):
    """Episodes of the circle are cut after 2 steps, which takes nothing from their values."""
    env = Chain(circle, episode_length=2 if circle else 9)
    settings: dict[str, Any] = {
        "num_envs": 8, "horizon": 6, "learn_every": 2, "batch_size": 32, "replay_size": 8 * 18,
        "learning_starts": 8 * 7, "hidden": (), "obs_normalize": False, "layer_norm": False,
        "discount": 0.5, "cost_discount": 0.75, "critic_lr": 0.02, "tau": 0.2, "n_step": n_step,
        "replay_ratio": 32,
    }  # fmt: skip
    quiet = {"alpha_init": 1e-6, "alpha_lr": 0.0}
    settings |= quiet if name.startswith("sac") else {"policy_delay": 1}
    row = ALGOS[name]
    cfg, algo = row.config(**settings), row.make(env)
    train = jax.jit(training(algo, cfg, 150), compiler_options=FAST)
    ts, metrics = train(jax.random.key(0))
    expected = {"critic_r": value(np.array([1.0, 2, 3]), 0.5, circle)}
    if row.holds == "average":
        expected["critic_c"] = value(np.array([3.0, 2, 1]), 0.75, circle)
    for critic, values in expected.items():
        for action in (-0.9, 0.0, 0.9):
            q = q_values(ts.params[critic], jnp.eye(3), jnp.full((3, 1), action), ts.config)
            np.testing.assert_allclose(q, np.stack([values] * len(q)), atol=1e-2)
    assert metrics["train/nonfinite"].sum() == 0


# ---- acting in training ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "decay, left, share", [(False, 0.25, 1.0), (True, 1.0, 1.0), (True, 0.25, 0.25)]
)
def test_each_environment_has_noise_of_its_own_which_can_fall_to_none(decay, left, share):
    cfg = td3.TD3Config(hidden=(), layer_norm=False, noise_min=0.1, noise_max=0.3, noise_decay=decay)
    actor: Any = ACTORS["td3"](4000)
    params = jax.tree.map(jnp.zeros_like, actor.init(jax.random.key(0), 1, 4000, cfg))  # mu(s) = 0
    actions = actor.explore(params, jnp.zeros((3, 1)), jax.random.key(1), cfg, jnp.float32(left))
    np.testing.assert_allclose(actions.std(1), share * np.array([0.1, 0.2, 0.3]), rtol=0.05)


@pytest.mark.parametrize("ends", [(0.1, 0.3), (0.3, 0.1)])
def test_a_sampled_action_has_the_noise_of_any_environment_and_none_leaves_its_bounds(ends):
    cfg = td3.TD3Config(hidden=(), layer_norm=False, noise_min=ends[0], noise_max=ends[1])
    actor: Any = ACTORS["td3"](2000)
    params = jax.tree.map(jnp.zeros_like, actor.init(jax.random.key(0), 1, 2000, cfg))  # mu(s) = 0
    obs, key = jnp.zeros((200, 1)), jax.random.key(1)
    spread = actor.act(params, obs, key, cfg).std(1)
    np.testing.assert_allclose([spread.min(), spread.mean(), spread.max()], [0.1, 0.2, 0.3], atol=0.02)
    wild = dataclasses.replace(cfg, noise_min=5.0, noise_max=5.0)
    for actions in (
        actor.act(params, obs, key, wild), actor.explore(params, obs, key, wild, jnp.float32(1))
    ):  # fmt: skip
        assert actions.max() == 1 and actions.min() == -1


# ---- saturated policies ------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["td3", "ddpg"])
@pytest.mark.parametrize("coef, freed", [(0.0, False), (1e-3, True)])
def test_a_policy_of_extreme_actions_is_freed_by_the_penalty_alone(method, coef, freed):
    """tanh(20) is 1 in float32, where the gradient of any Q is 0. Q = -a^2 wants actions of 0."""
    cfg = td3.TD3Config(hidden=(), saturation_coef=coef)
    actor: Any = ACTORS[method](2)
    obs, key = jnp.ones((5, 1)), jax.random.key(0)
    params = jax.tree.map(jnp.zeros_like, actor.init(key, 1, 2, cfg))
    params = jax.tree.map(lambda x: x + (20.0 if x.shape == (2,) else 0.0), params)  # the biases

    def loss(params):
        made = actor.propose(params, obs, key, cfg)
        return made.extra.mean() + (made.action**2).sum(-1).mean(), made

    adam = optax.adam(0.05)

    def descend(carry, _):
        params, state = carry
        grads, made = jax.grad(loss, has_aux=True)(params)
        updates, state = adam.update(grads, state)
        return (optax.apply_updates(params, updates), state), made

    made = jax.lax.scan(descend, (params, adam.init(params)), None, 800)[1]
    np.testing.assert_allclose(made.extra[0], coef * 20**2, rtol=1e-6)
    assert (made.metrics["train/saturated"][0] == 1).all()
    assert (made.metrics["train/saturated"][-1] == (0 if freed else 1)).all()
    np.testing.assert_allclose(made.action[-1], 0.0 if freed else 1.0, atol=1e-3)


# ---- the clock of the price --------------------------------------------------------------------


@pytest.mark.parametrize("num_envs, horizon", [(1, 50), (8, 25), (500, 4), (1000, 16)])
def test_the_price_moves_by_environment_steps_alone(num_envs, horizon):
    """J_c is 10 above its limit, so that each of Adam's moves is dual_lr: 0.1 for each 1,000 steps."""
    cfg = jax.tree.map(
        jnp.float32,
        sac.SACLagConfig(cost_limit=10.0, dual_every=1000, dual_starts=16_000, lam_init=0, dual_lr=0.1),
    )
    real = jnp.ones((horizon, num_envs), bool).at[0].set(False)  # the first of them are resets
    cost = jnp.where(real, 0.2, 7.0)

    @jax.jit
    def iteration(dual, bill):
        bill = charge(bill, cost, real, None)
        return settle(lagrangian, dual, bill, jnp.float32(100.0), cfg, jnp.int32(0))

    dual, bill, steps = lagrangian.init(cfg), empty_bill(cfg, ()), 0
    while steps < 48_000:
        dual, bill, stuck = iteration(dual, bill)
        steps += num_envs * horizon
        assert not stuck
        if steps in (16_000, 32_000, 48_000):
            np.testing.assert_allclose(dual.lam, 0.1 * (steps - 16_000) / 1000, rtol=1e-3, atol=1e-6)
    assert steps == 48_000 and bill.age == 0 and bill.steps == 0


def test_below_the_limit_the_price_falls_to_zero_and_stays():
    cfg = jax.tree.map(
        jnp.float32, sac.SACLagConfig(cost_limit=10.0, dual_every=100, lam_init=0.35, dual_lr=0.1)
    )
    dual, bill = lagrangian.init(cfg), empty_bill(cfg, ())
    seen = []
    for _ in range(6):
        bill = charge(bill, jnp.full((10, 10), 0.05), jnp.ones((10, 10), bool), None)
        dual, bill, _ = settle(lagrangian, dual, bill, jnp.float32(100.0), cfg, jnp.int32(0))
        seen.append(float(dual.lam))
    np.testing.assert_allclose(seen, [0.25, 0.15, 0.05, 0, 0, 0], atol=1e-3)


def test_what_steps_cost_before_the_price_may_move_is_forgotten():
    """An episode of 100 steps costs 100 before and 5 after, and its limit is 10."""
    sizes: dict[str, Any] = {"cost_limit": 10.0, "dual_every": 200, "dual_starts": 200}
    cfg = jax.tree.map(jnp.float32, sac.SACLagConfig(lam_init=0.35, dual_lr=0.1, **sizes))
    dual, bill = lagrangian.init(cfg), empty_bill(cfg, ())
    for cost, lam in ((1.0, 0.35), (1.0, 0.35), (0.05, 0.35), (0.05, 0.25)):
        bill = charge(bill, jnp.full((10, 10), cost), jnp.ones((10, 10), bool), None)
        dual, bill, _ = settle(lagrangian, dual, bill, jnp.float32(100.0), cfg, jnp.int32(0))
        np.testing.assert_allclose(dual.lam, lam, atol=1e-3)


def test_the_price_stays_where_no_step_says_what_an_episode_costs():
    cfg = jax.tree.map(
        jnp.float32, sac.SACLagConfig(cost_limit=10.0, dual_every=100, lam_init=0.35, dual_lr=0.1)
    )
    dual, bill = lagrangian.init(cfg), empty_bill(cfg, ())
    for real, lam in ((False, 0.35), (False, 0.35), (True, 0.25)):
        bill = charge(bill, jnp.full((10, 15), 0.05), jnp.full((10, 15), real), None)
        dual, bill, _ = settle(lagrangian, dual, bill, jnp.float32(100.0), cfg, jnp.int32(0))
        np.testing.assert_allclose(dual.lam, lam, atol=1e-3)
    assert bill.age == 50


@pytest.mark.parametrize("steps, multipliers", [(5, [1.5, 0.5]), (3, [0.5, 0.5])])
def test_a_bill_is_the_cost_of_real_steps_since_the_last_move_for_each_constraint(steps, multipliers):
    """Each step costs 0.5 and 1.5 by name; resets do not count. Episodes fail after 3 of 5 steps, or
    never. J_c is above the first limit, of 2, where they go on to the end alone."""
    env: Env = Ticker(episode_length=5, lives=(3, 3) if steps == 3 else (99, 99))
    settings: dict[str, Any] = {
        "num_envs": 4, "horizon": 12, "learn_every": 6, "batch_size": 8, "replay_ratio": 1,
        "replay_size": 96, "learning_starts": 10_000, "hidden": (4,), "stagger": False,
        "dual_every": 48, "lam_init": 1.0, "dual_lr": 0.5, "cost_limits": {"a": 2.0, "b": 8.0},
        "dual_damping": 0.2, "dual_eps": 1e-8,
    }  # fmt: skip
    cfg, algo = ALGOS["td3_lag"].config(**settings), ALGOS["td3_lag"].make(env)

    def first_update(key):
        return algo.update(algo.init(key, cfg, START), START)

    ts, metrics = jax.jit(first_update, compiler_options=FAST)(jax.random.key(0))
    costs = steps * np.array([0.5, 1.5])
    for name, cost in {"_a": costs[0], "_b": costs[1], "": costs.sum()}.items():
        np.testing.assert_allclose(metrics[f"train/cost_estimate{name}"], cost, rtol=1e-6)
    np.testing.assert_allclose(ts.dual.multiplier.lam, multipliers, rtol=1e-4)
    prices = np.maximum(multipliers + 0.2 * (costs - [2, 8]), 0)
    np.testing.assert_allclose(ts.dual.lam, prices, rtol=1e-4)
    lost, taken = ts.lost_time
    assert taken > 0
    np.testing.assert_allclose(lost, taken * (5 / steps - 1), rtol=1e-5)
    assert metrics["train/lam_a"] == ts.dual.lam[0] and ts.bill.age == 0
