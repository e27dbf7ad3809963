"""One command, `jaxsafe`, for all that the scripts do."""

import importlib
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from shell import SCRIPTS

from jaxsafe import __version__
from jaxsafe.commands import jaxsafe
from jaxsafe.commands.study import in_folder
from jaxsafe.commands.train import resume_command
from jaxsafe.run.settings import settings_from_options


def run(monkeypatch, *args: str) -> int | str | None:
    monkeypatch.setattr(sys, "argv", ["/usr/bin/jaxsafe", *args])
    try:
        return jaxsafe.main()
    except SystemExit as stop:
        return stop.code


@pytest.mark.parametrize("args", [(), ("--help",), ("-h",)])
def test_alone_it_lists_every_command_on_one_screen(args, monkeypatch, capsys):
    assert run(monkeypatch, *args) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 24 and all(len(line) <= 80 for line in lines)
    assert [line.split()[0] for line in lines if line.startswith("  ")] == [*jaxsafe.COMMANDS]


def test_it_says_its_version(monkeypatch, capsys):
    assert run(monkeypatch, "--version") == 0
    assert capsys.readouterr().out == f"jaxsafe {__version__}\n"


def test_every_command_has_a_module_and_a_thin_script():
    for name in jaxsafe.COMMANDS:
        assert callable(importlib.import_module(f"jaxsafe.commands.{name}").main)
        text = (SCRIPTS / f"{name}.py").read_text()
        assert f'sys.exit(run("{name}"))' in text and len(text.splitlines()) < 12


def test_a_typo_names_the_nearest_command(monkeypatch, capsys):
    assert run(monkeypatch, "trian", "algo=cpo") == 2
    assert capsys.readouterr().err == "error: unknown command trian; did you mean 'train'?\n"


@pytest.mark.parametrize(
    "words",
    [["-m", "jaxsafe", "plot"], *([path] for path in sorted(SCRIPTS.glob("*.py")))],
    ids=lambda words: Path(words[-1]).name,
)
def test_ctrl_c_while_a_command_loads_is_one_line(words, tmp_path):
    (tmp_path / "jax.py").write_text(
        "import signal\n\n"
        "try:\n    signal.raise_signal(signal.SIGINT)\n"
        "except KeyboardInterrupt:\n    raise ImportError from None  # as JAX's extension does\n"
    )
    path = os.pathsep.join([str(tmp_path), str(SCRIPTS.parent)])
    done = subprocess.run(
        [sys.executable, *words], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    expected = (130, "", "error: stopped before it began\n")
    assert (done.returncode, done.stdout, done.stderr) == expected


WRONG = {
    "train algo.lr=nan": "algo.lr=nan: expected",
    "sweep algo.lr=0.1": "nothing to sweep",
    "evaluate nowhere": "nowhere is not a run folder",
    "plot nowhere": "nowhere",
    "render nowhere --seed -1": "expected a whole number",
    "watch nowhere": "nowhere is not a run folder",
    "migrate omnisafe nowhere.json": "cannot read nowhere.json",
    "benchmark point_gol1": "did you mean 'point_goal1'?",
    "benchmark --algo nope": "unknown algo 'nope'",
    "train env=my_envs": "others; your own is MODULE:NAME",
    "train point_goal1 ppo": "cannot read 'point_goal1'; expected key=value without spaces",
    "evaluate nowhere --episodes 3 algo=nope": "nowhere is not a run folder",
    "plot nowhere --by algo.lr elsewhere": "nowhere",
    "benchmark point_goal1 --num-envs -5": "expected a whole number between 1 and",
    "study nothing": "no study nothing",
}


@pytest.mark.parametrize("line", WRONG)
def test_bad_input_is_one_line_and_status_2(line, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, *line.split()) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ") and err.count("\n") == 1 and WRONG[line] in err


def test_what_continues_a_run_is_typed_as_it_was_begun(monkeypatch):
    settings = settings_from_options({})
    for argv, says in (
        (["scripts/train.py"], "python scripts/train.py"),
        (["jaxsafe train"], "jaxsafe train"),
    ):
        monkeypatch.setattr(sys, "argv", argv)
        assert resume_command(settings, Path("runs/a")) == f"{says} resume=runs/a"


@pytest.mark.parametrize(
    "folder",
    [
        "000-a-ppo.horizon=128",
        "~a (1)#2",
        "dir with space",
        "\u00fcn\u00ef",
        "it's",
        "a=\\'b\\",
        "10",
        "a,b",
    ],
)
def test_hydra_reads_the_folder_of_a_command_that_continues_a_run(folder):
    settings = settings_from_options({"dataset": f"data/{folder}"})
    words = shlex.split(resume_command(settings, Path(folder)))[2:]
    parser = OverridesParser.create()
    found = {o.key_or_group: o.value() for o in parser.parse_overrides(words)}
    assert found == {"resume": folder, "dataset": f"data/{folder}"}
    (_, run_dir, _) = in_folder(["algo=cpo"], Path(folder))
    assert parser.parse_override(run_dir).value() == folder


def test_python_m_jaxsafe_is_the_command(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "jaxsafe", "plott"], cwd=tmp_path, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (2, "") and "did you mean 'plot'" in done.stderr


def test_a_missing_opengl_is_reported_in_one_line(tmp_path):
    env = os.environ | {"MUJOCO_GL": "vulkan"}

    def said(*words):
        command = [sys.executable, "-m", "jaxsafe", *words]
        where = {"cwd": tmp_path, "env": env, "timeout": 60}
        done = subprocess.run(command, capture_output=True, text=True, **where)
        return done.returncode, done.stdout, done.stderr

    status, out, err = said("plot", "nowhere")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert "MUJOCO_GL=vulkan: MuJoCo does not load" in err
    assert said("--version") == (0, f"jaxsafe {__version__}\n", "")
