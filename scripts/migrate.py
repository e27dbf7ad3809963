"""A config of OmniSafe or Safety Gym as a command: python scripts/migrate.py omnisafe CONFIG.json"""

import sys

from jaxsafe.commands.jaxsafe import run

if __name__ == "__main__":
    sys.exit(run("migrate"))
