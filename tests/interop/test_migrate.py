"""Configs of OmniSafe and of Safety Gym's Engine as command lines."""

import dataclasses
import json
from typing import Any

import pytest
from shell import typed

from jaxsafe import algos, envs
from jaxsafe.config import ConfigError
from jaxsafe.envs.safety_gym import suite
from jaxsafe.interop import migrate
from jaxsafe.interop.migrate.model_based import REPEAT
from jaxsafe.interop.migrate.on_policy import ON_POLICY
from jaxsafe.run import arguments, hydra_jobs
from jaxsafe.run.settings import TrainConfig

# What OmniSafe 0.5.0 and later takes where nothing is said: PPOLag, and what is other of TRPO.
PPO_LAG: dict[str, Any] = {
    "seed": 0,
    "train_cfgs": {
        "device": "cpu",
        "torch_threads": 16,
        "vector_env_nums": 1,
        "parallel": 1,
        "total_steps": 10000000,
    },
    "algo_cfgs": {
        "steps_per_epoch": 20000,
        "update_iters": 40,
        "batch_size": 64,
        "target_kl": 0.02,
        "entropy_coef": 0.0,
        "reward_normalize": False,
        "cost_normalize": False,
        "obs_normalize": True,
        "kl_early_stop": True,
        "use_max_grad_norm": True,
        "max_grad_norm": 40.0,
        "use_critic_norm": True,
        "critic_norm_coef": 0.001,
        "gamma": 0.99,
        "cost_gamma": 0.99,
        "lam": 0.95,
        "lam_c": 0.95,
        "clip": 0.2,
        "adv_estimation_method": "gae",
        "standardized_rew_adv": True,
        "standardized_cost_adv": True,
        "penalty_coef": 0.0,
        "use_cost": True,
    },
    "logger_cfgs": {"use_wandb": False, "save_model_freq": 100, "log_dir": "./runs"},
    "model_cfgs": {
        "weight_initialization_mode": "kaiming_uniform",
        "actor_type": "gaussian_learning",
        "linear_lr_decay": True,
        "exploration_noise_anneal": False,
        "std_range": [0.5, 0.1],
        "actor": {"hidden_sizes": [64, 64], "activation": "tanh", "lr": 0.0003},
        "critic": {"hidden_sizes": [64, 64], "activation": "tanh", "lr": 0.0003},
    },
    "lagrange_cfgs": {
        "cost_limit": 25.0,
        "lagrangian_multiplier_init": 0.001,
        "lambda_lr": 0.035,
        "lambda_optimizer": "Adam",
    },
}
TRPO: dict[str, Any] = {
    "algo_cfgs": {
        "update_iters": 10,
        "batch_size": 128,
        "target_kl": 0.01,
        "kl_early_stop": False,
        "cg_damping": 0.1,
        "cg_iters": 15,
        "fvp_obs": None,
        "fvp_sample_freq": 1,
    },
    "model_cfgs": {"linear_lr_decay": False, "actor": {"lr": None}, "critic": {"lr": 0.001}},
}
# configs/off-policy/SACLag.yaml
SAC_LAG: dict[str, Any] = {
    "seed": 0,
    "train_cfgs": {
        "device": "cpu",
        "torch_threads": 16,
        "vector_env_nums": 1,
        "parallel": 1,
        "total_steps": 1000000,
    },
    "algo_cfgs": {
        "steps_per_epoch": 2000,
        "update_cycle": 1,
        "update_iters": 1,
        "size": 1000000,
        "batch_size": 256,
        "reward_normalize": False,
        "cost_normalize": True,
        "obs_normalize": False,
        "max_grad_norm": 40,
        "use_critic_norm": False,
        "critic_norm_coef": 0.001,
        "polyak": 0.005,
        "gamma": 0.99,
        "start_learning_steps": 10000,
        "policy_delay": 2,
        "use_exploration_noise": False,
        "exploration_noise": 0.1,
        "policy_noise": 0.2,
        "policy_noise_clip": 0.5,
        "alpha": 0.2,
        "auto_alpha": False,
        "use_cost": True,
        "warmup_epochs": 100,
    },
    "logger_cfgs": {"use_wandb": False, "save_model_freq": 100, "window_lens": 10},
    "model_cfgs": {
        "weight_initialization_mode": "kaiming_uniform",
        "actor_type": "gaussian_sac",
        "linear_lr_decay": False,
        "actor": {"hidden_sizes": [256, 256], "activation": "relu", "lr": 0.0003},
        "critic": {
            "num_critics": 2,
            "hidden_sizes": [256, 256],
            "activation": "relu",
            "lr": 0.0003,
        },
    },
    "lagrange_cfgs": {
        "cost_limit": 25.0,
        "lagrangian_multiplier_init": 0.001,
        "lambda_lr": 1e-5,
        "lambda_optimizer": "Adam",
    },
}
PLAIN = ["env=point_goal1", "env.rules=safety_gymnasium"]


def migrated(config: dict[str, Any], algo: str, env: str = "SafetyPointGoal1-v0") -> migrate.Migrated:
    found = migrate.omnisafe(config, algo, env)
    hydra_jobs.check_arguments(found.argv)  # train.py takes it
    return found


def lost(found: migrate.Migrated) -> list[str]:
    return [line.key for line in found.lines if line.lost]


@pytest.mark.parametrize(
    "config, theirs, ours", [(PPO_LAG, "PPOLag", "ppo_lag"), (TRPO, "TRPO", "trpo")]
)
def test_the_defaults_are_the_published_preset(config, theirs, ours):
    found = migrated(config, theirs)
    assert found.argv == [*PLAIN, f"algo={ours}", "preset=published", "compat=omnisafe"]
    assert lost(found) == []
    assert {line.key for line in found.lines} == {"algo", "env_id", *migrate.flatten(config)}


def test_off_policy_defaults_are_the_published_preset_for_a_million_steps():
    found = migrated(SAC_LAG, "SACLag")
    start = [*PLAIN, "algo=sac_lag", "preset=published", "compat=omnisafe"]
    assert found.argv == [*start, "total_steps=1000000"]
    noise = {f"algo_cfgs.{key}" for key in ("exploration_noise", "policy_noise", "policy_noise_clip")}
    assert set(lost(found)) == noise  # which SAC does not have


@pytest.mark.parametrize(
    "theirs, keys, options",
    [
        ("DDPG", {"train_cfgs.vector_env_nums": 4},
         "num_envs=4 algo.replay_size=4000000 algo.batch_size=1024"),
        ("TD3Lag", {"algo_cfgs.update_cycle": 4, "algo_cfgs.update_iters": 2},
         "algo.learn_every=4 algo.horizon=48 algo.replay_ratio=128"),
        ("SAC", {"algo_cfgs.auto_alpha": True, "model_cfgs.critic.lr": 1e-3},
         "algo.alpha_init=1.0 algo.alpha_lr=0.001 algo.critic_lr=0.001"),
        ("SACLag", {"lagrange_cfgs.lambda_lr": 5e-7, "algo_cfgs.warmup_epochs": 10},
         "algo.dual_lr=0.01 algo.dual_starts=20000"),
        ("TD3PID", {"lagrange_cfgs.pid_ki": 1e-8, "algo_cfgs.exploration_noise": 0.2},
         "algo.pid_ki=0.0002 algo.noise_min=0.2 algo.noise_max=0.2"),
    ],
)  # fmt: skip
def test_an_off_policy_key_becomes_its_options(theirs, keys, options):
    found = migrated(keys, theirs)
    assert set(options.split()) <= set(found.argv) and not lost(found)
    assert len(found.argv) == 5 + 1 + len(options.split())


# configs/model-based/SafeLOOP.yaml, and what is other of the PETS family and of CAPPETS
SAFE_LOOP: dict[str, Any] = {
    "seed": 0,
    "train_cfgs": {
        "device": "cpu", "torch_threads": 16, "total_steps": 1000000, "vector_env_nums": 1,
        "parallel": 1,
    },
    "dynamics_cfgs": {
        "num_ensemble": 5, "elite_size": 5, "hidden_size": 200, "use_decay": True,
        "predict_reward": True, "predict_cost": False, "batch_size": 256, "max_epoch": 5,
        "reward_size": 1, "cost_size": 1, "use_cost": True, "use_terminal": False, "use_var": False,
        "use_reward_critic": True, "use_cost_critic": False,
    },
    "planner_cfgs": {
        "plan_horizon": 7, "num_iterations": 5, "num_particles": 4, "num_samples": 100,
        "mixture_coefficient": 0.05, "num_elites": 20, "temperature": 10.0, "cost_temperature": 100.0,
        "momentum": 0.1, "epsilon": 0.001, "init_var": 0.075,
    },
    "evaluation_cfgs": {"use_eval": True, "eval_cycle": 10000, "num_episode": 1},
    "algo_cfgs": {
        "steps_per_epoch": 20000, "cost_limit": 1.0, "action_repeat": 5, "update_dynamics_cycle": 1200,
        "start_learning_steps": 10000, "reward_normalize": False, "cost_normalize": False,
        "obs_normalize": False, "policy_store_done": False, "gamma": 0.99, "cost_gamma": 0.99,
        "policy_batch_size": 256, "update_policy_cycle": 250, "update_policy_iters": 50,
        "max_grad_norm": 40, "use_critic_norm": False, "critic_norm_coeff": 0.001, "polyak": 0.005,
        "alpha": 0.2, "alpha_discount": True, "loss_pi_deterministic": True, "use_grad_norm": False,
        "alpha_gamma": 0.99, "auto_alpha": False, "policy_delay": 1, "use_cost": False,
    },
    "logger_cfgs": {"use_wandb": False, "save_model_freq": 5, "window_lens": 10},
    "model_cfgs": {
        "weight_initialization_mode": "kaiming_uniform", "actor_type": "gaussian_sac",
        "linear_lr_decay": False,
        "actor": {"hidden_sizes": [64, 64], "activation": "relu", "lr": 0.001},
        "critic": {"num_critics": 2, "hidden_sizes": [64, 64], "activation": "relu", "lr": 0.001},
    },
}  # fmt: skip
LOOP: dict[str, Any] = SAFE_LOOP | {
    "planner_cfgs": {
        k: v for k, v in SAFE_LOOP["planner_cfgs"].items() if k != "cost_temperature"
    } | {"init_var": 0.01},
    "algo_cfgs": {k: v for k, v in SAFE_LOOP["algo_cfgs"].items() if k != "cost_limit"},
}  # fmt: skip
PETS: dict[str, Any] = {k: v for k, v in SAFE_LOOP.items() if k != "model_cfgs"} | {
    "planner_cfgs": {
        "plan_horizon": 7, "num_iterations": 5, "num_particles": 20, "num_samples": 512,
        "num_elites": 64, "momentum": 0.1, "epsilon": 0.001, "init_var": 4,
    },
    "algo_cfgs": {
        "steps_per_epoch": 20000, "action_repeat": 5, "update_dynamics_cycle": 1200,
        "start_learning_steps": 10000, "reward_normalize": False, "cost_normalize": False,
        "obs_normalize": False, "gamma": 0.99, "cost_gamma": 1.0,
    },
}  # fmt: skip
CCE: dict[str, Any] = PETS | {"algo_cfgs": PETS["algo_cfgs"] | {"cost_limit": 1.0}}
CAP: dict[str, Any] = PETS | {
    "lagrange_cfgs": {
        "cost_limit": 1.0, "lagrangian_multiplier_init": 0.0, "lambda_lr": 0.1,
        "lambda_optimizer": "SGD", "lagrangian_upper_bound": 1.0,
    },
}  # fmt: skip
ANT = {  # the section of the velocity tasks, of LOOP and of PETS
    "LOOP": {
        "algo_cfgs": {
            "action_repeat": 1, "update_policy_cycle": 1, "update_policy_iters": 1, "policy_delay": 2,
            "loss_pi_deterministic": False, "use_grad_norm": True, "alpha_discount": False,
            "policy_store_done": True,
        },
        "planner_cfgs": {"plan_horizon": 3, "init_var": 0.1, "temperature": 0.1, "alpha": 0.2},
        "model_cfgs": {
            "actor": {"hidden_sizes": [256, 256], "lr": 0.0003},
            "critic": {"hidden_sizes": [256, 256], "lr": 0.0003},
        },
    },
    "PETS": {
        "algo_cfgs": {"action_repeat": 1},
        "planner_cfgs": {"plan_horizon": 16, "init_var": 0.1},
        "dynamics_cfgs": {"predict_cost": True},
    },
}  # fmt: skip
EVALUATED = ["eval_episodes=1", "eval_every=10000"]  # 1e6 steps are the default of planners


@pytest.mark.parametrize(
    "theirs, config",
    {"PETS": PETS, "CCEPETS": CCE, "RCEPETS": CCE, "CAPPETS": CAP, "LOOP": LOOP,
     "SafeLOOP": SAFE_LOOP}.items(),
)  # fmt: skip
def test_the_defaults_of_planning_are_the_published_preset_on_coordinates(theirs, config):
    found = migrate.omnisafe(config, theirs, "SafetyPointGoal1-v0-modelbased")
    hydra_jobs.check_arguments(found.argv)
    own = f"algo={migrate.algorithms()[theirs]}"
    start = [*PLAIN, "env.observation=coordinates", own, "preset=published", "compat=omnisafe"]
    assert found.argv[:6] == start
    assert sorted(found.argv[6:]) == sorted([*EVALUATED, "env.wrap.action_repeat=5"])
    drawn = ["algo_cfgs.loss_pi_deterministic"] if theirs in ("LOOP", "SafeLOOP") else []
    assert lost(found) == drawn
    assert {line.key for line in found.lines} == {"algo", "env_id", *migrate.flatten(config)}


@pytest.mark.parametrize(
    "theirs, changed", [("LOOP", ["algo.temperature=33.333333333333336"]), ("PETS", [])]
)
def test_planning_in_velocity_tasks_has_their_preset(theirs, changed):
    config = {"defaults": {"LOOP": LOOP, "PETS": PETS}[theirs], "SafetyAntVelocity-v1": ANT[theirs]}
    found = migrate.omnisafe(config, theirs, "SafetyAntVelocity-v1")
    hydra_jobs.check_arguments(found.argv)
    start = [
        "env=ant_velocity",
        f"algo={theirs.lower()}",
        "preset=omnisafe_velocity",
        "compat=omnisafe",
    ]
    assert found.argv[:4] == start and not lost(found)
    assert sorted(found.argv[4:]) == sorted([*EVALUATED, *changed])


@pytest.mark.parametrize(
    "theirs, keys, options",
    [
        ("PETS", {"algo_cfgs": {"action_repeat": 2, "update_dynamics_cycle": 600}},
         "env.wrap.action_repeat=2 algo.refit_every=300"),
        ("PETS", {"dynamics_cfgs": {"num_ensemble": 4, "hidden_size": 32, "use_decay": False}},
         "algo.models=4 algo.particles=5 algo.model_hidden=[32,32,32,32] algo.weight_decay=0.0"),
        ("CCEPETS", {"planner_cfgs": {"num_elites": 8, "momentum": 0.2, "epsilon": 0.1}},
         "algo.elites=8 algo.mean_momentum=0.2 algo.var_momentum=0.2"),
        ("CAPPETS", {"lagrange_cfgs": {"lambda_lr": 0.01}, "algo_cfgs": {"steps_per_epoch": 10000}},
         "algo.kappa_lr=0.01 algo.dual_every=2000"),
        ("LOOP", {"planner_cfgs": {"plan_horizon": 5, "num_particles": 8, "epsilon": 0.1}},
         "algo.plan_steps=5 algo.temperature=2000.0 algo.particles=8 algo.var_stop=0.1"),
        ("SafeLOOP", {"algo_cfgs": {"update_policy_cycle": 100, "update_policy_iters": 40}},
         "algo.learn_every=20 algo.horizon=40 algo.replay_ratio=512"),
        ("LOOP", {"algo_cfgs": {"alpha_discount": False, "use_grad_norm": True, "max_grad_norm": 10}},
         "algo.alpha_init=0.2 algo.max_grad_norm=10.0"),
    ],
)  # fmt: skip
def test_a_key_of_planning_becomes_its_options(theirs, keys, options):
    found = migrated(keys, theirs)
    expected = {"env.wrap.action_repeat=5"} if "repeat" not in options else set()
    assert set(found.argv[6:]) == {*options.split(), *expected}
    assert not lost(found)


CHANGES = [  # algorithm, key, value, options
    ("PPOLag", "seed", 5, "seed=5"),
    ("PPOLag", "train_cfgs.total_steps", 1000000, "total_steps=1000000"),
    (
        "PPOLag",
        "algo_cfgs.steps_per_epoch",
        10000,
        "num_envs=10 algo.minibatches=125 algo.cost_window=10",
    ),
    (
        "PPOLag",
        "algo_cfgs.steps_per_epoch",
        512,
        "num_envs=1 algo.horizon=512 algo.minibatches=8 algo.cost_window=100",
    ),
    ("PPOLag", "algo_cfgs.batch_size", 200, "algo.minibatches=100"),
    ("PPOLag", "algo_cfgs.update_iters", 20, "algo.epochs=20 algo.critic_epochs=20"),
    ("CPO", "algo_cfgs.update_iters", 20, "algo.critic_epochs=20"),
    ("PPOLag", "algo_cfgs.target_kl", 0.03, "algo.target_kl=0.03"),
    ("CPO", "algo_cfgs.target_kl", 0.02, "algo.target_kl=0.02"),
    ("CPO", "logger_cfgs.window_lens", 40, "algo.cost_window=2"),
    ("PPOLag", "algo_cfgs.kl_early_stop", False, "algo.target_kl=inf"),
    ("PPOLag", "algo_cfgs.use_max_grad_norm", False, "algo.max_grad_norm=inf"),
    ("PPOLag", "algo_cfgs.use_critic_norm", False, "algo.critic_norm_coef=0.0"),
    ("PPOLag", "algo_cfgs.gamma", 0.9, "algo.discount=0.9 algo.cost_discount=0.9"),
    ("PPOLag", "algo_cfgs.adv_estimation_method", "gae-rtg", "algo.estimator=gae_rtg"),
    ("PPOLag", "model_cfgs.weight_initialization_mode", "orthogonal", "algo.init=orthogonal"),
    ("PPOLag", "model_cfgs.actor.hidden_sizes", [256, 256], "algo.hidden=[256,256]"),
    ("PPOLag", "lagrange_cfgs.cost_limit", 10, "algo.cost_limit=10.0"),
    ("CPO", "algo_cfgs.cost_limit", 10, "algo.cost_limit=10.0"),
    ("CPPOPID", "lagrange_cfgs.pid_kp", 0.2, "algo.pid_kp=0.2"),
    ("P3O", "algo_cfgs.kappa", 10.0, "algo.kappa=10.0"),
    ("IPO", "algo_cfgs.kappa", 0.1, "algo.barrier=0.1"),
    ("PPOSaute", "algo_cfgs.safety_budget", 15.0, "algo.cost_limit=15.0"),
    ("PPOSimmerPID", "algo_cfgs.safety_budget", 15.0, "algo.budget_init=0.6"),
]


def test_a_changed_key_is_a_changed_option():
    for algo, key, value, options in CHANGES:
        found = migrated({key: value}, algo)
        assert " ".join(found.argv[5:]) == options, key
        assert lost(found) == []


@pytest.mark.parametrize(
    "algo, key, value, reason",
    [
        ("PPOLag", "train_cfgs.parallel", 4, "devices=N"),
        ("PPOLag", "algo_cfgs.penalty_coef", 0.5, "ppo_penalty"),
        ("PPOLag", "algo_cfgs.standardized_rew_adv", False, "always"),
        ("PPOLag", "model_cfgs.actor.activation", "sigmoid", "one option"),
        ("PPOLag", "algo_cfgs.cg_iters", 5, "ppo_lag has no algo.cg_iterations"),
    ],
)
def test_what_has_no_counterpart_is_named(algo, key, value, reason):
    found = migrated({key: value}, algo)
    assert lost(found) == [key]
    assert reason in migrate.report(found.lines).splitlines()[-1]
    assert len(found.argv) == 5


def test_a_key_of_another_algorithm_or_a_value_of_another_type_is_lost_and_no_more():
    """An option of LOOP with PETS; a list where a word stands."""
    for key, value, algo in (("alpha", 0.1, "PETS"), ("adv_estimation_method", ["gae"], "PPOLag")):
        found = migrated({"algo_cfgs": {key: value}}, algo)
        assert lost(found) == [f"algo_cfgs.{key}"]


def test_two_keys_of_one_option_say_which_counts():
    sizes = {"actor": {"hidden_sizes": [32]}, "critic": {"hidden_sizes": [64]}}
    found = migrated({"model_cfgs": sizes}, "PPOLag")
    assert found.argv[5:] == ["algo.hidden=[32]"]
    assert "algo.hidden=[32] in place of algo.hidden=[64]" in migrate.report(found.lines)


@pytest.mark.parametrize("on, argv", [(True, ["logger=wandb"]), (False, [])])
def test_weights_and_biases_go_on_if_they_were_asked_for(on, argv):
    logger = PPO_LAG["logger_cfgs"] | {"use_wandb": on}
    found = migrated({"defaults": PPO_LAG | {"logger_cfgs": logger}}, "PPOLag")
    assert [x for x in found.argv if x.startswith("logger")] == argv


def test_sections_of_environments_count_for_theirs():
    config = {"defaults": PPO_LAG, "SafetyPointGoal1-v0": {"algo_cfgs": {"gamma": 0.9}}, "Other": {}}
    assert migrated(config, "PPOLag").argv[5:] == ["algo.discount=0.9", "algo.cost_discount=0.9"]


THEIRS = {  # all that OmniSafe @15603dd has
    "on-policy": (
        "PolicyGradient NaturalPG TRPO PPO PDO RCPO PPOLag TRPOLag CPPOPID TRPOPID CPO PCPO FOCOPS CUP "
        "OnCRPO IPO P3O PPOSaute TRPOSaute PPOSimmerPID TRPOSimmerPID PPOEarlyTerminated "
        "TRPOEarlyTerminated"
    ),
    "off-policy": "DDPG TD3 SAC DDPGLag TD3Lag SACLag DDPGPID TD3PID SACPID CRABS",
    "model-based": "PETS CCEPETS RCEPETS CAPPETS LOOP SafeLOOP",
    "offline": "VAEBC BCQ BCQLag CRR CCRR COptiDICE",
}


def test_every_option_that_a_key_becomes_exists_in_its_family():
    for name, family in migrate.FAMILIES.items():
        rows = [row for row in algos.ALGOS.values() if migrate.family_of(row) == name]
        fields = {f"algo.{f.name}" for row in rows for f in dataclasses.fields(row.config)}
        fields |= {"algo", "env", "env.rules", REPEAT}
        fields |= {f.name for f in dataclasses.fields(TrainConfig)}
        own = {k: r for k, r in family.rules.items() if r != ON_POLICY.get(k)} or family.rules
        assert {o for rule in own.values() for o in rule.ours.split()} <= fields


def test_all_of_omnisafe_is_here_and_no_row_has_a_name_that_is_not_there():
    ours = {theirs: migrate.family_of(algos.ALGOS[n]) for theirs, n in migrate.algorithms().items()}
    assert ours == {n: kind for kind, names in THEIRS.items() for n in names.split()}
    assert len(ours) == sum(bool(row.omnisafe) for row in algos.ALGOS.values()) == 45


CRABS = {  # of OmniSafe's CRABS.yaml
    "train_cfgs": {"num_epochs": 101, "raw_policy_episodes": 10},
    "algo_cfgs": {
        "steps_per_epoch": 6000, "batch_size": 256, "max_grad_norm": 40, "polyak": 0.005,
        "exploration_noise": 2.0, "alpha": 0.2, "auto_alpha": False, "start_learning_steps": 10_000,
    },
    "transition_model_cfgs": {"n_ensemble": 5, "n_elites": 5, "train": {"batch_size": 256}},
    "lyapunov": {"ell_coef": 1.0, "barrier_coef": 1},
    "opt_s": {"temperature": {"max": 0.03, "min": 0.03}, "batch_size": 10_000, "method": "MALA"},
    "opt_h": {"weight_decay": 0.0001, "lr": 0.0003, "lambda_2": "norm", "locals": {}},
    "crabs": {"obj": {"eps": 0.01, "neg_coef": 1.0}},
    "task": "train_policy",
}  # fmt: skip


def test_a_config_of_crabs_is_its_preset_with_omnisafes_temperature():
    found = migrated(CRABS, "CRABS", "SafeInvertedPendulumSwing-v2")
    assert not lost(found)
    assert found.argv == [
        "env=pendulum_swing", "algo=crabs", "preset=published", "compat=omnisafe", "total_steps=606000",
        "algo.max_grad_norm=40.0", "algo.alpha_init=0.2", "algo.alpha_lr=0.0",
    ]  # fmt: skip
    other = {
        "algo_cfgs": {"exploration_noise": 1.0},
        "opt_s": {"temperature": {"max": 0.1, "min": 0.01}},
    }
    assert lost(migrated(other, "CRABS", "MyPendulumTilt-v0")) == [
        "algo_cfgs.exploration_noise", "opt_s.temperature.max", "opt_s.temperature.min",
    ]  # fmt: skip


BCQ_LAG = {  # of OmniSafe's BCQLag.yaml
    "train_cfgs": {"total_steps": 1_000_000, "evaluate_epoisodes": 10, "dataset": "mixed.npz"},
    "algo_cfgs": {
        "gamma": 0.99, "cost_gamma": 0.99, "batch_size": 256, "steps_per_epoch": 1000, "phi": 0.05,
        "sampled_action_num": 10, "minimum_weighting": 0.75, "polyak": 0.005,
        "lagrange_start_step": 150_000,
    },
    "model_cfgs": {"actor": {"hidden_sizes": [256, 256, 256], "activation": "relu", "lr": 0.001}},
    "lagrange_cfgs": {"cost_limit": 25.0, "lagrangian_multiplier_init": 1.0, "lambda_lr": 0.001},
}  # fmt: skip


def test_offline_configs_count_gradient_steps_and_keep_a_path():
    found = migrated(BCQ_LAG, "BCQLag")
    assert not lost(found)
    assert found.argv[2:] == [
        "algo=bcq_lag", "preset=published", "compat=omnisafe", "total_updates=1000000",
        "eval_episodes=10",
        "dataset=mixed.npz",
    ]  # fmt: skip
    named = {"train_cfgs": {"dataset": "SafetyPointCircle1-v0_mixed_0.5"}}
    assert lost(migrated(named, "VAEBC")) == ["train_cfgs.dataset"]
    for path in ("~/mixed.npz", "a,b.npz", "mixed (1).npz"):  # what Hydra reads as something else
        argv = migrated({"train_cfgs": {"dataset": path}}, "VAEBC").argv
        assert arguments.compose(argv).train.dataset == path
    dice = {"algo_cfgs": {"cost_limit": 0.1, "alpha": 0.01}, "model_cfgs": {"tau": {"lr": 0.1}}}
    found = migrated(dice, "COptiDICE").argv
    assert {"algo.cost_limit=50.0", "algo.alpha=0.01", "algo.tau_lr=0.1"} <= {*found}
    assert lost(migrated({"algo_cfgs": {"phi": 0.1}}, "PPOLag")) == ["algo_cfgs.phi"]


@pytest.mark.parametrize(
    "config, algo, env, message",
    [
        ({"algo_cfgs": {"gama": 0.9}}, "PPOLag", "point_goal1", "did you mean 'algo_cfgs.gamma'"),
        ({"algo_cfgs": {"gamma": "high"}}, "PPOLag", "point_goal1", "expected a number"),
        (
            {"algo_cfgs": {"batch_size": 0}},
            "PPOLag",
            "point_goal1",
            "batch_size=0: expected a whole number between 1 and",
        ),
        (
            {"algo_cfgs": {"warmup_epochs": None}},
            "SACLag",
            "point_goal1",
            "warmup_epochs=None: expected a whole number",
        ),
        (
            {"opt_s": {"temperature": {"max": [1, 2]}}},
            "CRABS",
            "pendulum_swing",
            r"algo.temperature=\[1, 2\]: expected a number",
        ),
        ({"seed": float("nan")}, "PPOLag", "point_goal1", "seed=nan: expected a whole number"),
        ({"seed": -1}, "PPOLag", "point_goal1", "seed=-1: expected a whole number between 0 and"),
        ({"algo": ["PPO"], "env_id": "point_goal1"}, "", "", r"algo=\['PPO'\]: expected a string"),
        ({"env_id": 5}, "PPOLag", "", "env_id=5: expected a string"),
        ({}, "PPOlag", "point_goal1", "did you mean 'PPOLag'"),
        ({}, "CRABS", "SafetyPointGoal1-v0", "CRABS is for SafeInvertedPendulumSwing-v2 alone"),
        ({}, "", "point_goal1", "add --algo"),
        ({}, "CPO", "", "add --env"),
        ({}, "CPO", "SafetyRacecarGoal1-v0", "no counterpart"),
        ({}, "CPO", "point_gaol1", "did you mean 'point_goal1'"),
        ({}, "PETS", "SafetyPointPush1-v0", "plans in Goal and in the velocity tasks alone"),
        ({}, "PETS", "SafetyAntGoal1-v0-modelbased", "no counterpart"),
    ],
)
def test_bad_input_is_one_line(config, algo, env, message):
    with pytest.raises(ConfigError, match=message) as error:
        migrate.omnisafe(config, algo, env)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "theirs, ours",
    {
        "SafetyHalfCheetahVelocity-v1": ["env=halfcheetah_velocity"],
        "SafetyAntVelocityGymnasium-v1": ["env=ant_velocity"],
        "SafetySwimmerVelocity-v0": ["env=swimmer_velocity", "env.thresholds=v0"],
    }.items(),
)
def test_a_velocity_task_is_migrated_with_its_thresholds(theirs, ours):
    assert migrate.find_environment(theirs) == ours
    for options in (ours, [f"env={theirs.replace('Gymnasium-', '-')}"]):
        settings = arguments.compose(options)
        assert settings.plain()["env"]["thresholds"] == theirs[-2:]
        assert f"env={settings.env_name}" == ours[0]


def test_an_id_of_goal_is_the_task_with_its_rules():
    by_id, by_name = (arguments.compose(words) for words in (["env=SafetyPointGoal1-v0"], PLAIN))
    assert by_id.plain() == by_name.plain()
    assert by_id.plain()["env"]["rules"] == "safety_gymnasium"


def test_the_options_of_every_registered_environment_are_its_name():
    for name, options in suite.suite().items():
        assert migrate.safety_gym(options).argv == [f"env={name}"]


def test_an_engine_dict_is_the_nearest_environment_and_the_rest():
    config = {
        **envs.ENVS["point_push1"],
        "hazards_num": 3,
        "hazards_locations": [[1, 1], [-1, 0.5]],
        "goal_placements": None,
        "constrain_indicator": False,
        "vision_size": [60, 40],
    }
    found = migrate.safety_gym(config)
    expected = ["env.hazards_num=3", "env.hazards_locations=[[1.0,1.0],[-1.0,0.5]]"]
    assert sorted(found.argv) == sorted(["env=point_push1", *expected, "env.constrain_indicator=false"])
    assert {line.key for line in found.lines} == set(config)
    request = hydra_jobs.check_arguments(found.argv)
    assert expected[1] in request.argv
    for name, message in (("hazard_num", "did you mean 'hazards_num'"), ("awake", "of Engine")):
        with pytest.raises(ConfigError, match=message):
            migrate.safety_gym({name: 3})
    seen = migrate.safety_gym({**envs.ENVS["point_goal1"], "observe_vision": True})
    assert seen.argv == ["env=point_goal1", "env.observe_vision=true"]


def test_the_script_prints_a_command_and_refuses_in_a_line(tmp_path, capsys):
    path = tmp_path / "config.json"
    path.write_text(json.dumps(PPO_LAG | {"algo": "PPOLag", "env_id": "SafetyCarPush2-v0", "seed": 3}))
    assert typed("migrate", "omnisafe", str(path)) == 0
    out, err = capsys.readouterr()
    rules = "env=car_push2 env.rules=safety_gymnasium"
    assert (
        out == f"python scripts/train.py {rules} algo=ppo_lag preset=published compat=omnisafe seed=3\n"
    )
    assert len(err.splitlines()) == len(migrate.flatten(PPO_LAG)) + 2
    for source, text, message in (
        ("omnisafe", "{", "is no JSON"),
        ("omnisafe", "[" * 99_999, "is no JSON: maximum recursion depth"),
        ("omnisafe", "[1]", "expected names with values"),
        ("safety_gym", "1: 2", "unknown option 1 of Engine"),
        ("omnisafe", "a: &a {b: *a}", "is no YAML: maximum recursion depth"),
        ("omnisafe", None, "cannot read"),
    ):
        path = tmp_path / ("config.yaml" if text and ":" in text else "config.json")
        path.unlink() if text is None else path.write_text(text)
        assert typed("migrate", source, str(path)) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
