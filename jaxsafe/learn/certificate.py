"""Barrier certificates: sets of states that a policy never leaves, learned against the worst of them.

    h(s)    = softplus(f(s) - f(s_0)) + B(s) - 1,   C = {s: h(s) < 0}
    u(s, a) = max over models T of h(T(s, a))
    wanted:   h(s) < 0  =>  u(s, pi(s)) + eps <= 0

The environment gives B, which is at most 1 where a state is safe. So h < 0 means safe. Episodes begin
at s_0. If it is well within the safe set, h(s_0) = log 2 + B(s_0) - 1 < 0 whatever f is. If what is
wanted holds for all s in C, pi stays in C. So does any action with u(s, a) < 0.

Whether it holds is found out by many states that climb u within C, a Langevin walk each:

    density of s proportional to exp((u(s, pi(s)) + eps) / temperature)  within C, 0 outside of it

States that violate the condition are what h is trained on:

    minimise_f  mean over violating s of  u + eps - lam(s) h(s),   lam = |grad_s u| / |grad_s h|

The second term moves the border of C past s, or s within C to where u is least: it is the Lagrange
multiplier of the worst state under the constraint h(s) <= 0.

Source: Luo and Ma (2021), "Learning Barrier Certificates: Towards Safe Reinforcement Learning with Zero
Training-time Violations", arXiv:2108.01846, and the authors' code, roosephu/crabs @823da6c.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import optax

from jaxsafe.config import Amount, Bounds, ConfigError, Rate, Units, Weight, config
from jaxsafe.learn.batch import select
from jaxsafe.learn.models import FARTHEST
from jaxsafe.nn.critics import largest
from jaxsafe.nn.networks import MLP
from jaxsafe.types import Env, PyTree

OUTSIDE = 1000.0  # what a state outside of C is worse by than any within
ACCEPTED = 0.574  # the share of steps that a Langevin walk of the best size takes (Roberts, Rosenthal)
TAU, TAU_RATE = 0.01, 0.01  # of a walk: its first step size, and how fast that adapts
FIRST_BOX, GROWTH, BOX_POINTS, BOX_ROUNDS = 1e-3, 1.5, 4096, 100
EDGE = 1e-2  # of `interval_barrier`, as in the authors' code


@config
class CertificateConfig:
    """For algorithms with a barrier certificate."""

    barrier_hidden: tuple[Units, ...] = (64, 64)  # Units of f. The paper has 256 and 256.
    barrier_lr: Rate = 1e-3  # Adam's step of f. The paper has 3e-4.
    # The decay of weights, of f and of the policy in steps against violations, as in the paper's code.
    barrier_decay: Weight = 1e-4
    # The weight of mean (h - h_ref)+, which keeps C from shrinking; h_ref is of the last certificate.
    barrier_keep: Weight = 1e-3
    margin: Weight = 0.01  # eps, by which u has to be below 0. As in the paper's code.
    chains: Amount = 500  # States that look for violations. The paper has 10,000.
    temperature: Annotated[float, Bounds(1e-6, 1e6)] = 0.03  # Of their density, as in the paper's code.
    # Steps in search of a certificate, at most, at each refit. The paper's code has 20,000.
    barrier_steps: Annotated[int, Bounds(1, 2**24)] = 4000
    # Steps without a violation after which the states begin anew, all over C. The paper's code has
    # 1,000.
    quiet_steps: Annotated[int, Bounds(1, 2**24)] = 100
    # Steps without a violation from there on that make a certificate. The paper's code has 4,000.
    check_steps: Annotated[int, Bounds(1, 2**24)] = 400


def interval_barrier(x: jax.Array, bound: float) -> jax.Array:
    """0 at `x` = 0, 1 at +-`bound`, steep beyond: float like `x`.

    b = -log((1 + y + e) (1 - y + e) / (1 + e)^2) / b_max,   y = x / bound,   for |y| < 1
    b = 1 + 2 (|y| - 1) / (e (2 + e))                                         for |y| >= 1
    """
    y = jnp.abs(x) / bound
    most = -math.log(EDGE * (2 + EDGE) / (1 + EDGE) ** 2)
    within = jnp.minimum(y, 1.0)
    log = -jnp.log((1 + within + EDGE) * (1 - within + EDGE) / (1 + EDGE) ** 2)
    return jnp.where(y < 1, log / most, 1 + 2 / (EDGE * (2 + EDGE)) * (y - 1))


def safe_set(env: Env) -> Callable[[jax.Array], jax.Array]:
    """B of an environment: (obs [..., O]) -> [...].

    Raises:
        ConfigError: the environment does not say.
    """
    barrier = getattr(env, "barrier", None)
    if barrier is None:
        raise ConfigError(
            "this algorithm needs an environment that says which observations are safe, by a method "
            "`barrier(obs)`; env=pendulum_upright does"
        )
    return barrier


# ---- the certificate ---------------------------------------------------------------------------


@flax.struct.dataclass
class Core:
    """What a certificate is about: f, the policy and the models of the environment."""

    barrier: PyTree
    actor: PyTree
    model: PyTree


class System(NamedTuple):
    """What the parts of a `Core` mean.

    safe(obs [..., O]) -> [...]: B. start: float [O], s_0.
    act(actor, obs [..., O], cfg) -> action [..., A], the mean one.
    foresee(model, obs [..., O], action [..., A], cfg) -> [M, ..., O], where each model says it leads.
    """

    safe: Callable[[jax.Array], jax.Array]
    start: jax.Array
    act: Callable[[PyTree, jax.Array, Any], jax.Array]
    foresee: Callable[[PyTree, jax.Array, jax.Array, Any], jax.Array]

    def h(self, barrier: PyTree, obs: jax.Array, cfg: Any) -> jax.Array:
        """h, float [...], for `obs` [..., O]."""
        net = barrier_net(cfg)
        f: Any = net.apply(barrier, obs)
        first: Any = net.apply(barrier, self.start)
        return jax.nn.softplus(f - first)[..., 0] + self.safe(obs) - 1

    def u(self, core: Core, obs: jax.Array, action: jax.Array, cfg: Any) -> jax.Array:
        """u, float [...], for `obs` [..., O] and `action` [..., A]."""
        h = self.h(core.barrier, self.foresee(core.model, obs, action, cfg), cfg)
        return largest(h)

    def judge(self, core: Core, obs: jax.Array, cfg: Any) -> tuple[jax.Array, jax.Array]:
        """h and u + eps of the policy at `obs` [..., O], float [...] each."""
        worst = self.u(core, obs, self.act(core.actor, obs, cfg), cfg)
        return self.h(core.barrier, obs, cfg), worst + cfg.margin


def barrier_net(cfg: Any) -> MLP:
    return MLP(cfg.barrier_hidden, 1, "torch", "relu", precision=jax.lax.Precision.DEFAULT)


def init_barrier(key: jax.Array, obs_size: int, cfg: Any) -> PyTree:
    return barrier_net(cfg).init(key, jnp.zeros(obs_size))


def violating(h: jax.Array, u: jax.Array) -> jax.Array:
    """Where the condition does not hold, for h and u + eps."""
    return (h < 0) & (u > 0)


def guarded(
    system: System, core: Core, obs: jax.Array, candidates: jax.Array, cfg: Any
) -> tuple[jax.Array, jax.Array]:
    """The first of `candidates` [C, ..., A] with u(s, a) <= 0, else the certified policy's action:
    action [..., A], and whether it had to be that one, bool [...]."""
    every = jnp.broadcast_to(obs, (*candidates.shape[:-1], obs.shape[-1]))
    allowed = system.u(core, every, candidates, cfg) <= 0
    first = jnp.argmax(allowed, axis=0)
    chosen = jnp.take_along_axis(candidates, first[None, ..., None], axis=0)[0]
    overruled = ~allowed.any(0)
    return jnp.where(overruled[..., None], system.act(core.actor, obs, cfg), chosen), overruled


# ---- the search for violations -----------------------------------------------------------------


class Box(NamedTuple):
    """Where walks begin: float [O] each."""

    centre: jax.Array
    half: jax.Array


@flax.struct.dataclass
class Search:
    """States that climb u: `box.centre + box.half * z`.

    z: float [chains, O]. tau: float [chains], their step sizes. key: uint32, the data of a random key,
    the same on all devices.
    """

    z: jax.Array
    tau: jax.Array
    box: Box
    key: jax.Array

    @property
    def obs(self) -> jax.Array:
        return self.box.centre + self.box.half * self.z


def begun(system: System, barrier: PyTree, key: jax.Array, cfg: Any) -> Search:
    """Walks that begin anywhere in a box around C, and one at s_0, which is always in C. Those that
    begin outside of C jump until they are in it: see `walk`."""
    box_key, z_key, key = jax.random.split(key, 3)
    box = box_around(system, barrier, box_key, cfg)
    z = jax.random.uniform(z_key, (cfg.chains, len(system.start)), minval=-1.0, maxval=1.0)
    z = z.at[0].set((system.start - box.centre) / box.half)
    return Search(z, jnp.full(cfg.chains, TAU), box, jax.random.key_data(key))


def box_around(system: System, barrier: PyTree, key: jax.Array, cfg: Any) -> Box:
    """A box half as large again as the part of C that is found, from s_0 outwards, up to the farthest
    that models predict: C may have no bounds before f is trained."""

    def boxed(low: jax.Array, high: jax.Array) -> Box:
        return Box((low + high) / 2, (high - low) / 2 * GROWTH)

    def grow(now: tuple) -> tuple:
        low, high, count, _ = now
        box = boxed(low, high)
        z = jax.random.uniform(
            jax.random.fold_in(key, count), (BOX_POINTS, len(low)), minval=-1.0, maxval=1.0
        )
        s = jnp.clip(box.centre + box.half * z, -FARTHEST, FARTHEST)
        inside = (system.h(barrier, s, cfg) < 0)[:, None]
        lower = jnp.minimum(low, jnp.where(inside, s, low).min(0))
        higher = jnp.maximum(high, jnp.where(inside, s, high).max(0))
        return lower, higher, count + 1, ((lower < low) | (higher > high)).any()

    low, high = system.start - FIRST_BOX, system.start + FIRST_BOX
    low, high, _, _ = jax.lax.while_loop(
        lambda now: now[3] & (now[2] < BOX_ROUNDS), grow, (low, high, jnp.int32(0), jnp.bool_(True))
    )
    return boxed(low, high)


def volume(system: System, barrier: PyTree, search: Search, cfg: Any) -> jax.Array:
    """The volume of C, float [], by points drawn in the box."""
    key = jax.random.wrap_key_data(search.key)
    z = jax.random.uniform(key, (BOX_POINTS, len(search.box.half)), minval=-1.0, maxval=1.0)
    inside = system.h(barrier, search.box.centre + search.box.half * z, cfg) < 0
    return inside.mean() * (2 * search.box.half).prod()


def walk(system: System, core: Core, search: Search, cfg: Any) -> Search:
    """One step of each walk: Langevin's, Metropolis-adjusted. A state outside of C jumps into it: to
    anywhere in the box or, where C is thin, near to a state in C.

    The drift of a step is at most 1 in each direction, in units of the box.
    """
    key, noise_key, jump_key, take_key = jax.random.split(jax.random.wrap_key_data(search.key), 4)
    box, z, tau = search.box, search.z, search.tau

    def height(z: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        h, u = system.judge(core, box.centre + box.half * z, cfg)
        f = jnp.where(h < 0, u, -h - OUTSIDE) / cfg.temperature
        return f.sum(), (f, h < 0)

    def drift(slope: jax.Array) -> jax.Array:
        return jnp.clip(tau[:, None] * slope, -1.0, 1.0)

    climb = jax.grad(height, has_aux=True)
    slope, (f, inside) = climb(z)
    noise = jax.random.normal(noise_key, z.shape)
    stepped = z + drift(slope) + jnp.sqrt(2 * tau)[:, None] * noise
    far_key, coin_key, other_key = jax.random.split(jump_key, 3)
    far = jax.random.uniform(far_key, z.shape, minval=-1.0, maxval=1.0)
    chosen = jax.random.randint(other_key, tau.shape, 0, jnp.maximum(inside.sum(), 1))
    other = jnp.argsort(~inside)[chosen]  # any of those in C
    near = z[other] + jnp.sqrt(2 * tau[other])[:, None] * noise
    jumped = jnp.where(jax.random.bernoulli(coin_key, shape=(len(z), 1)), far, near)
    new = jnp.where(inside[:, None], stepped, jumped)
    new_slope, (new_f, new_inside) = climb(new)
    forth = -(noise**2).sum(-1) / 2
    back = -((z - new - drift(new_slope)) ** 2).sum(-1) / (4 * tau)
    ratio = jnp.exp(jnp.minimum(new_f + back - f - forth, 0.0))
    ratio = jnp.where(inside, jnp.where(new_inside, ratio, 0.0), 1.0)
    taken = (jax.random.uniform(take_key, ratio.shape) < ratio) & new_inside
    adapted = tau * (1 + TAU_RATE * (ratio - ACCEPTED))
    return dataclasses.replace(
        search,
        z=jnp.where(taken[:, None], new, z),
        tau=jnp.where(inside, adapted, tau),
        key=jax.random.key_data(key),
    )


# ---- training ----------------------------------------------------------------------------------


def decayed_adam(lr: jax.Array | float, decay: jax.Array | float) -> optax.GradientTransformation:
    """Adam on the gradient of the loss and decay / 2 |theta|^2, as PyTorch's `weight_decay`."""
    return optax.chain(optax.add_decayed_weights(decay), optax.adam(lr))


class Hunt(NamedTuple):
    """The search for a certificate so far.

    clean: int32 [], steps since the last violation, or since the states began anew.
    violations: int32 [], steps with any.
    checking: bool [], whether the states have begun anew since the last violation.
    """

    barrier: PyTree
    opt_state: PyTree
    search: Search
    steps: jax.Array
    clean: jax.Array
    violations: jax.Array
    checking: jax.Array

    def passed(self, cfg: Any) -> jax.Array:
        return self.checking & (self.clean >= cfg.check_steps)


class Found(NamedTuple):
    """What a search for a certificate came to. certified: bool [], it is one. at_once: bool [], without
    any violation."""

    barrier: PyTree
    opt_state: PyTree
    search: Search
    certified: jax.Array
    at_once: jax.Array
    steps: jax.Array


def barrier_loss(
    system: System, core: Core, obs: jax.Array, reference: PyTree, keep: jax.Array | float, cfg: Any
) -> tuple[Callable[[PyTree], jax.Array], jax.Array]:
    """The loss of f over states [B, O], and where they violate the condition, bool [B].

    Args:
        reference: f of the last certificate. keep: the weight of mean (h - h_ref)+.
    """

    def both(obs: jax.Array) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        h, u = system.judge(core, obs, cfg)
        return (h.sum(), u.sum()), (h, u)

    _, back, (h, u) = jax.vjp(both, obs, has_aux=True)
    one, zero = jnp.ones(()), jnp.zeros(())
    slope_h, slope_u = back((one, zero))[0], back((zero, one))[0]
    lam = jnp.linalg.norm(slope_u, axis=-1) / jnp.maximum(jnp.linalg.norm(slope_h, axis=-1), 1e-6)
    counts = violating(h, u)
    h_ref = system.h(reference, obs, cfg)

    def loss(barrier: PyTree) -> jax.Array:
        h, u = system.judge(dataclasses.replace(core, barrier=barrier), obs, cfg)
        worst = jnp.where(counts, u - lam * h, 0.0).sum() / jnp.maximum(counts.sum(), 1)
        return worst + keep * jax.nn.relu(h - h_ref).mean()

    return loss, counts


def certify(
    system: System,
    core: Core,
    reference: PyTree,
    keep: jax.Array | float,
    opt_state: PyTree,
    search: Search,
    cfg: Any,
) -> Found:
    """Train f until no violation is found, or for `barrier_steps` steps.

    After `quiet_steps` steps without one the search begins anew, all over C. If `check_steps` more find
    none, f makes a certificate.
    """
    optimiser = decayed_adam(cfg.barrier_lr, cfg.barrier_decay)

    def step(now: Hunt) -> Hunt:
        at = dataclasses.replace(core, barrier=now.barrier)
        search = walk(system, at, now.search, cfg)
        loss, counts = barrier_loss(system, at, search.obs, reference, keep, cfg)
        change, opt_state = optimiser.update(jax.grad(loss)(now.barrier), now.opt_state, now.barrier)
        moved = (optax.apply_updates(now.barrier, change), opt_state)
        any_found = counts.any()
        return Hunt(
            *select(any_found, moved, (now.barrier, now.opt_state)),
            search=search,
            steps=now.steps + 1,
            clean=jnp.where(any_found, 0, now.clean + 1),
            violations=now.violations + any_found,
            checking=now.checking & ~any_found,
        )

    def goes_on(now: Hunt) -> jax.Array:
        return (now.steps < cfg.barrier_steps) & ~now.passed(cfg)

    def phase(now: Hunt) -> Hunt:
        """Train until it is quiet; or, once it is, begin anew and go on until a violation."""
        quiet = now.clean >= cfg.quiet_steps
        key = jax.random.wrap_key_data(now.search.key)
        anew = select(quiet, begun(system, now.barrier, key, cfg), now.search)
        now = now._replace(search=anew, clean=jnp.where(quiet, 0, now.clean), checking=quiet)
        return jax.lax.while_loop(
            lambda x: goes_on(x) & jnp.where(quiet, x.checking, x.clean < cfg.quiet_steps), step, now
        )

    none, no = jnp.int32(0), jnp.bool_(False)
    start = Hunt(core.barrier, opt_state, search, none, none, none, no)
    end = jax.lax.while_loop(goes_on, phase, start)
    certified = end.passed(cfg)
    return Found(end.barrier, end.opt_state, end.search, certified, end.violations == 0, end.steps)
