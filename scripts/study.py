"""Train what a study lacks: python scripts/study.py NAME [--minutes 8]"""

import sys

from jaxsafe.commands.jaxsafe import run

if __name__ == "__main__":
    sys.exit(run("study"))
