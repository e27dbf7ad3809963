"""Train a grid of settings: python scripts/sweep.py algo=ppo_lag algo.cost_limit=5,10,25"""

import sys

from jaxsafe.commands.jaxsafe import run

if __name__ == "__main__":
    sys.exit(run("sweep"))
