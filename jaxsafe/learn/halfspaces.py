"""Small convex problems within K half-spaces, solved by trying every set of active ones.

    e_i.y + kappa_i <= 0,  |e_i| = 1

The functions take no vectors, only their cosines: gram_ij = e_i.e_j [K, K] and, with a unit vector e_g
to go along, rho_i = e_g.e_i [K]. There are 2^K sets, each with one K x K system. Rounding may break the
optimality conditions of all of them a little, so the set that breaks them least is taken.

Where two half-spaces are nearly opposed, within about 0.05 rad, `RIDGE` changes the solution itself:
it then weighs both violations instead of touching both planes.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

RIDGE = 1e-4  # added to the diagonal, for half-spaces that are parallel
FAR = 1e6  # larger |kappa| are cut to this
HIGHEST = jax.lax.Precision.HIGHEST


def solve_on_every_subset(gram: jax.Array, v: jax.Array) -> jax.Array:
    """The solution of gram x = v within each set of indices, 0 outside: float [2^K, K]."""
    active = np.array(list(itertools.product((False, True), repeat=len(v))))  # [2^K, K]
    within = jnp.where(active[:, :, None] & active[:, None, :], gram, 0.0)
    ridge = jnp.where(active, RIDGE, 1.0)[:, :, None] * jnp.eye(len(v))
    inverse, v = jnp.linalg.inv(within + ridge), jnp.where(active, v, 0.0)[..., None]
    x = product(inverse, v)
    return (x + product(inverse, v - product(within, x)))[..., 0]  # which takes the ridge out again


def argmin_finite(broken: jax.Array) -> jax.Array:
    """The index of the smallest entry; one that is not finite is larger than all."""
    return jnp.argmin(jnp.where(jnp.isfinite(broken), broken, jnp.inf))


def cosines(gram: jax.Array) -> jax.Array:
    """Cosines of K vectors, from their inner products [K, K]. A zero vector has cosine 0 with every
    other one."""
    size = jnp.sqrt(jnp.maximum(jnp.diag(gram), 1e-20))
    return jnp.fill_diagonal(gram / size / size[:, None], 1.0, inplace=False)


def dot(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.dot(a, b, precision=HIGHEST)


def product(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.matmul(a, b, precision=HIGHEST)


def nearest_point(gram: jax.Array, kappa: jax.Array) -> jax.Array:
    """beta >= 0, [K], with y = -sum_i beta_i e_i the point of the half-spaces nearest to the origin.

    Where they have no point in common, y is the one with the least squared distances to all.
    """
    kappa = jnp.clip(kappa, -FAR, FAR)
    beta = solve_on_every_subset(gram, kappa)
    beyond = kappa - dot(beta, gram)  # e_i.y + kappa_i
    return jnp.maximum(0.0, beta[argmin_finite(jnp.maximum(beyond, -beta).max(-1))])


def furthest_point(
    gram: jax.Array, rho: jax.Array, kappa: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The y within the half-spaces and |y| <= 1 that is furthest along e_g.

        y = alpha e_g - sum_i beta_i e_i

    Given the active set A, with C the gram matrix and all vectors on it, y lies on those planes, so

        alpha = sqrt((1 - kappa'C^-1 kappa) / (1 - rho'C^-1 rho)),   beta = C^-1 (kappa + alpha rho)

    and is the solution if beta >= 0 and y lies within the other half-spaces too.

    Returns:
        alpha: float [], > 0; beta: float [K], >= 0.
        found: bool [], whether there is such a point. If not, y lies in the direction of
            `nearest_point` as far as |y| <= 1 allows, and alpha is 0.
    """
    kappa = jnp.clip(kappa, -FAR, FAR)
    by_kappa, by_rho = solve_on_every_subset(gram, kappa), solve_on_every_subset(gram, rho)
    # the floors are those of one constraint, in `cpo.multipliers`
    apart = jnp.maximum(1 - dot(by_rho, rho), 1e-4)
    left = jnp.maximum(1 - dot(by_kappa, kappa), 0.0)
    alpha = jnp.maximum(jnp.sqrt(left / apart), 1e-6)  # [2^K]
    beta = by_kappa + alpha[:, None] * by_rho
    inside = dot(beta, gram)
    beyond = (alpha[:, None] * rho - inside + kappa).max(-1)
    outside = alpha**2 - 2 * alpha * dot(beta, rho) + (beta * inside).sum(-1) - 1
    negative = (-beta).max(-1) / jnp.maximum(alpha, 1.0)
    best = argmin_finite(jnp.maximum(jnp.maximum(beyond, outside), jnp.maximum(negative, 0.0)))

    back = nearest_point(gram, kappa)
    inside = dot(gram, back)
    length = jnp.sqrt(jnp.maximum(back @ inside, 0.0))
    found = (length < 1) & ((kappa - inside).max() < 1e-3)
    beta = jnp.where(found, jnp.maximum(0.0, beta[best]), back / jnp.maximum(length, 1.0))
    return jnp.where(found, alpha[best], 0.0), beta, found
