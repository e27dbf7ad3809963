"""Evaluate a trained policy over fresh episodes: python scripts/evaluate.py RUN"""

import sys

from jaxsafe import algos, envs
from jaxsafe.run.command import evaluate_main

if __name__ == "__main__":
    sys.exit(evaluate_main(envs, algos))
