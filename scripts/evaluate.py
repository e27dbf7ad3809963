"""Evaluate a trained policy over fresh episodes: python scripts/evaluate.py RUN"""

import sys

from jaxsafe.commands.jaxsafe import run

if __name__ == "__main__":
    sys.exit(run("evaluate"))
