"""The notebooks, executed with small settings in place of those of their `parameters` cell."""

import importlib
import json
import os
import sys
from pathlib import Path
from typing import Any

import nbclient
import nbformat
import pytest
from compiling import BUSY, as_flags

ROOT = Path(__file__).parent.parent.parent
sys.path.insert(0, str(ROOT / "notebooks"))
write: Any = importlib.import_module("write")
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
TINY: dict[str, Any] = {
    "num_envs": 4, "horizon": 20, "minibatches": 2, "critic_epochs": 1, "hidden": (4, 4),
    "total_steps": 240, "eval_episodes": 0, "video": False,
}  # fmt: skip
SHIELD: dict[str, Any] = {
    "preset": "cpu", "num_envs": 4, "horizon": 8, "learn_every": 8, "batch_size": 32, "replay_ratio": 2,
    "n_step": 3, "replay_size": 128, "learning_starts": 32, "size": "tiny", "imagine_steps": 3,
    "overshoot": 2, "shield_rollouts": 4, "delta": 0.8, "shield_horizon": 5, "total_steps": 128,
    "eval_episodes": 2,
}  # fmt: skip
SMALL = {  # what the settings of each become
    "quickstart": TINY | {"env.num_steps": 40},
    "sweep": TINY | {"num_seeds": 2},
    "own_environment": TINY,
    "own_algorithm": TINY,
    "comparison": TINY | {"num_seeds": 2},
    "offline": TINY,
    "shielding": SHIELD,
}
MORE = {  # other lines of its parameters
    "offline": """\
size = 80
learning = {"total_updates": 20, "updates": 10, "batch_size": 8, "hidden": (4,), "eval_episodes": 4}""",
    "shielding": "seen, ahead = 8, 5",
}
TASK = "toys:Corridor"  # of tests/, where a notebook has a `task`: compiles in seconds, and is cached


def cells(path: Path) -> list[dict[str, Any]]:
    return json.loads(path.read_text())["cells"]


def tagged(path: Path, tag: str) -> list[str]:
    return ["".join(c["source"]) for c in cells(path) if tag in c["metadata"].get("tags", ())]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_runs_from_top_to_bottom(path, tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    monkeypatch.setenv("XLA_FLAGS", f"{os.environ.get('XLA_FLAGS', '')} {as_flags(BUSY)}")
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "tests"), prepend=os.pathsep)
    notebook: Any = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        tags = cell.metadata.get("tags", ())
        if "parameters" in tags:
            cell.source += f"\ntask, settings = {TASK!r}, settings | {SMALL[path.stem]!r}"
            cell.source += f"\n{MORE.get(path.stem, '')}"
    nbclient.NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    outputs = [o for cell in notebook.cells if cell.cell_type == "code" for o in cell.outputs]
    kinds = {kind for o in outputs for kind in o.get("data", ())}
    assert kinds & {"image/png", "text/html"}, "it shows no picture"
    assert not [o.text for o in outputs if o.output_type == "stream" and o.name == "stderr"]


def test_every_notebook_has_small_settings():
    assert [path.stem for path in NOTEBOOKS] == sorted(SMALL)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_has_the_common_set_up_and_outputs_small_enough_for_the_web(path):
    assert path.read_text() == write.text(write.filled(path)), "run python notebooks/write.py"
    assert tagged(path, "install") == ["".join(cells(path)[1]["source"])]
    outputs = [c["outputs"] for c in cells(path) if c["cell_type"] == "code"]
    assert any(outputs) == (path.stem in write.STORED)
    assert any(outputs) or "stored without outputs" in "".join(cells(path)[0]["source"])
    assert path.stat().st_size < 200_000
    (parameters,) = tagged(path, "parameters")
    assert "settings = {" in parameters


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_states_its_problem_as_an_equation_and_opens_in_colab(path):
    prose = ["".join(c["source"]) for c in cells(path) if c["cell_type"] == "markdown"]
    assert any("$$" in text for text in prose)
    assert f"/blob/main/notebooks/{path.name})" in prose[0] and "colab.research.google.com" in prose[0]


def test_the_address_of_the_repository_stands_in_one_place():
    home = write.REPOSITORY.removeprefix("https://github.com/")
    for path in ROOT.glob("*/*.py"):
        assert home not in path.read_text() or path.name == "write.py", path
