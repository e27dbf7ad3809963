"""Run folders from strangers: whatever lies in them, nothing outside is read, written or executed.

Each case takes a copy of a sound run, plants something in it, and gives the copy to a command. The
command may refuse it in one line or go on without what was planted.
"""

import io
import json
import lzma
import os
import pickle
import shutil
import socket
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
import yaml
from shell import STEPS, TOY, typed

from jaxsafe.report import film, study_files
from jaxsafe.run import checkpoint, files, run_folder, settings

SECRET = "a-password-of-the-user"
LONGER = (TOY, f"total_steps={41 * STEPS}", "eval_episodes=1")
ALIASES = "a0: &a0 [x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 8)}]\n" for i in range(1, 20)
)
BIG = 10**12


class Place(NamedTuple):
    """A copy of a run, and a folder of the user's that nothing may touch."""

    run: Path
    outside: Path


Plant = Callable[[Place], Any]


def to_outside(name: str, target: str = "precious") -> Plant:
    """A link in place of a file or folder of the run."""

    def plant(place: Place) -> None:
        path = place.run / name
        path.parent.mkdir(exist_ok=True, parents=True)
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        path.symlink_to(place.outside / target)

    return plant


def holds(name: str, content: str | bytes) -> Plant:
    return lambda place: (place.run / name).write_bytes(
        content.encode() if isinstance(content, str) else content
    )


def says(**new: Any) -> Plant:
    """Settings in config.yaml. A double underscore leads into a group."""

    def plant(place: Place) -> None:
        path = place.run / "config.yaml"
        config = yaml.safe_load(path.read_text())
        for name, value in new.items():
            group, _, inside = name.rpartition("__")
            (config[group] if group else config)[inside] = value
        path.write_text(yaml.safe_dump(config))

    return plant


def pipe(name: str) -> Plant:
    def plant(place: Place) -> None:
        (place.run / name).unlink(missing_ok=True)
        os.mkfifo(place.run / name)

    return plant


def newest(place: Place, kind: str = "policy") -> Path:
    return checkpoint.checkpoints(place.run / kind)[0]


def claims(**changes: Any) -> Plant:
    """The newest manifests say something else."""

    def plant(place: Place) -> None:
        for kind in ("policy", "checkpoints"):
            for path in (place.run / kind).glob("*/manifest.json"):
                raw = json.loads(path.read_text())
                for name, value in changes.items():
                    raw[name] = value(raw[name]) if callable(value) else value
                path.write_text(json.dumps(raw))

    return plant


def every_leaf(change: Callable[[str, list[int]], list[Any]]) -> Callable[[dict], dict]:
    return lambda leaves: {name: change(*leaf) for name, leaf in leaves.items()}


def both(*plants: Plant) -> Plant:
    def plant(place: Place) -> None:
        for one in plants:
            one(place)

    return plant


def in_policies(change: Callable[[Path], Any]) -> Plant:
    """Something done in every state/ of a policy."""
    return lambda place: [change(path) for path in (place.run / "policy").glob("*/state")]


def endless(state: Path) -> None:
    with max((p for p in state.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size).open(
        "r+b"
    ) as file:
        file.truncate(BIG)


def larger_arrays_than_the_manifest_says(place: Place) -> None:
    for path in list((place.run / "policy").iterdir()):
        raw = json.loads((path / "manifest.json").read_text())
        arrays = {k: np.zeros([*shape, 7], dtype) for k, (dtype, shape) in raw["leaves"].items()}
        shutil.rmtree(path)
        checkpoint.save(place.run / "policy", arrays, run_folder.Progress(int(path.name), 1, 1))
        forged = json.loads((path / "manifest.json").read_text())
        (path / "manifest.json").write_text(json.dumps(forged | {"leaves": raw["leaves"]}))


def packed_metrics(text: bytes) -> Plant:
    def plant(place: Place) -> None:
        (place.run / "metrics.csv").unlink()
        (place.run / "metrics.csv.xz").write_bytes(lzma.compress(text))

    return plant


def unlearned(place: Place) -> None:
    shutil.rmtree(place.run / "checkpoints")
    shutil.rmtree(place.run / "policy")


def unbound_socket(place: Place) -> None:
    path = place.run / "evaluation.json"
    path.unlink()
    here = os.getcwd()
    os.chdir(place.run)  # names of sockets are short
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(path.name)
    os.chdir(here)


# what is planted -> what the command says
REFUSED_BY_ALL: dict[str, tuple[Plant, str]] = {
    "a link as config": (to_outside("config.yaml"), "is a link"),
    "a pipe as config": (pipe("config.yaml"), "is a pipe"),
    "a folder as config": (
        lambda place: ((place.run / "config.yaml").unlink(), (place.run / "config.yaml").mkdir()),
        "is a folder",
    ),
    "a long config": (holds("config.yaml", "# " + "x" * 300_000), "expected at most"),
    "an endless config": (lambda place: os.truncate(place.run / "config.yaml", BIG), "at most"),
    "aliases of aliases": (holds("config.yaml", ALIASES), "holds an alias"),
    "lists in lists": (holds("config.yaml", "[" * 100_000), "in each other"),
    "dicts in dicts": (holds("config.yaml", "{a: " * 50_000), "in each other"),
    "a tag": (
        holds("config.yaml", "!!python/object/apply:os.system ['touch owned']"),
        "cannot be read",
    ),
    "bytes": (holds("config.yaml", b"\xff\xfe\x00"), "cannot be read"),
    "a long number": (holds("config.yaml", f"seed: !!int {'9' * 5000}"), "cannot be read"),
    "no date": (holds("config.yaml", "seed: 2020-13-45"), "cannot be read"),
    "a date": (says(seed=__import__("datetime").date(2026, 1, 1)), "holds a date"),
    "a number as name": (holds("config.yaml", "1: 2"), "holds the name 1"),
    "a coordinator": (says(coordinator="127.0.0.1:1"), "sets coordinator"),
    "processes": (says(num_processes=2), "sets num_processes"),
    "a process": (says(process_index=0), "sets process_index"),
    "another default": (says(defaults=[{"override hydra/launcher": "x"}]), "unknown option defaults"),
    "options of Hydra": (says(hydra={"run": {"dir": "/tmp"}}), "unknown option hydra"),
    "a target": (says(_target_="os.system"), "unknown option _target_"),
    "an interpolated number": (says(seed="${oc.env:SECRET}"), "expected a whole number"),
    "an interpolated float": (says(algo__lr="${oc.env:SECRET}"), "expected a number"),
    "an interpolated name": (says(env__name="${oc.env:SECRET}"), "not imported"),
    "code as environment": (says(env__name="evil:env"), "not imported"),
    "code as algorithm": (says(algo__name="evil:row"), "not imported"),
    "many seeds": (says(num_seeds=10**9), "num_seeds="),
    "many settings": (says(algo__clip=[1.0] * 30_000), "occurs twice"),
    "no layer": (says(algo__hidden="wide"), "expected"),
    "an option of dicts": (says(algo__lr={"a": {"b": 1}}), "expected a number"),
}
REFUSED: dict[str, tuple[Plant, str, str]] = {  # ... by what
    "a path as robot": (
        lambda place: says(
            env={"name": "point_goal0", "robot_base": str(place.outside / "robot.xml")}
        )(place),
        "env.robot_base", "evaluate",
    ),
    "a path among our robots": (
        says(env={"name": "point_goal0", "robot_base": "xmls/../../../pyproject.toml"}),
        "env.robot_base", "evaluate",
    ),
    "a data set to resume": (says(dataset="/etc/passwd"), "names dataset=", "resume"),
    "a policy to begin with": (
        both(says(init_from="/etc"), unlearned), "names init_from=", "resume",
    ),
    "many environments": (says(algo__num_envs=BIG, num_envs=BIG), "expected a whole number", "resume"),
    "wide layers": (says(algo__hidden=[10**9]), "expected a whole number", "resume"),
    "wide layers of a policy": (says(algo__hidden=[10**9]), "expected a whole number", "evaluate"),
    "names of limits that lead away": (
        says(algo__cost_limits={"../../../x": 1.0}), "x", "resume",
    ),
    "a link as policies": (to_outside("policy", "."), "is a link", "evaluate"),
    "a link as checkpoints": (to_outside("checkpoints", "."), "is a link", "resume"),
    "a link as a policy to begin with": (to_outside("policy", "."), "is a link", "init_from"),
    "a link as checkpoint": (to_outside("policy/00000099", "."), "is a link", "evaluate"),
    "a link as metrics": (to_outside("metrics.csv"), "is a link", "plot"),
    "a link as packed metrics": (
        both(to_outside("metrics.csv.xz"), lambda place: (place.run / "metrics.csv").unlink()),
        "is a link", "plot",
    ),
    "a link as metrics to go on with": (to_outside("metrics.csv"), "is a link", "resume"),
    "a pipe as metrics": (pipe("metrics.csv"), "is a pipe", "plot"),
    "metrics that unpack without end": (packed_metrics(b"0" * 40_000_000), "unpacks to", "plot"),
    "a long first line": (holds("metrics.csv", "," * 10_000_000), "begins with a line", "plot"),
    "metrics without seeds": (holds("metrics.csv", "iteration,steps\n1,2\n"), "no column seed", "plot"),
    "metrics of text": (holds("metrics.csv", "iteration,steps,seed\n1,2,x"), "cannot be read", "plot"),
    "a link as evaluation": (to_outside("evaluation.json"), "is a link", "plot"),
    "a socket as evaluation": (unbound_socket, "is a socket", "plot"),
    "lists in lists as evaluation": (
        holds("evaluation.json", '{"seeds": ' + "[" * 10_000), "cannot be read", "plot",
    ),
    "tables as evaluation": (
        holds("evaluation.json", '{"seeds": {"return": [[1, 2]]}}'), "one a seed", "plot",
    ),
    "a link as the list of lost seeds": (to_outside("diverged.json"), "is a link", "plot"),
    "numbers as the list of lost seeds": (holds("diverged.json", "[1]"), "cannot be read", "plot"),
    "a large number as evaluation": (
        holds("evaluation.json", '{"seeds": {"return": [1' + "0" * 400 + "]}}"),
        "cannot be read", "plot",
    ),
}  # fmt: skip
CORRUPT: dict[str, tuple[Plant, str]] = {  # of policies; no policy is left
    "a link as manifest": (
        lambda place: [
            (path.unlink(), path.symlink_to(place.outside / "precious"))
            for path in (place.run / "policy").glob("*/manifest.json")
        ],
        "is a link",
    ),
    "a large shape": (claims(leaves=every_leaf(lambda dtype, shape: [dtype, [BIG, BIG]])), "bytes"),
    "shapes that are none": (claims(leaves=every_leaf(lambda dtype, shape: [dtype, [-1]])), "numbers"),
    "objects": (claims(leaves=every_leaf(lambda dtype, shape: ["object", shape])), "expected numbers"),
    "another type": (claims(leaves=every_leaf(lambda dtype, shape: ["int64", shape])), "in state/"),
    "a name that leads away": (
        claims(leaves=lambda leaves: {f"../../{k}": v for k, v in leaves.items()}), "expected numbers",
    ),
    "a negative iteration": (claims(iteration=-5), "at least 0"),
    "no numbers": (claims(steps="many"), "cannot be read"),
    "lists in lists as manifest": (claims(files=json.loads("[" * 50 + "]" * 50)), "in each other"),
    "a pickle beside": (
        in_policies(lambda state: (state / "x.pkl").write_bytes(pickle.dumps(print))), "unknown file",
    ),
    "a link inside": (in_policies(lambda state: (state / "x").symlink_to("/etc/passwd")), "is a link"),
    "a pipe inside": (in_policies(lambda state: os.mkfifo(state / "x")), "is a pipe"),
    "an endless file": (in_policies(endless), "its files have"),
    "larger arrays": (larger_arrays_than_the_manifest_says, "in state/"),
}  # fmt: skip
WRITTEN = {  # names that a command might write through
    "curves.png": "curves.png",
    "evaluation.json": "evaluation.json",
    "versions.json": "versions.json",
    "config.yaml.part": "config.yaml.part",
    "versions.json.part": "versions.json.part",
    "metrics.part": "metrics.part",
}


@pytest.fixture
def place(finished, tmp_path, monkeypatch) -> Place:
    settings.load("env", "toys:Corridor")  # by the user, that is
    run, outside = tmp_path / "run", tmp_path / "outside"
    shutil.copytree(finished, run)
    outside.mkdir()
    (outside / "precious").write_text("iteration,steps,seed\n")
    (outside / "robot.xml").write_text("<mujoco/>")
    (outside / "00000099").mkdir()
    (tmp_path / "evil.py").write_text("open('owned', 'w')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SECRET", SECRET)

    def refuse(*args: Any, **options: Any) -> None:
        raise AssertionError("a connection")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket.socket, "connect_ex", refuse)
    monkeypatch.setattr(jax.distributed, "initialize", refuse)
    return Place(run, outside)


def snapshot(folder: Path) -> dict[str, Any]:
    return {
        str(path): (path.lstat().st_mtime_ns, path.is_file() and path.read_bytes())
        for path in sorted([folder, *folder.rglob("*")])
    }


COMMANDS = {
    "evaluate": ("evaluate", "{run}", TOY, "--episodes", "1"),
    "evaluate point": ("evaluate", "{run}", "--episodes", "1"),
    "render": ("render", "{run}", TOY),
    "plot": ("plot", "{run}", "--out", "out"),
    "resume": ("train", "resume={run}", *LONGER),
    "init_from": (
        "train",
        "init_from={run}",
        "run_dir=new",
        *LONGER,
        "algo.hidden=[8,8]",
        "num_envs=4",
    ),
}


def give(place: Place, command: str, capsys: pytest.CaptureFixture) -> tuple[Any, str, str]:
    """Exit status, stdout and stderr of a command on the planted folder. It leaves the rest alone."""
    before, begun = snapshot(place.outside), time.monotonic()
    words = [word.format(run=place.run) for word in COMMANDS[command]]
    status = typed(*words)
    out, err = capsys.readouterr()
    assert snapshot(place.outside) == before
    assert not list(place.run.parent.glob("**/owned"))
    assert len(err.splitlines()) <= 1 + err.count("warning: ") + err.count(" runs by "), err
    assert "Traceback" not in out + err and SECRET not in out + err
    assert time.monotonic() - begun < 60
    return status, out, err


@pytest.mark.parametrize("command", ["evaluate", "plot", "resume", "init_from", "render"])
@pytest.mark.parametrize("case", REFUSED_BY_ALL)
def test_a_config_that_no_run_writes_is_refused_in_one_line(place, capsys, case, command):
    plant, expected = REFUSED_BY_ALL[case]
    plant(place)
    (status, _, err) = give(place, command, capsys)
    if case in ("code as environment", "an interpolated name") and command in ("evaluate", "render"):
        expected = "was trained with env="  # the user named the toy
    if (case, command) == ("a folder as config", "plot"):
        expected = "holds no run"
    assert (status, err.count("\n")) == (2, 1) and expected in err, err


@pytest.mark.parametrize("case", REFUSED)
def test_what_leads_outside_or_beyond_any_size_is_refused_in_one_line(place, capsys, case):
    plant, expected, command = REFUSED[case]
    plant(place)
    if command == "evaluate" and "point_goal0" in (place.run / "config.yaml").read_text():
        command = "evaluate point"
    status, _, err = give(place, command, capsys)
    assert status == 2 and expected in err, err


@pytest.mark.parametrize("case", CORRUPT)
def test_a_policy_that_is_not_what_it_says_is_not_read(place, capsys, case):
    plant, expected = CORRUPT[case]
    plant(place)
    status, _, err = give(place, "evaluate", capsys)
    assert status in (1, 2) and expected in err, err


@pytest.mark.parametrize("command", ["resume", "init_from"])
def test_a_train_state_that_is_not_what_it_says_is_not_read(place, capsys, command):
    plant, _ = CORRUPT["a large shape"]
    plant(place)
    status, out, err = give(place, command, capsys)
    assert status in (1, 2) and "bytes" in out + err


def test_what_a_run_writes_takes_the_place_of_links(place, capsys):
    for name in WRITTEN:
        to_outside(name)(place)
    status, out, err = give(place, "resume", capsys)
    assert status == 0, out + err
    for name in ("curves.png", "evaluation.json", "versions.json"):
        assert (place.run / name).is_file() and not (place.run / name).is_symlink()


@pytest.mark.parametrize("name", ["tensorboard", "tensorboard/seed0"])
def test_a_link_as_folder_of_tensorboard_is_refused(place, capsys, name):
    to_outside(name, ".")(place)
    status, _, err = give(place, "resume", capsys)
    assert status == 2 and "is a link" in err


def test_a_link_where_a_checkpoint_is_written_ends_in_one_line(place, capsys):
    to_outside("checkpoints/00000041.part", ".")(place)
    status, _, err = give(place, "resume", capsys)
    assert status == 1 and "cannot write checkpoint" in err


def test_an_interpolation_stays_the_text_that_it_is(place, capsys):
    says(run_dir="\\${oc.env:SECRET}", init_from="${oc.env:SECRET}", video=False)(place)
    status, out, err = give(place, "resume", capsys)
    assert status == 0, out + err
    saved = run_folder.read_config(place.run)
    assert (saved["run_dir"], saved["init_from"]) == ("\\${oc.env:SECRET}", "${oc.env:SECRET}")
    assert SECRET not in (place.run / "config.yaml").read_text()


def test_a_data_set_that_the_user_names_himself_is_read(place, capsys):
    says(dataset="data.npz")(place)
    words = ("train", f"resume={place.run}", "dataset=data.npz", TOY, "eval_episodes=1")
    assert typed(*words) == 2 and "there is no such file" in capsys.readouterr().err


def test_what_a_file_says_tells_the_terminal_nothing(place, capsys):
    says(**{"\x1b[2J": 1})(place)
    _, _, err = give(place, "resume", capsys)
    assert "\x1b" not in err


def test_tables_and_figures_take_the_place_of_links(place, capsys):
    out = Path("out")
    out.mkdir()
    names = ["results.md", "results.tex", "results.csv", "curves.png", "curves.svg", "trade_off.png"]
    for name in names:
        (out / name).symlink_to(place.outside / "precious")
    status, _, err = give(place, "plot", capsys)
    assert status == 0, err
    assert not any((out / name).is_symlink() for name in names)


def test_dollars_in_a_name_are_no_mathematics(place, capsys):
    shutil.copytree(place.run, "other")
    says(init_from="$\\frac{$", seed=3)(place)
    table = (place.run / "metrics.csv").read_text().replace(",0,", ",3,")
    (place.run / "metrics.csv").write_text(table)
    COMMANDS["plot two"] = ("plot", "{run}", "other", "--out", "out")
    status, _, err = give(place, "plot two", capsys)
    assert status == 0, err


def test_a_film_takes_the_place_of_a_link(place, monkeypatch):
    to_outside("video.gif")(place)
    picture = [np.zeros((32, 32, 3), np.uint8)] * 3
    monkeypatch.setattr(film.render, "render_episode", lambda *args, **options: picture)
    actor: Any = type("Actor", (), {"env": None, "player": None})()
    before = snapshot(place.outside)
    film.film([actor], place.run / "video.gif", film.key_of(0))
    assert snapshot(place.outside) == before
    assert not (place.run / "video.gif").is_symlink() and (place.run / "video.gif").stat().st_size > 0


# ---- sweeps and studies ------------------------------------------------------------------------


def as_sweep(place: Place, swept: Any = ["algo.cost_limit"]) -> Path:  # noqa: B006
    folder = place.run.parent / "sweep"
    folder.mkdir()
    shutil.copytree(place.run, folder / "000-a")
    saved = {"swept": swept, "parallel": {"000-a": 1}, "groups": {"000-a": {}}}
    (folder / "sweep.yaml").write_text(yaml.safe_dump(saved))
    return folder


NO_SWEEPS = ("[" * 100_000, ALIASES, "{swept: 3, groups: {}, parallel: {}}", "swept: [1]")


@pytest.mark.parametrize("text", [*NO_SWEEPS, "x" * 5_000_000])
def test_a_sweep_that_is_none_is_refused_in_one_line(place, capsys, text):
    folder = as_sweep(place)
    (folder / "sweep.yaml").write_text(text)
    assert typed("sweep", "--summary", str(folder)) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_the_summary_of_a_sweep_takes_the_place_of_links_and_passes_over_linked_runs(place, capsys):
    folder, before = as_sweep(place), snapshot(place.outside)
    for name in ("summary.md", "summary.csv", "summary.png"):
        (folder / name).symlink_to(place.outside / "precious")
    (folder / "001-b").symlink_to(place.run)
    assert typed("sweep", "--summary", str(folder)) == 0
    assert snapshot(place.outside) == before and not (folder / "summary.png").is_symlink()
    assert len((folder / "summary.md").read_text().splitlines()) == 3


class Executed:
    def __reduce__(self):
        return (open, ("owned", "w"))


def npz(**arrays: Any) -> bytes:
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays)
    return packed.getvalue()


def zipped(**members: bytes) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return packed.getvalue()


def header(shape: tuple[int, ...], data: bytes = b"") -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return file.getvalue() + data


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("curves.npz", npz(run=np.array([Executed()], object))),
        ("curves.npz", zipped(run=header((BIG, BIG)))),
        ("curves.npz", zipped(run=header((-1,)))),
        ("curves.npz", zipped(run=b"0" * 50_000_000)),
        ("curves.npz", zipped(**{"../../../outside/precious": header((1,), b"0000")})),
        ("curves.npz", b"PK\x03\x04"),
        (
            "curves.npz",
            npz(run=np.array(["a"]), seed=np.array(["0"]), curves=np.zeros(1), settings="["),
        ),
        ("final.csv", b"run,seed\na,0,extra\n"),
        ("final.csv", b"\x00\xff"),
        ("final.csv", b'"' * 1_000_000),
    ],
)
def test_a_study_that_is_none_is_refused_in_one_line(place, capsys, name, content):
    study = place.run.parent / "study"
    study.mkdir()
    (study / "final.csv").write_text("run,seed\na,0\n")
    saved = json.dumps({"common": {}, "runs": {"a": {}}})
    (study / "curves.npz").write_bytes(
        npz(run=["a"], seed=["0"], curves=np.zeros((1, 3, 100), np.float32), settings=saved)
    )
    (study / name).write_bytes(content)
    before = snapshot(place.outside)
    assert typed("plot", str(study), "--out", "out") == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert snapshot(place.outside) == before and not Path("owned").exists()


def test_a_study_is_read_from_plain_files_only(place, capsys):
    study = place.run.parent / "study"
    study.mkdir()
    (study / "final.csv").symlink_to(place.outside / "precious")
    assert study_files.holds_study(study) and typed("plot", str(study), "--out", "out") == 2
    assert "is a link" in capsys.readouterr().err


# ---- the module that opens them ------------------------------------------------------------------


def test_a_folder_that_the_user_types_may_be_a_link(place, capsys):
    Path("mine").symlink_to(place.run)
    assert typed("plot", "mine", "--out", "out") == 0


def test_a_file_with_a_second_name_is_not_appended_to(tmp_path):
    (tmp_path / "one").write_text("")
    os.link(tmp_path / "one", tmp_path / "two")
    with pytest.raises(files.ConfigError, match="of one name"):
        files.appending(tmp_path / "two")


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path):
    files.write(tmp_path / "a.txt", "old")
    with pytest.raises(OSError, match="full"), files.replacing(tmp_path / "a.txt") as part:
        part.write_text("half")
        raise OSError("full")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a.txt", "old")]
