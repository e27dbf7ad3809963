"""Film a trained policy: python scripts/render.py RUN"""

import sys

from jaxsafe import algos, envs
from jaxsafe.run.viewing import render_main

if __name__ == "__main__":
    sys.exit(render_main(envs, algos))
