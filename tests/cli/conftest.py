from pathlib import Path

import pytest
import shell


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> Path:
    """An uninterrupted run of the toy, 40 updates, which nobody changes."""
    run = tmp_path_factory.mktemp("finished") / "run"
    assert shell.typed("train", *shell.SMALL, f"total_steps={40 * shell.STEPS}", f"run_dir={run}") == 0
    return run
