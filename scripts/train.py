"""Train a policy: python scripts/train.py env=car_push1 algo=cpo"""

import sys

from jaxsafe import algos, envs
from jaxsafe.run.command import train_main

if __name__ == "__main__":
    sys.exit(train_main(envs, algos))
