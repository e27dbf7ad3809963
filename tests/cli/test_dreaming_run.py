"""A run under a shield: resumed, evaluated, and played for a film."""

import json
import runpy
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from shell import SCRIPTS, TOY, assert_same_run, typed
from toys import START

from jaxsafe.algos import ambs
from jaxsafe.config import ConfigError
from jaxsafe.envs.view import render
from jaxsafe.report.dreams import play
from jaxsafe.run import checkpoint, run_folder
from jaxsafe.run.arguments import beside_a_run, compose
from jaxsafe.run.policies import open_run
from jaxsafe.run.session import about_cpu
from jaxsafe.run.settings import acting, load, make_env, nested, settings_from_options

TINY = (
    "num_envs=4", "algo.horizon=8", "algo.learn_every=8", "algo.batch_size=32", "algo.replay_ratio=2",
    "algo.n_step=3", "algo.replay_size=128", "algo.learning_starts=32", "algo.size=tiny",
    "algo.imagine_steps=3", "eval_episodes=2", "video=false",
)  # fmt: skip
AMBS = (
    TOY, "algo=ambs", *TINY, "algo.overshoot=2", "algo.rule=hoeffding", "algo.shield_rollouts=4",
    "algo.shield_horizon=5", "algo.labels=[wall]",
)  # fmt: skip
DREAMER = ("algo=dreamer", *TINY, "total_steps=64")
STEPS = 32  # of an update
foresight = runpy.run_path(str(SCRIPTS / "foresight.py"))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    run = tmp_path_factory.mktemp("dreaming") / "run"
    assert typed("train", *AMBS, f"total_steps={4 * STEPS}", f"run_dir={run}") == 0
    return run


@pytest.mark.slow
def test_stopped_and_resumed_it_ends_bit_for_bit_as_if_uninterrupted(trained, tmp_path, capsys):
    run = tmp_path / "run"
    args = (*AMBS, f"total_steps={4 * STEPS}", "checkpoint_iterations=2", f"run_dir={run}")
    assert typed("train", *args) == 0
    said = capsys.readouterr().out
    assert "shield: overrules from 1 of 4 dreams" in said and "(4 are too few)" in said
    for kind in ("checkpoints", "policy"):  # as if it had been killed after iteration 2
        shutil.rmtree(run / kind / "00000004")
    assert typed("train", *args, "resume=true") == 0
    assert_same_run(run, trained)
    carry = checkpoint.load(run / "checkpoints")[0]["stepping.rollout.carry.latent.deter"]
    assert carry.shape == (1, 4, 32) and carry.any()  # members, environments, memory


@pytest.mark.slow
def test_evaluation_says_what_the_shield_does_and_a_film_has_where(trained):
    found = json.loads((trained / "evaluation.json").read_text())
    assert 0 <= found["override rate"]["mean"] <= 1 and found["violations"]["mean"] >= 0
    assert {"violations, no shield", "return, no shield", "Brier score"} <= found.keys()
    assert {len(x) for x in found["calibration"].values()} != {0}
    assert (trained / "calibration.png").exists()
    assert "train/violations" in run_folder.read_metrics(trained)
    run = open_run(trained, (TOY,))
    states, said = render.run_episode(run.one(0).player, jax.random.key(0), 20)
    assert np.isfinite(states.obs).all() and said["overruled"].shape == (20,)


@pytest.mark.slow
def test_another_shield_is_tried_without_training_again(trained, capsys):
    assert typed("evaluate", str(trained), TOY, "--episodes", "2", "algo.shield=none") == 0
    said = capsys.readouterr().out
    assert said.splitlines()[0].endswith("cost limit 0 | algo.shield=none")
    assert "violations " in said and "override rate" not in said
    always = ("evaluate", str(trained), TOY, "algo.delta=0.01")
    assert typed(*always) == 2 and "delta=0.01: expected at least" in capsys.readouterr().err
    player = open_run(trained, (TOY,), acts_by={"delta": 0.5}).one(0).player
    assert player.learned.config.delta == 0.5


def test_a_setting_in_which_a_run_s_policies_differ_is_not_replaced():
    swept = settings_from_options(nested({"algo": "ambs", "algo.delta": [0.2, 0.4], "video": False}))
    assert [cfg.confidence for cfg in acting(swept, {"confidence": 0.05}).configs] == [0.05, 0.05]
    assert [cfg.delta for cfg in acting(swept, {"confidence": 0.05}).configs] == [0.2, 0.4]
    with pytest.raises(ConfigError, match=r"algo\.delta: the run has several"):
        acting(swept, {"delta": 0.3})
    with pytest.raises(ConfigError, match=r"algo\.delt: .* may change .*; did you mean 'delta'"):
        acting(swept, {"delt": 0.3})
    with pytest.raises(ConfigError, match=r"algo\.delta: expected one value"):
        beside_a_run([TOY, "algo.delta=0.1,0.2"])
    assert beside_a_run([TOY, "algo.delta=1e-1"]) == ([TOY], {"delta": 0.1})


@pytest.mark.slow
def test_foresight_compares_dreams_with_what_came(trained):
    player = open_run(trained, (TOY,)).one(0).player
    episodes = jax.vmap(lambda key: play(player, key))(jax.random.split(jax.random.key(0), 3))
    cost = np.asarray(episodes.state.cost)
    found = foresight["costs_ahead"](player, ambs.shielded_behaviour, episodes, 4, jax.random.key(1))
    counted = 10.0 * (cost > 0)  # as violation_cost
    starts = np.arange(20, cost.shape[1] - 4, 3)
    for k in range(4):
        np.testing.assert_array_equal(found.paid[k].reshape(3, -1), counted[:, starts + k + 1])
    assert found.predicted.shape == found.paid.shape and np.isfinite(found.predicted).all()


TICKER, PATCH = "env=toys:Ticker", "env=toys:Patch"
MISFITS = {  # a command, and what its line says
    "another observation": (
        ("train", *DREAMER, TICKER, "run_dir=new", "init_from=run"),
        ("does not fit", "env.name is toys:Corridor there, toys:Ticker here"),
    ),
    "pictures": (
        ("train", *DREAMER, PATCH, "algo.encoder=cnn", "run_dir=new", "init_from=run"),
        ("toys:Corridor there, toys:Patch here", "algo.encoder is none there, cnn here"),
    ),
    "another algorithm": (
        ("train", *AMBS, "total_steps=64", "run_dir=new", "init_from=run"),
        ("critic_c1", "is absent", "algo.name is dreamer there, ambs here"),
    ),
    "another size": (
        ("train", *DREAMER, TOY, "algo.size=300k", "run_dir=new", "init_from=run"),
        ("does not fit", "algo.size is tiny there, 300k here"),
    ),
    "resumed elsewhere": (("train", TICKER, "resume=run"), ("was trained with toys:Corridor",)),
    "evaluated elsewhere": (("evaluate", "run", TICKER), ("was trained with env=toys:Corridor",)),
    "evaluated where observations and actions have changed": (
        ("evaluate", "changed", TOY),
        ("does not fit", "is [2], expected [4]"),
    ),
}


def untrained(folder: Path, env: str) -> None:
    """Write the run of a Dreamer there whose policy is all zeros."""
    run = compose([*DREAMER, env])
    algo = run.row.make(make_env(run), None)
    like = jax.eval_shape(lambda: algo.learned(algo.init(jax.random.key(0), run.algo, START)))
    policy = jax.tree.map(lambda x: np.zeros((1, *x.shape), x.dtype), like)
    folder.mkdir()
    run_folder.write_config(folder, run.plain())
    checkpoint.save(folder / "policy", checkpoint.to_arrays(policy), checkpoint.Progress(1, 64, 4))


@pytest.mark.parametrize("case", MISFITS)
def test_a_model_of_other_observations_is_refused_in_a_line(case, tmp_path, monkeypatch, capsys):
    (command, *words), told = MISFITS[case]
    monkeypatch.chdir(tmp_path)
    for env in (TOY, TICKER, PATCH):
        load("env", env.removeprefix("env="))
    if "changed" in words:
        untrained(Path("changed"), TICKER)
        run_folder.write_config(Path("changed"), compose([*DREAMER, TOY]).plain())
    else:
        untrained(Path("run"), TOY)
    assert typed(command, *words) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and all(part in err for part in told), err


def test_an_area_of_1_sorts_all_and_a_half_is_a_coin_s():
    area, true = foresight["roc_area"], np.array([True, False, True, False])
    assert area(np.array([3.0, 1.0, 2.0, 0.0]), true) == 1.0
    assert area(np.array([0.0, 1.0, 0.0, 1.0]), true) == 0.0
    assert area(np.zeros(4), true) == 0.5
    assert area(np.array([2.0, 1.0, 0.0, 0.0]), true) == 0.625  # 2 > 1, 2 > 0, 0 < 1, 0 = 0
    assert np.isnan(area(np.zeros(2), np.ones(2, bool)))


def test_the_mean_explains_nothing_and_the_truth_explains_all():
    explained, paid = foresight["explained"], np.array([0.0, 1.0, 2.0])
    assert explained(paid, paid) == 1.0 and explained(np.ones(3), paid) == 0.0
    np.testing.assert_allclose(explained(paid[::-1], paid), -3.0)


def test_a_label_that_the_environment_does_not_have_is_refused_in_a_line(capsys, tmp_path):
    args = ("algo.labels=[walls]", "total_steps=64", f"run_dir={tmp_path / 'run'}")
    assert typed("train", *AMBS, *args) == 2
    assert "labels: unknown cost 'walls'; did you mean 'wall'?" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_on_a_cpu_the_defaults_name_the_preset_for_it(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    task = ["env=point_goal1", "algo=ambs"]
    found = [about_cpu(compose([*task, *more])) for more in ([], ["preset=cpu"], ["algo.size=tiny"])]
    assert "preset=cpu is for" in found[0] and found[1:] == ["", ""]
    assert about_cpu(compose(["env=point_goal1", "algo=cpo"])) == ""  # which has none
