"""The simulated HSR as a ROS node: it publishes what an HSR publishes and obeys its commands.

    HSRTouchEnv ──joint states, skin, object──► topics ──► whoever drives the robot
         ▲                                                           │
         └────── joint targets ◄── trajectories, base twist ◄────────┘

A finger pushes where ``<prefix>/push`` says: a ``std_msgs/Float32MultiArray`` of the number of a
patch in the order of ``Skin``, the force in N (0 lets go) and, if wanted, the cell.
"""

import threading
import time
from functools import partial
from typing import Any

import numpy as np
import torch
from geometry_msgs.msg import PointStamped, Twist
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32MultiArray
from torch import Tensor
from trajectory_msgs.msg import JointTrajectory

from hasm_torch.robot import BASE_FRAME
from hasm_torch.ros import topics
from hasm_torch.ros.spinning import Spinning
from hasm_torch.sim.env import CONTROL_RATE, LARGEST_FORCE, HSRTouchEnv
from hasm_torch.sim.scene import FINGERS

Array = NDArray[np.float64]

PERIOD = 1 / CONTROL_RATE  # s
TWIST_LASTS = 0.2  # s without a new one, after which the base stops
PATIENCE = 0.5  # s, how long the simulation waits for a command where it waits
ARM = "arm_trajectory"  # the last of the commands of a control step
Touches = dict[str, tuple[float, int | None]]


class SimulatedHSR:
    """A policy that lies across ROS: it publishes what is read and returns what was commanded.

    Rolled out in a simulation like any other policy, it makes that simulation an HSR on ROS.

    Attributes:
        latencies: Time from the moment in which a sample begins to be published until the arm's
            next trajectory arrives, s; infinite where none comes before the next sample.

    Args:
        sim: The simulation.
        prefix: Before all topics.
        waits: Whether time stands still until the robot is commanded; otherwise it is real time.
    """

    def __init__(self, sim: HSRTouchEnv, prefix: str = "/hsrb", waits: bool = False) -> None:
        self._sim, self._waits, self._prefix = sim, waits, prefix
        self._spinning = Spinning("simulated_hsr")
        self._arrived = threading.Condition()  # holds all that callbacks change
        self._pushes: Touches = {}
        self.latencies: list[float] = []
        self._due = time.perf_counter()
        self._time = 0.0
        self.reset()
        self._advertise(prefix)
        self._listen(prefix)
        self._spinning.start()

    @property
    def pushes(self) -> Touches:
        """Force, N, and cell of every patch that is to be pushed."""
        with self._arrived:
            return dict(self._pushes)

    @property
    def found(self) -> bool:
        """Whether someone listens to it and drives it."""
        heard = (self._skin, self._joints)
        name = topics.topic(self._prefix, f"{ARM}_controller", "command")
        listened = all(offered.get_subscription_count() for offered in heard)
        return listened and self._spinning.node.count_publishers(name) > 0

    def reset(self) -> None:
        """The robot was put elsewhere: it stays there until commanded."""
        with self._arrived:
            self._target: Array | None = None
            self._speed: Array = np.zeros(3)  # x and y ahead and to the left, turning left
            self._driven_until = -np.inf
            self._sampled: float | None = None  # when the last sample was published

    def step(self, state: Tensor, skin: Tensor, *, observation: Tensor | None = None) -> Tensor:
        """Publish a sample, and give the robot its time to answer.

        Args:
            state: (J,) positions of ``JOINTS``, rad or m.
            skin: (C, 3) or flat, forces of all cells, N.
            observation: (3,) centre of the object in the base frame, m.

        Returns:
            (J,) float32 joint targets.
        """
        if not self._waits:
            self._pause()
        measured = state.numpy().astype(np.float64)
        with self._arrived:
            if self._target is None:
                self._target = measured.copy()
            if self._sampled is not None:
                self.latencies.append(np.inf)
            self._sampled = time.perf_counter()
        self._publish(measured, skin.numpy().reshape(-1, 3), observation)
        with self._arrived:
            patience = PATIENCE if self._waits else max(0.0, self._due - time.perf_counter())
            self._arrived.wait_for(lambda: self._waits and self._sampled is None, patience)
            self._drive(float(measured[topics.BASE[2]]))
            return torch.from_numpy(self._target.astype(np.float32))

    def close(self) -> None:
        """Leave ROS."""
        self._spinning.close()

    def _pause(self) -> None:
        """Wait for the next control step; steps that were missed are not made up for."""
        now = time.perf_counter()
        if now < self._due:
            time.sleep(self._due - now)
        self._due = max(self._due, time.perf_counter() - PERIOD) + PERIOD

    def _drive(self, yaw: float) -> None:
        """Move the base's target by its speed."""
        assert self._target is not None
        if not self._waits and time.perf_counter() > self._driven_until:
            self._speed = np.zeros(3)
        ahead, left, turn = self._speed * PERIOD
        cos, sin = np.cos(yaw), np.sin(yaw)
        self._target[topics.BASE] += cos * ahead - sin * left, sin * ahead + cos * left, turn

    def _publish(self, state: Array, forces: Array, observation: Tensor | None) -> None:
        self._skin.publish(topics.skin_message(forces.astype(np.float32)))
        if observation is not None:
            message = PointStamped()
            message.header.frame_id = BASE_FRAME
            point = message.point
            point.x, point.y, point.z = (float(x) for x in observation)
            self._object.publish(message)
        velocity = self._sim.joint_velocity
        self._joints.publish(topics.joint_state(state, velocity, self._time))
        self._time += PERIOD

    def _take_trajectory(self, controller: str, message: JointTrajectory) -> None:
        with self._arrived:
            if self._target is None:
                return
            for joint, position in topics.goals(message).items():
                if np.isfinite(position):
                    self._target[joint] = position
            if controller == ARM and self._sampled is not None:
                self.latencies.append(time.perf_counter() - self._sampled)
                self._sampled = None
                self._arrived.notify_all()

    def _take_twist(self, message: Twist) -> None:
        with self._arrived:
            self._speed = np.array([message.linear.x, message.linear.y, message.angular.z])
            self._driven_until = time.perf_counter() + TWIST_LASTS

    def _take_push(self, message: Float32MultiArray) -> None:
        number, force, *cell = (*message.data, 0.0, 0.0)[: max(2, len(message.data))]
        patch = self._sim.skin.patches[int(number) % len(self._sim.skin.patches)]
        with self._arrived:
            self._pushes.pop(patch, None)
            if 0.0 < force <= LARGEST_FORCE and len(self._pushes) < len(FINGERS):
                self._pushes[patch] = float(force), int(cell[0]) if cell else None

    def _advertise(self, prefix: str) -> None:
        def offer(kind: type, *parts: str) -> Any:
            name = topics.topic(prefix, *parts)
            return self._spinning.node.create_publisher(kind, name, topics.COMMAND)

        self._skin = offer(Float32MultiArray, "skin")
        self._object = offer(PointStamped, "object")
        self._joints = offer(JointState, "joint_states")

    def _listen(self, prefix: str) -> None:
        def listen(kind: type, callback: Any, *parts: str) -> None:
            name = topics.topic(prefix, *parts)
            self._spinning.listen(kind, name, callback, topics.COMMAND)

        for controller in topics.CONTROLLERS:
            callback = partial(self._take_trajectory, controller)
            listen(JointTrajectory, callback, f"{controller}_controller", "command")
        listen(Twist, self._take_twist, "command_velocity")
        listen(Float32MultiArray, self._take_push, "push")
