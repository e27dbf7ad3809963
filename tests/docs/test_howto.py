"""The pages of docs/howto do what they say."""

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from jaxsafe import envs
from jaxsafe.learn.observations import observation_like, vector_of
from jaxsafe.run.arguments import compose
from jaxsafe.run.settings import make_env

ROOT = Path(__file__).parent.parent.parent
PAGES = sorted((ROOT / "docs" / "howto").glob("*.md"), key=lambda p: p.name)
PAGES = [page for page in PAGES if "```bash" in page.read_text()]  # what is in `sh` has placeholders
BLOCK = re.compile(r"(<!-- slow -->\n)?^```(\w+)\n(.*?)^```$", re.M | re.S)
FILE = re.compile(r"(?:# |<!-- )(\w+\.(?:py|xml))\b")
SMALL = (
    "num_envs=4", "algo.horizon=16", "algo.minibatches=2", "algo.critic_epochs=2", "algo.hidden=[8,8]",
    "total_steps=128", "eval_episodes=2", "video=false",
)  # fmt: skip


def blocks(page: Path) -> list[tuple[bool, str, str]]:
    """(whether it takes minutes, language, text) of each block of code."""
    found = [(bool(slow), kind, text) for slow, kind, text in BLOCK.findall(page.read_text())]
    assert page.read_text().count("\n```") == 2 * len(found)
    return found


@pytest.fixture
def page(request, tmp_path, monkeypatch) -> Iterator[Path]:
    """A page whose files lie in the working directory."""
    for _, _, text in blocks(request.param):
        if name := FILE.match(text):
            (tmp_path / name[1]).write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    known = {**envs.ENVS}
    yield request.param
    envs.ENVS.clear()
    envs.ENVS.update(known)


def named(path: Path) -> str:
    return path.stem


@pytest.mark.parametrize("page", PAGES, indirect=True, ids=named)
def test_the_python_of_a_page_runs(page, capsys):
    names: dict = {}
    for slow, kind, text in blocks(page):
        if kind == "python" and not slow and not FILE.match(text):
            exec(compile(text, page.name, "exec"), names)


@pytest.mark.parametrize("page", PAGES, indirect=True, ids=named)
def test_the_runs_of_a_page_could_start(page):
    for line in commands(page):
        if line[1] == "scripts/train.py" and not any(word.startswith("resume=") for word in line):
            env = make_env(compose(line[2:]))
            assert vector_of(observation_like(env)).shape == (env.obs_size,)


def commands(page: Path) -> list[list[str]]:
    lines = [
        shlex.split(x) for _, kind, text in blocks(page) if kind == "bash" for x in text.splitlines()
    ]
    assert lines
    return lines


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, indirect=True, ids=named)
def test_the_commands_of_a_page_run(page):
    for line in commands(page):
        if any("algo.encoder=cnn" in word for word in line) and not any("ppo" in word for word in line):
            continue  # tests/contract/test_pixels.py trains them, with small replays
        script = [sys.executable, str(ROOT / line[1]), *line[2:]]
        if line[1] in ("scripts/train.py", "scripts/sweep.py"):
            script += SMALL if "resume" not in str(line) else ["total_steps=256"]
        done = subprocess.run(script, capture_output=True, text=True)
        assert done.returncode == 0, (line, done.stderr)


@pytest.mark.slow  # needs playground
@pytest.mark.parametrize("page", PAGES, indirect=True, ids=named)
def test_the_python_that_takes_minutes_runs_too(page):
    if "mujoco_playground" in page.read_text():
        pytest.importorskip("mujoco_playground")
    names: dict = {}
    for slow, kind, text in blocks(page):
        if kind == "python" and not FILE.match(text):
            exec(compile(text.replace("600_000", "40_960") if slow else text, page.name, "exec"), names)
