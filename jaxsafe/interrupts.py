"""Ctrl-C and SIGTERM as a request to stop, seen even while JAX compiles."""

import signal
import socket
import threading
from collections.abc import Callable
from types import TracebackType

from jaxsafe import distributed

EXIT_STATUS = 130


class Interrupts:
    """The first signal sets `requested`; the second, or any while `nothing_to_save`, leaves at once.

    Python runs signal handlers between its own instructions only, and one XLA compilation can
    take minutes. So a thread reads the signals from the wakeup socket, which is written at once.
    """

    def __init__(self, say: Callable[[str], None]):
        self.say = say
        self.requested = False
        self.nothing_to_save = ""  # what to say when leaving at once is all right

    def __enter__(self) -> "Interrupts":
        self.handlers = {}
        if threading.current_thread() is threading.main_thread():  # elsewhere Python allows no handlers
            self.reader, self.writer = socket.socketpair()
            self.writer.setblocking(False)
            self.wakeup = signal.set_wakeup_fd(self.writer.fileno(), warn_on_full_buffer=False)
            for number in (signal.SIGINT, signal.SIGTERM):
                self.handlers[number] = signal.signal(number, lambda *_: None)
            threading.Thread(target=self._listen, daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.handlers:
            for number, handler in self.handlers.items():
                signal.signal(number, handler)
            signal.set_wakeup_fd(self.wakeup)
            self.writer.close()  # ends the thread

    def _listen(self) -> None:
        with self.reader:
            while received := self.reader.recv(1):
                if received[0] not in (signal.SIGINT, signal.SIGTERM):
                    continue
                if self.requested or self.nothing_to_save:
                    self.say(self.nothing_to_save or "stopped without a last checkpoint")
                    distributed.end(EXIT_STATUS)
                self.requested = True
                self.say(
                    "stopping after this iteration, with a checkpoint; Ctrl-C again leaves at once"
                )
