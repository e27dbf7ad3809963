"""Every algorithm learns Lever, whose best policies are known, with the options of its row.

Three of them in every run of the tests, one with Adam's steps, one with a trust region and one with an
augmented task; all of them with -m slow.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import BUSY
from learners import on_policy_names, options_of
from toys import Lever, run_episodes, training

from jaxsafe.algos import ALGOS

QUICK = ("cpo", "p3o", "trpo_saute")
LIMIT, BEST = 2.5, 14.375  # cost of an episode, and the best return within it


def slow_but(quick, names):
    return [name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in names]


def train(name, iterations=100, options=None, **swept):
    """2 seeds, or one for each value of what is swept: the algorithm, the train states, metrics."""
    algo = ALGOS[name].make(Lever())
    sizes: dict[str, Any] = {"num_envs": 32, "horizon": 20, "minibatches": 2, "critic_epochs": 4}
    settings = {**sizes, "hidden": (16,), "cost_limit": LIMIT, **ALGOS[name].lever, **(options or {})}
    cfg = ALGOS[name].config(**settings)

    def run(key, swept):
        return training(algo, dataclasses.replace(cfg, **swept), iterations)(key)

    keys = jax.random.split(jax.random.key(0), max(map(len, swept.values()), default=2))
    return algo, *jax.jit(jax.vmap(run), compiler_options=BUSY)(keys, swept)


def late(metrics, window=30):
    """Return and cost of an episode, means over the last iterations."""
    return tuple(np.asarray(metrics[k])[:, -window:].mean(1) for k in ("train/return", "train/cost"))


@pytest.mark.parametrize("name", slow_but(QUICK, on_policy_names(holds="nothing")))
def test_without_a_constraint_all_the_reward_is_taken_and_the_cost_paid(name):
    ret, cost = late(train(name)[2])
    assert (ret > 19).all() and (cost > 8).all()  # 20 and 10 at best


AVERAGE = on_policy_names(holds="average")
PRICED = [name for name in AVERAGE if "dual_lr" in options_of(name)]


@pytest.mark.parametrize("name", slow_but(QUICK, [name for name in AVERAGE if name not in PRICED]))
def test_constrained_algorithms_earn_what_the_limit_allows(name):
    """A controller's first price is too high, and swings as it falls: hence a longer run and mean."""
    iterations, window = (160, 60) if "pid_ki" in options_of(name) else (100, 30)
    ret, cost = late(train(name, iterations)[2], window)
    assert (cost < LIMIT * 1.1).all()
    assert (ret > 0.9 * BEST).all()


@pytest.mark.parametrize("name", slow_but(QUICK, PRICED))
def test_an_adaptive_price_holds_the_limit_on_average(name):
    """Adam's multiplier swings about its value, and the cost about the limit: hence a long mean."""
    ret, cost = late(train(name, iterations=200, options={"dual_lr": 0.05})[2], window=150)
    assert (cost < LIMIT * 1.15).all()
    assert (ret > 0.9 * BEST).all()


@pytest.mark.parametrize("name", slow_but(QUICK, on_policy_names(holds="episode")))
def test_a_budget_or_an_early_end_holds_the_limit_in_every_episode(name):
    """Up to 1 in 50: the policy is a smooth function, and is paid to come near the limit."""
    algo, ts, metrics = train(name)
    whole = run_episodes(algo, jax.vmap(algo.learned)(ts), 200, seed=0)
    assert (whole.length == 10).all()
    assert (whole.cost > LIMIT).mean() < 0.02
    assert (whole.ret.mean(1) > 0.9 * BEST).all()
    assert (metrics["train/episode_length"][:, -30:] > 9.5).all()


@pytest.mark.slow
def test_a_fixed_price_is_paid_until_cost_is_not_worth_it():
    paid = late(train("ppo_penalty", price=jnp.array([0.0, 0.5, 20.0]))[2])[1]
    assert paid[0] > 8 and paid[2] < 0.5
    assert paid[2] + 1 < paid[1] < paid[0] - 1
