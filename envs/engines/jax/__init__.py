"""Engine `jax`: MJX in plain JAX, with contacts and a constraint solver of our own."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints that it lacks Warp, without which it does
    import mujoco.mjx  # noqa: F401
