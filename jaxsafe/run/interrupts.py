"""Ctrl-C, SIGTERM and a closed terminal as a request to stop, seen even while JAX compiles."""

import contextlib
import signal
import socket
import threading
import time
from collections.abc import Callable
from types import TracebackType

from jaxsafe.run import distributed

EXIT_STATUS = 130
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
MOMENT = 0.5  # s, within which two signals are one


class Interrupts:
    """The first signal sets `requested`; the second, or any while `nothing_to_save`, leaves at once.

    A terminal that closes sends SIGHUP, perhaps several times. Under nohup it is not listened to.
    `timeout` signals a program and then its group, so that what comes within a `MOMENT` is one signal.

    Python runs signal handlers between its own instructions only, and one XLA compilation can
    take minutes. So a thread reads the signals from the wakeup socket, which is written at once.

    Args:
        say: where to say what a signal does.
        hosted: the process goes on afterwards, as a notebook does. To leave at once is then a
            KeyboardInterrupt, which has to wait for a compilation, and SIGTERM is not for us.
    """

    def __init__(self, say: Callable[[str], None], hosted: bool = False):
        self.say, self.hosted = say, hosted
        self.requested = False
        self.nothing_to_save = ""  # what to say when leaving at once is all right

    def __enter__(self) -> "Interrupts":
        self.handlers = {}
        if threading.current_thread() is not threading.main_thread():
            return self  # there Python allows no handlers
        if self.hosted:
            self.handlers[signal.SIGINT] = signal.signal(signal.SIGINT, self._interrupted)
        else:
            self.reader, self.writer = socket.socketpair()
            self.writer.setblocking(False)
            self.wakeup = signal.set_wakeup_fd(self.writer.fileno(), warn_on_full_buffer=False)
            for number in SIGNALS:
                if signal.getsignal(number) is not signal.SIG_IGN:
                    self.handlers[number] = signal.signal(number, lambda *_: None)
            threading.Thread(target=self._listen, daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self.handlers.items():
            signal.signal(number, handler)
        if self.handlers and not self.hosted:
            signal.set_wakeup_fd(self.wakeup)
            self.writer.close()  # ends the thread

    def _interrupted(self, *_: object) -> None:  # says nothing: it may interrupt what is being said
        if self.requested or self.nothing_to_save:
            raise KeyboardInterrupt(self.nothing_to_save or "stopped without a last checkpoint")
        self.requested = True

    def _listen(self) -> None:
        first = 0.0
        with self.reader:
            while received := self.reader.recv(1):
                echo = received[0] == signal.SIGHUP or time.monotonic() < first + MOMENT
                if received[0] not in SIGNALS or (self.requested and echo):
                    continue
                if self.requested or self.nothing_to_save:
                    self._try_to_say(self.nothing_to_save or "stopped without a last checkpoint")
                    distributed.exit_all(EXIT_STATUS)
                self.requested, first = True, time.monotonic()
                self._try_to_say(
                    "stopping after this iteration, with a checkpoint; Ctrl-C again leaves at once"
                )

    def _try_to_say(self, text: str) -> None:
        with contextlib.suppress(OSError):  # the terminal may be gone
            self.say(text)
