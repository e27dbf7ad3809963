"""Record a data set from trained policies: python scripts/collect.py RUN:SHARE ... size=1e6"""

import sys

from jaxsafe.commands.collect import main

if __name__ == "__main__":
    sys.exit(main())
