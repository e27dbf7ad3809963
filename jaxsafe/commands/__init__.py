"""The commands: a module each, called by `jaxsafe` and by scripts/."""

import os
import sys

if os.environ.get("MUJOCO_GL"):  # an OpenGL that is not there fails as soon as MuJoCo is imported
    try:
        import mujoco as mujoco
    except Exception as error:
        given = f"MUJOCO_GL={os.environ['MUJOCO_GL']}"
        expected = "expected egl, osmesa or glfw, as far as they are installed, off, or no MUJOCO_GL"
        print(f"error: {given}: MuJoCo does not load ({error}); {expected}", file=sys.stderr)
        sys.exit(2)
