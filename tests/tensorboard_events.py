"""What a file of TensorBoard holds."""

import struct
from pathlib import Path

from tensorboardX.proto import event_pb2


def tags(path: Path) -> set[str]:
    """The names of all scalars."""
    data, at, found = path.read_bytes(), 0, set()
    while at < len(data):
        (size,) = struct.unpack_from("<Q", data, at)
        event = event_pb2.Event.FromString(data[at + 12 : at + 12 + size])  # type: ignore[attr-defined]
        found |= {value.tag for value in event.summary.value}
        at += size + 16  # the length, its checksum and the data's
    return found
