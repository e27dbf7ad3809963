"""Measure environments and fused training: python scripts/benchmark.py point_goal1 --num-envs 1024"""

import sys

from jaxsafe.commands.jaxsafe import run

if __name__ == "__main__":
    sys.exit(run("benchmark"))
