"""AMBS: Dreamer with a shield. Where its dreams look unsafe, a safe policy acts instead."""

import dataclasses
import itertools
import math
import operator
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaxsafe.algos import dreamer
from jaxsafe.config import Amount, Bounds, ConfigError, Iterations, Rate, Share, Weight, config
from jaxsafe.learn.acting import Course, Learned, Play
from jaxsafe.learn.constraints import Costs, check_cost_names, signal
from jaxsafe.learn.dreaming import (
    Behaviour,
    Memory,
    Outcome,
    Scene,
    chosen,
    dreaming_learner,
    dreaming_policy,
    fixed,
    moved,
    no_range,
    seen,
)
from jaxsafe.learn.off_policy import off_policy
from jaxsafe.learn.planning import key_of_step, particles_of
from jaxsafe.learn.row import Examined, Row
from jaxsafe.learn.world_model import CHANCE, dream_returns, read, value_of, world_of
from jaxsafe.nn.rssm import Latent
from jaxsafe.nn.two_hot import BINS
from jaxsafe.types import Algorithm, Env, Metrics, Policy, PyTree, State

MOST_ROLLOUTS = 2**16  # beyond that 32 bits do not tell the exact bound
PARTS = 10  # of [0, 1], by which the risk is compared with what came
LEAST_SHARE = 1e-6  # more than float32 is off by, and less than one of the most rollouts
ROUNDING = 1e-5  # a sum of costs that is above a bound by less is at the bound
MOST_DISCOUNT = 0.9999  # steps differ by a share of 1e-4 then, ten times ROUNDING


@config
class AMBSConfig(dreamer.ForesightConfig):
    """AMBS: Dreamer with a shield. Where its dreams look unsafe, a safe policy acts instead.

        p(s)  = share of m dreams of pi from s with  R > C discount^T,   R = sum of discounted costs
        act by pi_safe if  p(s) > delta - eps,   else by pi
        or, with rule=binomial, if  P(B <= m p(s)) > confidence,   B binomial: m draws at delta
        c     = C where a step has a violation, else 0;   y = 1 if it has none, else 0
        k     = 1 if the episode goes on from a state, else 0
        R     = c_1 + discount k_1 (c_2 + .. c_H + discount k_H min_i V_i(s_H)),   H < T
        V_i   : returns of c under pi, cut at the first violation, discount k y
        pi_safe climbs -c, discounted by cost_discount;   pi climbs  w A + penalty_coef A_pen
        penl    w = 1
        plpg    w = exp(min(0, -c_{t+1} + V_safe(s_{t+1}) - V_safe(s_t))), at least 1e-6
        copt    w = 1 - sigmoid(kappa (R_t - C discount^T)), without gradient
        none    w = 1, and no A_pen

    A is Dreamer's advantage. A_pen is that of -c under pi, discounted by `cost_discount` and divided by
    S_pen: Dreamer's scale of these returns, at least `least_penalty_scale`. So in units of reward pi
    pays penalty_coef C S / S_pen for a violation, and the rarer they are in dreams, the more. A
    violation i steps ahead costs discount^(i-1) C, so R tells whether there is one within
    T steps. The shield's dreams have only H = `shield_steps` steps. V_i stand for the rest. The shield
    acts in training, evaluation and films. What is dreamed begins with actions of pi that are drawn
    anew, unless `verify_action` has the proposed one dreamed first.

    With `shield=true_dynamics` the simulator takes the place of the dreams: pi goes on for T steps in m
    copies of it. They foresee its random numbers, too, and only the actions differ. It shows what a
    learned model costs. The policy then needs the simulator wherever it acts.

    With `verdict=drawn` a dream has T steps and no V_i. Each of its states has a violation as likely as
    the model says, and one is enough.

    What the shield guarantees with `verdict=drawn` or in the simulator: where pi has a violation within
    T steps with a probability of delta or more, the shield lets pi act with a probability of
    `confidence` at most. With `rule=hoeffding` this takes m of at least ln(1 / confidence) / (2 eps^2).
    It holds for each decision, and not for an episode of hundreds. It does not say how likely a
    violation is where the shield has let pi act. It says nothing of the safe policy.

    In dreams the guarantee needs an exact model, too, and the model is learned. All dreams begin in one
    latent. Its z is one draw, with mean actions the likeliest one. So p is of that latent. Where the
    observation leaves z open, the guarantee does not cover it. With `verdict=summed` V_i would have to
    be C or 0 at the end of a dream. V_i is a mean, so nothing is guaranteed there.

    Source: Goodall and Belardinelli (2023), "Approximate Model-Based Shielding for Safe Reinforcement
    Learning", arXiv:2308.00707, and (2024), "Leveraging Approximate Model-based Shielding for
    Probabilistic Safety Guarantees in Continuous Environments", arXiv:2402.00816; the penalties are
    from their code.
    Differs from it: Dreamer is the later one, whose actor learns by reinforce (`actor_grad=backprop`
    has the authors'). An end of the episode also ends the costs that V_i foresee. Time limits are no
    ends (`limit_ends=true` has them). A violation of probability p costs p C, the mean of what the head
    says. In their code, the mean of symlogs, it costs (1 + C)^p - 1, a quarter of that at p = 0.1. Mean
    actions are shielded, too. The defaults are from runs on point_goal1 (docs/results/shielding). The
    model foresees cost, as Dreamer-PID's does. The critic of rewards learns from replayed ones, too.
    Cost is discounted sooner, and its price is bounded. The shield looks less far ahead and lets more
    through, by the exact bound. `preset=plpg`, `penl` and `copt` are the authors'.
    """

    ACTS_BY: ClassVar = (
        "shield", "rule", "shield_rollouts", "shield_horizon", "shield_steps", "delta", "eps",
        "confidence", "verdict", "verify_action",
    )  # fmt: skip

    # The discount of what both policies avoid, and of costs in evaluations: 33 steps ahead. V_i and the
    # shield have `discount`, and so has everything in AMBS's code.
    cost_discount: Share = 0.97
    # Rows of a gradient step, of all devices together: half as many steps as Dreamer-PID takes, each
    # with higher rates.
    batch_size: Amount = 2048
    model_lr: Rate = 1.4e-3  # The model's learning rate, by LaProp. The authors have 1e-4.
    lr: Rate = 7e-4  # The actors' learning rate, by LaProp. The authors have 3e-5.
    critic_lr: Rate = 1.4e-3  # The critics' learning rate, by LaProp. The authors have 3e-5.

    # The undiscounted cost that an episode may have. It is only drawn in plots.
    cost_limit: Weight = 0.0
    # How the task's policy learns to avoid what the shield hides from it: see above.
    penalty: Literal["penl", "plpg", "copt", "none"] = "penl"
    # The weight of A_pen. The authors have 1 with penl and copt, and 0.8 with plpg.
    penalty_coef: Weight = 1.0
    # The least scale of the returns of -c, by which A_pen is divided. With 1, as the authors have it, a
    # violation costs more reward the fewer there are, without a bound to speak of.
    least_penalty_scale: Annotated[float, Bounds(1e-6, 1e6)] = 30.0
    # Costs of the environment that are violations where they are above 0. []: `cost`.
    labels: tuple[str, ...] = ()
    violation_cost: Annotated[float, Bounds(1e-3, 1e6)] = 10.0  # C, as in the paper.
    # Where the shield looks ahead: in the model's dreams, or in copies of the simulator. none: nothing
    # overrules pi, and A_pen alone keeps it from violations.
    shield: Literal["dreams", "true_dynamics", "none"] = "dreams"
    # By which bound it decides. hoeffding: as in the paper. binomial: exact, so fewer dreams do.
    rule: Literal["hoeffding", "binomial"] = "binomial"
    # m, dreams of the shield at each step. The paper has 512. More than 65,536 are beyond what 32 bits
    # tell of the exact bound.
    shield_rollouts: Annotated[int, Bounds(1, MOST_ROLLOUTS)] = 64
    shield_horizon: Iterations = 10  # T, steps within which a violation counts. The paper has 30.
    # H, steps of the shield's dreams with verdict=summed, at most T. The paper has 15.
    shield_steps: Iterations = 5
    # Delta, the probability of a violation that is still let through. The paper has 0.1.
    delta: Share = 0.3
    # The error of the estimate that `hoeffding` allows for, as in the paper.
    eps: Annotated[float, Bounds(1e-6, 1)] = 0.09
    # The probability that the estimate is further off, as in the paper.
    confidence: Annotated[float, Bounds(1e-12, 1)] = 0.01
    # How a dream is found unsafe. summed: by the sum R of what its steps are expected to cost, as in
    # the paper. drawn: each of T dreamed states has a violation, and is an end, as likely as the model
    # says. It has no effect with shield=true_dynamics.
    verdict: Literal["summed", "drawn"] = "summed"
    # Whether the dreams begin with the proposed action. The authors' draw theirs anew.
    verify_action: bool = False
    kappa: Weight = 10.0  # How sharply copt decides, as in the authors' code.


# ---- what a violation is -----------------------------------------------------------------------


def violated(env: Env, rows: Costs, cfg: Any) -> jax.Array:
    """Where a row has a violation, bool [...]."""
    costs = signal(env, rows, cfg.labels)
    return (costs > 0).any(-1) if cfg.labels else costs > 0


def targets(env: Env, rows: Costs, cfg: Any) -> dict[str, jax.Array]:
    bad = violated(env, rows, cfg)
    return {"cost": cfg.violation_cost * bad, "safe": 1.0 - bad}


def clipped(cost: jax.Array, cfg: Any) -> jax.Array:
    """A predicted cost or value of costs, within [0, C]."""
    return jnp.clip(cost, 0.0, cfg.violation_cost)


def threshold(cfg: Any) -> jax.Array:
    """C discount^T: what a violation costs in step T + 1, and less than one before that costs."""
    return cfg.violation_cost * cfg.discount**cfg.shield_horizon


# ---- learning ----------------------------------------------------------------------------------


class Advantages(NamedTuple):
    """Of the task's policy, float [H, S]: in reward and in -c, scaled; and what else penalties read.

    cost, value_safe: float [H + 1, S], c and V_safe. returns_c: float [H, S], R_t of a dream.
    """

    reward: jax.Array
    penalty: jax.Array
    cost: jax.Array
    value_safe: jax.Array
    returns_c: jax.Array


def penalised(found: Advantages, cfg: Any) -> jax.Array:
    """What the task's policy climbs, float [H, S]."""
    match cfg.penalty:
        case "none":
            return found.reward
        case "penl":
            weight = 1.0
        case "plpg":
            change = -found.cost[1:] + found.value_safe[1:] - found.value_safe[:-1]
            weight = jnp.clip(jnp.exp(jnp.minimum(change, 0.0)), 1e-6, 1.0)
        case "copt":
            violates = jax.nn.sigmoid(cfg.kappa * (found.returns_c - threshold(cfg)))
            weight = 1.0 - fixed(violates)
    return weight * found.reward + cfg.penalty_coef * found.penalty


def learn(trained: dict[str, PyTree], memory: PyTree, scene: Scene, key: jax.Array) -> Outcome:
    cfg, axis_name = scene.cfg, scene.axis_name
    discount, least = cfg.discount, cfg.least_scale
    actors = jax.tree.map(lambda *x: jnp.stack(x), trained["actor"], trained["safe"])
    both = jax.vmap(scene.dream)(actors, jax.random.split(key))  # in one program
    task_dreams, safe_dreams = (jax.tree.map(operator.itemgetter(i), both) for i in range(2))

    # the safe policy
    dreams = safe_dreams
    cost = clipped(dreams.read["cost"], cfg)
    judged = scene.judge("critic_safe", dreams, -cost, cfg.cost_discount)
    range_safe = moved(memory["safe"], judged.returns, axis_name)
    loss = scene.actor_loss(dreams, judged.advantage / range_safe.scale(least))
    loss += scene.critic_loss(trained, "critic_safe", dreams, judged.returns)
    metrics: Metrics = {"train/value_safe": scene.over_dreams(judged.value[:-1])}

    # the task's policy
    dreams = task_dreams
    cost = clipped(dreams.read["cost"], cfg)
    earned = scene.judge("critic_r", dreams, dreams.read["reward"], discount)
    paid = scene.judge("critic_p", dreams, -cost, cfg.cost_discount)
    range_r = moved(memory["reward"], earned.returns, axis_name)
    range_p = moved(memory["penalty"], paid.returns, axis_name)
    scale_r, scale_p = range_r.scale(least), range_p.scale(cfg.least_penalty_scale)
    value_c = safety_value(scene.params, dreams.features, cfg)
    found = Advantages(
        reward=earned.advantage / scale_r,
        penalty=paid.advantage / scale_p,
        cost=cost,
        value_safe=scene.value(scene.params["critic_safe"], dreams.features),
        returns_c=dream_returns(cost, value_c, dreams.read["cont"], discount=discount, decay=1.0),
    )
    actor_loss = scene.actor_loss(dreams, penalised(found, cfg))
    critic_loss = scene.critic_loss_with_rows(
        trained, "critic_r", dreams, earned.returns, scene.batch.rows.reward, discount
    )
    lasts = dreams.read["cont"] * dreams.read["safe"]
    until = dream_returns(cost, value_c, lasts, discount=discount, decay=cfg.td_lambda)
    first, second = (scene.critic_loss(trained, name, dreams, clipped(until, cfg)) for name in PAIR)
    critic_loss_c = first + second
    loss += actor_loss + critic_loss + critic_loss_c
    loss += scene.critic_loss(trained, "critic_p", dreams, paid.returns)
    metrics |= {
        "train/actor_loss": actor_loss,
        "train/critic_loss": critic_loss,
        "train/critic_loss_c": critic_loss_c,
        "train/entropy": scene.over_dreams(dreams.entropy),
        "train/value": scene.over_dreams(earned.value[:-1]),
        "train/value_c": scene.over_dreams(value_c[:-1]),
        "train/return_scale": scale_r,
        "train/penalty_scale": scale_p,
    }
    return Outcome(loss, {"reward": range_r, "penalty": range_p, "safe": range_safe}, metrics)


PAIR = ("critic_c1", "critic_c2")
shielded_behaviour = Behaviour(
    learn=learn,
    memory=lambda cfg: {name: no_range() for name in ("reward", "penalty", "safe")},
    actors=("actor", "safe"),
    critics=("critic_r", "critic_p", "critic_safe", *PAIR),
    heads=lambda cfg: {"cost": BINS, "safe": CHANCE},
    targets=targets,
)


def safety_value(params: dict[str, PyTree], features: jax.Array, cfg: Any) -> jax.Array:
    """min_i V_i within [0, C], float [...]: the discounted cost until the first violation."""
    first, second = (value_of(params[name], features, cfg) for name in PAIR)
    return clipped(jnp.minimum(first, second), cfg)


# ---- the shield --------------------------------------------------------------------------------


class Dreamt(NamedTuple):
    """m dreams of H states, or of T with verdict=drawn: their costs, float [H, m]; whether the episode
    goes on from them, bool [H, m]; the cost that follows the last one, float [m]; where a violation was
    drawn, bool [H, m]."""

    cost: jax.Array
    alive: jax.Array
    value: jax.Array
    hit: jax.Array


def risk(env: Env, learned: Learned, latent: Latent, proposed: jax.Array, key: jax.Array) -> jax.Array:
    """p, the share of dreams from `latent` that have a violation within T steps, float []."""
    return unsafe(dreamt(env, learned, latent, proposed, key), learned.config).mean()


def dreamt(env: Env, learned: Learned, latent: Latent, proposed: jax.Array, key: jax.Array) -> Dreamt:
    """Dreams of the task's policy from `latent`: of T steps if violations are drawn, else of H, or of T
    where that is less.

    proposed: float [A], with which they begin where `verify_action` is set.
    """
    cfg, params = learned.config, learned.params
    steps = cfg.shield_horizon
    if cfg.verdict == "summed":
        steps = min(cfg.shield_steps, steps)  # what comes after T does not count
    world = world_of(env, shielded_behaviour.all_heads(cfg), cfg)
    start = particles_of(latent, (cfg.shield_rollouts,))

    def step(now: Latent, x: tuple[jax.Array, jax.Array]) -> tuple[Latent, jax.Array]:
        h, key = x
        act_key, model_key = jax.random.split(key)
        action = chosen(env, learned, "actor", now, act_key)
        action = jnp.where((h == 0) & cfg.verify_action, proposed, action)
        after: Any = world.apply(params["model"], now, action, model_key, method="imagine")
        return after, after.features

    dream_key, hit_key, end_key = jax.random.split(key, 3)
    keys = jax.random.split(dream_key, steps)
    last, features = jax.lax.scan(step, start, (jnp.arange(steps), keys))
    says = read(world, params["model"], features)  # of all steps at once
    hit = jax.random.bernoulli(hit_key, 1 - says["safe"])
    least = jax.random.uniform(end_key, hit.shape) if cfg.verdict == "drawn" else 0.5
    cost, alive = clipped(says["cost"], cfg), says["cont"] > least
    return Dreamt(cost, alive, safety_value(params, last.features, cfg), hit)


def unsafe(dreams: Dreamt, cfg: Any) -> jax.Array:
    """Which dreams have a violation within T steps, bool [m]: one was drawn before the episode ended;
    or, with verdict=summed, R > C discount^T."""
    cost, alive, value, hit = dreams
    if cfg.verdict == "drawn":
        runs = jnp.cumprod(alive, axis=0)[:-1] > 0  # from the second state on
        return hit[0] | (hit[1:] & runs).any(0)

    def backward(later: jax.Array, x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        cost, alive = x
        return cost + cfg.discount * alive * later, None

    total = jax.lax.scan(backward, value, (cost, alive), reverse=True)[0]
    return total > (1 + ROUNDING) * threshold(cfg)


class Ahead(NamedTuple):
    """A copy of the simulator that runs ahead: where the policy thinks that it is, the state; whether
    there was a violation, and whether the episode still runs, bool []."""

    latent: Latent
    state: State
    hit: jax.Array
    alive: jax.Array


def true_risk(
    env: Env, learned: Learned, latent: Latent, proposed: jax.Array, state: State, key: jax.Array
) -> jax.Array:
    """p as of `risk`, in copies of the simulator in place of dreams."""
    cfg = learned.config

    def step(now: Ahead, x: tuple[jax.Array, jax.Array]) -> tuple[Ahead, None]:
        h, key = x
        act_key, latent_key = jax.random.split(key)
        action = chosen(env, learned, "actor", now.latent, act_key)
        action = jnp.where((h == 0) & cfg.verify_action, proposed, action)
        after = env.step(now.state, action)
        memory = Memory(now.latent, action, h)
        latent = seen(env, shielded_behaviour, learned, memory, after.obs, latent_key)
        hit = now.hit | (now.alive & violated(env, after, cfg))
        return Ahead(latent, after, hit, now.alive & ~after.ended), None

    def ahead(key: jax.Array) -> jax.Array:
        start = Ahead(latent, state, jnp.bool_(False), jnp.bool_(True))
        steps = jnp.arange(cfg.shield_horizon), jax.random.split(key, cfg.shield_horizon)
        return jax.lax.scan(step, start, steps)[0].hit

    return jax.vmap(ahead)(jax.random.split(key, cfg.shield_rollouts)).mean()


def overrules(p: jax.Array, cfg: Any) -> jax.Array:
    """Whether the shield acts where a share `p` of the dreams is unsafe, bool []. An infinite
    `delta` turns it off."""
    if cfg.rule == "hoeffding":
        return p > cfg.delta - cfg.eps + LEAST_SHARE
    m = cfg.shield_rollouts
    count = jnp.round(p * m)
    # P(B <= count), of a binomial with m draws at delta
    likely = jax.scipy.special.betainc(
        jnp.maximum(m - count, 1.0), count + 1, 1 - jnp.minimum(cfg.delta, 1.0)
    )
    return (jnp.where(count < m, likely, 1.0) > cfg.confidence) & (cfg.delta <= 1)


def shielded(env: Env, policy: Policy) -> Policy:
    """`policy`, under a shield: where what it proposes looks unsafe, the safe policy acts instead. What
    is remembered is the action that is taken."""

    def privileged(learned: Learned) -> bool:
        return learned.config.shield == "true_dynamics"

    def keys_of(
        key: jax.Array | None, step: jax.Array
    ) -> tuple[jax.Array | None, jax.Array | None, jax.Array]:
        """Of both policies and of the dreams. The mean action has dreams, too."""
        if key is None:
            return None, None, key_of_step(step)
        act_key, shield_key = jax.random.split(key)
        backup_key, dream_key = jax.random.split(shield_key)
        return act_key, backup_key, dream_key

    def act(
        learned: Learned, carry: Memory, obs: Any, key: jax.Array | None
    ) -> tuple[jax.Array, Memory, dict[str, Any]]:
        act_key, backup_key, dream_key = keys_of(key, carry.step)
        if learned.config.shield == "none":
            return policy.act(learned, carry, obs, act_key)
        in_simulator = privileged(learned)
        proposed, after, said = policy.act(learned, carry, obs.obs if in_simulator else obs, act_key)
        if in_simulator:
            p = true_risk(env, learned, after.latent, proposed, obs, dream_key)
        else:
            p = risk(env, learned, after.latent, proposed, dream_key)
        overruled = overrules(p, learned.config)
        action = jnp.where(overruled, chosen(env, learned, "safe", after.latent, backup_key), proposed)
        said = {**said, "overruled": overruled, "risk": p}
        return action, after._replace(action=action), said

    return policy._replace(act=act, privileged=privileged)


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    policy = shielded(env, dreaming_policy(env, shielded_behaviour))
    learner = dreaming_learner(env, shielded_behaviour, policy, axis_name)
    counted = learner._replace(
        counted=lambda env, steps, cfg: {"violations": violated(env, steps, cfg)}
    )
    return off_policy(env, counted, axis_name=axis_name)


# ---- what is guaranteed ------------------------------------------------------------------------


def required_rollouts(eps: float, confidence: float, learned: bool = False) -> int:
    """The dreams after which an estimated probability is too low by `eps` at most, but for a
    probability of `confidence`. This is of one decision, and of the latent in which its dreams begin.

        m >= ln(1 / confidence) / (2 eps^2)

    Where too high an estimate counts, too, it takes those of `confidence / 2`.

    Args:
        learned: half of `eps` is left for the model, whose probabilities of the next state may be off
            by eps / T: the sum of their absolute differences, which is twice what many call total
            variation. m is 4 times as large.
    """
    share = 0.5 if learned else 1.0
    return math.ceil(math.log(1 / confidence) / (2 * (share * eps) ** 2))


def overruled_from(cfg: Any) -> int:
    """The least number of unsafe dreams where the shield acts; one more than all if it never does."""
    m = cfg.shield_rollouts
    decides = np.asarray(overrules(jnp.arange(m + 1) / m, cfg))
    return int(np.append(decides, True).argmax())


def check(cfg: Any, env: Env, data: Any = ()) -> None:
    """Raise ConfigError for unknown labels, and for a shield that would always act, or never."""
    check_cost_names("labels", cfg.labels, env)
    if cfg.shield == "none":
        return
    if cfg.shield == "dreams" and cfg.verdict == "summed" and cfg.discount > MOST_DISCOUNT:
        raise ConfigError(
            f"discount={float(cfg.discount):g}: expected at most {MOST_DISCOUNT:g}, as verdict=summed "
            "tells steps within shield_horizon by it"
        )
    least, delta, confidence = overruled_from(cfg), float(cfg.delta), float(cfg.confidence)
    if least > cfg.shield_rollouts:
        raise ConfigError(f"confidence={confidence:g}: expected less, or the shield never acts")
    if least == 0:
        expected = f"eps={float(cfg.eps):g}" if cfg.rule == "hoeffding" else acceptable(cfg)
        raise ConfigError(f"delta={delta:g}: expected at least {expected}, or the shield always acts")


def acceptable(cfg: Any) -> str:
    """The least delta, of two digits, with which a shield by the exact bound may rest, and the dreams
    that the present delta takes. Where no dream is unsafe it rests if  (1 - delta)^m <= confidence."""
    m, delta, confidence = cfg.shield_rollouts, float(cfg.delta), float(cfg.confidence)

    def rests(**settings: Any) -> bool:
        return overruled_from(dataclasses.replace(cfg, **settings)) > 0

    exact = -math.expm1(math.log(confidence) / m)
    unit = 10.0 ** (math.floor(math.log10(exact)) - 1)
    rounded = (float(f"{n * unit:.2g}") for n in itertools.count(math.ceil(exact / unit)))
    least = next(x for x in rounded if rests(delta=x))
    found = f"{least:g} with shield_rollouts={m}"
    few = math.ceil(math.log(confidence) / math.log1p(-delta)) if delta > 0 else MOST_ROLLOUTS + 1
    for more in range(few, MOST_ROLLOUTS + 1):
        if rests(shield_rollouts=more):
            return f"{found}, or shield_rollouts of at least {more}"
    return found


def note(cfg: Any) -> str:
    """What the shield guarantees with these settings, in one line; '' without one."""
    if cfg.shield == "none":
        return ""
    m, eps, confidence = cfg.shield_rollouts, float(cfg.eps), float(cfg.confidence)
    what = "dreams" if cfg.shield == "dreams" else "copies of the simulator"
    least = overruled_from(cfg)
    half = scipy.special.betaincinv(least, m - least + 1, 0.5)  # P(B >= least) is 1/2 there
    line = f"shield: overrules from {least} of {m} {what} with a violation"
    line += f" within {cfg.shield_horizon} steps, half the time where that has P = {half:.2g}"
    allowed = f"the policy act with probability {confidence:g} at most where P >= {float(cfg.delta):g}"
    exact = required_rollouts(eps, confidence)
    enough = "enough" if m >= exact else "too few"
    if cfg.shield == "true_dynamics":
        if cfg.rule == "binomial":
            return f"{line}; lets {allowed}"
        return f"{line}. To let {allowed} takes {exact} ({m} are {enough})"
    unknown = "; how wrong the learned model is, nobody knows"
    if cfg.verdict == "summed":
        unknown += "; and verdict=summed takes means for violations, for which none of this holds"
    if cfg.rule == "binomial":
        return f"{line}; lets {allowed}, if the model is exact{unknown}"
    off = required_rollouts(eps, confidence, learned=True)
    return (
        f"{line}. To let {allowed} takes {exact} with an exact model ({m} are {enough}), and {off} "
        f"with a model that is off by {eps:g} / {cfg.shield_horizon} a step at most{unknown}"
    )


# ---- evaluation --------------------------------------------------------------------------------


class Foreseen(NamedTuple):
    """T steps of an episode, [T] each: whether it still runs, p, whether the step had a violation, and
    whether the episode failed with it."""

    alive: jax.Array
    risk: jax.Array
    violation: jax.Array
    failed: jax.Array


def came_true(found: Foreseen, horizon: int) -> tuple[jax.Array, jax.Array]:
    """Of each step whether one of the next `horizon` steps had a violation, and whether that is known,
    bool [T] each. It is not where fewer than `horizon` steps were left of an episode that did not fail:
    to count those of them that had a violation would choose steps by what came."""

    def backward(
        later: tuple[jax.Array, jax.Array], x: tuple[jax.Array, ...]
    ) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        """Steps until the next violation, and until nothing more is known, this step included."""
        violation, failed, alive = x
        until = jnp.where(violation, 1, later[0] + 1)
        known = jnp.where(failed, horizon, jnp.where(alive, later[1] + 1, 0))
        return (until, known), (until, known)

    start = jnp.int32(horizon), jnp.int32(0)
    series = (found.violation, found.failed, found.alive)
    until, known = jax.lax.scan(backward, start, series, reverse=True)[1]
    return until <= horizon, found.alive & (known >= horizon)


def brier_score(found: Foreseen, horizon: int) -> jax.Array:
    """The mean of (p_t - e_t)^2 over steps of which e_t is known, float []; NaN if there are none.

    e_t is 1 if one of the next `horizon` steps had a violation, and 0 if none had.
    """
    happened, counts = came_true(found, horizon)
    total = jnp.where(counts, (found.risk - happened) ** 2, 0.0).sum()
    return jnp.where(counts.any(), total / jnp.maximum(counts.sum(), 1), jnp.nan)


def calibration(found: Foreseen, horizon: int) -> jax.Array:
    """Of the steps with p in each of `PARTS` equal parts of [0, 1], float [3, PARTS]: how many there
    are, the sum of their p, and how many had a violation within `horizon` steps.

    Only steps of which that is known count.
    """
    happened, counts = came_true(found, horizon)
    part = jnp.minimum((found.risk * PARTS).astype(int), PARTS - 1)
    summed = counts * jnp.stack([jnp.ones_like(found.risk), found.risk, 1.0 * happened])  # [3, T]
    return summed @ jax.nn.one_hot(part, PARTS)


def compared(found: Foreseen, horizon: int) -> tuple[jax.Array, jax.Array]:
    return brier_score(found, horizon), calibration(found, horizon)


def examine(algo: Algorithm, learned: PyTree, shielded: Course, play: Play, sampled: bool) -> Examined:
    """What the shield does in the `shielded` episodes, which the S policies in `learned` played with
    mean or with `sampled` actions; and what the same episodes are without it.

    The Brier score and the calibration are always of sampled actions without the shield: the shield
    dreams of those.
    """
    env, cfg = algo.task(jax.tree.map(lambda x: x[0], learned)), learned.config
    violations = violated(env, shielded, cfg) & shielded.alive
    counted = np.asarray(violations.sum(2), np.float32)
    if cfg.shield == "none":
        return Examined({"violations": counted})

    def unshielded(sampled: bool, **settings: Any) -> Course:
        other = dataclasses.replace(learned, config=dataclasses.replace(cfg, **settings))
        actions = "sampled" if sampled else "mean"
        return play(other, sampled, f"evaluating without the shield, {actions} actions")

    drawn = unshielded(True, delta=jnp.full_like(cfg.delta, jnp.inf))  # it dreams, and never acts
    bare = drawn if sampled else unshielded(False, shield="none")
    horizon, runs = cfg.shield_horizon, drawn.alive
    found = Foreseen(runs, drawn.said["risk"], violated(env, drawn, cfg) & runs, drawn.terminated)
    scores, parts = jax.jit(jax.vmap(jax.vmap(partial(compared, horizon=horizon))))(found)
    acts = (shielded.said["overruled"] & shielded.alive).sum(2)
    measures = {
        "override rate": acts / jnp.maximum(shielded.alive.sum(2), 1),
        "violations": counted,
        "violations, no shield": (violated(env, bare, cfg) & bare.alive).sum(2).astype(jnp.float32),
        "return, no shield": bare.reward.sum(2),
        "Brier score": scores,
    }
    return Examined({k: np.asarray(x) for k, x in measures.items()}, np.asarray(parts.sum(1)))


# ---- rows --------------------------------------------------------------------------------------

# sacktock/AMBS @5184901: its shield; and README, penalties and their weights
PAPER: dict[str, Any] = dreamer.AMBS | {
    "cost_discount": 0.997, "least_penalty_scale": 1.0, "rule": "hoeffding", "shield_rollouts": 512,
    "shield_horizon": 30, "shield_steps": 15, "delta": 0.1,
}  # fmt: skip
PENALTIES: dict[str, dict[str, Any]] = {
    "plpg": PAPER | {"penalty": "plpg", "penalty_coef": 0.8},
    "penl": PAPER | {"penalty": "penl", "penalty_coef": 1.0},
    "copt": PAPER | {"penalty": "copt", "penalty_coef": 1.0},
}
# for two cores, on which foresight takes too long
CPU: dict[str, Any] = dreamer.CPU_FORESIGHT | {
    "overshoot": 0, "shield_rollouts": 32, "model_lr": 1e-3, "lr": 5e-4, "critic_lr": 1e-3,
}  # fmt: skip

ROWS = {
    "ambs": Row(
        AMBSConfig,
        make,
        "Dreamer with a shield that dreams ahead, and a safe policy",
        PENALTIES
        | {"pixels": dreamer.PIXELS, "cpu": CPU, "true_dynamics": {"shield": "true_dynamics"}},
        total_steps=1_000_000,
        holds="nothing",
        check=check,
        note=note,
        examine=examine,
    ),
}
