"""`import jaxsafe` as a program or a notebook uses it, on toys."""

import inspect
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Corridor, run_episodes

import jaxsafe
from jaxsafe import algos, api
from jaxsafe.algos.ppo import PPOConfig
from jaxsafe.config import config
from jaxsafe.learn.acting import course
from jaxsafe.learn.on_policy import on_policy
from jaxsafe.learn.steps import adam_epochs
from jaxsafe.learn.surrogates import clipped
from jaxsafe.learn.treatments import penalty
from jaxsafe.report import film, finish
from jaxsafe.report.evaluation import evaluate
from jaxsafe.report.read import read
from jaxsafe.run import checkpoint, programs, progress, run_folder
from jaxsafe.run.arguments import compose
from jaxsafe.run.evaluate import totals
from jaxsafe.run.plain import to_plain
from jaxsafe.run.settings import Settings, nested, settings_from_options
from jaxsafe.run.sweep_plan import Sweep, plan

TINY: dict[str, Any] = {
    "num_envs": 4, "horizon": 8, "minibatches": 2, "epochs": 1, "critic_epochs": 1, "hidden": (4, 4),
    "total_steps": 96, "eval_episodes": 0,
}  # fmt: skip


@config
class PricedConfig(PPOConfig):
    price: float = 0.5


PRICED = algos.Row(
    PricedConfig, lambda env, axis_name=None: on_policy(env, penalty, clipped, adam_epochs, axis_name)
)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> jaxsafe.Run:
    """Two seeds of an algorithm that adds to the observation; nobody changes it."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    return jaxsafe.train(Corridor(), "ppo_saute", num_seeds=2, run_dir=folder, **TINY)


# ---- what is public --------------------------------------------------------------------------


def test_importing_the_package_imports_neither_jax_nor_the_registries():
    code = (
        "import jaxsafe, sys; print({'jax', 'hydra', 'jaxsafe.api'} & {*sys.modules});"
        "import jaxsafe.learn.on_policy; print({'jaxsafe.envs', 'jaxsafe.algos'} & {*sys.modules});"
        "print(callable(jaxsafe.sweep), 'train' in dir(jaxsafe))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:3] == ["set()", "set()", "True True"]


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'trian'"):
        jaxsafe.trian  # noqa: B018  # type: ignore[attr-defined]


def public() -> dict[str, Any]:
    """Every public function and class, and their public methods and properties."""
    found = {name: getattr(jaxsafe, name) for name in jaxsafe.__all__}
    members = {f"Run.{k}": v for k, v in vars(jaxsafe.Run).items() if not k.startswith("_")}
    return found | members


@pytest.mark.parametrize("name", public())
def test_a_public_name_says_what_it_takes_gives_and_raises(name):
    thing = public()[name]
    text = inspect.getdoc(thing) or ""
    assert text, f"{name} has no docstring"
    if inspect.isfunction(thing):
        for section in ("Args:", "Returns:", "Raises:"):
            assert f"\n{section}\n" in text, f"{name} has no {section}"
        for argument in inspect.signature(thing).parameters:
            assert argument == "self" or f"\n    {argument}: " in text, f"{name}: {argument}"
        assert inspect.signature(thing).return_annotation is not inspect.Parameter.empty
    if name in ("make", "evaluate"):
        assert "Source:" in text
    if name in ("make", "Run.policy"):
        assert "float [" in text


def test_the_lazy_names_are_what_the_module_defines_and_its_error():
    defined = {name for name, x in vars(api).items() if getattr(x, "__module__", "") == api.__name__}
    assert {*jaxsafe.__all__} == defined | {"ConfigError"}


# ---- the same as the scripts -----------------------------------------------------------------

SAME: dict[str, tuple[tuple[Any, Any, dict[str, Any]], list[str]]] = {
    "a name and settings": (
        ("point_goal1", "cpo", {"cost_limit": 10, "num_seeds": 4, "total_steps": 1e6}),
        ["algo=cpo", "algo.cost_limit=10", "num_seeds=4", "total_steps=1e6"],
    ),
    "the defaults": ((None, None, {}), []),
    "Safety Gym's id": (("Safexp-CarPush1-v0", None, {}), ["env=car_push1"]),
    "an option of the environment": (
        ("point_goal1", None, {"env.hazards_num": 12, "env.num_steps": np.int64(50)}),
        ["env.hazards_num=12", "env.num_steps=50"],
    ),
    "several values of a float": (
        (None, "ppo_lag", {"cost_limit": np.array([5.0, 10.0]), "hidden": (8, 8)}),
        ["algo.cost_limit=[5,10]", "algo.hidden=[8,8]"],
    ),
    "named limits": (
        ("point_goal2", "cpo", {"cost_limits": {"hazards": 10}, "video": False}),
        ["env=point_goal2", "algo=cpo", "algo.cost_limits={hazards: 10}", "video=false"],
    ),
    "a preset, by its prefix": (
        (None, None, {"preset": "published", "algo.clip": 0.1}),
        ["preset=published", "algo.clip=0.1"],
    ),
}


def asked(env: Any, algo: Any, **options: Any) -> Settings:
    choice = api.chosen(env, algo)
    return settings_from_options(nested(choice.given | api.full_names(choice, options)), choice.extras)


@pytest.mark.parametrize("case", SAME)
def test_arguments_mean_what_they_mean_on_the_command_line(case):
    (env, algo, options), expected = SAME[case]
    assert asked(env, algo, **options).plain() == compose(expected).plain()


def test_an_environment_that_was_made_is_recorded_by_its_name_and_options():
    env = jaxsafe.make("Safexp-PointGoal1-v0", hazards_num=12, hazards_size=0.1)
    assert api.chosen(env, None).objects == {}
    expected = ["env=point_goal1", "env.hazards_num=12", "env.hazards_size=0.1"]
    assert asked(env, None).plain() == compose(expected).plain()


@pytest.mark.parametrize(
    "value, expected",
    [
        (np.int64(3), 3), (np.float32(0.5), 0.5), (np.bool_(True), True), (np.arange(2), [0, 1]),
        (jnp.array([1.5]), [1.5]), ((8, (4,)), [8, [4]]), (range(2), [0, 1]), (Path("a/b"), "a/b"),
        ("it's [1, x=2", "it's [1, x=2"), ({"a": np.float64(1)}, {"a": 1.0}), (None, None),
    ],
)  # fmt: skip
def test_a_value_of_python_is_the_plain_value_that_it_stands_for(value, expected):
    found = to_plain(value)
    assert found == expected and type(found) is type(expected)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("point_gol1",), "did you mean 'point_goal1'?"),
        ((None, "cop"), "did you mean 'cpo'?"),
        ((None, None, {"cost_limt": 3}), "unknown option cost_limt; did you mean 'cost_limit'?"),
        ((None, None, {"total_step": 5}), "did you mean 'total_steps'?"),
        ((None, "cpo", {"epochs": 5}), "unknown option algo.epochs of cpo"),
        ((None, None, {"hazards_num": 5}), "did you mean 'env.hazards_num'?"),
        ((None, None, {"env.hazard_num": 5}), "did you mean 'hazards_num'?"),
        ((None, None, {"total_steps": -1}), "expected a whole number between 1 and"),
        ((None, None, {"cost_limit": "wide"}), "expected a number"),
        ((None, None, {"cost_limit": float("nan")}), "expected a number between 0 and"),
        ((None, None, {"clip": object()}), "expected a number, a string"),
        ((None, None, {"num_envs": 1e7}), "GiB"),
        ((None, None, {"resume": "nowhere"}), "not a run folder"),
        ((None, None, {"num_processes": 2}), "several processes are for the command line"),
        ((Corridor(), None, {"env.dt": 0.1}), "env.dt=0.1: this Corridor has another value"),
        ((object(),), "object (object) is no Env"),
        ((Corridor,), "Corridor is a class; expected an environment, as Corridor() makes one"),
        (("nowhere:Corridor",), "no module 'nowhere'"),
        ((None, object()), "expected a name or an object with a config class and make"),
    ],
)
def test_bad_input_is_a_config_error_of_one_line(arguments, message):
    env, algo = (*arguments[:2], None, None)[:2]
    options: dict[str, Any] = dict(*arguments[2:])
    with pytest.raises(jaxsafe.ConfigError) as caught:
        jaxsafe.train(env, algo, **options)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert not Path("runs").exists()


# ---- a run -----------------------------------------------------------------------------------


def test_a_run_has_its_settings_and_its_metrics_by_iteration_and_policy(run):
    assert run.steps == 96 and run.settings.algo.horizon == 8
    assert run.config["env"]["name"] == "Corridor" and run.config["env"]["half_width"] == 0.5
    metrics, table = run.metrics, run_folder.read_metrics(run.folder)
    assert metrics["steps"].tolist() == [32, 64, 96]
    assert metrics["train/kl"].shape == (3, 2)
    for seed in (0, 1):
        own = table["seed"] == seed
        np.testing.assert_array_equal(metrics["train/kl"][:, seed], table["train/kl"][own])
    assert repr(run).endswith(": Corridor, ppo_saute, 2 seeds, 96 steps)")


def test_a_policy_acts_on_what_its_environment_shows(run):
    env = run.env(1)
    assert env.obs_size == Corridor().obs_size + 1  # the budget
    obs = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 3)).obs
    actions = run.policy(obs, index=1)
    assert actions.shape == (3, 2)
    one_by_one = jax.jit(jax.vmap(lambda x: run.policy(x, index=1)))(obs)
    np.testing.assert_allclose(actions, one_by_one, atol=1e-6)
    assert not np.allclose(actions, run.policy(obs, index=0))
    assert not np.allclose(actions, run.policy(obs, jax.random.key(1), 1))
    with pytest.raises(jaxsafe.ConfigError, match="index 2: the run has 2 policies"):
        run.policy(obs, index=2)


def test_a_policy_refuses_the_observations_of_another_environment(run):
    state = Corridor().reset(jax.random.key(0))
    for given, found in (
        (state.obs, r"\[4\]"),
        (jnp.zeros((3, 4)), r"\[3, 4\]"),
        (state, "a State"),
        ([0.0] * 5, "a list"),
        ({"vector": jnp.zeros(5)}, r"vector \[5\]"),
    ):
        with pytest.raises(jaxsafe.ConfigError, match=rf"is {found}, expected \[5\] or a batch"):
            run.policy(given)
        if given is not state:  # which is no array: jit would take it apart
            with pytest.raises(jaxsafe.ConfigError, match=r"expected \[5\]"):
                jax.jit(run.policy)(given)
    assert run.policy(np.zeros((2, 3, 5), np.float32)).shape == (2, 3, 2)


def test_a_policy_that_plans_in_the_simulator_acts_on_a_state_alone(tmp_path):
    plans = {"true_model": True, "learning_starts": 0, "plans": 8, "elites": 3, "plan_steps": 3}
    run = jaxsafe.train(
        Corridor(), "cce_pets", run_dir=tmp_path / "run", num_envs=4, total_steps=48, horizon=6,
        eval_episodes=2, **plans,
    )  # fmt: skip
    assert run.metrics["train/nonfinite"].sum() == 0
    player = run.player()
    action, plan = player.act(player.begin(), player.task.reset(jax.random.key(0)))
    assert action.shape == (2,) and plan.mean.shape == (3, 2) and (plan.mean != 0).any()
    assert plan.step == 1
    with pytest.raises(jaxsafe.ConfigError, match="this policy plans in the simulator"):
        run.policy(jnp.zeros(4))
    with pytest.raises(jaxsafe.ConfigError, match="index 1: the run has one policy, 0, in"):
        run.player(1)
    other = jaxsafe.Run(run.folder, Corridor(), plan_steps=2, cost_limit=7)  # without training again
    player = other.player()
    _, plan = player.act(player.begin(), player.task.reset(jax.random.key(0)))
    assert plan.mean.shape == (2, 2) and player.learned.config.cost_limit == 7
    with pytest.raises(jaxsafe.ConfigError, match=r"algo\.horizon: expected a setting of cce_pets"):
        jaxsafe.Run(run.folder, Corridor(), horizon=3)


def test_most_trained_policies_act_by_no_setting(run):
    with pytest.raises(jaxsafe.ConfigError, match=r"algo\.cost_limit: no setting of ppo_saute"):
        jaxsafe.Run(run.folder, Corridor(), cost_limit=3)


def test_evaluation_is_that_of_the_script(run):
    scores = jaxsafe.evaluate(run, episodes=3)
    (expected,) = evaluate(run._opened, 3, 1)
    assert scores == expected
    assert len(scores.seeds["return"]) == 2
    assert str(scores).splitlines()[1].startswith("return ")
    wrong: list[dict[str, Any]] = [{"episodes": 0}, {"seed": -1}, {"setting": 1}]
    for bad in wrong:
        with pytest.raises(jaxsafe.ConfigError, match=r"expected|has 1"):
            jaxsafe.evaluate(run, **bad)


@pytest.mark.parametrize("episodes", [5, 0])
def test_a_run_films_its_episode_of_the_median_return_or_that_of_its_seed(
    episodes, tmp_path, monkeypatch
):
    filmed: list[Any] = []
    monkeypatch.setattr(finish, "film", lambda policies, path, key: filmed.append((policies, key)))
    made = jaxsafe.train(
        Corridor(), "ppo", run_dir=tmp_path / "run", num_envs=4, total_steps=48, horizon=6,
        eval_episodes=episodes, video=True,
    )  # fmt: skip
    (((policy,), key),) = filmed
    if episodes:
        (ret,) = run_episodes(made._opened.algo, made._opened.learned, episodes, seed=0).ret
        assert len({*ret.tolist()}) == episodes
        assert np.argmin(abs(ret - totals(course(policy.player, key)).ret)) == np.argsort(ret)[2]
    else:
        assert (key == film.key_of(0)).all()


def test_sampled_actions_are_evaluated_in_the_same_episodes(run):
    mean, sampled = (jaxsafe.evaluate(run, episodes=3, sampled=x) for x in (False, True))
    played = run_episodes(run._opened.algo, run._opened.learned, 3, seed=1, sampled=True)
    np.testing.assert_allclose(sampled.seeds["return"], played.ret.mean(1), rtol=1e-6)
    assert sampled.seeds["return"] != mean.seeds["return"]


def test_what_cannot_be_filmed_is_refused(run):
    with pytest.raises(jaxsafe.ConfigError, match=r"policy\.avi: expected a name that ends in"):
        jaxsafe.render(run, "policy.avi")
    with pytest.raises(jaxsafe.ConfigError, match="index 7"):
        jaxsafe.render(run, "policy.mp4", index=7)
    with pytest.raises(jaxsafe.ConfigError, match="velocity and racing tasks can be drawn"):
        jaxsafe.render(run, "policy.mp4")
    with pytest.raises(jaxsafe.ConfigError, match="not a run folder"):
        jaxsafe.evaluate("nowhere")


def test_a_run_of_ones_own_opens_with_the_same_object_alone(run):
    again = jaxsafe.Run(run.folder, Corridor())
    obs = run.env().reset(jax.random.key(0)).obs
    np.testing.assert_array_equal(again.policy(obs), run.policy(obs))
    opens = r"trained with env=Corridor, .* jaxsafe\.Run\(FOLDER, env=OBJECT\)"
    for elsewhere in (
        lambda: jaxsafe.Run(run.folder),
        lambda: jaxsafe.train(resume=run.folder),
        lambda: jaxsafe.train("pendulum_tilt", init_from=run.folder),
        lambda: read([run.folder]),
    ):
        with pytest.raises(jaxsafe.ConfigError, match=opens):
            elsewhere()


@pytest.fixture
def signals(monkeypatch):
    """Ctrl-C at the first report of progress."""

    sent = []

    def update(self: progress.Reporter, *_: Any, **__: Any) -> None:
        if not sent:
            sent.append(signal.raise_signal(signal.SIGINT))

    monkeypatch.setattr(progress.Reporter, "update", update)


def test_an_interrupted_run_is_saved_and_continues(signals, run, capsys):
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt, match=r"env=<your Corridor>, algo=<your Priced>, r"):
        jaxsafe.train(Corridor(), PRICED, run_dir="stopped", **TINY)
    assert signal.getsignal(signal.SIGINT) is before
    with pytest.raises(jaxsafe.ConfigError, match=r"trained with algo=Priced, .* algo=OBJECT\)"):
        jaxsafe.Run("stopped", Corridor())
    stopped = jaxsafe.Run("stopped", Corridor(), PRICED)
    assert 0 < stopped.steps < 96
    out = capsys.readouterr().out
    assert "only this program knows Corridor and Priced" in out and "stopped at" in out
    with pytest.raises(jaxsafe.ConfigError, match=r"env\.half_width=0.5: this Corridor has another"):
        jaxsafe.train(Corridor(half_width=0.1), PRICED, resume="stopped")
    assert jaxsafe.train(Corridor(), PRICED, resume="stopped").steps == 96
    jaxsafe.train(Corridor(), PRICED, run_dir="whole", **TINY)
    left, right = (checkpoint.load(Path(f, "checkpoints"))[0] for f in ("stopped", "whole"))
    for name in left:
        np.testing.assert_array_equal(left[name], right[name], err_msg=name)


def test_an_interrupt_with_nothing_to_save_leaves_the_program_running(monkeypatch):
    def compiling(program: programs.Program, ts: Any) -> Any:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(programs, "compiled", compiling)
    with pytest.raises(KeyboardInterrupt, match="stopped before the first update; nothing to save"):
        jaxsafe.train(Corridor(), run_dir="run", **TINY)


# ---- sweeps ----------------------------------------------------------------------------------


def test_a_sweep_that_is_stopped_before_an_update_says_how_it_goes_on(monkeypatch):
    def compiling(program: programs.Program, ts: Any) -> Any:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(programs, "compiled", compiling)
    with pytest.raises(KeyboardInterrupt, match=r"stopped before the first update; (?!nothing)"):
        jaxsafe.sweep(Corridor(), cost_limit=[5, 10], max_parallel=1, run_dir="sweep", **TINY)


def planned(env: Any, algo: Any = None, **options: Any) -> Sweep:
    choice = api.chosen(env, algo)
    return plan(*api.asked_for(choice, options), choice.extras)


def test_a_sweep_takes_lists_for_values_and_tuples_for_lists():
    found = planned("point_goal1", ["ppo_lag", PRICED], hidden=[(8, 8), (4, 4)], cost_limit=[5, 10])
    assert [(g.algo_name, g.algo.hidden) for g in found.groups.values()] == [
        (name, hidden) for name in ("ppo_lag", "Priced") for hidden in ((8, 8), (4, 4))
    ]
    assert [c.cost_limit for c in next(iter(found.groups.values())).configs] == [5.0, 10.0]
    (group,) = planned("point_goal1", cost_limit=[5, 10], num_seeds=3).groups.values()
    assert (len(group.configs), group.train.num_seeds) == (2, 3)  # one program of six members
    found = planned("point_goal1", seed=range(2), max_parallel=np.int64(4), num_envs=4)
    assert [g.train.seed for g in found.groups.values()] == [0, 1] and found.max_parallel == 4
    found = planned("point_goal2", cost_limits={"hazards": [5, 10], "vases_contact": 25})
    (group,) = found.groups.values()
    assert found.swept == ["algo.cost_limits.hazards"]
    assert [c.cost_limits["hazards"] for c in group.configs] == [5.0, 10.0]


def test_a_sweep_of_nothing_or_of_unknown_options_is_one_line():
    for options, message in (
        ({"cost_limit": []}, "expected values to sweep"),
        ({"cost_limits": {"hazards": []}}, "cost_limits.hazards=[]: expected values to sweep"),
        ({"cost_limit": 5}, "nothing to sweep"),
        ({"max_paralel": 5}, "did you mean 'max_parallel'?"),
    ):
        with pytest.raises(jaxsafe.ConfigError, match=re.escape(message)):
            jaxsafe.sweep("point_goal1", **options)
    with pytest.raises(jaxsafe.ConfigError, match="expected names in a list"):
        jaxsafe.sweep(["point_goal1", Corridor()])


def test_a_sweep_has_a_row_a_setting_and_opens_its_runs():
    found = jaxsafe.sweep(Corridor(), PRICED, price=[0.0, 1.0], num_seeds=2, run_dir="sweep", **TINY)
    assert [row.name for row in found.rows] == ["algo.price=0", "algo.price=1"]
    assert found.rows[0].returns.shape == (2,)
    assert str(found) == Path("sweep", "summary.md").read_text()
    (run,) = found.runs
    assert run.metrics["train/lam"][0].tolist() == [0, 0, 1, 1]
    assert run.policy(jnp.zeros(4), index=3).shape == (2,)
