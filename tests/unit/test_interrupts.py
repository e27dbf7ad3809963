"""Signals as requests to stop."""

import signal
import threading
import time

from jaxsafe.run import distributed, interrupts


def test_a_signal_and_its_echo_are_one_and_a_later_one_leaves_at_once(monkeypatch):
    said: list[str] = []
    left = threading.Event()
    monkeypatch.setattr(distributed, "exit_all", lambda status: left.set())
    with interrupts.Interrupts(said.append) as asked:
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)  # as `timeout` does
        time.sleep(interrupts.MOMENT + 0.2)
        assert asked.requested and not left.is_set()
        signal.raise_signal(signal.SIGINT)
        assert left.wait(timeout=10)
    assert [line.split()[0] for line in said[:2]] == ["stopping", "stopped"]
