"""Several processes, perhaps on several hosts, that train one run on the devices of all.

Every process runs the same program in step. Process 0 alone writes and speaks; it also listens at
the coordinator's address, where the others meet before `jax.distributed` starts: that ends a process
with a stack trace where another one is missing. The connections made there stay open, without
traffic, as lifelines: when a process ends, its connection closes and so all others end too, even
while they wait for it in a collective. A byte sent before says that it ended by an error which it
has reported, with this exit status. Process 0 leaves last: the others' `jax.distributed` ends them
with a stack trace as soon as its service there is gone.
"""

import atexit
import contextlib
import os
import re
import select
import socket
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any, NamedTuple, NoReturn

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import NamedSharding, PartitionSpec, Sharding

from jaxsafe.config import ConfigError
from jaxsafe.run import checkpoint
from jaxsafe.types import PyTree

PATIENCE = 120.0  # s for all processes to start
KEEPALIVE = {"TCP_KEEPIDLE": 10, "TCP_KEEPINTVL": 10, "TCP_KEEPCNT": 5}  # s, s; a lost host: 60 s
FAREWELL = 5.0  # s that process 0 waits for the others to end before it does
OPTIONS = ("coordinator", "num_processes", "process_index")

_lifelines: dict[int, socket.socket] = {}  # to process 0 or, there, to all others; empty when alone
_leaving = threading.RLock()  # held by the thread that ends this process


class Position(NamedTuple):
    """A process among several."""

    host: str  # of process 0
    port: int
    count: int
    index: int
    local_device: int | None = None  # the only one to take on this host; None: all

    @property
    def coordinator(self) -> str:
        return f"coordinator={self.host}:{self.port}"


# ---- meeting and leaving ---------------------------------------------------------------------


def position_from_options(
    coordinator: str | None, num_processes: int | None, process_index: int | None, devices: int
) -> Position | None:
    """From the options, within the bounds of TrainConfig, or, without any and with several devices,
    from SLURM; None: a lone process.

    Raises:
        ConfigError: options are missing, or out of range.
    """
    given = dict(zip(OPTIONS, (coordinator, num_processes, process_index), strict=True))
    missing = [name for name, value in given.items() if value is None]
    if missing == [*OPTIONS]:
        return slurm_position(os.environ) if devices > 1 else None
    if num_processes == 1 and not process_index:
        return None
    if missing:
        raise ConfigError(
            f"{' and '.join(missing)} missing: several processes need coordinator=host:port, "
            "num_processes=N and, each its own, process_index=0 .. N-1"
        )
    assert coordinator is not None and num_processes is not None and process_index is not None
    host, _, port = coordinator.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 2**16:
        raise ConfigError(f"coordinator={coordinator}: expected host:port, the host that of process 0")
    if process_index >= num_processes:
        raise ConfigError(f"process_index={process_index}: expected 0 to {num_processes - 1}")
    return Position(host.strip("[]"), int(port), num_processes, process_index)


def slurm_position(environ: Any) -> Position | None:
    """That of a task of `srun`. Tasks that share a host and see all its GPUs take one each."""
    count = int(environ.get("SLURM_STEP_NUM_TASKS", 1))
    node = re.match(r"([^,\[]+)(?:\[(\d+))?", environ.get("SLURM_STEP_NODELIST", ""))  # node[07-09]
    if count == 1 or not node:
        return None
    host = node[1] + (node[2] or "")
    port = 61440 + int(environ["SLURM_JOB_ID"]) % 4096
    here = re.match(r"\d+", environ.get("SLURM_STEP_TASKS_PER_NODE", "1"))
    shared = here and int(here[0]) > 1 and "," in environ.get("CUDA_VISIBLE_DEVICES", "")
    local = int(environ["SLURM_LOCALID"]) if shared else None
    return Position(host, port, count, int(environ["SLURM_PROCID"]), local)


@contextlib.contextmanager
def joined(at: Position | None) -> Iterator[None]:
    """Meet the other processes, if there are any. Comes before anything that asks JAX for devices.

    Raises:
        ConfigError: not all of them came in time.
    """
    if at:
        port = meet(at)
        # for an error that nobody expected; its traceback is printed by then
        atexit.register(exit_all_if_joined, 1)
        threading.Thread(target=watch_lifelines, daemon=True).start()
        jax.distributed.initialize(
            f"{at.host if ':' not in at.host else f'[{at.host}]'}:{port}",
            at.count,
            at.index,
            None if at.local_device is None else [at.local_device],
            cluster_detection_method="deactivate",
        )
    try:
        yield
    except Exception:
        if _lifelines:  # the end of another process may be the cause; then `watch_lifelines` says so
            time.sleep(1.0)
        raise


def meet(at: Position) -> int:
    """Connect process 0 with every other; returns the port that it has chosen for `jax.distributed`."""
    lines, port = meet_as_leader(at) if at.index == 0 else meet_as_follower(at)
    for line in lines.values():
        line.settimeout(None)
        line.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in KEEPALIVE.items():
            if hasattr(socket, name):  # not on every system
                line.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
    _lifelines.update(lines)
    return port


def meet_as_leader(at: Position) -> tuple[dict[int, socket.socket], int]:
    """Process 0's part of `meet`: wait for all others, then tell them the port."""
    lines: dict[int, socket.socket] = {}
    ends = time.monotonic() + PATIENCE
    try:
        with listen(at.port) as server:
            while len(lines) < at.count - 1:
                server.settimeout(max(0.01, ends - time.monotonic()))
                line = server.accept()[0]
                line.settimeout(5.0)
                match = re.fullmatch(r"(\d+) of (\d+)", greeting := read_line(line))
                if not match:  # something else that tries ports
                    line.close()
                elif int(match[2]) != at.count or int(match[1]) in (0, *lines):
                    problem = f"process {greeting} came, twice or to one of {at.count}"
                    for other in (*lines.values(), line):
                        other.sendall(f"{problem}\n".encode())
                    raise ConfigError(f"{at.coordinator}: {problem}")
                else:
                    lines[int(match[1])] = line
        with listen(0) as free:
            port = free.getsockname()[1]
        for line in lines.values():
            line.sendall(f"{port}\n".encode())
    except TimeoutError as error:
        missing = ", ".join(str(i) for i in range(1, at.count) if i not in lines)
        raise ConfigError(
            f"{at.coordinator}: process {missing} of {at.count} did not come in {PATIENCE:g} s; "
            "check that each runs and can reach this host, through any firewall"
        ) from error
    except OSError as error:
        raise ConfigError(f"{at.coordinator}: cannot listen there: {error.strerror}") from error
    return lines, port


def meet_as_follower(at: Position) -> tuple[dict[int, socket.socket], int]:
    """Another process's part of `meet`: reach process 0, which may start later, and wait for all."""
    ends = time.monotonic() + PATIENCE
    while True:
        try:
            line = socket.create_connection((at.host, at.port), PATIENCE)
            break
        except OSError as error:
            if time.monotonic() > ends:
                raise ConfigError(
                    f"{at.coordinator}: process {at.index} finds no process 0 there in "
                    f"{PATIENCE:g} s ({error.strerror}); check that it runs, that this is its host, "
                    "and that no firewall closes the port"
                ) from error
            time.sleep(0.2)
    line.sendall(f"{at.index} of {at.count}\n".encode())
    answer = read_line(line)
    if not answer.isdigit():
        raise ConfigError(f"{at.coordinator}: {answer or 'process 0 there does not answer'}")
    return {0: line}, int(answer)


def listen(port: int) -> socket.socket:
    if socket.has_dualstack_ipv6():
        return socket.create_server(("", port), family=socket.AF_INET6, dualstack_ipv6=True)
    return socket.create_server(("", port))


def read_line(line: socket.socket) -> str:
    with contextlib.suppress(OSError), line.makefile() as file:
        return file.readline(200).strip()
    return ""


def watch_lifelines() -> None:
    """End this process as soon as another has ended, unless all have left in order."""
    lines = {**_lifelines}
    ready = select.select([*lines.values()], [], [])[0][0]
    try:
        status = ready.recv(1)
    except OSError:
        status = b""
    with _leaving:  # else this thread waits here for the end
        if status == b"\0" or not _lifelines:
            return
        if not status:
            index = next(i for i, line in lines.items() if line is ready)
            line = f"error: process {index} has ended, and so this one; the last checkpoint stays\n"
            os.write(sys.stderr.fileno(), line.encode())  # at once: jax.distributed may notice too
        exit_all(status[0] if status else 1)


def exit_all(status: int) -> NoReturn:
    """End this process and, where several train together, the others too."""
    with _leaving:
        send_status(status)
        if 0 not in _lifelines:
            wait_for_their_end(FAREWELL)
        os._exit(status)


def wait_for_their_end(seconds: float) -> None:
    """Wait until every other process has closed its lifeline, for `seconds` at most."""
    ends = time.monotonic() + seconds
    for line in _lifelines.values():
        with contextlib.suppress(OSError):
            line.settimeout(max(0.01, ends - time.monotonic()))
            while line.recv(1):
                pass


def exit_all_if_joined(status: int) -> None:
    """`exit_all`, unless this process is alone. For an error, once it is reported."""
    if _lifelines:
        exit_all(status)


def send_status(status: int) -> None:
    for line in _lifelines.values():
        with contextlib.suppress(OSError):
            line.sendall(bytes([status]))


def part() -> None:
    """Part from the other processes when all have come this far; each goes on alone."""
    if _lifelines:
        jax.distributed.shutdown()
        send_status(0)
        _lifelines.clear()


# ---- values and arrays of all processes --------------------------------------------------------


def leads() -> bool:
    """Whether this process writes and speaks."""
    return jax.process_index() == 0


def from_process_0(tree: PyTree) -> PyTree:
    """`tree`, of NumPy arrays, as process 0 has it. Everywhere it has the same shapes."""
    return tree if jax.process_count() == 1 else multihost_utils.broadcast_one_to_all(tree)


def text_from_process_0(text: str) -> str:
    data = np.frombuffer(text.encode(), np.uint8)
    size = int(from_process_0(np.array(len(data))))
    return bytes(from_process_0(np.resize(data, size))).decode()


def place(tree: PyTree, sharding: Sharding) -> PyTree:
    """`tree`, which every process holds whole, over the devices of all."""
    if jax.process_count() == 1:
        return jax.device_put(tree, sharding)

    def put(x: Any) -> jax.Array:
        if isinstance(x, jax.Array) and not x.is_fully_addressable:
            return x  # there already
        if checkpoint.is_key(x):
            return jax.jit(jax.random.wrap_key_data)(put(jax.random.key_data(x)))
        x = np.asarray(x)
        return jax.make_array_from_callback(x.shape, sharding, x.__getitem__)

    return jax.tree.map(put, tree)


def identity(x: PyTree) -> PyTree:
    return x


def whole(tree: PyTree) -> PyTree:
    """The inverse of `place`, with each array on one of this process's devices. Does not wait."""
    if jax.process_count() == 1:
        return tree

    def replicated(x: jax.Array) -> Sharding:
        assert isinstance(x.sharding, NamedSharding)
        return NamedSharding(x.sharding.mesh, PartitionSpec())

    everywhere = jax.jit(identity, out_shardings=jax.tree.map(replicated, tree))(tree)
    return jax.tree.map(lambda x: x.addressable_data(0), everywhere)


class Vote:
    """What any process wishes. Asked once an iteration, by all; an answer takes until the next one,
    so that no device waits for the hosts. A lone process has it at once."""

    def __init__(self, sharding: Sharding):
        self.sharding = sharding
        self.counted: Any = None

    def __call__(self, *wishes: bool) -> tuple[bool, ...]:
        if jax.process_count() == 1:
            return wishes
        mine = np.array([wishes] * jax.local_device_count())
        cast = whole(jax.make_array_from_process_local_data(self.sharding, mine))
        known, self.counted = self.counted, cast
        return tuple(np.any(known, axis=0).tolist()) if known is not None else (False,) * len(wishes)
