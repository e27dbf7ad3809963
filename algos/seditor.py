"""SEditor: a policy that seeks reward, and one that edits its actions to keep them safe."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxsafe.config import (
    Amount,
    Bounds,
    Iterations,
    Norm,
    Rate,
    Share,
    Units,
    Weight,
    config,
)
from jaxsafe.learn.acting import Learned
from jaxsafe.learn.batch import aligned, device_count, pmean
from jaxsafe.learn.bill import PriceClockConfig
from jaxsafe.learn.constraints import constrained_costs, each, limit, metrics_by_constraint, signal
from jaxsafe.learn.critics import Values, init_cost_critics, values_of_each, with_reduced_cost
from jaxsafe.learn.learner import GradientStep, Learner
from jaxsafe.learn.normalise import averaged, no_moments, standard
from jaxsafe.learn.observations import EncoderConfig, features, init_features
from jaxsafe.learn.off_policy import OffPolicyConfig, off_policy
from jaxsafe.learn.replay import Record
from jaxsafe.learn.row import Row
from jaxsafe.learn.sequences import SequenceBatch, check_sequences, drawn_sequences, lambda_returns
from jaxsafe.learn.steps import Trainable, adam, descend_each, follow
from jaxsafe.learn.treatments import LagrangianConfig, Treatment, initial_price, lagrangian
from jaxsafe.nn.beta import Beta, beta_policy, beta_sample, init_beta
from jaxsafe.nn.critics import init_critics, q_values, smallest
from jaxsafe.types import Algorithm, Count, Env, Metrics, PyTree

Positive = Annotated[float, Bounds(1e-6, 1e6)]
Chance = Annotated[float, Bounds(1e-6, 1)]
EPS = 1e-7  # of Adam, as in the authors' code


@config
class SEditorConfig(LagrangianConfig, PriceClockConfig, EncoderConfig, OffPolicyConfig):
    """SEditor: a safety editor corrects the actions of a policy that only seeks reward.

        a = h(u, v) = clip(u + 2 v, +-1),   proposal u ~ pi(s),   change v ~ mu(s, u)
        maximise_pi     E[Q_r(s, a) + alpha_1 H(pi)],   mu fixed
        maximise_mu     E[(-(Q_r(s, u) - Q_r(s, a))+ - lam Q_c(s, a)) / (1 + lam) + alpha_2 H(mu)]
        minimise_Q      E[sum_i (Q_ri(s, a) - G_r)^2 + (Q_ci(s, a) - G_c)^2],   G: TD(lambda) returns
        minimise_alpha  log alpha_j (H_j - target_j),   target_j = action size * log(2 min_prob)
        minimise_lam    (cost_limit - J_c) lam,   lam = softplus(l),  by Adam
        Q' <- Q' + tau (Q - Q')

    Without an editor (`edit=none`) one policy acts, a = u, and

        maximise_pi     E[(Q_r(s, a) - lam Q_c(s, a)) / (1 + lam) + alpha_1 H(pi)]

    Then alpha_1 H(pi) counts as reward in G_r and against cost in G_c. That is the authors'
    SAC-Lagrangian.

    Q_r is the smaller of two critics' values and Q_c the larger, and so are their targets', which take
    actions that both policies draw anew. Both policies are Beta distributions. While one is trained,
    the other is fixed. TD(lambda) returns run over replayed sequences of `n_step` + 1 rows. Rewards and
    costs are normalised when they are replayed. lam moves once every `dual_every` environment steps,
    and J_c is what a step has cost since then, times the length of an episode. The paper allows
    5e-4 violations a step. Where a step with a violation costs 1 and the time limit is 1,000 steps,
    that is a `cost_limit` of 0.5.

    With `encoder=cnn` s is what an encoder makes of the picture, one for policies and critics. The loss
    of Q trains it. Gradients of the policies stop before it.

    Source: Yu, Xu and Zhang (2022), "Towards Safe Reinforcement Learning with a Safety Editor Policy",
    arXiv:2201.12427; networks, returns and schedules are from the authors' code.
    Differs from it: the defaults are for a thousand environments, which take 32 gradient steps and 32
    moves of the price for 5 of their steps, and learning rates fall. `preset=published` has 32
    environments, one gradient step and one move of the price, and keeps the rates. Their encoder
    is trained by the same loss, and its convolutions have the same sizes. It makes 256 numbers of the
    picture and 256 of the vector, and gives the tanh of their mean. Ours gives 128 numbers of the
    picture, and the vector beside them.
    """

    # Environments side by side, of all devices together. The authors have 32.
    num_envs: Amount = 1024
    horizon: Amount = 5  # Steps of each environment in an update, as in the authors' code.
    learn_every: Amount = 5  # Steps of each environment between two rounds of gradient steps, likewise.
    # Transitions kept, rounded to whole updates. As in the authors' code.
    replay_size: Annotated[int, Bounds(1, 2**31 - 1)] = 1_600_000
    # Rows replayed for each environment step, as in the authors' code. A gradient step comes every 160.
    replay_ratio: Amount | Annotated[float, Bounds(1e-6, 1e6)] = 51.2
    # Rows of a gradient step, of all devices together: 1,024 sequences of 8, as in the authors' code.
    batch_size: Amount = 8192
    layer_norm: bool = False  # Whether the critics normalise their layers. The authors' do not.
    # Whether observations are normalised by a running mean and variance. The authors' are not.
    obs_normalize: bool = False
    # Whether the learning rates of policies and critics fall linearly to 0 at `total_iterations`. On
    # Button 96% of episodes then end in success, in place of 86%, of three seeds. The authors keep the
    # rates.
    lr_decay: bool = True
    # The largest norm of each network's gradient. The authors have no bound.
    max_grad_norm: Norm = float("inf")
    # Steps of a replayed sequence. It has a row more: 8, as the authors have.
    n_step: Iterations = 7
    # How far TD(lambda) returns reach: 0 is one step. The authors have 0.95.
    td_lambda: Share = 0.95
    # Units of the hidden layers of each network, as in the paper.
    hidden: tuple[Units, ...] = (256, 256, 256)
    activation: Literal["relu", "tanh"] = "tanh"  # Of the hidden layers, as in the authors' code.
    # The critics' first weights. fan_in: uniform, as in the authors' code. The policies' are Xavier's.
    init: Literal["fan_in", "torch", "orthogonal"] = "fan_in"
    # The undiscounted cost of an episode of full length: 5e-4 a step, as in the paper, in 1,000 steps.
    cost_limit: Weight = 0.5
    # How the values of two cost critics become one. max is cautious, as in the authors' code.
    cost_reduce: Literal["mean", "max", "one"] = "max"
    lam_init: Positive = 1.0  # The price on cost at the start, as in the authors' code.
    # The highest price. The authors have no bound.
    lam_max: Annotated[float, Bounds(1e-6, 1e6, inf="no bound")] = float("inf")
    # Adam's step of l, whatever the size of the violation, as in the authors' code.
    dual_lr: Rate = 0.01
    # Environment steps between two moves of the price, as the authors have. Adam's steps stay short for
    # some thousand moves after the first violations, which are many.
    dual_every: Annotated[int, Bounds(1, 2**30)] = 160
    # The share of the critics that their targets take on at each step, as in the authors' code.
    tau: Share = 0.005
    alpha_init: Positive = 1.0  # Both temperatures at first, as in the authors' code.
    alpha_lr: Rate = 3e-4  # The learning rate of log alpha, by Adam, as in the authors' code.
    # The proposals' target entropy is that of a uniform density over this share of [-1, 1], in each
    # dimension, as in the authors' code.
    min_prob: Chance = 0.1
    # The same for the editor's changes. The authors have 0.1 on Safety Gym, and 0.2 in racing.
    editor_min_prob: Chance = 0.1
    # The longest gradient of one sample's concentrations, as in the authors' code.
    concentration_clip: Norm = 0.01
    # What an edit is charged. hinge: the reward it loses, as in the paper. action: the mean square of
    # a - u, the paper's SEditor-L2. reward: nothing; the editor earns Q_r(s, a) itself.
    distance: Literal["hinge", "action", "reward"] = "hinge"
    # How the change is applied. add: as in the paper. overwrite: a = v, an ablation of the authors.
    # none: a = u. There is no editor, and the proposer itself pays: the authors' SAC-Lagrangian.
    edit: Literal["add", "overwrite", "none"] = "add"
    # Whether the mean is taken from rewards and costs before they are scaled, as in the authors' code.
    # Where episodes can fail, a failure is then worth as much as going on at the mean.
    centre: bool = True


# ---- the price on cost -------------------------------------------------------------------------


class SoftMultiplier(NamedTuple):
    """The price lam = softplus(`raw`), float [] or [K], and Adam's state."""

    raw: jax.Array
    opt_state: PyTree

    @property
    def lam(self) -> jax.Array:
        return jax.nn.softplus(self.raw)


def softplus_inverse(x: jax.Array) -> jax.Array:
    return x + jnp.log(-jnp.expm1(-x))


def init_soft_multiplier(cfg: Any) -> SoftMultiplier:
    raw = softplus_inverse(jnp.minimum(initial_price(cfg), cfg.lam_max))
    return SoftMultiplier(raw, optax.adam(cfg.dual_lr, eps=EPS).init(raw))


def soft_ascent(
    dual: SoftMultiplier, episode_cost: jax.Array, cfg: Any, iteration: Count
) -> SoftMultiplier:
    """One Adam step on the loss (cost_limit - J_c) softplus(l), then lam in [0, lam_max]."""
    grad = (limit(cfg, constrained_costs(cfg)) - episode_cost) * jax.nn.sigmoid(dual.raw)
    change, opt_state = optax.adam(cfg.dual_lr, eps=EPS).update(grad, dual.opt_state)
    raw: Any = optax.apply_updates(dual.raw, change)
    return SoftMultiplier(jnp.minimum(raw, softplus_inverse(cfg.lam_max)), opt_state)


soft_lagrangian = Treatment(
    init=init_soft_multiplier,
    update=soft_ascent,
    advantage=lagrangian.advantage,
    metrics=lambda dual: {"train/lam": dual.lam},
    constrained_costs=constrained_costs,
)


# ---- the two policies --------------------------------------------------------------------------


class Edited(NamedTuple):
    """Proposals and what the editor makes of them, float [..., A]; the log probabilities of the
    proposals and of the changes, float [...]. Without an editor actions are the proposals."""

    proposal: jax.Array
    action: jax.Array
    log_prob: jax.Array
    log_prob_change: jax.Array


def edit(proposal: jax.Array, change: jax.Array, cfg: Any) -> jax.Array:
    """h(u, v), float [..., A]. Some v in [-1, 1] makes any action of any proposal."""
    return jnp.clip(proposal + 2 * change, -1.0, 1.0) if cfg.edit == "add" else change


def editor_of(editor: PyTree, obs: jax.Array, proposal: jax.Array, cfg: Any) -> Beta:
    """The editor's distribution of changes [..., A], given `obs` [..., O] and `proposal` [..., A]."""
    return beta_policy(editor, jnp.concatenate([obs, proposal], -1), cfg)


def edited(proposer: PyTree, editor: PyTree, obs: jax.Array, key: jax.Array | None, cfg: Any) -> Edited:
    """Both policies' draws for `obs` [..., O], or their modes where `key` is None. Without an editor,
    `editor` is ()."""
    proposal_key, change_key = (None, None) if key is None else jax.random.split(key)
    proposal, log_prob = beta_sample(beta_policy(proposer, obs, cfg), proposal_key)
    if editor == ():
        return Edited(proposal, proposal, log_prob, jnp.zeros_like(log_prob))
    change, log_prob_change = beta_sample(editor_of(editor, obs, proposal, cfg), change_key)
    return Edited(proposal, edit(proposal, change, cfg), log_prob, log_prob_change)


def act(learned: Learned, obs: PyTree, key: jax.Array | None) -> jax.Array:
    params, cfg = learned.params, learned.config
    return edited(params["proposer"], params["editor"], features(params, obs), key, cfg).action


# ---- what each policy climbs -------------------------------------------------------------------


class Scene(NamedTuple):
    """What is fixed while policies climb: all networks, the price, observations [..., O], settings."""

    params: dict[str, PyTree]
    dual: Any
    obs: jax.Array
    cfg: Any


def reward_value(params: dict[str, PyTree], obs: jax.Array, action: jax.Array, cfg: Any) -> jax.Array:
    """Q_r, the smaller value, float [...]."""
    return smallest(q_values(params["critic_r"], obs, action, cfg))


def both_values(params: dict[str, PyTree], obs: jax.Array, action: jax.Array, cfg: Any) -> Values:
    """Q_r, float [...], and Q_c, float [...] or [..., K]."""
    q_r, q_c = with_reduced_cost(params, obs, action, constrained_costs(cfg), cfg)
    return Values(smallest(q_r), q_c)


def unpriced(scene: Scene, action: jax.Array) -> jax.Array:
    """Q_r(s, a), float [...]."""
    return reward_value(scene.params, scene.obs, action, scene.cfg)


def priced(scene: Scene, action: jax.Array) -> jax.Array:
    """(Q_r(s, a) - lam Q_c(s, a)) / (1 + lam), float [...]."""
    q_r, q_c = both_values(scene.params, scene.obs, action, scene.cfg)
    return soft_lagrangian.advantage(scene.dual, q_r, q_c)


def proposer_gain(proposer: PyTree, scene: Scene, key: jax.Array) -> tuple[jax.Array, Edited]:
    """Q_r(s, a) + alpha_1 H(pi), float [...], or with the price of `priced`; and the draws."""
    params, _, obs, cfg = scene
    found = edited(proposer, params["editor"], obs, key, cfg)
    worth = policies_of(cfg).worth(scene, found.action)
    return worth - jnp.exp(params["log_alpha"]) * found.log_prob, found


def editor_gain(editor: PyTree, scene: Scene, key: jax.Array) -> tuple[jax.Array, Edited, jax.Array]:
    """(-(Q_r(s, u) - Q_r(s, a))+ - lam Q_c(s, a)) / (1 + lam) + alpha_2 H(mu), float [...], with
    `distance` in place of the first term; the draws; the reward that edits lose, float [...]."""
    params, dual, obs, cfg = scene
    found = edited(params["proposer"], editor, obs, key, cfg)
    q_r, q_c = both_values(params, obs, found.action, cfg)
    lost = jax.nn.relu(reward_value(params, obs, found.proposal, cfg) - q_r)
    match cfg.distance:
        case "hinge":
            worth = -lost
        case "action":
            worth = -jnp.square(found.action - found.proposal).mean(-1)
        case "reward":
            worth = q_r
    worth = soft_lagrangian.advantage(dual, worth, q_c)
    return worth - jnp.exp(params["log_alpha_editor"]) * found.log_prob_change, found, lost


# ---- losses ------------------------------------------------------------------------------------


def excess_entropy(
    batch: SequenceBatch, log_prob: jax.Array, size: int, min_prob: jax.Array | float
) -> jax.Array:
    """H - target, float [], for actions of this size. log alpha falls with it."""
    target = size * jnp.log(2 * min_prob)
    return -batch.mean(jax.lax.stop_gradient(log_prob) + target)


def proposer_loss(
    trained: dict[str, PyTree], scene: Scene, batch: SequenceBatch, key: jax.Array
) -> tuple[jax.Array, Metrics]:
    """log alpha_1 (H_1 - target_1) less what pi climbs. Both are among `trained`."""
    gain, found = proposer_gain(trained["proposer"], scene, key)
    size = found.action.shape[-1]
    excess = excess_entropy(batch, found.log_prob, size, scene.cfg.min_prob)
    return trained["log_alpha"] * excess - batch.mean(gain), {
        "train/actor_loss": -batch.mean(gain),
        "train/entropy": -batch.mean(found.log_prob),
        "train/alpha": jnp.exp(scene.params["log_alpha"]),
    }


def editor_loss(
    trained: dict[str, PyTree], scene: Scene, batch: SequenceBatch, key: jax.Array
) -> tuple[jax.Array, Metrics]:
    """log alpha_2 (H_2 - target_2) less what mu climbs. Both are among `trained`."""
    gain, found, lost = editor_gain(trained["editor"], scene, key)
    size = found.action.shape[-1]
    excess = excess_entropy(batch, found.log_prob_change, size, scene.cfg.editor_min_prob)
    return trained["log_alpha_editor"] * excess - batch.mean(gain), {
        "train/editor_loss": -batch.mean(gain),
        "train/entropy_editor": -batch.mean(found.log_prob_change),
        "train/alpha_editor": jnp.exp(scene.params["log_alpha_editor"]),
        "train/edit": batch.mean(jnp.abs(found.action - found.proposal).mean(-1)),
        "train/edit_loss": batch.mean(lost),
    }


def critics_loss(
    trained: dict[str, PyTree], batch: SequenceBatch, targets: Values, cfg: Any, axis_name: str | None
) -> tuple[jax.Array, Metrics]:
    """E[sum_i (Q_ri(s, a) - G_r)^2 + (Q_ci(s, a) - G_c)^2]. It alone trains the encoder.

    targets: G_r and G_c of all rows but the last.
    """
    rows, names = batch.rows, constrained_costs(cfg)
    counted = batch.weight * batch.follows
    counted /= jnp.maximum(pmean(counted.sum(), axis_name), 1e-6)

    def mean_step(x: jax.Array) -> jax.Array:
        return (counted * x).sum()

    # Compiled, this pass of the encoder and that for the policies are one.
    obs = features(trained, rows.obs)[:-1]
    q_r, q_c = values_of_each(trained, obs, rows.action[:-1], names, cfg)
    loss_r = mean_step(((q_r - targets.reward) ** 2).sum(0))
    loss_c = each(mean_step, names)(((q_c - targets.cost) ** 2).sum(0))
    return loss_r + loss_c.sum(), {
        "train/critic_loss": loss_r,
        "train/critic_loss_c": loss_c,
        "train/q": mean_step(q_r.mean(0)),
        "train/q_c": each(mean_step, names)(q_c.mean(0)),
    }


def without_entropy(paid: Values, found: Edited, rows: Record, scene: Scene) -> Values:
    return paid


def with_entropy(paid: Values, found: Edited, rows: Record, scene: Scene) -> Values:
    """`paid`, where alpha_1 H(pi) counts as reward and against cost, unless the episode has failed."""
    params, _, _, cfg = scene
    bonus = jnp.where(rows.terminated, 0.0, -jnp.exp(params["log_alpha"]) * found.log_prob)
    over_costs = aligned(bonus, paid.cost)
    return Values(paid.reward + cfg.discount * bonus, paid.cost - cfg.cost_discount * over_costs)


def targets_of(paid: Values, batch: SequenceBatch, scene: Scene, key: jax.Array) -> Values:
    """G_r and G_c of all rows but the last, from what the rows paid."""
    params, _, obs, cfg = scene
    found = edited(params["proposer"], params["editor"], obs, key, cfg)
    next_q = both_values(params["targets"], obs, found.action, cfg)
    earned = policies_of(cfg).earned(paid, found, batch.rows, scene)

    def returns(earned: jax.Array, value: jax.Array, discount: jax.Array) -> jax.Array:
        ended = batch.rows.terminated
        return lambda_returns(batch, earned, value, ended, discount=discount, decay=cfg.td_lambda)

    costs_returns = each(partial(returns, discount=cfg.cost_discount), constrained_costs(cfg))
    g_r = returns(earned.reward, next_q.reward, cfg.discount)
    return Values(g_r, costs_returns(earned.cost, next_q.cost))


# ---- with an editor, and without ---------------------------------------------------------------


class Policies(NamedTuple):
    """Which policies there are, and what depends on it.

    losses: of each policy and its temperature, by the name of its network.
    worth(scene, action [..., A]) -> float [...], what the proposer climbs beside its entropy.
    earned(paid, found, rows, scene) -> Values, rewards and costs as they count in G_r and G_c. `found`
        are draws for the observations of `rows`.
    """

    losses: dict[str, Callable[[PyTree, Scene, SequenceBatch, jax.Array], tuple[jax.Array, Metrics]]]
    worth: Callable[[Scene, jax.Array], jax.Array]
    earned: Callable[[Values, Edited, Record, Scene], Values]


SEDITOR = Policies({"proposer": proposer_loss, "editor": editor_loss}, unpriced, without_entropy)
SAC_LAGRANGIAN = Policies({"proposer": proposer_loss}, priced, with_entropy)
TEMPERATURES = {"proposer": "log_alpha", "editor": "log_alpha_editor"}


def policies_of(cfg: Any) -> Policies:
    return SAC_LAGRANGIAN if cfg.edit == "none" else SEDITOR


# ---- the gradient step -------------------------------------------------------------------------


def init_small_critics(key: jax.Array, critics: PyTree, cfg: Any) -> PyTree:
    """`critics` with last layers in +-0.003."""
    last = f"Dense_{len(cfg.hidden)}"
    leaves, structure = jax.tree.flatten(critics["params"][last])
    keys = jax.random.split(key, len(leaves))
    small = [
        jax.random.uniform(k, x.shape, minval=-0.003, maxval=0.003)
        for k, x in zip(keys, leaves, strict=True)
    ]
    return {"params": critics["params"] | {last: jax.tree.unflatten(structure, small)}}


def optimisers(cfg: Any, share: jax.Array | float) -> dict[str, optax.GradientTransformation]:
    policy, critic = (adam(lr * share, cfg, EPS) for lr in (cfg.lr, cfg.critic_lr))
    temperature = optax.adam(cfg.alpha_lr, eps=EPS)
    rules = {"critic_r": critic, "critic_c": critic}
    if cfg.encoder == "cnn":
        rules |= {"encoder": critic}
    for name in policies_of(cfg).losses:
        rules |= {name: policy, TEMPERATURES[name]: temperature}
    return rules


def seditor_learner(env: Env, axis_name: str | None = None) -> Learner:
    def init(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> Trainable:
        check_sequences(cfg, axis_name)
        names = constrained_costs(cfg)
        keys = jax.random.split(key, 6)
        encoder, seen = init_features(jax.random.fold_in(key, 1), env, obs_size, cfg)
        critics = {
            "critic_r": init_critics(keys[2], seen, action_size, 2, cfg),
            "critic_c": init_cost_critics(keys[3], seen, action_size, names, cfg),
        }
        critics = {
            name: init_small_critics(key, critics[name], cfg)
            for name, key in zip(critics, keys[4:], strict=True)
        }
        networks = {
            **critics,
            **encoder,
            "proposer": init_beta(keys[0], seen, action_size, cfg),
            "editor": init_beta(keys[1], seen + action_size, action_size, cfg),
            "log_alpha": jnp.log(cfg.alpha_init),
            "log_alpha_editor": jnp.log(cfg.alpha_init),
        }
        rules = optimisers(cfg, 1.0)
        opt_state: dict[str, Any] = {name: rule.init(networks[name]) for name, rule in rules.items()}
        opt_state["moments"] = no_moments(1 + max(len(names), 1))
        trained = {name: networks[name] for name in rules}
        return Trainable({"editor": ()} | trained | {"targets": critics}, opt_state)

    def step(
        nets: Trainable, batch: SequenceBatch, at: GradientStep, cfg: Any, axis_name: str | None
    ) -> tuple[Trainable, Metrics]:
        # On d devices a sample weighs d times as much in the loss of its device. There its gradient is
        # d times as long, so the clip has to be, too.
        longest = cfg.concentration_clip * device_count(axis_name)
        cfg = dataclasses.replace(cfg, concentration_clip=longest)
        target_key, proposer_key, editor_key = jax.random.split(at.key, 3)
        keys = {"proposer": proposer_key, "editor": editor_key}
        scene = Scene(nets.params, at.dual, features(nets.params, batch.rows.obs), cfg)
        paid, nets = paid_in(nets, batch, cfg, axis_name)
        targets = targets_of(paid, batch, scene, target_key)

        def loss(trained: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            total, metrics = critics_loss(trained, batch, targets, cfg, axis_name)
            for name, policy_loss in policies_of(cfg).losses.items():
                own, said = policy_loss(trained, scene, batch, keys[name])
                total, metrics = total + own, metrics | said
            return total, jax.lax.stop_gradient(metrics)

        rules = optimisers(cfg, at.remaining if cfg.lr_decay else 1.0)
        nets, metrics = descend_each(loss, nets, rules, axis_name)
        return follow(nets, cfg.tau), metrics_by_constraint(metrics, constrained_costs(cfg))

    def paid_in(
        nets: Trainable, batch: SequenceBatch, cfg: Any, axis_name: str | None
    ) -> tuple[Values, Trainable]:
        """Rewards and costs of the rows, normalised, and `nets` with the moments that they move."""
        rows = batch.rows
        charged = signal(env, rows, constrained_costs(cfg))
        paid = jnp.concatenate([rows.reward[..., None], charged.reshape(*rows.reward.shape, -1)], -1)
        moments = averaged(nets.opt_state["moments"], paid, batch.weight, axis_name)
        paid = standard(moments, paid, cfg.centre)
        nets = nets._replace(opt_state=nets.opt_state | {"moments": moments})
        return Values(paid[..., 0], paid[..., 1:].reshape(charged.shape)), nets

    return Learner(init=init, act=act, step=step, replayed=drawn_sequences)


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return off_policy(env, seditor_learner(env, axis_name), soft_lagrangian, axis_name)


# HorizonRobotics/alf @23aca49, examples/seditor_safety_gym_conf.py, without its DEBUG: 32 environments
# take 5 steps each between two gradient steps
PAPER: dict[str, Any] = {"num_envs": 32, "stagger": False, "lr_decay": False}
# HorizonRobotics/alf @4816997, examples/safety/seditor/seditor_safe_car_racing_conf.py, and that of sac
# which it is made of: 16 environments take 5 steps each between two gradient steps, on 256 sequences of
# 8. The limit and the replay are those of Safety Gym. There is one frame.
RACING: dict[str, Any] = PAPER | {
    "encoder": "cnn", "num_envs": 16, "replay_ratio": 25.6, "batch_size": 2048, "dual_every": 80,
    "learning_starts": 50_000, "hidden": (256, 256), "editor_min_prob": 0.2,
    # Ours: wheels turn at up to 185 rad/s, and stand beside numbers of the picture in +-1.
    "obs_normalize": True,
}  # fmt: skip
# for a problem of two levers
LEVER: dict[str, Any] = {
    "num_envs": 32, "horizon": 8, "learn_every": 2, "batch_size": 64, "replay_ratio": 2,
    "replay_size": 20_000, "learning_starts": 256, "n_step": 3, "hidden": (32,), "discount": 0.5,
    "cost_discount": 0.5, "lr": 1e-2, "critic_lr": 1e-2, "tau": 0.05, "alpha_init": 0.1,
    "alpha_lr": 3e-3, "min_prob": 0.2, "editor_min_prob": 0.2, "lam_init": 0.3, "dual_lr": 0.05,
    "dual_every": 256, "layer_norm": True, "obs_normalize": True, "max_grad_norm": 40.0,
}  # fmt: skip

ROWS = {
    "seditor": Row(
        SEditorConfig,
        make,
        "a policy that seeks reward, and a safety editor of its actions",
        {"paper": PAPER, "racing": RACING},
        total_steps=5_000_000,
        lever=LEVER,
    ),
}
