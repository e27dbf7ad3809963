"""Settings that cannot mean anything are refused in one line, wherever they come from."""

import dataclasses
import math
import random
import time
import typing
from typing import Annotated, Any

import numpy as np
import pytest
from shell import typed
from toys import Corridor

import jaxsafe
from jaxsafe import algos, envs
from jaxsafe.config import (
    Amount,
    Bounds,
    ConfigError,
    Share,
    check_values,
    convert,
    flat,
    from_dict,
    shown,
)
from jaxsafe.envs.wrap import WrapConfig
from jaxsafe.learn.conventions import conventions
from jaxsafe.run.arguments import compose, read_values
from jaxsafe.run.hydra_jobs import check_arguments
from jaxsafe.run.plain import as_text
from jaxsafe.run.settings import (
    Settings,
    TrainConfig,
    defaults_of,
    nested,
    settings_from_config,
    settings_from_options,
)
from jaxsafe.run.sweep_plan import plan

CONFIGS = {name: row.config for name, row in algos.ALGOS.items()}
CONFIGS |= {
    cls.__name__: cls
    for cls in (TrainConfig, envs.SafetyGymConfig, envs.VelocityConfig, envs.CarRacing, WrapConfig)
}
INFINITE = {  # fields whose comment or bounds say what infinity means
    "total_iterations", "lam_max", "price_max", "max_grad_norm", "target_kl", "healthy_z_range",
    "healthy_angle_range", "healthy_state_range",
}  # fmt: skip


def bare(kind: Any) -> bool:
    """Whether the annotation holds an int or a float without bounds."""
    if typing.get_origin(kind) in (Annotated, typing.Literal):
        return False
    return kind in (int, float) or any(bare(part) for part in typing.get_args(kind))


@pytest.mark.parametrize("name", CONFIGS)
def test_every_number_of_a_config_has_bounds(name):
    hints = typing.get_type_hints(CONFIGS[name], include_extras=True)
    fields = [f.name for f in dataclasses.fields(CONFIGS[name])]
    assert [field for field in fields if bare(hints[field])] == []


@pytest.mark.parametrize("name", CONFIGS)
def test_an_unknown_word_is_refused_from_python_too(name):
    needed = {"robot": "ant"} if CONFIGS[name] is envs.VelocityConfig else {}
    for field, kind in typing.get_type_hints(CONFIGS[name]).items():
        if typing.get_origin(kind) is typing.Literal:
            with pytest.raises(ConfigError, match=f"{field}='golf'"):
                check_values(CONFIGS[name](**needed | {field: "golf"}))


@pytest.mark.parametrize(
    "kind, found",
    [(int, True), (float | None, True), (tuple[Amount, int], True), (dict[str, float], True),
     (Amount, False), (tuple[Share, ...] | None, False), (typing.Literal[2, 3], False), (str, False)],
)  # fmt: skip
def test_a_number_without_bounds_is_found_wherever_it_stands(kind, found):
    assert bare(kind) is found


@pytest.mark.parametrize("name", sorted(algos.ALGOS))
def test_defaults_and_published_settings_are_within_their_bounds(name):
    row = algos.ALGOS[name]
    own = [dict(c.options) for c in conventions(row.config)]
    for options in ({}, row.lever, *row.published.values(), *own):
        values = dataclasses.asdict(row.config(**dict(options)))
        assert dataclasses.asdict(from_dict(row.config, values)) == values


def test_the_options_of_every_task_are_within_their_bounds():
    for name in envs.ENVS:
        envs.check_options(name)


# ---- one check ---------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [3, 3.0, np.int64(3), np.float32(3), np.uint8(3)])
def test_any_whole_number_is_a_whole_number(value):
    found = convert(value, Amount, "n")
    assert found == 3 and type(found) is int


@pytest.mark.parametrize(
    "value",
    [0, -1, 2.5, math.nan, math.inf, -math.inf, 10**400, -(10**5000), 1e300, True, "3", [3], {}],
    ids=shown,
)
def test_what_is_no_such_number_is_refused_in_a_short_line(value):
    says = r"^n=.*: expected a whole number between 1 and 16777216$"
    with pytest.raises(ConfigError, match=says) as e:
        convert(value, Amount, "n")
    assert len(str(e.value)) < 200


def test_infinity_is_taken_only_where_it_means_something():
    kind = Annotated[float, Bounds(0, 1, inf="no bound")]
    assert convert(math.inf, kind, "x") == math.inf
    for value in (-math.inf, math.nan, 2.0):
        with pytest.raises(ConfigError, match=r"between 0 and 1, or inf \(no bound\)"):
            convert(value, kind, "x")
    with pytest.raises(ConfigError, match="x=inf: expected a number"):
        convert(math.inf, float, "x")


def test_numbers_inside_lists_names_and_what_may_be_null_have_their_bounds():
    assert convert([0, 1], tuple[Share, ...], "x") == (0.0, 1.0)
    with pytest.raises(ConfigError, match="x='a': expected a list, of which each is a string"):
        convert("a", tuple[str, ...], "x")
    for value, kind, says in (
        ([0, 2], tuple[Share, ...], r"x\[1\]=2: expected a number between 0 and 1"),
        ({"a": -1}, dict[str, Share] | None, r"x\.a=-1: expected a number between 0 and 1"),
        (7, Share | None, r"x=7: expected a number between 0 and 1"),  # type: ignore[operator]
    ):
        with pytest.raises(ConfigError, match=says):
            convert(value, kind, "x")


def test_the_same_line_comes_from_the_command_line_python_and_a_file():
    says = r"^algo\.lr=inf: expected a number between 0 and 10$"
    saved = settings_from_options({}).plain()
    saved["algo"]["lr"] = math.inf
    for given in (
        lambda: compose(["algo.lr=inf"]),
        lambda: settings_from_options({"algo": {"lr": math.inf}}),
        lambda: settings_from_config(saved),
    ):
        with pytest.raises(ConfigError, match=says):
            given()


@pytest.mark.parametrize(
    "argument", ["algo.lr=nan", "env.hazards_num=1e6", "num_envs=10 algo.num_envs=20", "run_dir=''"]
)
def test_a_printed_config_is_checked_too(argument, capsys):
    assert typed("train", "--cfg", "job", *argument.split()) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("error: ") and err.count("\n") == 1


# ---- contradictions and sizes ------------------------------------------------------------------


def test_two_values_of_one_number_are_refused():
    says = "num_envs=10 and algo.num_envs=512: they are one number"
    texts = ["num_envs=10", "algo.num_envs=512"]  # though 512 is the default
    for given in (compose, check_arguments):
        with pytest.raises(ConfigError, match=says):
            given(texts)
    with pytest.raises(ConfigError, match=says):
        settings_from_options({"num_envs": 10, "algo": {"num_envs": 512}})
    saved = settings_from_options({"num_envs": 10}).plain()
    assert settings_from_config(saved).algo.num_envs == 10
    saved["algo"]["num_envs"] = 20
    with pytest.raises(ConfigError, match=r"num_envs=10 and algo\.num_envs=20"):
        settings_from_config(saved)
    assert settings_from_options({"num_envs": 10, "algo": {"num_envs": 10}}).algo.num_envs == 10


HUGE = {
    "seed=range(1,1e9)": "999,999,999 settings: expected at most 10,000",
    "seed=range(1,200) algo.lr=range(0,1,0.01)": "19,900 settings",
    "seed=range(1,5,0)": "step not 0",
    "seed=range(1,nan)": "finite numbers",
    "seed=range(5,1)": "holds no value",
    "num_envs=1e12,1e11": "expected a whole number between 1 and 16777216",
    "algo.num_envs=16000000 algo.horizon=16000000,8": "x horizon=16000000: expected at most",
}


@pytest.mark.parametrize("texts", HUGE)
def test_a_sweep_is_judged_before_its_settings_are_listed(texts):
    begun = time.monotonic()
    with pytest.raises(ConfigError, match=HUGE[texts]):
        given = read_values(["env=toys:Corridor", *texts.split()])
        plan(given.options, given.several)
    assert time.monotonic() - begun < 10


@pytest.mark.parametrize("value", [5, None, ["point_goal1"], 1.5])
def test_an_environment_that_is_no_name_is_refused(value):
    with pytest.raises(ConfigError, match=r"^env=.*: expected a name"):
        jaxsafe.make(value)


def test_numpys_numbers_are_options_of_an_environment():
    env = jaxsafe.make("point_goal1", engine="c", lidar_num_bins=np.int64(7), goal_size=np.float64(0.3))
    assert env.config.lidar_num_bins == 7


# ---- the other commands ------------------------------------------------------------------------

WRONG = {
    "evaluate RUN --seed 1e20": "--seed: 1e20: expected a whole number between 0 and 2147483647",
    "evaluate RUN --episodes 0": "--episodes: 0: expected a whole number between 1 and",
    "evaluate RUN --episodes many": "--episodes: many: expected a whole number",
    "render RUN --index -1": "expected a whole number between 0 and",
    "render RUN --seed nan": "--seed: nan: expected a whole number",
    "watch env=car_goal1 --port 0": "--port: 0: expected a whole number between 1 and 65535",
    "study goal --minutes nan": "--minutes: nan: expected a number between 0 and",
    "study goal --at-once 0": "--at-once: 0: expected a whole number between 1 and",
}


@pytest.mark.parametrize("line", WRONG)
def test_a_wrong_number_of_another_command_is_one_line(line, capsys):
    command, *args = line.split()
    assert typed(command, *args) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ") and err.count("\n") == 1 and WRONG[line] in err


def test_where_a_film_goes_is_looked_at_before_any_run_is_opened(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    for out, says in (
        ("file/x.mp4", "is not a folder"),
        (".", "ends in .mp4"),
        ("folder.mp4", "cannot"),
        ("new/x.mp4", "no config.yaml"),
    ):
        (tmp_path / "folder.mp4").mkdir(exist_ok=True)
        assert typed("render", str(tmp_path), "--out", str(tmp_path / out)) == 2
        assert says in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


# ---- mutations ---------------------------------------------------------------------------------

ODD = [
    math.nan, math.inf, -math.inf, 0, -1, -5, 0.5, 1.5, 1e-320, 1e9, 1e12, 1e18, 1e30, 1e300, 2**31,
    2**63, 10**400, True, None, "", "wide", "[", [], [0], [1, 2], [math.nan], [[0, 0, 1, math.inf]], {},
    {"a": -1},
]  # fmt: skip
PLACES = ("resume", "init_from", "dataset")  # looked at on the disk


def mutated(rng: random.Random) -> tuple[dict[str, Any], dict[str, Any]]:
    """An environment and an algorithm, and one or two of their options with odd values."""
    names = {"env": rng.choice(sorted(envs.ENVS)), "algo": rng.choice(sorted(algos.ALGOS))}
    known = flat(defaults_of({}, names))
    options = [n for n in known if not n.endswith(".name") and n not in PLACES]
    changed = {}
    for name in rng.sample(options, rng.randint(1, 2)):
        old = known[name]
        near = [old * 2, old // 2, old + 1, 1 - old] if type(old) in (int, float) else [old]
        changed[name] = rng.choice([rng.choice(ODD), *near])
    return names, changed


def settled(names: dict[str, Any], changed: dict[str, Any], way: str) -> Settings:
    """Through one of the three doors."""
    if way == "python":
        return settings_from_options(nested({**names, **changed}))
    if way == "command line":
        return compose([f"{name}={as_text(value)}" for name, value in {**names, **changed}.items()])
    saved = settings_from_options(nested(names)).plain()
    for name, value in changed.items():
        *path, last = name.split(".")
        inside = saved
        for part in path:
            inside = inside[part]
        inside[last] = value
    return settings_from_config(saved)


def assert_means_something(found: Settings) -> None:
    """What every accepted setting has, without a look at the bounds that let it in."""
    for cfg in found.configs:
        check_meaning({**flat(found.plain()), **flat({"algo": dataclasses.asdict(cfg)})})


def check_meaning(plain: dict[str, Any]) -> None:
    for name, value in plain.items():
        field = name.rpartition(".")[2]
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, bool) or not isinstance(number, int | float):
                continue
            assert not math.isnan(number), name
            assert math.isfinite(number) or field in INFINITE, name
            if math.isfinite(number):
                assert abs(np.float32(number)) < np.inf and abs(number) <= 1e15, name
    for part in (
        "num_envs",
        "horizon",
        "minibatches",
        "epochs",
        "cg_iterations",
        "updates",
    ):
        assert plain.get(f"algo.{part}", 1) >= 1, part
    assert plain.get("algo.batch_size") is None or plain["algo.batch_size"] >= 1
    for part in ("discount", "cost_discount", "gae_lambda", "pid_smoothing", "simmer_smoothing", "tau"):
        assert 0 <= plain.get(f"algo.{part}", 0) <= 1, part
    for part in (
        "lr",
        "critic_lr",
        "dual_lr",
        "cost_limit",
        "target_kl",
        "damping",
        "max_grad_norm",
        "barrier",
    ):
        assert plain.get(f"algo.{part}", 0) >= 0, part
    assert plain.get("algo.clip", 1) > 0 and plain.get("algo.temperature", 1) > 0
    assert 0 < plain.get("algo.line_search_shrink", 0.5) < 1
    for part in ("hidden", "model_hidden", "vae_hidden"):
        assert all(units >= 1 for units in plain.get(f"algo.{part}", ())), part
    assert plain["num_seeds"] >= 1 and plain["seed"] >= 0 and plain["total_steps"] >= 1
    assert plain["num_envs"] in (None, plain.get("algo.num_envs"))
    for name, value in plain.items():
        if name.startswith("env.") and isinstance(value, int | float):
            assert value > 0 or not name.endswith(("_size", "_density", "_height", "num_steps")), name
            assert value >= 0 or not name.endswith(("_num", "_keepout", "_cost", "_seed")), name


def try_mutations(seeds: range) -> None:
    taken = 0
    for seed in seeds:
        rng = random.Random(seed)
        names, changed = mutated(rng)
        way = rng.choice(["python", "command line", "file"])
        case = f"seed {seed}, {way}: {names} { {k: shown(v) for k, v in changed.items()} }"
        begun = time.process_time()
        try:
            found = settled(names, changed, way)
            assert_means_something(found)
            found.row.make(Corridor(), None).clocks(found.algo)  # sizes that do not fit each other
            taken += 1
        except ConfigError as error:
            line = str(error)
            assert line and "\n" not in line and len(line) < 2000, case
        except Exception as error:
            raise AssertionError(case) from error
        assert time.process_time() - begun < 10, case
    assert len(seeds) / 10 < taken < len(seeds), "all or nothing was refused"


def test_300_mutated_settings_are_refused_in_a_line_or_mean_something():
    try_mutations(range(300))


@pytest.mark.nightly
def test_2000_mutated_settings_are_refused_in_a_line_or_mean_something():
    try_mutations(range(1000, 3000))
