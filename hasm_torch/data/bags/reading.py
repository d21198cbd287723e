"""Messages of a bag's topics, in blocks of one layout, with their times."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hasm_torch.data.bags.decode import Leaf, decode
from hasm_torch.data.bags.messages import typestore

CHUNK = 4096  # messages that are decoded at once: some 20 MB of a skin of 54 cells
STAMP = ("header.stamp.sec", "header.stamp.nanosec")


class Heard(NamedTuple):
    """Messages of one topic.

    Attributes:
        topic: Its name.
        times: (n,) when they came, ns.
        fields: Their wanted fields, by path.
    """

    topic: str
    times: NDArray[np.int64]
    fields: dict[str, list[Leaf]]


class Bag:
    """A ROS 1 bag, a ROS 2 bag (sqlite3 or MCAP; its folder or one file of it), or an MCAP file.

    Used as a context manager.

    Args:
        path: The bag.
        stamped: Times are those in the messages' headers, where there are any; else when the bag
            received them.

    Attributes:
        topics: Type of each topic.

    Raises:
        FileNotFoundError: There is no bag.
        ImportError: ``rosbags`` is not installed.
        ValueError: It cannot be read.
    """

    def __init__(self, path: Path, stamped: bool = False) -> None:
        try:
            from rosbags.highlevel import AnyReader, AnyReaderError
        except ImportError as error:
            raise ImportError(
                'reading bags needs the package rosbags: pip install "hasm-torch[ros]"'
            ) from error
        if not path.exists():
            raise FileNotFoundError(f"no bag {path}: expected a .bag, an .mcap or a bag's folder")
        self._stack = ExitStack()
        try:
            self._reader = self._stack.enter_context(
                AnyReader([path], default_typestore=typestore())
            )
        except (AnyReaderError, AssertionError, KeyError) as error:
            raise ValueError(f"{path} is no bag that can be read: {error}") from error
        self.path, self._stamped = path, stamped
        self.topics = {c.topic: c.msgtype for c in self._reader.connections}

    def __enter__(self) -> "Bag":
        return self

    def __exit__(self, *_error: object) -> None:
        self._stack.close()

    def type_of(self, topic: str) -> str:
        """Type of a topic's messages.

        Raises:
            ValueError: There is no such topic.
        """
        if topic not in self.topics:
            known = "".join(f"\n  {name}  {kind}" for name, kind in sorted(self.topics.items()))
            raise ValueError(f"{self.path} has no topic {topic!r}; its topics:{known or ' none'}")
        return self.topics[topic]

    def read(self, wanted: Mapping[str, set[str]]) -> Iterator[Heard]:
        """The messages of some topics.

        Args:
            wanted: Paths of the wanted fields of each topic.

        Yields:
            Messages of one topic and layout, in no order.
        """
        waiting: dict[str, tuple[list[int], list[bytes]]] = {topic: ([], []) for topic in wanted}
        mine = [c for c in self._reader.connections if c.topic in wanted]
        for connection, time, data in self._reader.messages(mine):
            times, messages = waiting[connection.topic]
            times.append(time)
            messages.append(data)
            if len(times) == CHUNK:
                yield from self._decoded(connection.topic, times, messages, wanted)
                waiting[connection.topic] = ([], [])
        for topic, (times, messages) in waiting.items():
            yield from self._decoded(topic, times, messages, wanted)

    def _decoded(
        self, topic: str, times: list[int], messages: list[Any], wanted: Mapping[str, set[str]]
    ) -> Iterator[Heard]:
        received = np.array(times, np.int64)
        paths = wanted[topic] | (set(STAMP) if self._stamped else set())
        definitions = self._reader.typestore.fielddefs
        try:
            for rows, fields in decode(
                messages, self.type_of(topic), definitions, paths, self._reader.is2
            ):
                came, stamp = received[rows], [fields.get(path) for path in STAMP]
                if stamp[0] and stamp[1]:
                    seconds, nanoseconds = (s[0].values[:, 0].astype(np.int64) for s in stamp if s)
                    came = seconds * 10**9 + nanoseconds
                yield Heard(topic, came, fields)
        except ValueError as error:
            raise ValueError(f"{self.path}, topic {topic}: {error}") from error
