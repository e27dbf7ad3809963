"""The commands: a module each, called by `jaxsafe` and by scripts/."""

import importlib
import os
import sys

# MuJoCo fails as it is imported where MUJOCO_GL names an OpenGL that is not there. The commands import
# it before any of them could say so.
if os.environ.get("MUJOCO_GL") and not {"-h", "--help", "--version"} & {*sys.argv[1:2]}:
    try:
        importlib.import_module("mujoco")
    except Exception as error:
        given, why = os.environ["MUJOCO_GL"], " ".join(str(error).split())
        print(
            f"error: MUJOCO_GL={given}: MuJoCo does not load ({why}); unset it, or set an installed "
            "one of egl, osmesa and glfw, or off",
            file=sys.stderr,
        )
        sys.exit(2)
