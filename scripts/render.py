"""Film a trained policy: python scripts/render.py RUN"""

import sys

from jaxsafe.commands.render import main

if __name__ == "__main__":
    sys.exit(main())
