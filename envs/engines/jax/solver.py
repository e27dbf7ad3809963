"""MuJoCo's Newton solver for engine `jax`.

    minimise_x  (x - x0)' M (x - x0) / 2 + sum_r s_r(J_r x - aref_r)

x: accelerations, x0: those without constraints, s_r: the cost of row r, convex and quadratic in pieces.
An iteration solves H d = -g with the gradient g and the Hessian H = M + J' diag(s'') J, and goes along
d to where the slope vanishes. It ends where g' H^-1 g is small: what the step has gained or, if it
stayed on a piece of the cost, what the next one would gain.

The force -s_r' is that of a spring, cut off at its bounds: none of an equality, the loss of dry
friction, 0 of what only pushes.

Why not MJX's own solver: it evaluates 150 points on every line, however soon the minimum is found. It
goes by the cost. Where the cost is large, its differences are rounding in float32, so that it stops now
and then with accelerations that are wrong by 0.1%. And all its worlds go on until the last one is done.

Source: Todorov (2014), "Convex and analytically-invertible dynamics with contacts and constraints",
and MuJoCo's documentation, Computation.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from jaxsafe.envs.engines.batching import batched

TRIALS = 6  # of a step along a line; most take two, and none of 1,900 more than six
FEW = 8  # one in so many worlds: when fewer are left, they go on alone
ROUNDING = 8 * np.finfo(np.float32).eps  # of a sum, relative to its largest terms


class Problem(NamedTuple):
    """What is minimised in a world with N degrees of freedom and R rows."""

    J: jax.Array  # [R, N]
    D: jax.Array  # [R], stiffness of the rows
    aref: jax.Array  # [R]
    M: jax.Array  # [N, N]
    smooth: jax.Array  # [N], M x0
    guess: jax.Array  # [N]


class Rows(NamedTuple):
    """What is the same in all worlds: bounds of the rows' forces [R], and MuJoCo's options."""

    least: np.ndarray
    most: np.ndarray
    tolerance: float
    ls_tolerance: float
    iterations: int
    trials: int  # of a step along a line

    def pull(self, D: jax.Array, residual: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Forces -s' and curvatures s''."""
        spring = -D * residual
        bends = (self.least < spring) & (spring < self.most)
        return jnp.clip(spring, self.least, self.most), jnp.where(bends, D, 0.0)


class Point(NamedTuple):
    """Where the solver is."""

    x: jax.Array  # [N]
    inertial: jax.Array  # M (x - x0) [N]
    residual: jax.Array  # J x - aref [R]
    force: jax.Array  # [R]
    curvature: jax.Array  # [R]
    gradient: jax.Array  # M (x - x0) - J' force [N]
    iterations: jax.Array  # int []
    done: jax.Array  # bool []


def solve(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`data` with its accelerations, the rows' forces, and what these do to the degrees of freedom."""
    impl: Any = data._impl
    M = mjx.full_m(model, data) if mjx.is_sparse(model) else impl.M
    problem = Problem(impl.efc_J, impl.efc_D, impl.efc_aref, M, data.qfrc_smooth, data.qacc_warmstart)
    end = batched(partial(minimise, rows(model, data)))(problem)
    return data.replace(
        qacc=end.x, qfrc_constraint=end.inertial - end.gradient, _impl=impl.replace(efc_force=end.force)
    )


def rows(model: mjx.Model, data: mjx.Data) -> Rows:
    """Equalities come first, then dry friction, then what only pushes: limits and contacts."""
    impl: Any = data._impl
    equal, pushes = impl.ne, impl.ne + impl.nf
    least, most = np.zeros(impl.nefc, np.float32), np.full(impl.nefc, np.inf, np.float32)
    losses = np.concatenate([model.dof_frictionloss, model.tendon_frictionloss])
    most[equal:pushes] = losses[losses > 0][: impl.nf]
    least[:pushes] = -most[:pushes]
    opt = model.opt
    # where a linear piece ends the slope jumps, and only halving finds that
    trials = opt.ls_iterations if impl.nf else TRIALS
    tolerances = float(opt.tolerance), float(opt.ls_tolerance)
    return Rows(least, most, *tolerances, opt.iterations, int(trials))


@jax.default_matmul_precision("highest")
def minimise(rows: Rows, problem: Problem) -> Point:
    """Where the solver ends in each world of a batch."""
    improved = jax.vmap(partial(improve, rows))
    few = len(problem.D) // FEW
    at = jax.vmap(partial(start, rows))(problem)
    at = jax.lax.while_loop(lambda at: (~at.done).sum() > few, partial(improved, problem), at)
    if few:
        left = jnp.argsort(at.done)[:few]
        problem, last = jax.tree.map(lambda x: x[left], (problem, at))
        last = jax.lax.while_loop(lambda at: ~at.done.all(), partial(improved, problem), last)
        at = jax.tree.map(lambda x, y: x.at[left].set(y), at, last)
    return at


def start(rows: Rows, problem: Problem) -> Point:
    x, J = problem.guess, problem.J
    inertial, residual = problem.M @ x - problem.smooth, J @ x - problem.aref
    force, curvature = rows.pull(problem.D, residual)
    gradient = inertial - J.T @ force
    return Point(x, inertial, residual, force, curvature, gradient, jnp.int32(0), jnp.bool(False))


def improve(rows: Rows, problem: Problem, at: Point) -> Point:
    """An iteration, unless `at` is done."""
    J, M = problem.J, problem.M
    H = M + (J.T * at.curvature) @ J
    d = -jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(H), at.gradient)
    Md, slope = M @ d, J @ d
    alpha = step(rows, problem, at, d, Md, slope)
    inertial, residual = at.inertial + alpha * Md, at.residual + alpha * slope
    force, curvature = rows.pull(problem.D, residual)
    gradient = inertial - J.T @ force
    # on one piece of the cost the gradient is now 1 - alpha of what it was; else there is more to gain
    # (both linear pieces of dry friction have no curvature)
    same = (curvature == at.curvature) & ((curvature > 0) | (force == at.force))
    left = jnp.where(same.all(), (1 - alpha) ** 2, 1.0)
    gain = -at.gradient.dot(d) / (2 * jnp.trace(M)) * left
    count = at.iterations + 1
    done = ~(gain >= rows.tolerance) | (alpha < ROUNDING) | (count >= rows.iterations)  # also NaN
    after = Point(at.x + alpha * d, inertial, residual, force, curvature, gradient, count, done)
    lost = (at.iterations > 0) & ~jnp.isfinite(d).all()  # then the last point is as good as it gets
    at = at._replace(done=at.done | lost)
    return jax.tree.map(lambda old, new: jnp.where(at.done, old, new), at, after)


def step(
    rows: Rows, problem: Problem, at: Point, d: jax.Array, Md: jax.Array, slope: jax.Array
) -> jax.Array:
    """How far to go along d: to where the cost stops to fall, by Newton's method kept within bounds."""
    rise0, bent0 = d.dot(at.inertial), d.dot(Md)
    flat = rows.tolerance * rows.ls_tolerance * jnp.linalg.norm(d) * jnp.trace(problem.M)

    def trial(_: Any, now: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        low, high, alpha, found = now
        force, curvature = rows.pull(problem.D, at.residual + alpha * slope)
        rise = rise0 + alpha * bent0 - force.dot(slope)
        bent = bent0 + curvature.dot(slope**2)
        rounding = ROUNDING * (jnp.abs(rise0) + alpha * bent0 + jnp.abs(force * slope).sum())
        newton = alpha - rise / bent
        found |= ~(jnp.abs(rise) > jnp.maximum(flat, rounding)) | (newton == alpha)
        low, high = jnp.where(rise < 0, alpha, low), jnp.where(rise < 0, high, alpha)
        inside = (low < newton) & (newton < high)
        alpha = jnp.where(found, alpha, jnp.where(inside, newton, (low + high) / 2))
        return low, high, alpha, found

    first = jnp.zeros(()), jnp.array(jnp.inf), jnp.ones(()), jnp.bool(False)
    # fifty without a loop took half a minute to compile
    return jax.lax.fori_loop(0, rows.trials, trial, first, unroll=min(rows.trials, TRIALS))[2]
