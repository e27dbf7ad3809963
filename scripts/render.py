"""Film a trained policy: python scripts/render.py RUN"""

import sys

from jaxsafe.commands.jaxsafe import run

if __name__ == "__main__":
    sys.exit(run("render"))
