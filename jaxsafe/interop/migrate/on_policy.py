"""Keys of OmniSafe's on-policy algorithms. The other families' tables begin with these."""

import math
from typing import Any

from jaxsafe.config import convert
from jaxsafe.interop.migrate.rules import Facts, Rule, always, computed, ignored, named, switch
from jaxsafe.learn.timetable import divisors

EPISODE = 1000  # steps
NETWORK = "one option for policy and critics"


def batch(value: Any, facts: Facts) -> dict[str, Any]:
    """From steps_per_epoch, batch_size and window_lens.

    steps_per_epoch becomes environments side by side, with whole episodes. batch_size becomes the
    number of minibatches that divides the batch and comes nearest. window_lens counts episodes;
    ours counts iterations, in each of which every environment has one episode.
    """
    steps = facts.whole("algo_cfgs.steps_per_epoch", 20_000)
    size = facts.whole("algo_cfgs.batch_size", 128 if facts.trust_region else 64)
    horizon = min(steps, EPISODE)
    num_envs = math.ceil(steps / horizon)
    total = num_envs * horizon
    minibatches = min(divisors(total), key=lambda m: abs(math.log(m * size / total)))
    episodes = facts.whole("logger_cfgs.window_lens", 100)
    return {
        "num_envs": num_envs,
        "algo.horizon": horizon,
        "algo.minibatches": minibatches,
        "algo.cost_window": max(1, round(episodes / num_envs)),
    }


def by_adam(rule: Rule) -> Rule:
    """`rule`, for a key that OmniSafe's trust regions do not read."""

    def turn(value: Any, facts: Facts) -> dict[str, Any] | None:
        return {} if facts.trust_region else rule.options(value, facts)

    return rule._replace(turn=turn)


def passes(value: Any, facts: Facts) -> dict[str, Any]:
    both = {"algo.epochs": value, "algo.critic_epochs": value}
    return {"algo.critic_epochs": value} if facts.trust_region else both


def budget(value: Any, facts: Facts) -> dict[str, Any]:
    if "algo.budget_init" not in facts.options:
        return {"algo.cost_limit": value}
    upper = facts.real("algo_cfgs.upper_budget", 25.0)
    return {"algo.budget_init": convert(value, float, "algo_cfgs.safety_budget") / upper}


# Where two keys of a file set one option, the key that is later here wins.
ON_POLICY: dict[str, Rule] = {
    "algo": Rule("algo", "see the names"),
    "env_id": Rule("env env.rules", "see the names"),
    "exp_name": ignored("run_dir names a run's folder"),
    "exp_increment_cfgs": ignored("a copy of what was changed, for OmniSafe's records"),
    "seed": Rule("seed", "num_seeds=8 trains 8 at once"),
    "train_cfgs.device": ignored("JAX takes a GPU if there is one; JAX_PLATFORMS=cpu forbids"),
    "train_cfgs.torch_threads": ignored("XLA takes the cores there are"),
    "train_cfgs.vector_env_nums": ignored("num_envs follows from steps_per_epoch"),
    "train_cfgs.parallel": always(1, note="devices=N splits one program over N devices"),
    "train_cfgs.total_steps": Rule("total_steps"),
    "train_cfgs.epochs": ignored("total_steps / steps_per_epoch"),
    "algo_cfgs.steps_per_epoch": computed(
        "num_envs algo.horizon algo.minibatches algo.cost_window",
        batch,
        "whole episodes of 1,000 steps, side by side",
    ),
    "algo_cfgs.batch_size": computed(
        "algo.minibatches", batch, "steps_per_epoch / batch_size, made a divisor of the batch"
    ),
    "algo_cfgs.update_iters": computed(
        "algo.epochs algo.critic_epochs", passes, "with trust regions of the critics alone"
    ),
    "algo_cfgs.target_kl": Rule("algo.target_kl", "of trust regions per action, as there"),
    "algo_cfgs.kl_early_stop": by_adam(
        switch("algo.target_kl", math.inf, "false is inf; trust regions never stop early")
    ),
    "algo_cfgs.entropy_coef": Rule("algo.entropy_coef"),
    "algo_cfgs.obs_normalize": Rule("algo.obs_normalize"),
    "algo_cfgs.reward_normalize": Rule("algo.reward_normalize"),
    "algo_cfgs.cost_normalize": Rule("algo.cost_normalize"),
    "algo_cfgs.max_grad_norm": Rule("algo.max_grad_norm"),
    "algo_cfgs.use_max_grad_norm": switch("algo.max_grad_norm", math.inf, "false is inf"),
    "algo_cfgs.critic_norm_coef": Rule("algo.critic_norm_coef"),
    "algo_cfgs.use_critic_norm": switch("algo.critic_norm_coef", 0.0, "false is 0"),
    "algo_cfgs.gamma": Rule("algo.discount algo.cost_discount", "OmniSafe has one for both"),
    "algo_cfgs.cost_gamma": ignored("OmniSafe does not read it"),
    "algo_cfgs.lam": Rule("algo.gae_lambda"),
    "algo_cfgs.lam_c": Rule("algo.cost_gae_lambda"),
    "algo_cfgs.clip": Rule("algo.clip"),
    "algo_cfgs.adv_estimation_method": named(
        "algo.estimator",
        {"gae": "gae", "gae-rtg": "gae_rtg", "plain": "plain", "vtrace": "vtrace"},
        "gae, plain and vtrace; gae-rtg is gae_rtg",
    ),
    "algo_cfgs.standardized_rew_adv": always(True, note="reward advantages always are"),
    "algo_cfgs.standardized_cost_adv": always(True, note="cost advantages are always centred"),
    "algo_cfgs.penalty_coef": always(
        0, note="algo=ppo_penalty has a fixed price, on advantages instead of rewards"
    ),
    "algo_cfgs.use_cost": ignored("the algorithm decides"),
    "algo_cfgs.cg_damping": Rule("algo.damping"),
    "algo_cfgs.cg_iters": Rule("algo.cg_iterations"),
    "algo_cfgs.fvp_sample_freq": always(1, note="the Fisher matrix is of all samples"),
    "algo_cfgs.fvp_obs": ignored("the Fisher matrix is of the batch"),
    "algo_cfgs.cost_limit": Rule("algo.cost_limit"),
    "algo_cfgs.distance": Rule("algo.tolerance"),
    "algo_cfgs.focops_lam": Rule("algo.temperature"),
    "algo_cfgs.focops_eta": Rule("algo.near_kl"),
    "algo_cfgs.kappa": Rule("algo.kappa algo.barrier", "kappa of P3O, barrier of IPO"),
    "algo_cfgs.penalty_max": Rule("algo.price_max"),
    "algo_cfgs.saute_gamma": Rule("algo.saute_discount"),
    "algo_cfgs.unsafe_reward": Rule("algo.unsafe_reward"),
    "algo_cfgs.max_ep_len": always(EPISODE, note="a budget is for env.num_steps"),
    "algo_cfgs.upper_budget": Rule("algo.cost_limit"),
    "algo_cfgs.safety_budget": computed(
        "algo.cost_limit algo.budget_init", budget, "of Simmer a share of upper_budget"
    ),
    "control_cfgs.kp": Rule("algo.simmer_kp"),
    "control_cfgs.ki": Rule("algo.simmer_ki"),
    "control_cfgs.kd": Rule("algo.simmer_kaw", "it acts against wind-up"),
    "control_cfgs.polyak": Rule("algo.simmer_smoothing"),
    "logger_cfgs.use_wandb": computed(
        "logger", lambda on, facts: {"logger": "wandb"} if on else {}, "true is wandb"
    ),
    "logger_cfgs.wandb_project": ignored("the project is jaxsafe"),
    "logger_cfgs.use_tensorboard": always(True, note="always written"),
    "logger_cfgs.save_model_freq": ignored("a run is saved each minute, whole, for resume"),
    "logger_cfgs.log_dir": ignored("run_dir names a run's folder; default runs/ENV-ALGO/"),
    "logger_cfgs.window_lens": computed(
        "algo.cost_window", batch, "in episodes there, in iterations here"
    ),
    "model_cfgs.weight_initialization_mode": named(
        "algo.init",
        {"kaiming_uniform": "torch", "orthogonal": "orthogonal"},
        "kaiming_uniform is torch",
    ),
    "model_cfgs.actor_type": always("gaussian_learning", note="a Gaussian with a learnt deviation"),
    "model_cfgs.linear_lr_decay": by_adam(Rule("algo.lr_decay", "trust regions have no rate")),
    "model_cfgs.exploration_noise_anneal": always(False, note="the deviation is learnt"),
    "model_cfgs.std_range": ignored("only read with exploration_noise_anneal"),
    "model_cfgs.critic.hidden_sizes": Rule("algo.hidden", NETWORK),
    "model_cfgs.actor.hidden_sizes": Rule("algo.hidden", NETWORK),
    "model_cfgs.critic.activation": named("algo.activation", {"tanh": "tanh", "relu": "relu"}, NETWORK),
    "model_cfgs.actor.activation": named("algo.activation", {"tanh": "tanh", "relu": "relu"}, NETWORK),
    "model_cfgs.actor.lr": by_adam(Rule("algo.lr", "trust regions have none")),
    "model_cfgs.critic.lr": Rule("algo.critic_lr"),
    "lagrange_cfgs.cost_limit": Rule("algo.cost_limit"),
    "lagrange_cfgs.lagrangian_multiplier_init": Rule("algo.lam_init"),
    "lagrange_cfgs.lambda_lr": Rule("algo.dual_lr"),
    "lagrange_cfgs.lambda_optimizer": always("Adam", note="always Adam"),
    "lagrange_cfgs.lagrangian_upper_bound": Rule("algo.lam_max"),
    "lagrange_cfgs.pid_kp": Rule("algo.pid_kp"),
    "lagrange_cfgs.pid_ki": Rule("algo.pid_ki"),
    "lagrange_cfgs.pid_kd": Rule("algo.pid_kd"),
    "lagrange_cfgs.pid_delta_d_ema_alpha": Rule("algo.pid_smoothing", "one for both"),
    "lagrange_cfgs.pid_delta_p_ema_alpha": Rule("algo.pid_smoothing", "one for both"),
    "lagrange_cfgs.pid_d_delay": Rule("algo.pid_delay"),
    "lagrange_cfgs.sum_norm": always(True, note="always (A_r - lam A_c) / (1 + lam)"),
    "lagrange_cfgs.diff_norm": always(False, note="always (A_r - lam A_c) / (1 + lam)"),
    "lagrange_cfgs.penalty_max": ignored("OmniSafe does not read it with sum_norm"),
}
