"""What every command shares: an error that the user can mend is one line and an exit status."""

import errno
import os
import sys
from collections.abc import Callable

import jax

from jaxsafe.config import ConfigError, one_line
from jaxsafe.report.film import NoVideo
from jaxsafe.run import arguments, checkpoint, memory
from jaxsafe.run.divergence import Diverged

DIVERGED = 3  # the exit status of a run that learns no more
UNREAD = 128 + 13  # of a command whose output nobody reads, as a shell reports SIGPIPE
BAD_DISK = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO)


def guarded(command: Callable[[], int]) -> int:
    """Run `command`; what the user can mend becomes one line on stderr and an exit status."""
    try:
        status = command()
        sys.stdout.flush()  # not after this function, where a reader that has gone is a traceback
        return status
    except (ConfigError, *arguments.ERRORS) as error:
        return complain(one_line(error), 2)
    except (checkpoint.NotSaved, memory.OutOfMemory, NoVideo) as error:
        return complain(one_line(error), 1)
    except Diverged as error:
        return complain(one_line(error), DIVERGED)
    except KeyboardInterrupt:
        return complain("stopped; what was saved stays", 130)
    except BrokenPipeError:  # the reader has gone, as in `jaxsafe study NAME --list | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNREAD
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            return complain(f"{error.filename}: expected names of at most 255 bytes", 2)
        if error.errno not in BAD_DISK:
            raise
        where = f" ({error.filename})" if error.filename else ""
        return complain(f"{error.strerror}{where}; what was saved stays", 1)
    except jax.errors.JaxRuntimeError as error:
        if not memory.is_exhausted(error):
            raise
        return complain("out of memory; use fewer environments, seeds or episodes", 1)


def complain(line: str, status: int) -> int:
    """Print `line` as an error; return `status`."""
    # a file may have put control characters into it, which a terminal would obey
    shown = "".join(letter if letter.isprintable() else "?" for letter in line)
    print(f"error: {shown}", file=sys.stderr)
    return status
