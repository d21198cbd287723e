"""A ROS node beside the program's own loop."""

import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from rclpy.context import Context
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

# How long a thread keeps Python to itself, s: callbacks and the program's own loop take turns many
# times a control step, and would hand over after 5 ms each time.
SWITCH_INTERVAL = 0.0005
LOOKED_UP = 0.05  # s after which it looks up from waiting, to see whether it is to end


class Spinning:
    """A node whose callbacks run in a thread of their own, in a context of its own.

    It waits for its subscriptions by itself: rclpy's executor gathers all that could call back, and
    makes a task of every callback, in Python. From sample to command that took twice as long at the
    99th percentile; its `EventsExecutor` hung.

    Attributes:
        node: The node.

    Args:
        name: Name of the node.
    """

    def __init__(self, name: str) -> None:
        self._context = Context()
        self._context.init(args=[])
        self.node = Node(
            name, context=self._context, start_parameter_services=False, enable_rosout=False
        )
        self._heard: list[tuple[Subscription[Any], Callable[[Any], None]]] = []
        self._period, self._tick = LOOKED_UP, lambda: None  # type: float, Callable[[], None]
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._spin, name=name, daemon=True)

    def listen(
        self, kind: type, name: str, callback: Callable[[Any], None], profile: QoSProfile
    ) -> None:
        """Call back with every message of a topic; before `start`."""
        heard = self.node.create_subscription(kind, name, callback, profile)
        self._heard.append((heard, callback))

    def every(self, period: float, tick: Callable[[], None]) -> None:
        """Call back once a period, s; before `start`."""
        self._period, self._tick = period, tick

    def start(self) -> None:
        """Begin to call back."""
        sys.setswitchinterval(SWITCH_INTERVAL)
        if self._heard:
            self._thread.start()

    def close(self) -> None:
        """Leave ROS."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join()
        self.node.destroy_node()
        self._context.try_shutdown()

    def _spin(self) -> None:
        assert self._context.handle is not None  # it was initialised
        counts = len(self._heard), 0, 0, 0, 0, 0  # no guards, timers, clients, services, events
        waiting = rclpy_implementation.WaitSet(*counts, self._context.handle)
        due = time.monotonic() + self._period
        while not self._ending.is_set():
            waiting.clear_entities()
            for heard, _ in self._heard:
                waiting.add_subscription(heard.handle)
            waiting.wait(round(1e9 * max(0.0, due - time.monotonic())))
            for number, (heard, callback) in enumerate(self._heard):
                if waiting.is_ready("subscription", number):
                    taken = heard.handle.take_message(heard.msg_type, heard.raw)
                    if taken is not None:
                        callback(taken[0])
            if (now := time.monotonic()) >= due:
                self._tick()
                due = now + self._period
