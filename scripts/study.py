"""Train what a study lacks: python scripts/study.py NAME [--minutes 8]"""

import sys

from jaxsafe.commands.study import main

if __name__ == "__main__":
    sys.exit(main())
