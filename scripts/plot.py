"""Compare runs and sweeps in tables and figures: python scripts/plot.py RUNS... [--by FIELD ...]"""

import sys

from jaxsafe import algos, envs
from jaxsafe.report.compare import main

if __name__ == "__main__":
    sys.exit(main(envs, algos))
