"""A config of OmniSafe or Safety Gym as a command: python scripts/migrate.py omnisafe CONFIG.json"""

import sys

from jaxsafe.commands.migrate import main

if __name__ == "__main__":
    sys.exit(main())
