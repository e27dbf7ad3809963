import gc
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from compiling import compile_quickly, forget_lines, keep_programs

from jaxsafe import algos, envs
from jaxsafe.envs.view import backend

keep_programs()
forget_lines()

# In the background the tests are told to ignore these. The programs that they start would inherit
# that, but not a handler.
for number in (signal.SIGINT, signal.SIGHUP):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, lambda *_: None)

MAPS = Path("/proc/self/maps")
MOST_MAPS = 30_000  # Linux lets a process have 65,530
OURS = [(registry, dict(registry)) for registry in (envs.ENVS, algos.ALGOS)]


def pytest_configure(config: pytest.Config) -> None:
    """Slow proofs run longer than they compile: they compile as users' programs do."""
    if "not slow" in config.option.markexpr:
        compile_quickly()


def pytest_collection_finish() -> None:
    """Look for garbage less often: tracing leaves little of it, and to look takes a tenth of the time.

    What is imported by now stays, so it is never looked at.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


@pytest.fixture(autouse=True, scope="module")
def forgotten_programs(request: pytest.FixtureRequest) -> Iterator[None]:
    """Free the compiled programs of a file when it ends; those of environments are shared by several.

    A process that keeps some thousands of them runs out of memory maps, and XLA crashes. What the file
    registered is forgotten, too.
    """
    yield
    for registry, ours in OURS:
        registry.clear()
        registry.update(ours)
    if request.path.parent.name != "envs" or many_memory_maps():
        jax.clear_caches()


@pytest.fixture(autouse=True)
def few_memory_maps(request: pytest.FixtureRequest) -> Iterator[None]:
    """Free the compiled programs before a file of many slow tests has had too many of them."""
    yield
    if request.node.get_closest_marker("slow") and many_memory_maps():
        jax.clear_caches()


def many_memory_maps() -> bool:
    return MAPS.exists() and len(MAPS.read_bytes().splitlines()) > MOST_MAPS


@pytest.fixture(autouse=True)
def forgotten_code(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Forget the environments, algorithms and modules that a test brought with it."""
    folder = str(tmp_path_factory.getbasetemp())
    registries = [(registry, dict(registry)) for registry in (envs.ENVS, algos.ALGOS)]
    modules, path = {*sys.modules}, [*sys.path]
    yield
    for registry, before in registries:
        if registry.keys() != before.keys():
            registry.clear()
            registry.update(before)
    for name in {*sys.modules} - modules:
        if str(getattr(sys.modules[name], "__file__", None)).startswith(folder):
            del sys.modules[name]
    sys.path[:] = path


@pytest.fixture(scope="session")
def display() -> None:
    """What draws pictures, where the machine has it."""
    try:
        backend.find_backend()
    except backend.NoDisplay as error:
        pytest.skip(str(error))
