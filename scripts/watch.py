"""Watch a policy: python scripts/watch.py RUN; drive a robot: python scripts/watch.py env=car_goal1"""

import sys

from jaxsafe import algos, envs
from jaxsafe.run.viewing import watch_main

if __name__ == "__main__":
    sys.exit(watch_main(envs, algos))
