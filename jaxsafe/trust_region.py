"""What trust-region steps share: Fisher products, conjugate gradients, a line search.

Vectors are flat, float [P]: the policy's parameters through `ravel_pytree`.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxsafe.batch import pmean
from jaxsafe.gaussian import Gaussian, kl

Matvec = Callable[[jax.Array], jax.Array]


def fisher_product(
    dist: Callable[[jax.Array], Gaussian],
    params: jax.Array,
    old: Gaussian,
    damping: jax.Array | float,
    axis_name: str | None,
) -> Matvec:
    """v -> H v + damping v, with H the Hessian of E_s[KL(old || dist(params))] at `params`.

    The KL is summed over action dimensions and averaged over states and devices. Where `params`
    are the old policy's, H is the Fisher information. The gradient is linearised once for all v.
    """

    def divergence(params: jax.Array) -> jax.Array:
        return jnp.mean(kl(old, dist(params)))

    product = jax.linearize(jax.grad(divergence), params)[1]
    return lambda v: pmean(product(v), axis_name) + damping * v


def conjugate_gradient(matvec: Matvec, b: jax.Array, iterations: int) -> tuple[jax.Array, jax.Array]:
    """Solve A x = b for a symmetric positive definite A: (x, ||b - A x|| / ||b||).

    A fixed number of iterations from x = 0, frozen once the residual is at float32's floor. The
    residual is the recursion's own; it is 0 for b = 0.

    Source: Hestenes and Stiefel (1952); Nocedal and Wright (2006), algorithm 5.2.
    """
    scale = jnp.linalg.norm(b)
    b = b / jnp.where(scale > 0, scale, 1.0)  # squares of small gradients would underflow

    def iterate(_: int, carry: Any) -> Any:
        x, r, p, rr = carry
        a_p = matvec(p)
        curvature = p @ a_p
        going = (rr > 1e-14) & (curvature > 0)
        alpha = jnp.where(going, rr / jnp.where(going, curvature, 1.0), 0.0)
        r_new = r - alpha * a_p
        rr_new = r_new @ r_new
        beta = jnp.where(going, rr_new / jnp.where(going, rr, 1.0), 0.0)
        return x + alpha * p, r_new, jnp.where(going, r_new + beta * p, p), rr_new

    x, _, _, rr = jax.lax.fori_loop(0, iterations, iterate, (jnp.zeros_like(b), b, b, b @ b))
    return scale * x, jnp.sqrt(rr)


def line_search(
    accept: Callable[[jax.Array], jax.Array],
    start: jax.Array,
    step: jax.Array,
    tries: int,
    shrink: float,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The first of start + shrink^i step, i < tries, that `accept` takes; else `start`.

    Args:
        accept: params [P] -> bool []. Comparisons with NaN are False, so it should ask for what
            must hold rather than for what must not.
    Returns:
        params [P], accepted (bool []), and i (int32 [], `tries` if there is none).
    """

    def candidate(i: jax.Array) -> jax.Array:
        return start + shrink ** i.astype(start.dtype) * step

    accepted, i = jax.lax.while_loop(
        lambda carry: ~carry[0] & (carry[1] < tries),
        lambda carry: (ok := accept(candidate(carry[1])), carry[1] + jnp.where(ok, 0, 1)),
        (jnp.bool_(False), jnp.int32(0)),
    )
    return jnp.where(accepted, candidate(i), start), accepted, i
