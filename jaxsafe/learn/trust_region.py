"""Trust-region steps, and what they share: Fisher products, conjugate gradients, a line search.

Vectors are flat, float [P]: the policy's parameters through `ravel_pytree`.
"""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jaxsafe.config import Bounds, Iterations, Weight, config
from jaxsafe.learn.batch import all_finite, pmean
from jaxsafe.learn.conventions import Convention
from jaxsafe.learn.steps import Context, Objective, PolicyStep, mean_kl, require_separate_trunk
from jaxsafe.nn.gaussian import Gaussian, kl
from jaxsafe.nn.networks import action_dist
from jaxsafe.types import Metrics, PyTree

Matvec = Callable[[jax.Array], jax.Array]


@config
class NaturalConfig:
    """For algorithms whose policy moves along natural gradients."""

    CONVENTIONS: ClassVar = (
        Convention(
            {"kl_per_action": True, "target_kl": 0.01},
            "the KL of the trust region, and H with it, is a mean over action dimensions",
            "it is their sum, with a bound for 2 dimensions; beside it our damping is half as large",
        ),
    )

    # delta, the KL of a step (nats). OmniSafe's 0.01 is a mean over the action's dimensions, of which
    # Point and Car have 2.
    target_kl: Annotated[float, Bounds(1e-9, 10)] = 0.02
    # Whether the KL is a mean over the action's dimensions, not their sum. OmniSafe's is.
    kl_per_action: bool = False
    # Added to the diagonal of the Fisher matrix, as in OmniSafe and safety-starter-agents.
    damping: Weight = 0.1
    cg_iterations: Iterations = 15  # Iterations of conjugate gradients, as in OmniSafe.


@config
class TrustRegionConfig(NaturalConfig):
    """For those that search the largest safe step along them."""

    line_search_tries: Iterations = 15  # Steps that the line search tries at most, as in OmniSafe.
    # Each step tried is this much of the one before, as in OmniSafe and safety-starter-agents.
    line_search_shrink: Annotated[float, Bounds(0.01, 0.99)] = 0.8


def fisher_product(
    dist: Callable[[jax.Array], Gaussian],
    params: jax.Array,
    old: Gaussian,
    cfg: Any,
    axis_name: str | None,
) -> Matvec:
    """v -> H v + damping v, with H the Hessian of E_s[KL(old || dist(params))] at `params`.

    The KL is summed over action dimensions, unless `cfg.kl_per_action`, and averaged over states and
    devices. Where `params` are the old policy's, H is the Fisher information. The gradient is
    linearised once for all v.
    """

    def divergence(params: jax.Array) -> jax.Array:
        return jnp.mean(kl(old, dist(params))) / dimensions(old, cfg)

    product = jax.linearize(jax.grad(divergence), params)[1]
    return lambda v: pmean(product(v), axis_name) + cfg.damping * v


def dimensions(dist: Gaussian, cfg: Any) -> int:
    """What a sum over the dimensions of an action is divided by: with `kl_per_action` it is a mean."""
    return dist.mean.shape[-1] if cfg.kl_per_action else 1


def distance(old: Gaussian, new: Gaussian, cfg: Any, axis_name: str | None) -> jax.Array:
    """KL(old || new), what `target_kl` bounds."""
    return mean_kl(old, new, axis_name) / dimensions(old, cfg)


class CG(NamedTuple):
    """The state of conjugate gradients: float [P], and the squared norm of the residual, float []."""

    x: jax.Array
    residual: jax.Array
    direction: jax.Array
    residual_sq: jax.Array


def conjugate_gradient(matvec: Matvec, b: jax.Array, iterations: int) -> tuple[jax.Array, jax.Array]:
    """Solve A x = b for a symmetric positive definite A: (x, ||b - A x|| / ||b||).

    A fixed number of iterations from x = 0, frozen once the residual is at float32's floor. The
    residual is the recursion's own; it is 0 for b = 0.

    Source: Hestenes and Stiefel (1952); Nocedal and Wright (2006), algorithm 5.2.
    """
    scale = jnp.linalg.norm(b)
    b = b / jnp.where(scale > 0, scale, 1.0)  # squares of small gradients would underflow

    def iterate(_: int, now: CG) -> CG:
        product = matvec(now.direction)
        curvature = now.direction @ product
        going = (now.residual_sq > 1e-14) & (curvature > 0)
        alpha = jnp.where(going, now.residual_sq / jnp.where(going, curvature, 1.0), 0.0)
        residual = now.residual - alpha * product
        residual_sq = residual @ residual
        beta = jnp.where(going, residual_sq / jnp.where(going, now.residual_sq, 1.0), 0.0)
        direction = jnp.where(going, residual + beta * now.direction, now.direction)
        return CG(now.x + alpha * now.direction, residual, direction, residual_sq)

    end = jax.lax.fori_loop(0, iterations, iterate, CG(jnp.zeros_like(b), b, b, b @ b))
    return scale * end.x, jnp.sqrt(end.residual_sq)


class Trial(NamedTuple):
    """Whether a step was accepted, bool [], and how many were tried before it, int32 []."""

    accepted: jax.Array
    tried: jax.Array


class Search(NamedTuple):
    """Where a line search ends: params [P], whether a step was accepted, bool [], and how many were
    tried before it, int32 []."""

    params: jax.Array
    accepted: jax.Array
    tried: jax.Array


def line_search(
    accept: Callable[[jax.Array], jax.Array],
    start: jax.Array,
    step: jax.Array,
    tries: int,
    shrink: float,
) -> Search:
    """The first of start + shrink^i step, i < tries, that `accept` takes; else `start`.

    Args:
        accept: params [P] -> bool []. Comparisons with NaN are False, so it should ask for what
            must hold rather than for what must not.
    """

    def candidate(i: jax.Array) -> jax.Array:
        return start + shrink ** i.astype(start.dtype) * step

    def attempt(now: Trial) -> Trial:
        ok = accept(candidate(now.tried))
        return Trial(ok, now.tried + jnp.where(ok, 0, 1))

    accepted, i = jax.lax.while_loop(
        lambda now: ~now.accepted & (now.tried < tries),
        attempt,
        Trial(jnp.bool_(False), jnp.int32(0)),
    )
    return Search(jnp.where(accepted, candidate(i), start), accepted, i)


def update_natural(
    actor: PyTree,
    opt_state: PyTree,
    objective: Objective,
    batch: Any,
    context: Context,
    search: bool,
) -> tuple[PyTree, PyTree, Metrics]:
    """theta + sqrt(2 delta / g'H^-1 g) H^-1 g, to where the quadratic model's KL is target_kl.

    With `search` the step is shortened until the objective does not fall and the KL itself is at
    most target_kl; else it is taken as it is.
    """
    cfg, axis_name = context.cfg, context.axis_name
    start, unravel = ravel_pytree(actor)

    def evaluate(params: jax.Array) -> tuple[jax.Array, jax.Array]:
        actor = unravel(params)
        gain = pmean(objective(actor, batch)[0], axis_name)
        return gain, distance(batch.old, action_dist(actor, batch.obs, cfg), cfg, axis_name)

    g = pmean(jax.grad(lambda params: objective(unravel(params), batch)[0])(start), axis_name)
    product = fisher_product(
        lambda params: action_dist(unravel(params), batch.obs, cfg), start, batch.old, cfg, axis_name
    )
    h_g, residual = conjugate_gradient(product, g, cfg.cg_iterations)
    step = jnp.sqrt(2 * cfg.target_kl / jnp.maximum(g @ h_g, 1e-20)) * h_g
    before, _ = evaluate(start)

    def accept(params: jax.Array) -> jax.Array:
        gain, divergence = evaluate(params)
        return (gain >= before) & (divergence <= cfg.target_kl) if search else jnp.isfinite(gain)

    tries, shrink = (cfg.line_search_tries, cfg.line_search_shrink) if search else (1, 1.0)
    found = line_search(accept, start, step, tries, shrink)
    after, divergence = evaluate(found.params)
    return (
        unravel(found.params),
        opt_state,
        {
            "train/kl": divergence,
            "train/objective": after - before,
            "train/accepted": found.accepted,
            "train/line_search": found.tried,
            "train/cg_residual_r": residual,
            "train/nonfinite": ~all_finite((g, step)),
        },
    )


def no_state(actor: PyTree, cfg: Any) -> tuple[()]:
    return ()


# Kakade (2001), "A Natural Policy Gradient", with the step's length from the trust region
natural_gradient = PolicyStep(
    init=no_state, update=partial(update_natural, search=False), check=require_separate_trunk
)
# Schulman et al. (2015), "Trust Region Policy Optimization", arXiv:1502.05477, appendix C
trust_region = PolicyStep(
    init=no_state, update=partial(update_natural, search=True), check=require_separate_trunk
)
