"""Train a policy: python scripts/train.py env=car_push1 algo=cpo"""

import sys

from jaxsafe.commands.jaxsafe import run

if __name__ == "__main__":
    sys.exit(run("train"))
