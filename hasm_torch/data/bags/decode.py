"""Many serialised messages at once: one message says where its fields lie, arrays hold all.

A message of 54 skin cells has some 380 fields; made into objects one by one, 10 minutes of them at
250 Hz take a minute. Messages of one type whose sequences and strings are of the same lengths have
their fields at the same places, so one of them is walked through and the others are sliced.
"""

import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_NUMBERS = {
    "bool": "u1", "byte": "u1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "i2",
    "uint16": "u2", "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8",
    "float32": "f4", "float64": "f8",
}  # fmt: skip


class Leaf(NamedTuple):
    """One array of a message's numbers, or a string, in all messages of a block.

    Attributes:
        where: Numbers of the elements that lead to it, one for each list of messages in its path.
        values: (n, count) numbers, or (n, 1) bytes of a string.
    """

    where: tuple[int, ...]
    values: NDArray[Any]


class Block(NamedTuple):
    """Messages of one layout.

    Attributes:
        rows: (n,) which of the messages they are.
        fields: Their wanted fields, by the path of names.
    """

    rows: NDArray[np.int64]
    fields: dict[str, list[Leaf]]


def decode(
    messages: Sequence[bytes],
    message_type: str,
    definitions: Mapping[str, Any],
    wanted: Collection[str],
    cdr: bool,
) -> Iterator[Block]:
    """Wanted fields of messages of one type.

    Args:
        messages: As the bag holds them.
        message_type: Name of their type, such as ``sensor_msgs/msg/JointState``.
        definitions: Fields of every type, as in the ``fielddefs`` of a ``rosbags`` typestore.
        wanted: Paths of names, such as ``header.stamp.sec``.
        cdr: The messages are of ROS 2; else of ROS 1.

    Yields:
        Blocks that hold each message once, in no order.

    Raises:
        ValueError: A message does not fit its type.
    """
    sizes = np.fromiter(map(len, messages), np.int64, len(messages))
    for size in np.unique(sizes).tolist():
        rows = np.flatnonzero(sizes == size)
        block = np.frombuffer(b"".join(messages[row] for row in rows), np.uint8)
        block = block.reshape(len(rows), size)
        while len(rows):
            layout = _Layout(block[0].tobytes(), definitions, cdr)
            layout.message(message_type, "", ())
            if layout.position > size or not size:
                raise ValueError(f"a message of {size} bytes is no {message_type}: it ends early")
            same = (block[:, layout.fixed] == block[0, layout.fixed]).all(axis=1)
            mine = block if same.all() else block[same]
            fields: dict[str, list[Leaf]] = {path: [] for path in wanted}
            for path, where, start, kind, count in layout.leaves:
                if path in fields:
                    length = count * np.dtype(kind).itemsize
                    values = np.ascontiguousarray(mine[:, start : start + length]).view(kind)
                    if kind[0] == "S" and not count:
                        values = np.zeros((len(mine), 1), kind)
                    fields[path].append(Leaf(where, values))
            yield Block(rows[same], fields)
            rows, block = rows[~same], block[~same]


class _Layout:
    """Where the fields of a message lie; walked through by ``message``."""

    def __init__(self, data: bytes, definitions: Mapping[str, Any], cdr: bool) -> None:
        self.data, self.definitions, self.cdr = data, definitions, cdr
        self.order = ">" if cdr and len(data) > 1 and data[1] % 2 == 0 else "<"
        self.position = 4 if cdr else 0
        self.fixed = list(range(self.position))  # bytes that make the layout what it is
        self.leaves: list[tuple[str, tuple[int, ...], int, str, int]] = []

    def message(self, name: str, path: str, where: tuple[int, ...]) -> None:
        for field, (node, content) in self.definitions[name][1]:
            self._field(int(node), content, f"{path}.{field}" if path else field, where)

    def _field(self, node: int, content: Any, path: str, where: tuple[int, ...]) -> None:
        from rosbags.interfaces import Nodetype

        if node == Nodetype.NAME:
            self.message(content, path, where)
        elif node == Nodetype.BASE:
            self._base(content[0], 1, path, where)
        else:
            (element, inner), count = content
            if node == Nodetype.SEQUENCE:
                count = self._length()
            if element == Nodetype.BASE and inner[0] in _NUMBERS:
                self._base(inner[0], count, path, where)
            else:
                for number in range(count):
                    if self.position > len(self.data):
                        raise ValueError(f"a message of {len(self.data)} bytes ends early")
                    self._field(int(element), inner, path, (*where, number))

    def _base(self, name: str, count: int, path: str, where: tuple[int, ...]) -> None:
        if name == "string":
            length = self._length()
            kind = f"S{max(length, 1)}"
            self.leaves.append((path, where, self.position, kind, int(length > 0)))
            self.position += length
            return
        if name not in _NUMBERS:
            raise ValueError(f"expected numbers and strings, got {name} in {path}")
        kind = self.order + _NUMBERS[name]
        size = int(kind[-1])
        if count:
            self._align(size)
        self.leaves.append((path, where, self.position, kind, count))
        self.position += size * count

    def _length(self) -> int:
        self._align(4)
        start = self.position
        self.position += 4
        if self.position > len(self.data):
            raise ValueError(f"a message of {len(self.data)} bytes ends early")
        self.fixed += range(start, self.position)
        return struct.unpack_from(f"{self.order}I", self.data, start)[0]

    def _align(self, size: int) -> None:
        if self.cdr:  # counted from behind the four bytes that come first
            self.position += -(self.position - 4) % size
