"""MuJoCo Warp's launches, recorded once and then repeated.

Its functions allocate what they need at every call. In a CUDA graph each of these arrays is two more
nodes, which a physics step waits for.
"""

import threading
from collections.abc import Callable
from typing import Any

import warp as wp


class Recording:
    """What `call` would launch, on arrays that it allocates now. It may launch kernels and ask for
    empty arrays or zeros, and nothing else on the device. Other threads launch as ever."""

    def __init__(self, call: Callable[[], Any]):
        self.launches: list[wp.Launch] = []
        self.zeros: list[wp.array] = []
        self.kept: list[Any] = []  # so that no array goes
        launch, zeros, thread = wp.launch, wp.zeros, threading.get_ident()

        def recorded(*args: Any, **settings: Any) -> Any:
            if threading.get_ident() != thread:
                return launch(*args, **settings)
            self.kept.append((args, settings))
            command = launch(*args, record_cmd=True, **settings)
            if command is not None:  # else it has no threads
                self.launches.append(command)
            return None

        def zeroed(*args: Any, **settings: Any) -> wp.array:
            found = zeros(*args, **settings)
            if threading.get_ident() == thread:
                self.zeros.append(found)
            return found

        wp.launch, wp.zeros = recorded, zeroed
        try:
            call()
        finally:
            wp.launch, wp.zeros = launch, zeros

    def repeat(self) -> None:
        for x in self.zeros:
            x.zero_()
        for command in self.launches:
            command.launch()
