"""Compare runs and sweeps in tables and figures: python scripts/plot.py RUNS... [--by FIELD ...]"""

import sys

from jaxsafe.commands.plot import main

if __name__ == "__main__":
    sys.exit(main())
