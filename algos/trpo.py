"""TRPO, and TRPO with each treatment of the constraint and each augmentation of the task."""

from functools import partial
from typing import Any, ClassVar

from jaxsafe.algos import npg, ppo
from jaxsafe.config import config
from jaxsafe.learn.augment import (
    OMNISAFE_SAUTE,
    OMNISAFE_SIMMER,
    Augmentation,
    EarlyConfig,
    SauteConfig,
    SimmerConfig,
    early,
    no_augmentation,
    saute,
    schedule,
    simmer,
)
from jaxsafe.learn.on_policy import EARLY_PRICE, OnPolicyConfig, on_policy, presets
from jaxsafe.learn.row import Row
from jaxsafe.learn.surrogates import plain
from jaxsafe.learn.treatments import (
    LagrangianConfig,
    PIDConfig,
    SwitchConfig,
    Treatment,
    lagrangian,
    no_treatment,
    pid,
    switch,
)
from jaxsafe.learn.trust_region import TrustRegionConfig, trust_region
from jaxsafe.types import Algorithm, Env


@config
class TRPOConfig(TrustRegionConfig, OnPolicyConfig):
    """TRPO: trust-region policy optimisation, blind to cost.

        maximise_theta  E[w A]   subject to   KL(old || new) <= delta

    Source: Schulman et al. (2015), "Trust Region Policy Optimization", arXiv:1502.05477.
    """


@config
class TRPOLagConfig(LagrangianConfig, TRPOConfig):
    """TRPO-Lagrangian: TRPO whose advantage pays for cost at an adaptive price.

        maximise_theta  E[w A]   subject to   KL(old || new) <= delta,   A = (A_r - lam A_c) / (1 + lam)
        minimise_lam    -lam (J_c - cost_limit),  lam >= 0,  by Adam

    An iteration first moves the price lam, and then the policy.

    Source: Ray, Achiam and Amodei (2019), "Benchmarking Safe Exploration in Deep Reinforcement
    Learning".
    Differs from it as PPO-Lagrangian does.
    """

    SUITS: ClassVar = {"early_price": ("swimmer_velocity",)}  # docs/results/velocity_settings


@config
class TRPOPIDConfig(PIDConfig, TRPOConfig):
    """TRPO-PID: TRPO whose price on cost is the output of a PID controller.

        maximise_theta  E[w A]   subject to   KL(old || new) <= delta,   A = (A_r - lam A_c) / (1 + lam)
        lam <- (K_p P + I + K_d D)+, as in CPPO-PID

    Source: Stooke, Achiam and Abbeel (2020), "Responsive Safety in Reinforcement Learning by PID
    Lagrangian Methods", arXiv:2007.03964, whose policy steps are PPO's.
    """


@config
class CRPOConfig(SwitchConfig, TRPOConfig):
    """CRPO: TRPO on the reward while the cost is near its limit, on the cost while it is beyond.

        maximise_theta  E[w A]   subject to   KL(old || new) <= delta
        A = A_r if J_c <= cost_limit + tolerance, else -A_c

    Source: Xu, Liang and Lan (2021), "CRPO: A New Approach for Safe Reinforcement Learning with
    Convergence Guarantee", arXiv:2011.05869, algorithm 1.
    Differs from it: the steps are TRPO's, as in OmniSafe's OnCRPO. The paper's are natural gradients.
    """


@config
class TRPOSauteConfig(SauteConfig, TRPOConfig):
    """TRPO-Saute: TRPO that sees what is left of its budget on cost, and earns while there is some.

        z_0 = 1,   z_{t+1} = (z_t - c_t / B) / gamma_n,   B = cost_limit mean_{t<T} gamma_n^t
        maximise_theta  E[w A]   subject to   KL(old || new) <= delta,  A of r_t if z_{t+1} > 0, else n

    Source: Sootla et al. (2022), "Saute RL: Almost Surely Safe Reinforcement Learning Using State
    Augmentation", arXiv:2202.06558.
    Differs from it as PPO-Saute does.
    """


@config
class TRPOSimmerPIDConfig(SimmerConfig, TRPOConfig):
    """TRPO-Simmer: TRPO-Saute whose episodes start with a part of the budget that a controller raises.

        z_0 = B / cost_limit, then z, the reward and the step as in TRPO-Saute
        B = clip(d + u, 0, cost_limit), as in PPO-Simmer

    Source: Sootla et al. (2022), "Effects of Safety State Augmentation on Safe Exploration",
    arXiv:2206.02675, PI Simmer.
    Differs from it as PPO-Simmer does.
    """


@config
class TRPOEarlyTerminatedConfig(EarlyConfig, TRPOConfig):
    """TRPO in the early-terminated task: an episode that breaks the cost limit ends there, for good.

        maximise_theta  E[w A]   subject to   KL(old || new) <= delta
        terminated_t  where  sum_{s<=t} c_s > cost_limit;  there r_t = r_e, and the value after it is 0

    Source: Sun et al. (2021), "Safe Exploration by Solving Early Terminated MDP", arXiv:2107.04200.
    Differs from it as early-terminated PPO does. Evaluation runs whole episodes here too.
    """


def make(
    env: Env,
    axis_name: str | None = None,
    treatment: Treatment = no_treatment,
    augmentation: Augmentation = no_augmentation,
) -> Algorithm:
    return on_policy(env, treatment, plain, trust_region, axis_name, augmentation)


# OmniSafe @15603dd: the others differ from TRPO.yaml by their own part. For Point and Car on Goal and
# Circle TRPOSaute.yaml and TRPOSimmerPID.yaml add algo.saute_discount=0.9999 algo.unsafe_reward=-0.2.
PUBLISHED: dict[str, Any] = npg.PUBLISHED

ROWS = {
    "trpo": Row(
        TRPOConfig,
        make,
        "trust-region steps, no constraint",
        presets(PUBLISHED),
        omnisafe="TRPO",
        holds="nothing",
    ),
    "trpo_lag": Row(
        TRPOLagConfig,
        partial(make, treatment=lagrangian),
        "TRPO with an adaptive price on cost",
        presets(PUBLISHED | {"dual_lr": 0.035}) | EARLY_PRICE,
        omnisafe="TRPOLag",
    ),
    "trpo_pid": Row(
        TRPOPIDConfig,
        partial(make, treatment=pid),
        "TRPO with a price on cost from a PID controller",
        presets(PUBLISHED),
        omnisafe="TRPOPID",
        lever=ppo.CONTROLLED,
    ),
    "crpo": Row(
        CRPOConfig,
        partial(make, treatment=switch),
        "TRPO on reward or on cost, by whether the limit holds",
        presets(PUBLISHED),
        omnisafe="OnCRPO",
        lever={"tolerance": 0.0},
    ),
    "trpo_saute": Row(
        TRPOSauteConfig,
        partial(make, augmentation=saute),
        "TRPO that sees its budget on cost, and pays a penalty once it is spent",
        presets(PUBLISHED | OMNISAFE_SAUTE),
        omnisafe="TRPOSaute",
        holds="episode",
        lever=ppo.BUDGETED,
    ),
    "trpo_simmer_pid": Row(
        TRPOSimmerPIDConfig,
        partial(make, treatment=schedule, augmentation=simmer),
        "TRPO-Saute with a budget that a PID controller raises",
        presets(PUBLISHED | OMNISAFE_SAUTE | OMNISAFE_SIMMER),
        omnisafe="TRPOSimmerPID",
        holds="episode",
        lever=ppo.BUDGETED | {"budget_ramp": 50.0},
    ),
    "trpo_early_terminated": Row(
        TRPOEarlyTerminatedConfig,
        partial(make, augmentation=early),
        "TRPO whose training episodes end where they break the limit",
        presets(PUBLISHED),
        omnisafe="TRPOEarlyTerminated",
        holds="episode",
    ),
}
