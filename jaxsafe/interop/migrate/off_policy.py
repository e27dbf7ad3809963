"""Keys of OmniSafe's off-policy algorithms that its on-policy ones lack or read otherwise."""

from typing import Any

from jaxsafe.config import Amount, Period, convert
from jaxsafe.interop.migrate.on_policy import ON_POLICY
from jaxsafe.interop.migrate.rules import Facts, Rule, Translate, always, computed, ignored
from jaxsafe.learn.bill import PriceClockConfig

HORIZON = 50  # steps of an update of the preset
DUAL_EVERY = PriceClockConfig.dual_every


def rounds(value: Any, facts: Facts) -> dict[str, Any] | None:
    """From vector_env_nums, update_cycle, update_iters, size and batch_size. OmniSafe's size and
    batch_size are those of each environment."""
    envs_there = facts.whole("train_cfgs.vector_env_nums", 1)
    if "algo.chains" in facts.options:  # CRABS learns 2,000 times in 6,000 steps, as its preset does
        size = facts.whole("algo_cfgs.size", 1_000_000)
        return {"algo.batch_size": facts.whole("algo_cfgs.batch_size", 256), "algo.replay_size": size}
    cycle = facts.whole("algo_cfgs.update_cycle", 1)
    batch = envs_there * facts.whole("algo_cfgs.batch_size", 256)
    replayed = facts.whole("algo_cfgs.update_iters", 1) * batch
    if replayed % (cycle * envs_there):
        return None
    return {
        "num_envs": envs_there,
        "algo.learn_every": cycle,
        "algo.horizon": cycle * max(1, round(HORIZON / cycle)),
        "algo.replay_ratio": replayed // (cycle * envs_there),
        "algo.batch_size": batch,
        "algo.replay_size": envs_there * facts.whole("algo_cfgs.size", 1_000_000),
    }


def per_move(option: str) -> Translate:
    """A step that OmniSafe takes at each gradient step, and we every `dual_every` environment steps."""

    def turn(value: Any, facts: Facts) -> dict[str, Any]:
        steps = facts.whole("algo_cfgs.update_cycle", 1) * facts.whole("train_cfgs.vector_env_nums", 1)
        moves = DUAL_EVERY * facts.whole("algo_cfgs.update_iters", 1) / steps
        return {option: convert(value, float, option) * moves}

    return turn


def warm_up(value: Any, facts: Facts) -> dict[str, Any]:
    epochs = convert(value, Period, "algo_cfgs.warmup_epochs")
    return {"algo.dual_starts": epochs * facts.whole("algo_cfgs.steps_per_epoch", 2000)}


def temperature(on: Any, facts: Facts) -> dict[str, Any]:
    """OmniSafe's own alpha begins at 1 and has the critics' rate."""
    rate = facts.real("model_cfgs.critic.lr", 3e-4)
    return {"algo.alpha_init": 1.0, "algo.alpha_lr": rate} if on else {"algo.alpha_lr": 0.0}


def noise(value: Any, facts: Facts) -> dict[str, Any] | None:
    """CRABS has it in a third of its environments, as a factor."""
    if "algo.chains" in facts.options:
        return {} if value == 2 else None
    return {"algo.noise_min": value, "algo.noise_max": value}


def epochs(value: Any, facts: Facts) -> dict[str, Any]:
    steps = facts.whole("algo_cfgs.steps_per_epoch", 6000)
    return {"total_steps": steps * convert(value, Amount, "train_cfgs.num_epochs")}


def hottest(value: Any, facts: Facts) -> dict[str, Any] | None:
    """The higher or the lower end of a range, which is one number here."""
    ends = [facts.values.get(f"opt_s.temperature.{end}", value) for end in ("min", "max")]
    return {"algo.temperature": value} if ends[0] == ends[1] else None


OFF_POLICY: dict[str, Rule] = ON_POLICY | {
    "train_cfgs.vector_env_nums": computed(
        "num_envs algo.batch_size algo.replay_size algo.replay_ratio",
        rounds,
        "size and batch_size are of each environment there",
    ),
    "train_cfgs.eval_episodes": Rule("eval_episodes", "eval_every evaluates during training"),
    "algo_cfgs.steps_per_epoch": ignored("metrics have a row for each update"),
    "algo_cfgs.update_cycle": computed(
        "algo.learn_every algo.horizon algo.replay_ratio", rounds, "steps between two rounds"
    ),
    "algo_cfgs.update_iters": computed("algo.replay_ratio", rounds, "gradient steps of a round"),
    "algo_cfgs.size": computed("algo.replay_size", rounds),
    "algo_cfgs.batch_size": computed("algo.batch_size algo.replay_ratio", rounds),
    "algo_cfgs.start_learning_steps": Rule("algo.learning_starts"),
    "algo_cfgs.policy_delay": Rule("algo.policy_delay"),
    "algo_cfgs.polyak": Rule("algo.tau"),
    "algo_cfgs.use_exploration_noise": ignored("OmniSafe does not read it"),
    "algo_cfgs.exploration_noise": computed(
        "algo.noise_min algo.noise_max", noise, "one for all environments; of CRABS always 2"
    ),
    "algo_cfgs.policy_noise": Rule("algo.smoothing"),
    "algo_cfgs.policy_noise_clip": Rule("algo.smoothing_clip"),
    "algo_cfgs.alpha": Rule("algo.alpha_init"),
    "algo_cfgs.auto_alpha": computed(
        "algo.alpha_init algo.alpha_lr", temperature, "false is a rate of 0"
    ),
    "algo_cfgs.warmup_epochs": computed("algo.dual_starts", warm_up, "epochs times steps_per_epoch"),
    "algo_cfgs.reward_normalize": always(False, note="rewards are as they are"),
    "algo_cfgs.use_critic_norm": always(False, note="critics have no such term"),
    "algo_cfgs.critic_norm_coef": ignored("only read with use_critic_norm"),
    "algo_cfgs.penalty_coef": ignored("OmniSafe does not read it"),
    "algo_cfgs.penalty_coefficient": ignored("OmniSafe does not read it"),
    "logger_cfgs.window_lens": ignored("the price sees all episodes since it last moved"),
    "model_cfgs.actor_type": ignored("the algorithm decides"),
    "model_cfgs.critic.num_critics": always(1, 2, note="one of DDPG, two of TD3 and SAC"),
    "model_cfgs.linear_lr_decay": Rule("algo.lr_decay"),
    "model_cfgs.actor.lr": Rule("algo.lr"),
    "lagrange_cfgs.lambda_lr": computed(
        "algo.dual_lr", per_move("algo.dual_lr"), "at each gradient step there"
    ),
    "lagrange_cfgs.pid_ki": computed(
        "algo.pid_ki", per_move("algo.pid_ki"), "at each gradient step there"
    ),
    # CRABS alone
    "train_cfgs.num_epochs": computed("total_steps", epochs, "times steps_per_epoch"),
    "train_cfgs.raw_policy_episodes": ignored("eval_every evaluates during training"),
    "algo_cfgs.critic_norm_coeff": ignored("only read with use_critic_norm"),
    "transition_model_cfgs.type": ignored("the models have no gates"),
    "transition_model_cfgs.n_ensemble": Rule("algo.models"),
    "transition_model_cfgs.n_elites": always(5, note="all models count"),
    "transition_model_cfgs.frozen": always(False, note="models are always refitted"),
    "transition_model_cfgs.train.batch_size": Rule("algo.model_batch"),
    "transition_model_cfgs.train.weight_decay": ignored("OmniSafe does not read it"),
    "transition_model_cfgs.train.lr": ignored("OmniSafe does not read it"),
    "transition_model_cfgs.train.mul_std": always(0, note="errors are not scaled"),
    "lyapunov.ell_coef": always(1, note="always 1"),
    "lyapunov.barrier_coef": always(1, note="always 1"),
    "opt_s.temperature.max": computed("algo.temperature", hottest, "max and min are one"),
    "opt_s.temperature.min": computed("algo.temperature", hottest, "max and min are one"),
    "opt_s.filter.top_k": ignored("OmniSafe does not read it"),
    "opt_s.filter.pool": ignored("OmniSafe does not read it"),
    "opt_s.n_steps": always(1, note="always 1"),
    "opt_s.method": always("MALA", note="always MALA"),
    "opt_s.lr": always(0.01, note="how fast step sizes adapt: always 0.01"),
    "opt_s.batch_size": Rule("algo.chains"),
    "opt_s.extend_region": ignored("OmniSafe does not read it"),
    "opt_s.barrier_coef": ignored("OmniSafe does not read it"),
    "opt_s.L_neg_coef": ignored("OmniSafe does not read it"),
    "opt_s.resample": always(False, note="states outside of the set jump into it"),
    "opt_s.n_proj_iters": ignored("states outside of the set jump into it"),
    "opt_s.precond": ignored("OmniSafe does not read it"),
    "opt_h.weight_decay": Rule("algo.barrier_decay"),
    "opt_h.lr": Rule("algo.barrier_lr"),
    "opt_h.lambda_2": always("norm", note="always the ratio of the slopes"),
    "opt_h.n_iters": ignored("OmniSafe does not read it"),
    "crabs.obj.eps": Rule("algo.margin"),
    "crabs.obj.neg_coef": ignored("OmniSafe does not read it"),
    "n_pretrain_s_iters": ignored("the search goes on from the run before"),
    "task": always("train_policy", note="init_from=RUN begins with a run"),
}
