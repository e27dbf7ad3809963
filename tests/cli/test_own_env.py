"""Environments and algorithms from outside the package, in Python and on the command line."""

import dataclasses
import sys
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import pytest
import shell
from toys import Corridor, Ticker

from jaxsafe import algos, envs
from jaxsafe.config import ConfigError
from jaxsafe.envs.check import check_env
from jaxsafe.envs.safety_gym.config import SafetyGymConfig
from jaxsafe.envs.safety_gym.suite import ROBOTS, TASKS
from jaxsafe.envs.safety_gym.task import SafetyGym
from jaxsafe.envs.wrap import ActionScale, wrap_config_of
from jaxsafe.run.arguments import compose
from jaxsafe.run.choice import choose_env


@pytest.fixture(autouse=True)
def registry(monkeypatch):
    """The registries as they were, and no module of an earlier test."""
    monkeypatch.setattr(algos, "ALGOS", {**algos.ALGOS})
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    known = {**envs.ENVS}
    yield
    envs.ENVS.clear()
    envs.ENVS.update(known)


def test_a_task_is_registered_by_its_options():
    envs.register("maze1", TASKS["goal1"] | ROBOTS["point"] | {"hazards_num": 12, "engine": "c"})
    assert envs.env_defaults("maze1")["hazards_num"] == 12
    env = envs.make("maze1", lidar_num_bins=8)
    assert (env.name, env.config.hazards_num, env.config.lidar_num_bins) == ("maze1", 12, 8)
    envs.register("maze2", env)
    assert envs.env_defaults("maze2")["lidar_num_bins"] == 8
    with pytest.raises(ConfigError, match="did you mean 'hazards_num'"):
        envs.register("maze3", {"hazard_num": 3})


class Generous(SafetyGym):
    def step(self, state, action):
        return dataclasses.replace(super().step(state, action), reward=jnp.float32(7))


def test_a_class_derived_from_a_task_stays_what_it_is():
    config = SafetyGymConfig(**TASKS["goal0"] | ROBOTS["point"])
    env = Generous(config, "c", "point_goal0")
    envs.register("generous", env)
    assert envs.make("generous") is env
    given, entries = choose_env(env)
    assert given["env"] == "point_goal0" and entries["point_goal0"].make() is env
    given, entries = choose_env(envs.make("point_goal0", engine="c"))
    assert not entries


def test_a_task_in_wrappers_that_no_option_makes_is_taken_as_it_is():
    env = ActionScale(envs.make("point_goal0", engine="c"), (-1.0, -1.0), (1.0, 0.5))
    assert wrap_config_of(env) is None
    _, entries = choose_env(env)
    assert entries["point_goal0"].make() is env


def test_an_id_that_is_registered_anew_implies_nothing():
    envs.register("SafetyAntVelocity-v0", Corridor)
    assert made("SafetyAntVelocity-v0", half_width=0.3).half_width == 0.3


def test_a_layout_without_room_is_refused_though_nothing_is_overridden():
    envs.register(
        "full", TASKS["goal1"] | ROBOTS["point"] | {"hazards_num": 90, "hazards_keepout": 0.5}
    )
    with pytest.raises(ConfigError, match="do not fit into the area"):
        envs.make("full")


def made(name: str, **options: Any) -> Any:
    return envs.make(name, **options)


def test_an_object_or_what_makes_one_is_registered_too():
    envs.register("hall", Corridor(half_width=0.2))
    assert made("hall").half_width == 0.2 and list(envs.env_defaults("hall")) == ["wrap"]
    envs.register("halls", Corridor)
    assert envs.env_defaults("halls")["half_width"] == 0.5
    assert made("halls", half_width=1).half_width == 1.0

    def clock(life: int = 3, label=object()):  # noqa: B008
        return Ticker(lives=(life, life))

    envs.register("clock", clock)
    assert envs.env_defaults("clock")["life"] == 3 and len(envs.env_defaults("clock")) == 2
    assert made("clock", life=2.0).lives == (2, 2)
    with pytest.raises(ConfigError, match=r"unknown option env.lif; did you mean 'life'"):
        envs.make("clock", lif=2)
    with pytest.raises(ConfigError, match=r"env.life='long': expected a whole number"):
        envs.make("clock", life="long")
    envs.register("bare", lambda life: clock(life))
    with pytest.raises(ConfigError, match="bare: argument 'life' has no default"):
        envs.env_defaults("bare")


@dataclasses.dataclass(frozen=True)
class Odd(Corridor):
    """A corridor with one thing wrong: fields of its states replaced."""

    fault: str = ""

    def reset(self, key):
        state = super().reset(key)
        return {"obs": state.obs} if self.fault == "dict" else self.spoilt(state)

    def step(self, state, action):
        new = super().step(dataclasses.replace(state, info={}), action)
        return (
            dataclasses.replace(new, physics=jnp.int32(0)) if self.fault == "step" else self.spoilt(new)
        )

    def spoilt(self, state):
        changes = {
            "obs": {"obs": state.obs[:3]},
            "cost": {"cost": state.cost[None]},
            "costs": {"costs": jnp.zeros(2)},
            "terminated": {"terminated": jnp.float32(0)},
            "info": {"info": {"laps": 3}},
        }
        return dataclasses.replace(state, **changes.get(self.fault, {}))


FAULTS = {
    "obs": r"odd.reset: obs is float32\[3\], expected float32\[4\]",
    "cost": r"odd.reset: cost is float32\[1\], expected float32\[\]",
    "costs": r"odd.reset: costs is float32\[2\], expected float32\[1\]",
    "terminated": r"odd.reset: terminated is float32\[\], expected bool\[\]",
    "info": r"odd.reset: info\['laps'\] is int32\[\], expected float32\[\]",
    "dict": "odd.reset gives a dict, expected jaxsafe.types.State",
    "step": r"odd: state.physics is float32\[4\] after reset but int32\[\] after step",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_state_that_does_not_fit_is_one_line(fault):
    with pytest.raises(ConfigError, match=FAULTS[fault]):
        check_env(Odd(fault=fault), "odd")


def test_a_member_that_is_missing_or_odd_is_one_line():
    with pytest.raises(
        ConfigError, match=r"odd \(SimpleNamespace\) is no Env .*: it lacks obs_size, action_size"
    ):
        check_env(SimpleNamespace(reset=1, step=1), "odd")
    with pytest.raises(ConfigError, match=r"odd: episode_length is inf, expected a whole number"):
        check_env(Corridor(episode_length=float("inf")), "odd")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="cost_names is 'wall', expected a tuple"):
        check_env(Corridor(cost_names="wall"), "odd")  # type: ignore[arg-type]
    assert check_env(Ticker(), "clock") == Ticker()


class Dark(Corridor):
    """Shows nothing."""

    def _state(self, x):
        return dataclasses.replace(super()._state(x), obs=self.shown())

    def shown(self) -> Any:
        return jnp.zeros(0)


class Pictured(Dark):
    """Shows a picture alone."""

    def shown(self) -> Any:
        return {"vector": jnp.zeros(0), "vision": jnp.zeros((8, 8, 3), jnp.uint8)}


def test_an_observation_is_something_if_only_a_picture():
    with pytest.raises(ConfigError, match="odd: obs_size is 0 and there is no picture"):
        check_env(Dark(obs_size=0), "odd")
    with pytest.raises(ConfigError, match="obs_size is -1, expected a whole number from 0 on"):
        check_env(Dark(obs_size=-1), "odd")
    assert check_env(Pictured(obs_size=0), "seen").obs_size == 0


@pytest.mark.parametrize(
    "end, found",
    [
        (lambda obs: obs[..., 0], "float32[2, 3]"),
        (lambda obs: obs[..., :1] > 2, "bool[2, 3, 1]"),
        (lambda obs: obs[0] > 2, "bool[3, 4]"),
        (lambda obs: obs @ jnp.ones((5, 1)) > 2, "no function of it"),
    ],
)
def test_what_an_observation_tells_is_checked_too(end, found):
    class Telling(Corridor):
        observed_end = staticmethod(end)

    with pytest.raises(ConfigError) as refused:
        check_env(Telling(), "odd")
    assert f"odd: observed_end of float32[2, 3, 4] is {found}" in str(refused.value)
    assert "expected bool[2, 3]" in str(refused.value)


# On the command line -------------------------------------------------------------------------

MINE = """
from pathlib import Path
from toys import Corridor
from jaxsafe.algos import ALGOS
from jaxsafe.envs.safety_gym.suite import ROBOTS, TASKS

Path("imported").touch()
maze1 = TASKS["goal1"] | ROBOTS["point"]
priced = ALGOS["ppo_penalty"]
number = 3
"""
SMALL = (
    "num_envs=4", "algo.horizon=16", "algo.minibatches=2", "algo.epochs=2",
    "algo.critic_epochs=2", "algo.hidden=[8,8]", "eval_episodes=2",
)  # fmt: skip


@pytest.fixture
def call(tmp_path, monkeypatch, capsys):
    """call('train', *arguments) -> exit status, stdout, stderr; in a folder with mine.py."""
    (tmp_path / "mine.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)

    def call(script: str, *args: str) -> tuple[int | str | None, str, str]:
        return shell.typed(script, *args), *capsys.readouterr()

    return call


def forget():
    """As in a new process."""
    del envs.ENVS["mine:Corridor"], algos.ALGOS["mine:priced"], sys.modules["mine"]


def test_a_run_on_ones_own_code_trains_resumes_and_evaluates_once_that_is_named(call, tmp_path):
    code = ("env=mine:Corridor", "algo=mine:priced")
    options = ("env.half_width=0.3", "algo.clip=0.3", *SMALL, "total_steps=128", "run_dir=run")
    status, out, err = call("train", *code, *options)
    assert status == 0, err
    assert "mine:Corridor | mine:priced" in out and "engine" not in out
    undrawn = "only Safety Gym's environments, velocity and racing tasks can be drawn"
    assert f"no video: {undrawn}, not a Corridor" in out
    config = (tmp_path / "run" / "config.yaml").read_text()
    assert "name: mine:Corridor\n  half_width: 0.3\n" in config and "name: mine:priced\n" in config
    forget()
    (tmp_path / "imported").unlink()
    for line in (("evaluate", "run"), ("render", "run"), ("train", "resume=run", "total_steps=256")):
        status, out, err = call(*line)
        assert status == 2 and "mine:Corridor is code" in err and "add env=mine:Corridor" in err
        assert err.count("\n") == 1 and not (tmp_path / "imported").exists()
    for line in (("evaluate", "run", code[0]), ("train", "resume=run", code[0])):
        status, _, err = call(*line)
        assert status == 2 and "mine:priced is code" in err and "add algo=mine:priced" in err
    status, _, err = call("evaluate", "run", "env=mine:maze1")
    assert status == 2 and "run was trained with env=mine:Corridor" in err
    status, out, err = call("evaluate", "run", *code)
    assert status == 0 and "violation rate" in out, err
    status, _, err = call("render", "run", *code)
    assert status == 2 and undrawn in err
    forget()
    status, out, err = call("train", "resume=run", *code, "total_steps=256")
    assert status == 0 and "resuming at 128 steps" in out, err


def test_runs_on_ones_own_code_are_plotted_once_that_is_named(call, tmp_path):
    code = ("env=mine:Corridor", "algo=mine:priced")
    status, _, err = call("train", *code, *SMALL, "total_steps=128", "video=false", "run_dir=run")
    assert status == 0, err
    forget()
    for given, missing in ((), code[0]), (code[:1], code[1]):
        status, _, err = call("plot", "run", *given)
        _, name = missing.split("=")
        assert status == 2 and err.startswith(f"error: run: {name} is code, which is not imported")
        assert err.endswith(f"if you trust it, add {missing}\n") and err.count("\n") == 1
    status, out, err = call("plot", "run", *code)
    assert status == 0 and "`mine:priced`" in out, err
    assert (tmp_path / "comparison" / "trade_off.png").exists()
    status, _, err = call("plot", *code)
    assert status == 2 and "expected run folders" in err


BAD = {
    "mine:Coridor": "mine has no 'Coridor'; did you mean 'Corridor'?",
    "mime:Corridor": "no module 'mime' in",
    "mine:": "expected module:name",
    "mine:number": "mine:number (int) is no Env",
    "mine:maze1 env.hazard_num=3": "did you mean 'hazards_num'?",
    "mine:Corridor env.half_width=wide": "env.half_width='wide': expected a number",
}


@pytest.mark.parametrize("arguments", BAD)
def test_what_is_no_environment_is_one_line(arguments, call):
    status, _, err = call("train", *f"env={arguments}".split())
    assert status == 2 and err.count("\n") == 1 and BAD[arguments] in err


@pytest.mark.parametrize(
    "name, message",
    [
        ("mine:prised", "mine has no 'prised'; did you mean 'priced'?"),
        ("mime:priced", "no module 'mime' in"),
        ("mine:", "expected module:name"),
        ("mine:number", "algo=mine:number"),
    ],
)
def test_what_is_no_algorithm_is_one_line(name, message, call):
    status, _, err = call("train", f"algo={name}")
    assert status == 2 and err.count("\n") == 1 and message in err


def test_a_fault_inside_the_module_is_its_own(call, tmp_path):
    (tmp_path / "mine.py").write_text("import nothing_like_this")
    with pytest.raises(ModuleNotFoundError, match="nothing_like_this"):
        call("train", "env=mine:maze1")


def test_the_folder_of_its_runs_has_a_name_for_every_system(call):
    settings = compose(["env=mine:maze1", "algo=cpo"])
    assert settings.env_name == "mine:maze1" and settings.label == "mine.maze1-cpo"
