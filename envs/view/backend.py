"""Where to draw: MuJoCo's OpenGL backends."""

import atexit
import functools
import importlib
import os
import platform
import subprocess
import sys
from typing import Any

BACKENDS = {"Linux": ("egl", "osmesa", "glfw"), "Darwin": ("cgl", "glfw")}
PROBE = """
import importlib, os, sys, mujoco
context = importlib.import_module("mujoco." + sys.argv[1]).GLContext(8, 8)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), 100)
os._exit(0)  # past the clean-up, which fails in some drivers
"""


class NoDisplay(RuntimeError):
    """Nothing to render with. The message is one line."""


@functools.cache
def gl_context() -> Any:
    """The OpenGL context of this process. Only the cache holds it, so that its end is ours to time."""
    context = importlib.import_module(f"mujoco.{find_backend()}").GLContext(64, 64)
    atexit.register(gl_context.cache_clear)  # while its library is still there
    return context


def find_backend() -> str:
    """The first of MuJoCo's OpenGL backends that works here, or the one that MUJOCO_GL names.

    Raises:
        NoDisplay: none does.
    """
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    names = BACKENDS.get(platform.system(), ("glfw",))
    if wanted not in ("", "1", "on", "true", "enable", "enabled"):
        names = ({"glx": "glfw", "wgl": "glfw"}.get(wanted, wanted),)
    for name in names:
        if works(name):
            return name
    hint = f"unset MUJOCO_GL={wanted}" if names == (wanted,) else "install libegl1 or libosmesa6"
    raise NoDisplay(f"nothing to render with here: {', '.join(names)} failed; {hint}")


def works(backend: str) -> bool:
    """Try a backend in a process of its own: a failure would bar the next one from this process."""
    try:
        probe = subprocess.run([sys.executable, "-c", PROBE, backend], capture_output=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return probe.returncode == 0
