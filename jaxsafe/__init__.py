"""Safe reinforcement learning in which environments and learners compile into one JAX program."""

import os

__version__ = "0.1.0"

# A host callback (the CPU engine is one) holds a thread of XLA's pool while it waits for its input,
# which another thread of that pool brings. With two cores the pool has two threads, and two
# callbacks at once wait for ever. JAX reads this when it first uses the CPU.
os.environ.setdefault("PJRT_NPROC", str(max(8, os.cpu_count() or 1)))
