"""python -m jaxsafe, which is the command `jaxsafe`."""

import sys

from jaxsafe.commands.jaxsafe import main

if __name__ == "__main__":
    sys.exit(main())
