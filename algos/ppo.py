"""PPO, and PPO with each treatment of the constraint and each augmentation of the task."""

from functools import partial
from typing import Annotated, Any, ClassVar

from jaxsafe.algos import pg
from jaxsafe.config import Bounds, config
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
from jaxsafe.learn.on_policy import EARLY_PRICE, on_policy, presets
from jaxsafe.learn.row import Row
from jaxsafe.learn.steps import adam_epochs
from jaxsafe.learn.surrogates import clipped
from jaxsafe.learn.treatments import (
    BarrierConfig,
    LagrangianConfig,
    PenaltyConfig,
    PIDConfig,
    Treatment,
    barrier,
    lagrangian,
    no_treatment,
    penalty,
    pid,
)
from jaxsafe.types import Algorithm, Env


@config
class PPOConfig(pg.PGConfig):
    """PPO: proximal policy optimisation, blind to cost.

        maximise_theta  E[min(w A, clip(w, 1 - eps, 1 + eps) A)],  w = pi(a | s) / pi_old(a | s)

    Source: Schulman et al. (2017), "Proximal Policy Optimization Algorithms", arXiv:1707.06347.
    Differs from it: the passes over a batch stop once KL(old || new) > target_kl, as in
    safety-starter-agents and OmniSafe. The value function is a network of its own, unless `trunk` is
    shared. A cost critic is trained, too, but only its metrics are used.
    """

    SUITS: ClassVar = {"parallel": ("humanoid_velocity",)}  # docs/results/velocity_settings

    # eps: ratios count as if they were at most this far from 1, as in the paper.
    clip: Annotated[float, Bounds(1e-6, 100)] = 0.2


@config
class PPOLagConfig(LagrangianConfig, PPOConfig):
    """PPO-Lagrangian: PPO whose advantage pays for cost at an adaptive price.

        maximise_theta  E[min(w A, clip(w, 1 - eps, 1 + eps) A)],  A = (A_r - lam A_c) / (1 + lam)
        minimise_lam    -lam (J_c - cost_limit),  lam >= 0,  by Adam

    An iteration first moves the price lam by one step of Adam, and then the policy. The price rises
    while an episode costs more than cost_limit, and falls while it costs less.

    Source: Ray, Achiam and Amodei (2019), "Benchmarking Safe Exploration in Deep Reinforcement
    Learning"; the 1 / (1 + lam) scale is from the authors' code.
    Differs from it: in the authors' code only the reward term is clipped, and Adam moves a softplus of
    lam. Here, as in OmniSafe, both terms are clipped, and Adam moves lam itself. J_c is estimated from
    the last batch. OmniSafe takes the mean of the last 100 episodes.
    """

    SUITS: ClassVar = {"early_price": ("swimmer_velocity",)}  # docs/results/velocity_settings


@config
class PPOPenaltyConfig(PenaltyConfig, PPOConfig):
    """PPO-Penalty: PPO whose advantage pays for cost at a fixed price.

        maximise_theta  E[min(w A, clip(w, 1 - eps, 1 + eps) A)],  A = A_r - price A_c

    It is the baseline that adaptive prices are compared with. Nothing keeps it to the cost limit, which
    is only drawn in plots.
    """


@config
class CPPOPIDConfig(PIDConfig, PPOConfig):
    """CPPO-PID: PPO whose price on cost is the output of a PID controller.

        maximise_theta  E[min(w A, clip(w, 1 - eps, 1 + eps) A)],  A = (A_r - lam A_c) / (1 + lam)
        lam <- (K_p P + I + K_d D)+,   I <- (I + K_i (J_c - cost_limit))+

    P is the smoothed violation J_c - cost_limit. D is how much the smoothed J_c rose in the last
    `pid_delay` iterations, or 0 if it fell. K_p, K_i and K_d are `pid_kp`, `pid_ki` and `pid_kd`.

    Source: Stooke, Achiam and Abbeel (2020), "Responsive Safety in Reinforcement Learning by PID
    Lagrangian Methods", arXiv:2007.03964, algorithm 2.
    Differs from it, as the authors' code and OmniSafe do: P and J_c are smoothed, and D looks back over
    several iterations, where the algorithm has the last violation and one iteration. I begins at
    `lam_init`, in the algorithm at 0.
    """

    SUITS: ClassVar = {"parallel": ("hopper_velocity",)}  # docs/results/velocity_settings


@config
class IPOConfig(BarrierConfig, PPOConfig):
    """IPO: PPO whose price on cost is the slope of a logarithmic barrier.

        maximise_theta  E[min(w A, clip(w, 1 - eps, 1 + eps) A)],  A = (A_r - p A_c) / (1 + p)
        p = barrier / (cost_limit - J_c) within the limit, at most price_max; price_max beyond it

    Source: Liu, Ding and Liu (2020), "IPO: Interior-point Policy Optimization under Constraints",
    arXiv:1910.09615.
    Differs from it, as OmniSafe does: the paper maximises the barrier itself, here its slope at the
    present policy is the price p. OmniSafe also normalises rewards and costs. Here
    `preset=published` does so.
    """


@config
class PPOSauteConfig(SauteConfig, PPOConfig):
    """PPO-Saute: PPO that sees what is left of its budget on cost, and earns while there is some.

        z_0 = 1,   z_{t+1} = (z_t - c_t / B) / gamma_n,   B = cost_limit mean_{t<T} gamma_n^t
        maximise_theta  E[min(w A, clip(w, 1 - eps, 1 + eps) A)],  A of r_t if z_{t+1} > 0, else n

    z is the share of the cost budget B that the episode has left, and part of what the policy observes.
    While z is positive a step earns its reward. After that it earns n (`unsafe_reward`) instead. So the
    policy learns to keep every episode within the limit, not only the average one. T is the number of
    steps of an episode. gamma_n (`saute_discount`) makes costs at the start of an episode count a
    little more.

    Source: Sootla et al. (2022), "Saute RL: Almost Surely Safe Reinforcement Learning Using State
    Augmentation", arXiv:2202.06558; B, which turns a sum into a discounted one, is from the authors'
    code.
    Differs from it: a step that ends at exactly z = 0 earns n, as in the authors' code and in OmniSafe.
    z is not normalised. At a time limit the critic is asked for the value of the last z. OmniSafe asks
    for that of z = 1 (`full_at_end`). A cost critic is trained, too, but only its metrics are used.
    """


@config
class PPOSimmerPIDConfig(SimmerConfig, PPOConfig):
    """PPO-Simmer: PPO-Saute whose episodes start with a part of the budget that a controller raises.

        z_0 = B / cost_limit, then z, the reward and the step as in PPO-Saute
        B = clip(d + u, 0, cost_limit),   u = clip(K_p e + K_i sum e + K_aw (u' - u'_raw), -U, U)
        e = s e' + (1 - s) (d - J_c),   once an iteration; ' is the iteration before

    d is the scheduled budget. It rises on a line to cost_limit, so training starts safer than it has to
    be. The controller's u corrects d by what episodes really cost. u is at most U (`budget_reach`). u'
    is what both clips left of u'_raw. The term with K_aw takes back what they cut off, so that the sum
    of errors does not grow without bound.

    Source: Sootla et al. (2022), "Effects of Safety State Augmentation on Safe Exploration",
    arXiv:2206.02675, PI Simmer; the filter, the sum over the last `simmer_window` errors and both clips
    are from the authors' code.
    Differs from it: d is a line, where the paper has a staircase. OmniSafe adds u to the last budget B'
    instead of d (`simmer_adds`), and calls K_aw the gain of a derivative. In OmniSafe all episodes of
    an epoch but the first start at z = 1 (`simmer_full`).
    """


@config
class PPOEarlyTerminatedConfig(EarlyConfig, PPOConfig):
    """PPO in the early-terminated task: an episode that breaks the cost limit ends there, for good.

        maximise_theta  E[min(w A, clip(w, 1 - eps, 1 + eps) A)]
        terminated_t  where  sum_{s<=t} c_s > cost_limit;  there r_t = r_e, and the value after it is 0

    An episode that breaks the limit loses all reward that was to come. So the policy learns to keep
    every episode within the limit. Only training ends episodes early. Evaluation runs whole episodes
    and so shows what they would cost. r_e is `termination_reward`.

    Source: Sun et al. (2021), "Safe Exploration by Solving Early Terminated MDP", arXiv:2107.04200.
    Differs from it: PPO sees the observation alone, as in OmniSafe. The paper's policies are off-policy
    ones that remember the episode. Each episode counts its own cost. OmniSafe's count goes on into
    the next episode after a time limit (`keep_cost`). A cost critic is trained, too, but only its
    metrics are used.
    """


def make(
    env: Env,
    axis_name: str | None = None,
    treatment: Treatment = no_treatment,
    augmentation: Augmentation = no_augmentation,
) -> Algorithm:
    return on_policy(env, treatment, clipped, adam_epochs, axis_name, augmentation)


# OmniSafe @15603dd: PPO.yaml differs from PolicyGradient.yaml by its passes, and the others from
# PPO.yaml by their own part. For Point and Car on Goal and Circle PPOSaute.yaml adds
# algo.saute_discount=0.9999 algo.unsafe_reward=-0.2 algo.epochs=80 algo.critic_epochs=80, and on Goal
# algo.obs_normalize=false. PPOSimmerPID.yaml adds the same, but not for Car on Circle.
PUBLISHED: dict[str, Any] = pg.PUBLISHED | pg.OFTEN
# A time limit bootstraps, so what is left of a budget is worth as much as the rewards it would buy
# beyond the limit: the less, the more they are discounted. At 0.99 a third of it is saved.
BUDGETED: dict[str, Any] = {"unsafe_reward": -1.0, "discount": 0.9}
CONTROLLED: dict[str, Any] = {"lam_init": 0.8, "pid_kp": 0.05, "pid_ki": 0.005, "pid_smoothing": 0.5}

ROWS = {
    "ppo": Row(
        PPOConfig,
        make,
        "clipped policy steps, no constraint",
        presets(PUBLISHED),
        omnisafe="PPO",
        holds="nothing",
        lever=pg.LEVER,
    ),
    "ppo_lag": Row(
        PPOLagConfig,
        partial(make, treatment=lagrangian),
        "PPO with an adaptive price on cost",
        presets(PUBLISHED | {"dual_lr": 0.035}) | EARLY_PRICE,
        omnisafe="PPOLag",
        lever=pg.LEVER,
    ),
    "ppo_penalty": Row(
        PPOPenaltyConfig,
        partial(make, treatment=penalty),
        "PPO with a fixed price on cost",
        presets(PUBLISHED),
        holds="nothing",
        lever=pg.LEVER | {"price": 0.0},
    ),
    "cppo_pid": Row(
        CPPOPIDConfig,
        partial(make, treatment=pid),
        "PPO with a price on cost from a PID controller",
        presets(PUBLISHED),
        omnisafe="CPPOPID",
        lever=pg.LEVER | CONTROLLED,
    ),
    "ipo": Row(
        IPOConfig,
        partial(make, treatment=barrier),
        "PPO with a logarithmic barrier at the limit",
        presets(PUBLISHED | {"epochs": 10, "critic_epochs": 10} | pg.SCALED),
        omnisafe="IPO",
        lever=pg.LEVER | {"barrier": 0.1, "price_max": 4.0},
    ),
    "ppo_saute": Row(
        PPOSauteConfig,
        partial(make, augmentation=saute),
        "PPO that sees its budget on cost, and pays a penalty once it is spent",
        presets(PUBLISHED | OMNISAFE_SAUTE),
        omnisafe="PPOSaute",
        holds="episode",
        lever=pg.LEVER | BUDGETED,
    ),
    "ppo_simmer_pid": Row(
        PPOSimmerPIDConfig,
        partial(make, treatment=schedule, augmentation=simmer),
        "PPO-Saute with a budget that a PID controller raises",
        presets(PUBLISHED | OMNISAFE_SAUTE | OMNISAFE_SIMMER),
        omnisafe="PPOSimmerPID",
        holds="episode",
        lever=pg.LEVER | BUDGETED | {"budget_ramp": 50.0},
    ),
    "ppo_early_terminated": Row(
        PPOEarlyTerminatedConfig,
        partial(make, augmentation=early),
        "PPO whose training episodes end where they break the limit",
        presets(PUBLISHED),
        omnisafe="PPOEarlyTerminated",
        holds="episode",
        lever=pg.LEVER,
    ),
}
