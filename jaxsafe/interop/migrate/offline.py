"""Keys of OmniSafe's offline algorithms that its on-policy ones lack or read otherwise."""

from typing import Any

from jaxsafe.config import convert
from jaxsafe.interop.migrate.on_policy import NETWORK, ON_POLICY
from jaxsafe.interop.migrate.rules import Facts, Rule, always, computed, ignored

CIRCLE = 500  # steps of an episode of OmniSafe's offline tasks


def data_set(value: Any, facts: Facts) -> dict[str, Any] | None:
    return {"dataset": value} if str(value).endswith(".npz") else None


def of_an_episode(limit: Any, facts: Facts) -> dict[str, Any]:
    return {"algo.cost_limit": CIRCLE * convert(limit, float, "algo_cfgs.cost_limit")}


OFFLINE: dict[str, Rule] = ON_POLICY | {
    "train_cfgs.dataset": computed(
        "dataset", data_set, "a path is kept; OmniSafe's named sets have to be downloaded there"
    ),
    "train_cfgs.total_steps": Rule("total_updates"),
    "train_cfgs.evaluate_epoisodes": Rule("eval_episodes"),
    "train_cfgs.vector_env_nums": ignored("nothing steps in training"),
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
    "algo_cfgs.fn_type": always("softchi", note="always the soft chi-square"),
    "algo_cfgs.alpha": Rule("algo.alpha"),
    "algo_cfgs.cost_ub_eps": Rule("algo.cost_divergence"),
    "algo_cfgs.cost_limit": computed(
        "algo.cost_limit", of_an_episode, "of a step there, of an episode of 500 steps here"
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
