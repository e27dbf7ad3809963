"""Compare runs and sweeps in tables and figures: python scripts/plot.py RUNS... [--by FIELD ...]"""

import sys

from jaxsafe.commands.jaxsafe import run

if __name__ == "__main__":
    sys.exit(run("plot"))
