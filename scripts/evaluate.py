"""Evaluate a trained policy over fresh episodes: python scripts/evaluate.py RUN"""

import sys

from jaxsafe.commands.evaluate import main

if __name__ == "__main__":
    sys.exit(main())
