"""From a config of OmniSafe, or of Safety Gym's Engine, to the command line that does the same here.

    jaxsafe migrate omnisafe CONFIG.json|.yaml [--algo PPOLag] [--env SafetyPointGoal1-v0]
    jaxsafe migrate safety_gym CONFIG.json|.yaml

The command goes to stdout. What became of every key goes to stderr. CONFIG is

    omnisafe    the config.json of a run, or a file of its configs, or a part of either. What a file
                leaves out has OmniSafe's default: preset=published compat=omnisafe.
    safety_gym  the dict that Engine(config) is given.

Source: the configs of OmniSafe after 0.5.0 (2025), and Safety Gym's Engine.
"""

import dataclasses
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import yaml

from jaxsafe import algos, envs
from jaxsafe.config import Amount, ConfigError, convert, from_dict, nearest, one_line
from jaxsafe.envs.registry import IMPLIED
from jaxsafe.envs.safety_gym import suite
from jaxsafe.envs.safety_gym.config import config_from_plain as read_config
from jaxsafe.envs.safety_gym.config import defaults
from jaxsafe.envs.velocity.config import VelocityConfig
from jaxsafe.learn.barrier import BarrierConfig
from jaxsafe.learn.bill import PriceClockConfig
from jaxsafe.learn.model_based import ModelBasedConfig
from jaxsafe.learn.off_policy import OffPolicyConfig
from jaxsafe.learn.offline import OfflineConfig
from jaxsafe.learn.row import Row
from jaxsafe.run.settings import OFFLINE_UPDATES, TrainConfig, algo_options, as_text

EPISODE = 1000  # steps


class Facts(NamedTuple):
    """What the meaning of a key may depend on."""

    values: Mapping[str, Any]  # all keys of the file
    options: Mapping[str, Any]  # of our algorithm, with the preset's values: 'algo.epochs', ...
    repeat: int = 1  # raw steps in a step of the planner

    @property
    def trust_region(self) -> bool:
        """Whether the policy moves by natural gradients, not by epochs of Adam."""
        return "algo.epochs" not in self.options

    def batch(self) -> dict[str, Any]:
        """Our options for steps_per_epoch, batch_size and window_lens.

        steps_per_epoch becomes environments side by side, with whole episodes. batch_size becomes the
        number of minibatches that divides the batch and comes nearest. window_lens counts episodes;
        ours counts iterations, in each of which every environment has one episode.
        """
        steps = self.whole("algo_cfgs.steps_per_epoch", 20_000)
        size = self.whole("algo_cfgs.batch_size", 128 if self.trust_region else 64)
        horizon = min(steps, EPISODE)
        num_envs = math.ceil(steps / horizon)
        total = num_envs * horizon
        divisors = [m for m in range(1, total + 1) if total % m == 0]
        minibatches = min(divisors, key=lambda m: abs(math.log(m * size / total)))
        episodes = self.whole("logger_cfgs.window_lens", 100)
        return {
            "num_envs": num_envs,
            "algo.horizon": horizon,
            "algo.minibatches": minibatches,
            "algo.cost_window": max(1, round(episodes / num_envs)),
        }

    def whole(self, key: str, default: int) -> int:
        return convert(self.values.get(key, default), Amount, key)


Translate = Callable[[Any, Facts], dict[str, Any] | None]


class Rule(NamedTuple):
    """What becomes of a key of OmniSafe.

    ours: the options, separated by spaces; '' if there is none. note: how, or why not.
    turn(value, facts): the options with their values; {} if jaxsafe does so anyway, None if it cannot.
        Without `turn`, each of `ours` gets the value as it is. Options that the algorithm lacks are
        left out.
    same: for a key without an option, the values that jaxsafe matches anyway; None: all of them.
    """

    ours: str = ""
    note: str = ""
    turn: Translate | None = None
    same: tuple[Any, ...] | None = ()


def batch(names: str) -> Translate:
    return lambda value, facts: {k: v for k, v in facts.batch().items() if k in names.split()}


def unless_on(option: str, off: float) -> Translate:
    """For OmniSafe's switches: on, another key says how much."""
    return lambda on, facts: {} if on else {option: off}


def one_of(option: str, names: dict[str, str]) -> Translate:
    return lambda value, facts: {option: names[value]} if value in names else None


def without_trust_region(turn: Translate) -> Translate:
    return lambda value, facts: {} if facts.trust_region else turn(value, facts)


def passes(value: Any, facts: Facts) -> dict[str, Any]:
    both = {"algo.epochs": value, "algo.critic_epochs": value}
    return {"algo.critic_epochs": value} if facts.trust_region else both


def budget(value: Any, facts: Facts) -> dict[str, Any]:
    if "algo.budget_init" not in facts.options:
        return {"algo.cost_limit": value}
    upper = convert(facts.values.get("algo_cfgs.upper_budget", 25.0), float, "algo_cfgs.upper_budget")
    return {"algo.budget_init": convert(value, float, "algo_cfgs.safety_budget") / upper}


REPEAT = "env.wrap.action_repeat"
NETWORK = "one option for policy and critics"
OMNISAFE: dict[str, Rule] = {  # later keys win
    "algo": Rule("algo", "see the names"),
    "env_id": Rule("env env.rules", "see the names"),
    "exp_name": Rule("", "run_dir names a run's folder", same=None),
    "exp_increment_cfgs": Rule("", "a copy of what was changed, for OmniSafe's records", same=None),
    "seed": Rule("seed", "num_seeds=8 trains 8 at once"),
    "train_cfgs.device": Rule(
        "", "JAX takes a GPU if there is one; JAX_PLATFORMS=cpu forbids", same=None
    ),
    "train_cfgs.torch_threads": Rule("", "XLA takes the cores there are", same=None),
    "train_cfgs.vector_env_nums": Rule("", "num_envs follows from steps_per_epoch", same=None),
    "train_cfgs.parallel": Rule("", "devices=N splits one program over N devices", same=(1,)),
    "train_cfgs.total_steps": Rule("total_steps"),
    "train_cfgs.epochs": Rule("", "total_steps / steps_per_epoch", same=None),
    "algo_cfgs.steps_per_epoch": Rule(
        "num_envs algo.horizon algo.minibatches algo.cost_window",
        "whole episodes of 1,000 steps, side by side",
        batch("num_envs algo.horizon algo.minibatches algo.cost_window"),
    ),
    "algo_cfgs.batch_size": Rule(
        "algo.minibatches",
        "steps_per_epoch / batch_size, made a divisor of the batch",
        batch("algo.minibatches"),
    ),
    "algo_cfgs.update_iters": Rule(
        "algo.epochs algo.critic_epochs", "with trust regions of the critics alone", passes
    ),
    "algo_cfgs.target_kl": Rule("algo.target_kl", "of trust regions per action, as there"),
    "algo_cfgs.kl_early_stop": Rule(
        "algo.target_kl",
        "false is inf; trust regions never stop early",
        without_trust_region(unless_on("algo.target_kl", math.inf)),
    ),
    "algo_cfgs.entropy_coef": Rule("algo.entropy_coef"),
    "algo_cfgs.obs_normalize": Rule("algo.obs_normalize"),
    "algo_cfgs.reward_normalize": Rule("algo.reward_normalize"),
    "algo_cfgs.cost_normalize": Rule("algo.cost_normalize"),
    "algo_cfgs.max_grad_norm": Rule("algo.max_grad_norm"),
    "algo_cfgs.use_max_grad_norm": Rule(
        "algo.max_grad_norm", "false is inf", unless_on("algo.max_grad_norm", math.inf)
    ),
    "algo_cfgs.critic_norm_coef": Rule("algo.critic_norm_coef"),
    "algo_cfgs.use_critic_norm": Rule(
        "algo.critic_norm_coef", "false is 0", unless_on("algo.critic_norm_coef", 0.0)
    ),
    "algo_cfgs.gamma": Rule("algo.discount algo.cost_discount", "OmniSafe has one for both"),
    "algo_cfgs.cost_gamma": Rule("", "OmniSafe does not read it", same=None),
    "algo_cfgs.lam": Rule("algo.gae_lambda"),
    "algo_cfgs.lam_c": Rule("algo.cost_gae_lambda"),
    "algo_cfgs.clip": Rule("algo.clip"),
    "algo_cfgs.adv_estimation_method": Rule(
        "algo.estimator",
        "gae, plain and vtrace; gae-rtg is gae_rtg",
        one_of(
            "algo.estimator",
            {"gae": "gae", "gae-rtg": "gae_rtg", "plain": "plain", "vtrace": "vtrace"},
        ),
    ),
    "algo_cfgs.standardized_rew_adv": Rule("", "reward advantages always are", same=(True,)),
    "algo_cfgs.standardized_cost_adv": Rule("", "cost advantages are always centred", same=(True,)),
    "algo_cfgs.penalty_coef": Rule(
        "", "algo=ppo_penalty has a fixed price, on advantages instead of rewards", same=(0,)
    ),
    "algo_cfgs.use_cost": Rule("", "the algorithm decides", same=None),
    "algo_cfgs.cg_damping": Rule("algo.damping"),
    "algo_cfgs.cg_iters": Rule("algo.cg_iterations"),
    "algo_cfgs.fvp_sample_freq": Rule("", "the Fisher matrix is of all samples", same=(1,)),
    "algo_cfgs.fvp_obs": Rule("", "the Fisher matrix is of the batch", same=None),
    "algo_cfgs.cost_limit": Rule("algo.cost_limit"),
    "algo_cfgs.distance": Rule("algo.tolerance"),
    "algo_cfgs.focops_lam": Rule("algo.temperature"),
    "algo_cfgs.focops_eta": Rule("algo.near_kl"),
    "algo_cfgs.kappa": Rule("algo.kappa algo.barrier", "kappa of P3O, barrier of IPO"),
    "algo_cfgs.penalty_max": Rule("algo.price_max"),
    "algo_cfgs.saute_gamma": Rule("algo.saute_discount"),
    "algo_cfgs.unsafe_reward": Rule("algo.unsafe_reward"),
    "algo_cfgs.max_ep_len": Rule("", "a budget is for env.num_steps", same=(EPISODE,)),
    "algo_cfgs.upper_budget": Rule("algo.cost_limit"),
    "algo_cfgs.safety_budget": Rule(
        "algo.cost_limit algo.budget_init", "of Simmer a share of upper_budget", budget
    ),
    "control_cfgs.kp": Rule("algo.simmer_kp"),
    "control_cfgs.ki": Rule("algo.simmer_ki"),
    "control_cfgs.kd": Rule("algo.simmer_kaw", "it acts against wind-up"),
    "control_cfgs.polyak": Rule("algo.simmer_smoothing"),
    "logger_cfgs.use_wandb": Rule("", "metrics.csv and TensorBoard files", same=(False,)),
    "logger_cfgs.wandb_project": Rule("", "metrics.csv and TensorBoard files", same=None),
    "logger_cfgs.use_tensorboard": Rule("", "always written", same=(True,)),
    "logger_cfgs.save_model_freq": Rule("", "a run is saved each minute, whole, for resume", same=None),
    "logger_cfgs.log_dir": Rule("", "run_dir names a run's folder; default runs/ENV-ALGO/", same=None),
    "logger_cfgs.window_lens": Rule(
        "algo.cost_window", "in episodes there, in iterations here", batch("algo.cost_window")
    ),
    "model_cfgs.weight_initialization_mode": Rule(
        "algo.init",
        "kaiming_uniform is torch",
        one_of("algo.init", {"kaiming_uniform": "torch", "orthogonal": "orthogonal"}),
    ),
    "model_cfgs.actor_type": Rule(
        "", "a Gaussian with a learnt deviation", same=("gaussian_learning",)
    ),
    "model_cfgs.linear_lr_decay": Rule(
        "algo.lr_decay",
        "trust regions have no rate",
        without_trust_region(lambda on, facts: {"algo.lr_decay": on}),
    ),
    "model_cfgs.exploration_noise_anneal": Rule("", "the deviation is learnt", same=(False,)),
    "model_cfgs.std_range": Rule("", "only read with exploration_noise_anneal", same=None),
    "model_cfgs.critic.hidden_sizes": Rule("algo.hidden", NETWORK),
    "model_cfgs.actor.hidden_sizes": Rule("algo.hidden", NETWORK),
    "model_cfgs.critic.activation": Rule(
        "algo.activation", NETWORK, one_of("algo.activation", {"tanh": "tanh", "relu": "relu"})
    ),
    "model_cfgs.actor.activation": Rule(
        "algo.activation", NETWORK, one_of("algo.activation", {"tanh": "tanh", "relu": "relu"})
    ),
    "model_cfgs.actor.lr": Rule(
        "algo.lr",
        "trust regions have none",
        without_trust_region(lambda lr, facts: {"algo.lr": lr}),
    ),
    "model_cfgs.critic.lr": Rule("algo.critic_lr"),
    "lagrange_cfgs.cost_limit": Rule("algo.cost_limit"),
    "lagrange_cfgs.lagrangian_multiplier_init": Rule("algo.lam_init"),
    "lagrange_cfgs.lambda_lr": Rule("algo.dual_lr"),
    "lagrange_cfgs.lambda_optimizer": Rule("", "always Adam", same=("Adam",)),
    "lagrange_cfgs.lagrangian_upper_bound": Rule("algo.lam_max"),
    "lagrange_cfgs.pid_kp": Rule("algo.pid_kp"),
    "lagrange_cfgs.pid_ki": Rule("algo.pid_ki"),
    "lagrange_cfgs.pid_kd": Rule("algo.pid_kd"),
    "lagrange_cfgs.pid_delta_d_ema_alpha": Rule("algo.pid_smoothing", "one for both"),
    "lagrange_cfgs.pid_delta_p_ema_alpha": Rule("algo.pid_smoothing", "one for both"),
    "lagrange_cfgs.pid_d_delay": Rule("algo.pid_delay"),
    "lagrange_cfgs.sum_norm": Rule("", "always (A_r - lam A_c) / (1 + lam)", same=(True,)),
    "lagrange_cfgs.diff_norm": Rule("", "always (A_r - lam A_c) / (1 + lam)", same=(False,)),
    "lagrange_cfgs.penalty_max": Rule("", "OmniSafe does not read it with sum_norm", same=None),
}

CIRCLE = 500  # steps of an episode of OmniSafe's offline tasks
OFFLINE: dict[str, Rule] = OMNISAFE | {  # of its offline algorithms; what differs
    "train_cfgs.dataset": Rule(
        "dataset",
        "a path is kept; OmniSafe's named sets have to be downloaded there",
        lambda value, facts: {"dataset": value} if str(value).endswith(".npz") else None,
    ),
    "train_cfgs.total_steps": Rule("total_updates"),
    "train_cfgs.evaluate_epoisodes": Rule("eval_episodes"),
    "train_cfgs.vector_env_nums": Rule("", "nothing steps in training", same=None),
    "algo_cfgs.steps_per_epoch": Rule("algo.updates", "eval_every evaluates in between"),
    "algo_cfgs.batch_size": Rule("algo.batch_size"),
    "algo_cfgs.gamma": Rule("algo.discount"),
    "algo_cfgs.cost_gamma": Rule("algo.cost_discount"),
    "algo_cfgs.phi": Rule("algo.perturbation", "of BCQ; the others do not read it"),
    "algo_cfgs.sampled_action_num": Rule("algo.candidates algo.actions", "of BCQ, of CRR"),
    "algo_cfgs.minimum_weighting": Rule("algo.caution"),
    "algo_cfgs.polyak": Rule("algo.tau", "COptiDICE does not read it"),
    "algo_cfgs.lagrange_start_step": Rule("algo.dual_starts"),
    "algo_cfgs.beta": Rule("algo.temperature"),
    "algo_cfgs.fn_type": Rule("", "always the soft chi-square", same=("softchi",)),
    "algo_cfgs.alpha": Rule("algo.alpha"),
    "algo_cfgs.cost_ub_eps": Rule("algo.cost_divergence"),
    "algo_cfgs.cost_limit": Rule(
        "algo.cost_limit",
        "of a step there, of an episode of 500 steps here",
        lambda value, facts: {
            "algo.cost_limit": CIRCLE * convert(value, float, "algo_cfgs.cost_limit")
        },
    ),
    "model_cfgs.hidden_sizes": Rule("algo.vae_hidden"),
    "model_cfgs.activation": Rule("algo.activation"),
    "model_cfgs.learning_rate": Rule("algo.lr"),
    "model_cfgs.actor.lr": Rule("algo.lr"),
    "model_cfgs.nu.hidden_sizes": Rule("algo.hidden", NETWORK),
    "model_cfgs.nu.activation": Rule("algo.activation", NETWORK),
    "model_cfgs.nu.lr": Rule("algo.critic_lr", "one for nu and chi"),
    "model_cfgs.chi.hidden_sizes": Rule("algo.hidden", NETWORK),
    "model_cfgs.chi.activation": Rule("algo.activation", NETWORK),
    "model_cfgs.chi.lr": Rule("algo.critic_lr", "one for nu and chi"),
    "model_cfgs.lamb.init": Rule("algo.lam_init"),
    "model_cfgs.lamb.lr": Rule("algo.dual_lr"),
    "model_cfgs.tau.init": Rule("algo.tau_init"),
    "model_cfgs.tau.lr": Rule("algo.tau_lr"),
}


def off_policy_loop(names: str) -> Translate:
    """The options `names`, from vector_env_nums, update_cycle, update_iters, size and batch_size.

    OmniSafe's size and batch_size are those of each environment.
    """

    def turn(value: Any, facts: Facts) -> dict[str, Any] | None:
        envs_there = facts.whole("train_cfgs.vector_env_nums", 1)
        cycle = facts.whole("algo_cfgs.update_cycle", 1)
        batch = envs_there * facts.whole("algo_cfgs.batch_size", 256)
        replayed = facts.whole("algo_cfgs.update_iters", 1) * batch
        if replayed % (cycle * envs_there):
            return None
        found = {
            "num_envs": envs_there,
            "algo.learn_every": cycle,
            "algo.horizon": cycle * max(1, round(HORIZON / cycle)),
            "algo.replay_ratio": replayed // (cycle * envs_there),
            "algo.batch_size": batch,
            "algo.replay_size": envs_there * facts.whole("algo_cfgs.size", 1_000_000),
        }
        return {k: v for k, v in found.items() if k in names.split()}

    return turn


def per_move(option: str) -> Translate:
    """A step that OmniSafe takes at each gradient step, and we every `dual_every` environment steps."""

    def turn(value: Any, facts: Facts) -> dict[str, Any]:
        steps = facts.whole("algo_cfgs.update_cycle", 1) * facts.whole("train_cfgs.vector_env_nums", 1)
        moves = DUAL_EVERY * facts.whole("algo_cfgs.update_iters", 1) / steps
        return {option: convert(value, float, option) * moves}

    return turn


def warm_up(value: Any, facts: Facts) -> dict[str, Any]:
    return {"algo.dual_starts": value * facts.whole("algo_cfgs.steps_per_epoch", 2000)}


def temperature(on: Any, facts: Facts) -> dict[str, Any]:
    """OmniSafe's own alpha begins at 1 and has the critics' rate."""
    rate = convert(facts.values.get("model_cfgs.critic.lr", 3e-4), float, "model_cfgs.critic.lr")
    return {"algo.alpha_init": 1.0, "algo.alpha_lr": rate} if on else {"algo.alpha_lr": 0.0}


def noise(value: Any, facts: Facts) -> dict[str, Any] | None:
    """CRABS has it in a third of its environments, as a factor."""
    if "algo.chains" in facts.options:
        return {} if value == 2 else None
    return {"algo.noise_min": value, "algo.noise_max": value}


def epochs(value: Any, facts: Facts) -> dict[str, Any]:
    steps = facts.whole("algo_cfgs.steps_per_epoch", 6000)
    return {"total_steps": steps * convert(value, Amount, "train_cfgs.num_epochs")}


def hottest(option: str) -> Translate:
    """For a range whose two ends are one number here."""

    def turn(value: Any, facts: Facts) -> dict[str, Any] | None:
        ends = {facts.values.get(f"opt_s.temperature.{end}", value) for end in ("min", "max")}
        return {option: value} if len(ends) == 1 else None

    return turn


HORIZON = 50  # steps of an update of the preset
DUAL_EVERY = PriceClockConfig.dual_every
SIZES = "num_envs algo.batch_size algo.replay_size algo.replay_ratio"
ROUNDS = "algo.learn_every algo.horizon algo.replay_ratio"
OFF_POLICY: dict[str, Rule] = OMNISAFE | {  # of its off-policy algorithms; what differs
    "train_cfgs.vector_env_nums": Rule(
        SIZES, "size and batch_size are of each environment there", off_policy_loop(SIZES)
    ),
    "train_cfgs.eval_episodes": Rule("eval_episodes", "eval_every evaluates during training"),
    "algo_cfgs.steps_per_epoch": Rule("", "metrics have a row for each update", same=None),
    "algo_cfgs.update_cycle": Rule(ROUNDS, "steps between two rounds", off_policy_loop(ROUNDS)),
    "algo_cfgs.update_iters": Rule(
        "algo.replay_ratio", "gradient steps of a round", off_policy_loop("algo.replay_ratio")
    ),
    "algo_cfgs.size": Rule("algo.replay_size", "", off_policy_loop("algo.replay_size")),
    "algo_cfgs.batch_size": Rule(
        "algo.batch_size algo.replay_ratio", "", off_policy_loop("algo.batch_size algo.replay_ratio")
    ),
    "algo_cfgs.start_learning_steps": Rule("algo.learning_starts"),
    "algo_cfgs.policy_delay": Rule("algo.policy_delay"),
    "algo_cfgs.polyak": Rule("algo.tau"),
    "algo_cfgs.use_exploration_noise": Rule("", "OmniSafe does not read it", same=None),
    "algo_cfgs.exploration_noise": Rule(
        "algo.noise_min algo.noise_max", "one for all environments; of CRABS always 2", noise
    ),
    "algo_cfgs.policy_noise": Rule("algo.smoothing"),
    "algo_cfgs.policy_noise_clip": Rule("algo.smoothing_clip"),
    "algo_cfgs.alpha": Rule("algo.alpha_init"),
    "algo_cfgs.auto_alpha": Rule("algo.alpha_init algo.alpha_lr", "false is a rate of 0", temperature),
    "algo_cfgs.warmup_epochs": Rule("algo.dual_starts", "epochs times steps_per_epoch", warm_up),
    "algo_cfgs.reward_normalize": Rule("", "rewards are as they are", same=(False,)),
    "algo_cfgs.use_critic_norm": Rule("", "critics have no such term", same=(False,)),
    "algo_cfgs.critic_norm_coef": Rule("", "only read with use_critic_norm", same=None),
    "algo_cfgs.penalty_coef": Rule("", "OmniSafe does not read it", same=None),
    "algo_cfgs.penalty_coefficient": Rule("", "OmniSafe does not read it", same=None),
    "logger_cfgs.window_lens": Rule("", "the price sees all episodes since it last moved", same=None),
    "model_cfgs.actor_type": Rule("", "the algorithm decides", same=None),
    "model_cfgs.critic.num_critics": Rule("", "one of DDPG, two of TD3 and SAC", same=(1, 2)),
    "model_cfgs.linear_lr_decay": Rule("algo.lr_decay"),
    "model_cfgs.actor.lr": Rule("algo.lr"),
    "lagrange_cfgs.lambda_lr": Rule(
        "algo.dual_lr", "at each gradient step there", per_move("algo.dual_lr")
    ),
    "lagrange_cfgs.pid_ki": Rule("algo.pid_ki", "at each gradient step there", per_move("algo.pid_ki")),
    # CRABS alone
    "train_cfgs.num_epochs": Rule("total_steps", "times steps_per_epoch", epochs),
    "train_cfgs.raw_policy_episodes": Rule("", "eval_every evaluates during training", same=None),
    "algo_cfgs.critic_norm_coeff": Rule("", "only read with use_critic_norm", same=None),
    "transition_model_cfgs.type": Rule("", "the models have no gates", same=None),
    "transition_model_cfgs.n_ensemble": Rule("algo.models"),
    "transition_model_cfgs.n_elites": Rule("", "all models count", same=(5,)),
    "transition_model_cfgs.frozen": Rule("", "models are always refitted", same=(False,)),
    "transition_model_cfgs.train.batch_size": Rule("algo.model_batch"),
    "transition_model_cfgs.train.weight_decay": Rule("", "OmniSafe does not read it", same=None),
    "transition_model_cfgs.train.lr": Rule("", "OmniSafe does not read it", same=None),
    "transition_model_cfgs.train.mul_std": Rule("", "errors are not scaled", same=(0,)),
    "lyapunov.ell_coef": Rule("", "always 1", same=(1,)),
    "lyapunov.barrier_coef": Rule("", "always 1", same=(1,)),
    "opt_s.temperature.max": Rule(
        "algo.temperature", "max and min are one", hottest("algo.temperature")
    ),
    "opt_s.temperature.min": Rule(
        "algo.temperature", "max and min are one", hottest("algo.temperature")
    ),
    "opt_s.filter.top_k": Rule("", "OmniSafe does not read it", same=None),
    "opt_s.filter.pool": Rule("", "OmniSafe does not read it", same=None),
    "opt_s.n_steps": Rule("", "always 1", same=(1,)),
    "opt_s.method": Rule("", "always MALA", same=("MALA",)),
    "opt_s.lr": Rule("", "how fast step sizes adapt: always 0.01", same=(0.01,)),
    "opt_s.batch_size": Rule("algo.chains"),
    "opt_s.extend_region": Rule("", "OmniSafe does not read it", same=None),
    "opt_s.barrier_coef": Rule("", "OmniSafe does not read it", same=None),
    "opt_s.L_neg_coef": Rule("", "OmniSafe does not read it", same=None),
    "opt_s.resample": Rule("", "states outside of the set jump into it", same=(False,)),
    "opt_s.n_proj_iters": Rule("", "states outside of the set jump into it", same=None),
    "opt_s.precond": Rule("", "OmniSafe does not read it", same=None),
    "opt_h.weight_decay": Rule("algo.barrier_decay"),
    "opt_h.lr": Rule("algo.barrier_lr"),
    "opt_h.lambda_2": Rule("", "always the ratio of the slopes", same=("norm",)),
    "opt_h.n_iters": Rule("", "OmniSafe does not read it", same=None),
    "crabs.obj.eps": Rule("algo.margin"),
    "crabs.obj.neg_coef": Rule("", "OmniSafe does not read it", same=None),
    "n_pretrain_s_iters": Rule("", "the search goes on from the run before", same=None),
    "task": Rule("", "init_from=RUN begins with a run", same=("train_policy",)),
}


def planner_steps(option: str) -> Translate:
    """Of what OmniSafe counts in raw steps, and we in steps of the planner."""

    def turn(value: Any, facts: Facts) -> dict[str, Any]:
        steps = round(convert(value, int, option) / facts.repeat)
        return {option: steps} if option in facts.options else {}

    return turn


def if_there(names: str) -> Translate:
    """For a key that OmniSafe's algorithm does not read, where ours lacks the option."""
    return lambda value, facts: {k: value for k in names.split() if k in facts.options}


def ensemble(names: str) -> Translate:
    """Of num_ensemble and num_particles. PETS and its kin share the particles among the models, in LOOP
    each model has as many."""

    def turn(value: Any, facts: Facts) -> dict[str, Any] | None:
        models = facts.whole("dynamics_cfgs.num_ensemble", 5)
        each = facts.options["algo.particles"]
        if LOOPS in facts.options:
            each = facts.whole("planner_cfgs.num_particles", each)
        else:
            total = facts.whole("planner_cfgs.num_particles", 5 * each)
            if total % models:
                return None
            each = total // models
        both = {"algo.models": models, "algo.particles": each}
        return {k: v for k, v in both.items() if k in names.split()}

    return turn


def plan(names: str) -> Translate:
    """Of plan_horizon, H, and temperature, which weighs a return that is 1000 / H as large there."""

    def turn(value: Any, facts: Facts) -> dict[str, Any]:
        steps = facts.whole("planner_cfgs.plan_horizon", facts.options["algo.plan_steps"])
        found = {"algo.plan_steps": steps}
        if LOOPS in facts.options:
            preset = facts.options["algo.temperature"] * facts.options["algo.plan_steps"] / 1000
            asked = facts.values.get("planner_cfgs.temperature", round(preset, 9))
            found["algo.temperature"] = convert(asked, float, "planner_cfgs.temperature") * 1000 / steps
        return {k: v for k, v in found.items() if k in names.split()}

    return turn


def actor_plans(value: Any, facts: Facts) -> dict[str, Any]:
    share = convert(value, float, "planner_cfgs.mixture_coefficient")
    plans, models = (
        facts.whole("planner_cfgs.num_samples", 100),
        facts.whole("dynamics_cfgs.num_ensemble", 5),
    )
    return {"algo.actor_plans": max(1, round(share * plans / models))}


def beside(value: Any, facts: Facts) -> dict[str, Any] | None:
    """Of LOOP's update_policy_cycle, update_policy_iters and policy_batch_size."""
    every = max(1, facts.whole("algo_cfgs.update_policy_cycle", 250) // facts.repeat)
    batch = facts.whole("algo_cfgs.policy_batch_size", 256)
    replayed = facts.whole("algo_cfgs.update_policy_iters", 50) * batch
    if replayed % every:
        return None
    return {
        "algo.learn_every": every,
        "algo.horizon": every * max(1, round(UPDATE / every)),
        "algo.replay_ratio": replayed // every,
        "algo.batch_size": batch,
    }


def cooling(value: Any, facts: Facts) -> dict[str, Any]:
    """LOOP's temperature. Multiplied by alpha_gamma at each gradient step it is soon next to 0."""
    falls = facts.values.get("algo_cfgs.alpha_discount", facts.options["algo.alpha_init"] == COLD)
    fixed = convert(facts.values.get("algo_cfgs.alpha", 0.2), float, "algo_cfgs.alpha")
    return {"algo.alpha_init": COLD if falls else fixed}


LOOPS = "algo.actor_plans"  # an option of LOOP and its kin alone
UPDATE = 40  # steps of the planner in an update of the presets
COLD = 1e-3  # what a temperature that falls is in the presets of LOOP
POLICY = "algo.learn_every algo.horizon algo.replay_ratio algo.batch_size"
DECIDES = "the algorithm decides"
MODEL_BASED: dict[str, Rule] = OMNISAFE | {  # of its model-based algorithms; what differs
    **{
        key: OFF_POLICY[key]
        for key in (
            "algo_cfgs.policy_delay",
            "algo_cfgs.polyak",
            "algo_cfgs.reward_normalize",
            "algo_cfgs.use_critic_norm",
            "model_cfgs.actor_type",
            "model_cfgs.critic.num_critics",
            "model_cfgs.linear_lr_decay",
            "model_cfgs.actor.lr",
        )
    },
    "train_cfgs.vector_env_nums": Rule("num_envs"),
    "algo_cfgs.action_repeat": Rule(
        "env.wrap.action_repeat", "a step of the planner; all settings of the algorithm count these"
    ),
    "algo_cfgs.steps_per_epoch": Rule(
        "algo.dual_every",
        "of CAP-PETS, whose kappa moves once an epoch",
        planner_steps("algo.dual_every"),
    ),
    "algo_cfgs.update_dynamics_cycle": Rule(
        "algo.refit_every", "in steps of the planner", planner_steps("algo.refit_every")
    ),
    "algo_cfgs.start_learning_steps": Rule(
        "algo.learning_starts", "in steps of the planner", planner_steps("algo.learning_starts")
    ),
    "algo_cfgs.cost_limit": Rule(
        "algo.cost_limit", "of an episode; of 1000 steps of the planner there"
    ),
    "algo_cfgs.cost_normalize": Rule("", "costs are as they are", same=(False,)),
    "algo_cfgs.obs_normalize": Rule("", "the model scales its inputs", same=(False,)),
    "algo_cfgs.policy_store_done": Rule("", "ends are always kept", same=None),
    "algo_cfgs.policy_batch_size": Rule(POLICY, "", beside),
    "algo_cfgs.update_policy_cycle": Rule(POLICY, "in steps of the planner", beside),
    "algo_cfgs.update_policy_iters": Rule(POLICY, "gradient steps of a round", beside),
    "algo_cfgs.use_grad_norm": Rule(
        "algo.max_grad_norm", "false is inf", unless_on("algo.max_grad_norm", math.inf)
    ),
    "algo_cfgs.critic_norm_coeff": Rule("", "only read with use_critic_norm", same=None),
    "algo_cfgs.alpha": Rule("algo.alpha_init", "with alpha_discount 0.001", cooling),
    "algo_cfgs.alpha_discount": Rule("algo.alpha_init", "true is 0.001", cooling),
    "algo_cfgs.alpha_gamma": Rule("", "the temperature is low from the beginning", same=None),
    "algo_cfgs.auto_alpha": Rule("", "OmniSafe does not read it", same=None),
    "algo_cfgs.loss_pi_deterministic": Rule(
        "", "the actor's loss is of an action that is drawn", same=(False,)
    ),
    "dynamics_cfgs.num_ensemble": Rule(
        "algo.models algo.particles", "", ensemble("algo.models algo.particles")
    ),
    "dynamics_cfgs.elite_size": Rule("", "it only changes plots of OmniSafe's evaluation", same=None),
    "dynamics_cfgs.hidden_size": Rule(
        "algo.model_hidden", "of four layers", lambda value, facts: {"algo.model_hidden": (value,) * 4}
    ),
    "dynamics_cfgs.use_decay": Rule(
        "algo.weight_decay", "false is 0", unless_on("algo.weight_decay", 0.0)
    ),
    "dynamics_cfgs.predict_reward": Rule("", "the model always predicts the reward", same=(True,)),
    "dynamics_cfgs.predict_cost": Rule(
        "algo.learn_cost",
        "false only where the observation tells the cost",
        lambda on, facts: {"algo.learn_cost": True} if on else {},
    ),
    "dynamics_cfgs.batch_size": Rule("algo.model_batch"),
    "dynamics_cfgs.max_epoch": Rule("", "OmniSafe does not read it", same=None),
    "dynamics_cfgs.reward_size": Rule("", "there is one", same=(1,)),
    "dynamics_cfgs.cost_size": Rule("", "there is one", same=(1,)),
    "dynamics_cfgs.use_cost": Rule("", DECIDES, same=None),
    "dynamics_cfgs.use_terminal": Rule("", "the model foresees no end", same=(False,)),
    "dynamics_cfgs.use_var": Rule("", DECIDES, same=None),
    "dynamics_cfgs.use_reward_critic": Rule("", DECIDES, same=None),
    "dynamics_cfgs.use_cost_critic": Rule("", "there is none in a plan", same=(False,)),
    "planner_cfgs.plan_horizon": Rule(
        "algo.plan_steps algo.temperature", "", plan("algo.plan_steps algo.temperature")
    ),
    "planner_cfgs.num_iterations": Rule("algo.cem_iterations"),
    "planner_cfgs.num_particles": Rule(
        "algo.particles", "of each model; of PETS and its kin in all there", ensemble("algo.particles")
    ),
    "planner_cfgs.num_samples": Rule("algo.plans"),
    "planner_cfgs.num_elites": Rule("algo.elites", "LOOP does not read it", if_there("algo.elites")),
    "planner_cfgs.mixture_coefficient": Rule("algo.actor_plans", "plans of each model", actor_plans),
    "planner_cfgs.temperature": Rule("algo.temperature", "times 1000 / H", plan("algo.temperature")),
    "planner_cfgs.cost_temperature": Rule("algo.cost_temperature"),
    "planner_cfgs.momentum": Rule(
        "algo.mean_momentum algo.var_momentum",
        "of SafeLOOP for the variance alone",
        lambda value, facts: (
            {"algo.var_momentum": value}
            if "algo.cost_temperature" in facts.options
            else {"algo.mean_momentum": value, "algo.var_momentum": value}
        ),
    ),
    "planner_cfgs.epsilon": Rule(
        "algo.var_stop",
        "only LOOP and SafeLOOP read it",
        lambda value, facts: {"algo.var_stop": value} if LOOPS in facts.options else {},
    ),
    "planner_cfgs.init_var": Rule("algo.plan_var"),
    **{
        key: Rule("", "OmniSafe does not read it there", same=None)
        for key in (
            "algo_cfgs.plan_horizon",
            "algo_cfgs.init_var",
            "algo_cfgs.temperature",
            "planner_cfgs.alpha",
        )
    },
    "evaluation_cfgs.eval_cycle": Rule("eval_every"),
    "evaluation_cfgs.num_episode": Rule("eval_episodes"),
    "evaluation_cfgs.use_eval": Rule("eval_every", "false is 0", unless_on("eval_every", 0)),
    "logger_cfgs.window_lens": Rule("", "kappa sees all episodes since it last moved", same=None),
    "lagrange_cfgs.lagrangian_multiplier_init": Rule("algo.kappa_init"),
    "lagrange_cfgs.lambda_lr": Rule("algo.kappa_lr"),
    "lagrange_cfgs.lambda_optimizer": Rule("", "always plain gradient steps", same=("SGD",)),
    "lagrange_cfgs.lagrangian_upper_bound": Rule("algo.kappa_max"),
}


class Family(NamedTuple):
    """config: what our configs of the family are. defaults: OmniSafe's that are not in the preset."""

    config: type
    rules: dict[str, Rule]
    defaults: Mapping[str, Any] = MappingProxyType({})


FAMILIES = {  # the first that an algorithm's config is one of
    "model-based": Family(ModelBasedConfig, MODEL_BASED, {"total_steps": 1_000_000}),
    "offline": Family(OfflineConfig, OFFLINE, {"total_updates": 1_000_000, "eval_episodes": 10}),
    "off-policy": Family(OffPolicyConfig, OFF_POLICY, {"total_steps": 1_000_000}),
    "on-policy": Family(object, OMNISAFE),
}
KNOWN = OFFLINE | OFF_POLICY | MODEL_BASED
# Options that Engine does not have.
OURS_ALONE = (
    "rules", "observation", "awake", "contact_room", "bounds_num", "bounds", "bounds_cost",
    "vision_camera",
)  # fmt: skip


class Line(NamedTuple):
    """What became of a key: `text` is its options, or why it has none; `lost` if it asked for more."""

    key: str
    value: Any
    text: str
    lost: bool = False


class Migrated(NamedTuple):
    argv: list[str]  # after scripts/train.py
    lines: list[Line]


def family_of(row: Row) -> str:
    return next(name for name, family in FAMILIES.items() if issubclass(row.config, family.config))


def only_of(key: str) -> Rule:
    """For a key of another family's algorithms."""
    families = [name for name, family in FAMILIES.items() if key in family.rules]
    return Rule("", f"a key of {' and '.join(families)} algorithms")


def omnisafe(config: dict[str, Any], algo: str = "", env: str = "") -> Migrated:
    """The command line for a config of OmniSafe.

    Args:
        config: its tree, as in a run's config.json, or with `defaults` as in OmniSafe's own files.
        algo, env: OmniSafe's names, if the config has none; an env may be one of ours.
    Raises:
        ConfigError: a key, an algorithm or an environment that is unknown or has no counterpart, or a
            value of the wrong type.
    """
    if "defaults" in config:
        config = flatten(config["defaults"]) | flatten(config.get(env) or {})
    values = {k: v for k, v in flatten(config).items() if not k.startswith("exp_increment_cfgs.")}
    for key in values:
        if key not in KNOWN:
            raise ConfigError(f"unknown key {key} of OmniSafe{nearest(key, KNOWN)}")
    name = find_algorithm(algo or values.get("algo"))
    target = find_environment(env or values.get("env_id"))
    row = algos.ALGOS[name]
    family = FAMILIES[family_of(row)]
    preset, target, repeat = set_up(row, target)
    start = {f"algo.{k}": v for k, v in algo_options(row, preset, "omnisafe").items()}
    start |= {"seed": 0, "eval_episodes": TrainConfig.eval_episodes}
    if family.config is OfflineConfig:
        start |= {"total_updates": OFFLINE_UPDATES, "dataset": None}
    else:
        start |= {"num_envs": start["algo.num_envs"], "total_steps": TrainConfig.total_steps}
    found = {**family.defaults}
    if family.config is ModelBasedConfig:
        start |= {"eval_every": 0, REPEAT: 1}
        found[REPEAT] = repeat = convert(values.get("algo_cfgs.action_repeat", repeat), Amount, REPEAT)
    facts = Facts(values, start, repeat)
    defaults = f"preset={preset} compat=omnisafe"
    lines = [Line("algo", algo or values.get("algo"), f"algo={name} {defaults}")]
    lines.append(Line("env_id", env or values.get("env_id"), " ".join(target)))
    for key in [k for k in KNOWN if k in values and k not in ("algo", "env_id")]:
        rule, value = family.rules.get(key) or only_of(key), values[key]
        if not rule.ours:
            lost = rule.same is not None and value not in rule.same
            lines.append(Line(key, value, rule.note, lost))
            continue
        turned = dict.fromkeys(rule.ours.split(), value)
        turned = rule.turn(value, facts) if rule.turn else turned
        if not turned:
            lines.append(Line(key, value, rule.note if turned is None else "so it is", turned is None))
            continue
        fits = {k: v for k, v in turned.items() if k in start}
        if not fits:
            lines.append(Line(key, value, f"{name} has no {' or '.join(turned)}", lost=True))
            continue
        replaced = [as_option(k, found[k]) for k, v in fits.items() if found.get(k, v) != v]
        found |= fits
        text = " ".join(as_option(k, v) for k, v in fits.items())
        lines.append(Line(key, value, text + "".join(f" in place of {r}" for r in replaced)))
    checked = from_dict(
        row.config, {k[5:]: v for k, v in found.items() if k.startswith("algo.")}, "algo."
    )
    for key, value in found.items():
        kind = str if key == "dataset" else int
        found[key] = getattr(checked, key[5:]) if key.startswith("algo.") else convert(value, kind, key)
    changed = [as_option(k, v) for k, v in found.items() if v != start[k]]
    return Migrated([*target, f"algo={name}", *defaults.split(), *changed], lines)


def set_up(row: Row, target: list[str]) -> tuple[str, list[str], int]:
    """The preset, all options of the environment, and OmniSafe's raw steps in a step.

    Raises:
        ConfigError: OmniSafe's planners do not take the environment.
    """
    task = target[0].removeprefix("env=")
    if issubclass(row.config, BarrierConfig) and not task.startswith("pendulum_"):
        raise ConfigError(f"{target[0]}: CRABS is for SafeInvertedPendulumSwing-v2 alone there")
    if not issubclass(row.config, ModelBasedConfig):
        return "published", target, 1
    if isinstance(envs.ENVS[task], VelocityConfig):
        return "omnisafe_velocity", target, 1
    if "_goal" not in task:
        raise ConfigError(f"{target[0]}: OmniSafe plans in Goal and in the velocity tasks alone")
    return "published", [*target, "env.observation=coordinates"], 5


def algorithms() -> dict[str, str]:
    """OmniSafe's names of the algorithms, and ours."""
    return dict(sorted((row.omnisafe, name) for name, row in algos.ALGOS.items() if row.omnisafe))


def find_algorithm(theirs: Any) -> str:
    known = algorithms()
    if not theirs:
        raise ConfigError(f"no algorithm in the file: add --algo, one of {', '.join(known)}")
    if theirs not in known:
        raise ConfigError(f"unknown algorithm {theirs} of OmniSafe{nearest(str(theirs), known)}")
    return known[theirs]


def find_environment(theirs: Any) -> list[str]:
    """Options for the environment that OmniSafe calls `theirs`, or that is called so here."""
    if not theirs:
        raise ConfigError("no env_id in the file: add --env, as in --env SafetyPointGoal1-v0")
    theirs = theirs.removesuffix("-modelbased")  # of the tasks of its planners
    if (alias := theirs.replace("Gymnasium-", "-")) in envs.ALIASES:
        implied = (as_option(f"env.{k}", v) for k, v in IMPLIED.get(alias, {}).items())
        return [f"env={envs.canonical(alias)}", *implied]
    if theirs.startswith("Safety"):
        raise ConfigError(
            f"{theirs} has no counterpart: of Safety-Gymnasium's tasks we have Point's and Car's Goal, "
            "Button, Push, Circle and Run, and the velocity tasks; --env chooses another, by "
            "Safety-Gymnasium's name or ours"
        )
    return [f"env={envs.canonical(theirs)}"]


def safety_gym(config: dict[str, Any]) -> Migrated:
    """The command line for the dict that Safety Gym's Engine takes; its options are ours by name.

    The environment is the registered one of that task and robot, if any, that differs least from it.

    Raises:
        ConfigError: an option that Engine does not have, or a value of the wrong type.
    """
    config = {**config}
    known = [field for field in defaults() if field not in OURS_ALONE]
    for key in config:
        if key not in known:
            raise ConfigError(f"unknown option {key} of Engine{nearest(key, known)}")
    lines = []
    options = dataclasses.asdict(read_config(defaults(**config)))

    def differences(name: str) -> dict[str, Any]:
        other = envs.env_defaults(name)
        return {k: v for k, v in options.items() if v != other[k]}

    def distance(name: str) -> tuple[bool, bool, int]:
        found = differences(name)
        return "task" in found, "robot_base" in found, len(found)

    name = min(suite.suite(), key=distance)
    argv = [f"env={name}", *(as_option(f"env.{k}", v) for k, v in differences(name).items())]
    lines += [Line(k, config[k], as_option(f"env.{k}", options[k])) for k in config]
    return Migrated(argv, lines)


def flatten(tree: Any, head: str = "") -> dict[str, Any]:
    """{'train_cfgs.device': 'cpu', ...}"""
    if not isinstance(tree, dict):
        raise ConfigError(f"{head or 'the file'}: expected names with values, not {tree!r}")
    found: dict[str, Any] = {}
    for name, value in tree.items():
        deeper = isinstance(value, dict)
        found |= flatten(value, f"{head}{name}.") if deeper else {f"{head}{name}": value}
    return found


def as_option(key: str, value: Any) -> str:
    """An option as train.py reads it."""
    return f"{key}={as_text(value)}"


def read_file(path: Path) -> dict[str, Any]:
    """A .json or .yaml file. Executes nothing from it."""
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot read {path}: {one_line(error)}") from error
    if path.suffix not in (".json", ".yaml", ".yml"):
        raise ConfigError(f"{path}: expected a name that ends in .json or .yaml")
    try:
        tree = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
    except (json.JSONDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{path} is no {path.suffix[1:].upper()}: {one_line(error)}") from error
    flatten(tree)
    return tree


def report(lines: list[Line]) -> str:
    """A line a key; what the command does not do comes last."""
    return "\n".join(
        f"{'no counterpart: ' * line.lost}{line.key}={as_text(line.value)}: {line.text}"
        for line in sorted(lines, key=lambda line: line.lost)
    )
