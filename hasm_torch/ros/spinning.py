"""A ROS node beside the program's own loop."""

import contextlib
import sys
import threading

from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

# How long a thread keeps Python to itself, s: callbacks and the program's own loop take turns many
# times a control step, and would hand over after 5 ms each time.
SWITCH_INTERVAL = 0.0005


class Spinning:
    """A node whose callbacks run in a thread of their own, in a context of its own.

    Attributes:
        node: The node.

    Args:
        name: Name of the node.
    """

    def __init__(self, name: str) -> None:
        self._context = Context()
        self._context.init(args=[])
        # Without services and log topic: every callback looks through all that may call back.
        self.node = Node(
            name, context=self._context, start_parameter_services=False, enable_rosout=False
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, name=name, daemon=True)

    def start(self) -> None:
        """Begin to call back."""
        sys.setswitchinterval(SWITCH_INTERVAL)
        self._thread.start()

    def close(self) -> None:
        """Leave ROS."""
        self._context.try_shutdown()
        if self._thread.is_alive():
            self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()

    def _spin(self) -> None:
        with contextlib.suppress(ExternalShutdownException):
            self._executor.spin()
