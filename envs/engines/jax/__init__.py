"""Engine `jax`: MJX in plain JAX, with contacts and a constraint solver of our own."""

import contextlib
import io

# MJX prints that Warp is missing when it is first imported. This engine needs none, so that is here,
# in silence.
with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx  # noqa: F401
