"""Record a data set from trained policies: python scripts/collect.py RUN:SHARE ... size=1e6"""

import sys

from jaxsafe.commands.jaxsafe import run

if __name__ == "__main__":
    sys.exit(run("collect"))
