"""The simulated HSR in a process of its own, on a ROS domain of its own, loopback only."""

import os
import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from std_msgs.msg import Empty, Float32MultiArray

from hasm_torch.ros import topics
from hasm_torch.ros.spinning import Spinning

PREFIX = "/robot"


def alone(monkeypatch) -> None:
    """Find no other ROS, and be found by none."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(random.SystemRandom().randint(1, 101)))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


@contextmanager
def simulated() -> Iterator[subprocess.Popen]:
    command = [sys.executable, "-m", "hasm_torch.apps.simulated_hsr", f"--prefix={PREFIX}"]
    process = subprocess.Popen(command, env=dict(os.environ), stdout=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(20)


class Outsider:
    """Who pushes the robot and presses its emergency button, from another ROS node."""

    def __init__(self) -> None:
        self.spinning = Spinning("outsider")
        offer = self.spinning.node.create_publisher
        name = topics.topic(PREFIX, "push")
        self._push = offer(Float32MultiArray, name, topics.COMMAND)
        name = topics.topic(PREFIX, "hasm", "emergency_stop")
        self._button = offer(Empty, name, topics.COMMAND)

    def push(self, force: float, patch: int = 0, cell: int = 2) -> None:
        self._push.publish(Float32MultiArray(data=[float(patch), float(force), float(cell)]))

    def press(self) -> None:
        self._button.publish(Empty())

    def close(self) -> None:
        self.spinning.close()


def until(condition: Callable[[], bool], seconds: float, meanwhile: Callable[[], object]) -> bool:
    """Do something until a condition holds; whether it does in time."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        meanwhile()
    return True
