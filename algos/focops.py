"""FOCOPS: a surrogate of its own with PPO-Lagrangian's price on cost."""

from typing import Annotated, ClassVar

from jaxsafe.algos import pg
from jaxsafe.config import Bounds, Cap, Weight, config
from jaxsafe.learn.conventions import Convention
from jaxsafe.learn.on_policy import on_policy, presets
from jaxsafe.learn.row import Row
from jaxsafe.learn.steps import adam_epochs
from jaxsafe.learn.surrogates import near_old
from jaxsafe.learn.treatments import LagrangianConfig, lagrangian
from jaxsafe.types import Algorithm, Env


@config
class FOCOPSConfig(LagrangianConfig, pg.PGConfig):
    """FOCOPS: first-order constrained optimisation in policy space.

        maximise_theta  E[1{KL <= eta} (w A / temperature - KL)],  A = (A_r - lam A_c) / (1 + lam)
        minimise_lam    -lam (J_c - cost_limit),  0 <= lam <= lam_max,  by Adam

    An iteration first moves the price lam, and then the policy. KL is KL(new || old) of each state, and
    eta is `near_kl`. States whose KL is already above eta do not move the policy any further.

    Source: Zhang, Vuong and Ross (2020), "First Order Constrained Optimization in Policy Space",
    arXiv:2002.06506, equation 11 and algorithm 1.
    Differs from it: Adam moves lam, and the advantage is scaled by 1 / (1 + lam), as in OmniSafe.
    lam_max is ten times the paper's, which does not hold the limit. The indicator 1{} is per state, as
    in the paper. OmniSafe multiplies the mean of the minibatch by it (`per_state=False`).
    """

    SUITS: ClassVar = {"frequent": ("hopper_velocity",)}  # docs/results/velocity
    CONVENTIONS: ClassVar = (
        Convention(
            {"per_state": False},
            "the share of states within near_kl multiplies the minibatch's mean gain",
            "each state's indicator multiplies its own gain, as in the paper",
        ),
    )

    # Advantages are divided by it (lambda of the paper), as in OmniSafe: higher keeps closer to the
    # old policy.
    temperature: Annotated[float, Bounds(1e-6, 1e6)] = 1.5
    near_kl: Weight = 0.02  # eta: states whose KL is above this (nats) do not count, as in OmniSafe.
    # Whether the KL of a state gates its own gain. In OmniSafe the share of near states multiplies
    # the mean gain.
    per_state: bool = True
    # The highest price, nu_max of the paper. With 2, as there and in OmniSafe, episodes of Goal and
    # Button cost 31 to 56 at a limit of 25.
    lam_max: Cap = 20.0


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy(env, lagrangian, near_old, adam_epochs, axis_name)


ROWS = {
    "focops": Row(
        FOCOPSConfig,
        make,
        "first-order steps near the optimal policy of a constrained problem",
        presets(pg.PUBLISHED | pg.OFTEN | {"dual_lr": 0.035, "lam_max": 2.0}),
        omnisafe="FOCOPS",
        lever=pg.LEVER,
    ),
}
