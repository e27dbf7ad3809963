"""Watch a policy: python scripts/watch.py RUN; drive a robot: python scripts/watch.py env=car_goal1"""

import sys

from jaxsafe.commands.jaxsafe import run

if __name__ == "__main__":
    sys.exit(run("watch"))
