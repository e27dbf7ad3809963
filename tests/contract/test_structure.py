"""What holds for every on-policy algorithm, without compiling one."""

from typing import Any

import chex
import jax
import jax.numpy as jnp
import pytest
from learners import TINY, begin, by_adam, covering, every_option, on_policy_names, options_of
from toys import START, Corridor, Ticker

from jaxsafe.algos import ALGOS
from jaxsafe.config import ConfigError

NAMES = on_policy_names()


def shapes(name, env: Any = Corridor(), **options):  # noqa: B008
    """The train state before and after an update, and its metrics, as shapes."""
    algo, cfg = ALGOS[name].make(env), ALGOS[name].config(**TINY | options)
    before = jax.eval_shape(lambda: algo.init(jax.random.key(0), cfg, START))
    return before, *jax.eval_shape(algo.update, before, START)


def kinds(tree):
    return [(x.shape, x.dtype, x.weak_type) for x in jax.tree.leaves(tree)]


@pytest.mark.parametrize("name", NAMES)
def test_an_update_keeps_the_structure(name):
    before, after, metrics = shapes(name)
    chex.assert_trees_all_equal_structs(before, after)
    assert kinds(before) == kinds(after)
    assert all(x.dtype == jnp.float32 and x.shape == () for x in metrics.values())
    assert {"train/return", "train/cost", "train/cost_estimate", "train/nonfinite"} <= metrics.keys()
    for metric, option in (("clip_fraction", "clip"), ("inside", "near_kl"), ("passes", "epochs")):
        assert (f"train/{metric}" in metrics) == (option in options_of(name))


@pytest.mark.parametrize("name", NAMES)
def test_an_update_with_every_option_at_once_keeps_the_structure(name):
    before, after, _ = shapes(name, **every_option(name))
    chex.assert_trees_all_equal_structs(before, after)
    assert kinds(before) == kinds(after)


@pytest.mark.parametrize("name", NAMES)
def test_the_algorithms_by_adam_share_a_trunk_and_the_others_say_that_they_do_not(name):
    algo, cfg = ALGOS[name].make(Ticker()), ALGOS[name].config(**TINY, trunk="shared")
    if not by_adam(name):
        for build in (algo.clocks, lambda cfg: algo.init(jax.random.key(0), cfg, START)):
            with pytest.raises(ConfigError, match="trunk=shared: expected separate"):
                build(cfg)
        return
    assert algo.clocks(cfg).gradient_steps == cfg.POLICY_STEPS * cfg.epochs * cfg.minibatches
    before, after, metrics = shapes(name, Ticker(), trunk="shared")
    chex.assert_trees_all_equal_structs(before, after)
    assert [*before.params] == ["actor"] and before.opt_state["critics"] == ()
    assert before.params["actor"]["mean"]["params"]["Dense_1"]["bias"].shape == (1 + 2,)
    assert {"train/value_loss_r", "train/value_loss_c", "train/nonfinite"} <= metrics.keys()


@pytest.mark.parametrize("name", NAMES)
def test_published_settings_build(name):
    algo = ALGOS[name].make(Corridor())
    for settings in ALGOS[name].published.values():
        cfg = ALGOS[name].config(**settings)
        jax.eval_shape(lambda cfg=cfg: algo.init(jax.random.key(0), cfg, START))


@pytest.mark.parametrize("name", NAMES)
def test_sizes_that_do_not_fit_are_refused_with_the_nearest_that_do(name):
    with pytest.raises(ConfigError, match=r"minibatches=7.*= 200; the nearest is 8"):
        begin(name, minibatches=7)


@pytest.mark.parametrize("name", ["cpo", "p3o", "pcpo"])
def test_normalised_costs_are_refused_where_the_violation_is_in_units_of_cost(name):
    with pytest.raises(ConfigError, match="cost_normalize=True: expected False"):
        begin(name, cost_normalize=True)


def test_the_rows_that_are_compiled_have_every_method_and_every_option():
    chosen = covering()
    assert {ALGOS[name].config.__module__ for name in chosen} == {
        ALGOS[name].config.__module__ for name in NAMES
    }
    assert set().union(*map(options_of, chosen)) == set().union(*map(options_of, NAMES))
    assert len(chosen) < len(NAMES)
