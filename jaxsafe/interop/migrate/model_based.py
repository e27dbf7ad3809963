"""Keys of OmniSafe's model-based algorithms that its on-policy ones lack or read otherwise."""

import math
from typing import Any

from jaxsafe.config import convert
from jaxsafe.interop.migrate.off_policy import OFF_POLICY
from jaxsafe.interop.migrate.on_policy import ON_POLICY
from jaxsafe.interop.migrate.rules import Facts, Rule, Translate, always, computed, ignored, switch

REPEAT = "env.wrap.action_repeat"
LOOPS = "algo.actor_plans"  # an option of LOOP and its kin alone
UPDATE = 40  # steps of the planner in an update of the presets
COLD = 1e-3  # what a temperature that falls is in the presets of LOOP
POLICY = "algo.learn_every algo.horizon algo.replay_ratio algo.batch_size"
DECIDES = "the algorithm decides"


def planner_steps(option: str) -> Translate:
    """For what OmniSafe counts in raw steps, and we in steps of the planner."""

    def turn(value: Any, facts: Facts) -> dict[str, Any]:
        steps = round(convert(value, int, option) / facts.repeat)
        return {option: steps} if option in facts.options else {}

    return turn


def learn_cost(on: Any, facts: Facts) -> dict[str, Any]:
    return {"algo.learn_cost": True} if on else {}


def four_layers(size: Any, facts: Facts) -> dict[str, Any]:
    return {"algo.model_hidden": (size,) * 4}


def num_elites(value: Any, facts: Facts) -> dict[str, Any]:
    return {"algo.elites": value} if "algo.elites" in facts.options else {}


def var_stop(value: Any, facts: Facts) -> dict[str, Any]:
    return {"algo.var_stop": value} if LOOPS in facts.options else {}


def momentum(value: Any, facts: Facts) -> dict[str, Any]:
    of_var = {"algo.var_momentum": value}
    return (
        of_var if "algo.cost_temperature" in facts.options else {"algo.mean_momentum": value} | of_var
    )


def ensemble(value: Any, facts: Facts) -> dict[str, Any] | None:
    """From num_ensemble and num_particles. PETS and its kin share the particles among the models. In
    LOOP each model has as many."""
    models = facts.whole("dynamics_cfgs.num_ensemble", 5)
    each = facts.options["algo.particles"]
    if LOOPS in facts.options:
        each = facts.whole("planner_cfgs.num_particles", each)
    else:
        total = facts.whole("planner_cfgs.num_particles", 5 * each)
        if total % models:
            return None
        each = total // models
    return {"algo.models": models, "algo.particles": each}


def plan(value: Any, facts: Facts) -> dict[str, Any]:
    """From plan_horizon, which is H, and temperature. There it weighs 1000 / H times the return of a
    plan, and here the return itself."""
    steps = facts.whole("planner_cfgs.plan_horizon", facts.options["algo.plan_steps"])
    found: dict[str, Any] = {"algo.plan_steps": steps}
    if LOOPS in facts.options:
        preset = facts.options["algo.temperature"] * facts.options["algo.plan_steps"] / 1000
        asked = facts.real("planner_cfgs.temperature", round(preset, 9))
        found["algo.temperature"] = asked * 1000 / steps
    return found


def actor_plans(value: Any, facts: Facts) -> dict[str, Any]:
    share = convert(value, float, "planner_cfgs.mixture_coefficient")
    plans = facts.whole("planner_cfgs.num_samples", 100)
    models = facts.whole("dynamics_cfgs.num_ensemble", 5)
    return {"algo.actor_plans": max(1, round(share * plans / models))}


def beside(value: Any, facts: Facts) -> dict[str, Any] | None:
    """From LOOP's update_policy_cycle, update_policy_iters and policy_batch_size."""
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
    if LOOPS not in facts.options:
        return {"algo.alpha_init": value}
    falls = facts.values.get("algo_cfgs.alpha_discount", facts.options["algo.alpha_init"] == COLD)
    fixed = facts.real("algo_cfgs.alpha", 0.2)
    return {"algo.alpha_init": COLD if falls else fixed}


MODEL_BASED: dict[str, Rule] = ON_POLICY | {
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
        REPEAT, "a step of the planner; all settings of the algorithm count these"
    ),
    "algo_cfgs.steps_per_epoch": computed(
        "algo.dual_every",
        planner_steps("algo.dual_every"),
        "of CAP-PETS, whose kappa moves once an epoch",
    ),
    "algo_cfgs.update_dynamics_cycle": computed(
        "algo.refit_every", planner_steps("algo.refit_every"), "in steps of the planner"
    ),
    "algo_cfgs.start_learning_steps": computed(
        "algo.learning_starts", planner_steps("algo.learning_starts"), "in steps of the planner"
    ),
    "algo_cfgs.cost_limit": Rule(
        "algo.cost_limit", "of an episode; of 1000 steps of the planner there"
    ),
    "algo_cfgs.cost_normalize": always(False, note="costs are as they are"),
    "algo_cfgs.obs_normalize": always(False, note="the model scales its inputs"),
    "algo_cfgs.policy_store_done": ignored("ends are always kept"),
    "algo_cfgs.policy_batch_size": computed(POLICY, beside),
    "algo_cfgs.update_policy_cycle": computed(POLICY, beside, "in steps of the planner"),
    "algo_cfgs.update_policy_iters": computed(POLICY, beside, "gradient steps of a round"),
    "algo_cfgs.use_grad_norm": switch("algo.max_grad_norm", math.inf, "false is inf"),
    "algo_cfgs.critic_norm_coeff": ignored("only read with use_critic_norm"),
    "algo_cfgs.alpha": computed("algo.alpha_init", cooling, "with alpha_discount 0.001"),
    "algo_cfgs.alpha_discount": computed("algo.alpha_init", cooling, "true is 0.001"),
    "algo_cfgs.alpha_gamma": ignored("the temperature is low from the beginning"),
    "algo_cfgs.auto_alpha": ignored("OmniSafe does not read it"),
    "algo_cfgs.loss_pi_deterministic": always(
        False, note="the actor's loss is of an action that is drawn"
    ),
    "dynamics_cfgs.num_ensemble": computed("algo.models algo.particles", ensemble),
    "dynamics_cfgs.elite_size": ignored("it only changes plots of OmniSafe's evaluation"),
    "dynamics_cfgs.hidden_size": computed("algo.model_hidden", four_layers, "of four layers"),
    "dynamics_cfgs.use_decay": switch("algo.weight_decay", 0.0, "false is 0"),
    "dynamics_cfgs.predict_reward": always(True, note="the model always predicts the reward"),
    "dynamics_cfgs.predict_cost": computed(
        "algo.learn_cost", learn_cost, "false only where the observation tells the cost"
    ),
    "dynamics_cfgs.batch_size": Rule("algo.model_batch"),
    "dynamics_cfgs.max_epoch": ignored("OmniSafe does not read it"),
    "dynamics_cfgs.reward_size": always(1, note="there is one"),
    "dynamics_cfgs.cost_size": always(1, note="there is one"),
    "dynamics_cfgs.use_cost": ignored(DECIDES),
    "dynamics_cfgs.use_terminal": Rule("algo.foresee_end"),
    "dynamics_cfgs.use_var": ignored(DECIDES),
    "dynamics_cfgs.use_reward_critic": ignored(DECIDES),
    "dynamics_cfgs.use_cost_critic": always(False, note="there is none in a plan"),
    "planner_cfgs.plan_horizon": computed("algo.plan_steps algo.temperature", plan),
    "planner_cfgs.num_iterations": Rule("algo.cem_iterations"),
    "planner_cfgs.num_particles": computed(
        "algo.particles", ensemble, "of each model; of PETS and its kin in all there"
    ),
    "planner_cfgs.num_samples": Rule("algo.plans"),
    "planner_cfgs.num_elites": computed("algo.elites", num_elites, "LOOP does not read it"),
    "planner_cfgs.mixture_coefficient": computed(
        "algo.actor_plans", actor_plans, "plans of each model"
    ),
    "planner_cfgs.temperature": computed("algo.temperature", plan, "times 1000 / H"),
    "planner_cfgs.cost_temperature": Rule("algo.cost_temperature"),
    "planner_cfgs.momentum": computed(
        "algo.mean_momentum algo.var_momentum", momentum, "of SafeLOOP for the variance alone"
    ),
    "planner_cfgs.epsilon": computed("algo.var_stop", var_stop, "only LOOP and SafeLOOP read it"),
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
    "evaluation_cfgs.use_eval": switch("eval_every", 0, "false is 0"),
    "logger_cfgs.window_lens": ignored("kappa sees all episodes since it last moved"),
    "lagrange_cfgs.lagrangian_multiplier_init": Rule("algo.kappa_init"),
    "lagrange_cfgs.lambda_lr": Rule("algo.kappa_lr"),
    "lagrange_cfgs.lambda_optimizer": always("SGD", note="always plain gradient steps"),
    "lagrange_cfgs.lagrangian_upper_bound": Rule("algo.kappa_max"),
}
