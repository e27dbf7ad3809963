from collections.abc import Iterator

import jax
import pytest

from jaxsafe.envs.view import render


@pytest.fixture(autouse=True, scope="module")
def forgotten_programs(request: pytest.FixtureRequest) -> Iterator[None]:
    """Free the compiled programs of a file when it ends; those of environments are shared by several.

    A process that keeps some thousands of them runs out of memory maps, and XLA crashes.
    """
    yield
    if request.path.parent.name != "envs":
        jax.clear_caches()


@pytest.fixture(scope="session")
def display() -> None:
    """What draws pictures, where the machine has it."""
    try:
        render.find_backend()
    except render.NoDisplay as error:
        pytest.skip(str(error))
