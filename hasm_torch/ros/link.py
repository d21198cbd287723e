"""The HSR over ROS 2: what it reads, and what it is told through a ``Guard``.

    joint_states, skin, object ──callbacks──► newest readings ──observe──► caller
    caller ──command──► Guard ──► arm, head, gripper trajectories, base twist

In a dry run there is not even a publisher: what would be sent is computed and logged.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import PointStamped, Twist
from numpy.typing import NDArray
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_msgs.msg import Empty, Float32MultiArray
from trajectory_msgs.msg import JointTrajectory

from hasm_torch._assets import asset_path
from hasm_torch.robot import JOINTS, Skin
from hasm_torch.robot.urdf import read_urdf
from hasm_torch.ros import topics
from hasm_torch.ros.safety import Guard, Limits, Mode, Order, SafetyConfig, planar_twist
from hasm_torch.ros.spinning import Spinning
from hasm_torch.sim.scene import joint_speed_limits

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

log = logging.getLogger(__name__)

LOGGED_EVERY = 50  # orders of a dry run
SKIN, OBJECT = "skin", "object"


@dataclass(frozen=True)
class LinkConfig:
    """Which HSR, and what may be done to it.

    Attributes:
        prefix: Before all its topics: "/hsrb", or "" on newer stacks.
        dry_run: Whether nothing is sent, only computed and logged.
        base: Whether the mobile base is read, as ``odom_x``, ``odom_y``, ``odom_t`` among the joint
            states, and driven. Otherwise it is taken to stand at 0.
        object: Whether the place of an object is read.
        sim_time: Whether time is that of the joint states' stamps, for a simulation that waits for
            the robot's commands.
        safety: When the robot is held and stopped.
    """

    prefix: str = "/hsrb"
    dry_run: bool = True
    base: bool = True
    object: bool = False
    sim_time: bool = False
    safety: SafetyConfig = field(default_factory=SafetyConfig)


class Reading(NamedTuple):
    """What was read last.

    Attributes:
        state: (J,) positions of ``JOINTS``, rad or m.
        skin: (C, 3) forces of all cells, N; NaN for a cell that did not report.
        object: (3,) centre of the object in the base frame, m, or None.
        new: Whether all of it came since the last reading.
    """

    state: Floats
    skin: Floats
    object: Floats | None
    new: bool


def hsr_limits() -> Limits:
    """Limits of the HSR's ``JOINTS`` in its URDF; the base has speed limits only."""
    joints = read_urdf(asset_path("hsr.urdf")).joints
    lower, upper = np.array([(joints[name].lower, joints[name].upper) for name in JOINTS]).T
    return Limits(JOINTS, lower, upper, joint_speed_limits())


class HSRLink:
    """A connection to an HSR; close it at the end.

    Args:
        config: Which HSR.
    """

    def __init__(self, config: LinkConfig) -> None:
        self.config = config
        self._skin = Skin.load()
        self._bound = (OBJECT,) if config.object else ()
        self._guard = Guard(hsr_limits(), (*self._skin.patches, *self._bound), config.safety)
        self._changed = threading.Condition()  # holds guard and readings together
        self._forces = np.zeros((self._skin.cells, 3), np.float32)
        self._object: Floats = np.zeros(3, np.float32)
        self._stamp, self._orders, self._said = 0.0, 0, (Mode.WAITING, "")
        self._expected = {"joint_states", SKIN, *self._bound}
        self._new: set[str] = set()
        self._spinning = Spinning("hasm_hsr")
        self._subscribe()
        self._trajectories: dict[str, Publisher] = {}
        self._twist: Publisher | None = None
        if not config.dry_run:
            self._advertise()
        self._spinning.every(1 / config.safety.rate, self._watch)
        self._spinning.start()

    # ---- What the caller does.

    def wait(self, timeout: float) -> Reading:
        """Wait until everything was read.

        Args:
            timeout: s.

        Raises:
            TimeoutError: If something was not; the message names it.
        """
        with self._changed:
            ready = self._changed.wait_for(lambda: not self._guard.missing(self._now()), timeout)
            if not ready:
                missing = ", ".join(self._guard.missing(self._now()))
                raise TimeoutError(
                    f"no new readings of {missing} within {timeout:g} s: is the robot there, with "
                    f"the prefix {self.config.prefix!r}, and ROS_DOMAIN_ID the same?"
                )
        return self.observe(0.0)

    def observe(self, timeout: float) -> Reading:
        """The newest readings, once all of them are newer than those of the last call.

        Args:
            timeout: How long to wait for that, s; then the last ones come again.
        """
        with self._changed:
            new = self._changed.wait_for(lambda: self._new >= self._expected, timeout)
            self._new.clear()
            state = self._guard.position.astype(np.float32)
            seen = self._object.copy() if self._bound else None
            return Reading(state, self._forces.copy(), seen, new)

    def command(self, target: NDArray[np.floating]) -> Array:
        """Send joints where they shall be, as far as that is safe.

        Args:
            target: (J,) targets of ``JOINTS``, rad or m.

        Returns:
            (J,) what was sent, or would be in a dry run; NaN where nothing may be sent.

        Raises:
            ValueError: If the target has another shape.
        """
        wanted = np.array(target, dtype=np.float64)
        if wanted.shape != (len(JOINTS),):
            raise ValueError(f"target must have shape ({len(JOINTS)},), got {wanted.shape}")
        if not self.config.base:
            wanted[topics.BASE] = np.nan
        with self._changed:
            order = self._guard.command(wanted, self._now())
            self._send(order)
        return np.full(len(JOINTS), np.nan) if order.position is None else order.position

    def emergency_stop(self, why: str = "asked for by the program") -> None:
        """Send nothing more and stop the base, until released."""
        with self._changed:
            self._guard.stop(why)
            order = self._guard.check(self._now())
            assert order is not None  # an emergency always has one
            self._send(order)

    def release(self) -> None:
        """End an emergency stop."""
        with self._changed:
            self._guard.release()
            self._say()

    def reset(self) -> None:
        """Forget what was read and sent, where the robot was put elsewhere."""
        with self._changed:
            self._guard.reset()
            self._new.clear()

    @property
    def mode(self) -> Mode:
        """What the robot is allowed to do."""
        return self._guard.mode

    @property
    def why(self) -> str:
        """Why it is not driven, in words."""
        return self._guard.why

    def close(self) -> None:
        """Stop the base and leave."""
        with self._changed:
            if self._twist is not None:
                self._twist.publish(Twist())
        self._spinning.close()

    # ---- Callbacks, in a thread of their own.

    def _take_joints(self, message: JointState) -> None:
        position = topics.positions(message)
        if not self.config.base:
            position[topics.BASE] = 0.0
        with self._changed:
            self._stamp = topics.stamp(message)
            named = np.isfinite(position)
            refused = named & ~self._guard.take_joints(position, self._now())
            if refused.any():
                joints = ", ".join(JOINTS[j] for j in np.flatnonzero(refused))
                log.warning("readings that no joint could have reached: %s", joints)
            self._took("joint_states")

    def _take_skin(self, message: Float32MultiArray) -> None:
        forces = np.array(message.data, dtype=np.float32)
        if forces.size != self._forces.size:
            log.warning("skin: expected %d forces, got %d", self._forces.size, forces.size)
            return
        forces[~np.isfinite(forces)] = np.nan
        forces = forces.reshape(-1, 3)
        with self._changed:
            for number, cells in enumerate(self._skin.slices.values()):
                if not np.isnan(forces[cells]).all():
                    self._forces[cells] = forces[cells]
                    self._guard.take_skin(number, self._now())
            self._took(SKIN)

    def _take_object(self, message: PointStamped) -> None:
        place = np.array([message.point.x, message.point.y, message.point.z], dtype=np.float32)
        if not np.isfinite(place).all():
            return
        with self._changed:
            self._object = place
            self._guard.take_skin(len(self._skin.patches), self._now())
            self._took(OBJECT)

    def _took(self, what: str) -> None:
        self._new.add(what)
        if self._new >= self._expected:
            self._changed.notify_all()

    def _watch(self) -> None:
        with self._changed:
            order = self._guard.check(self._now())
            if order is not None:
                self._send(order)

    # ---- What is sent.

    def _now(self) -> float:
        return self._stamp if self.config.sim_time else time.monotonic()

    def _send(self, order: Order) -> None:
        self._say()
        if self.config.dry_run:
            if self._orders % LOGGED_EVERY == 0 and order.position is not None:
                log.info("dry run, would send %s", np.round(order.position, 3).tolist())
            self._orders += 1
            return
        if order.position is not None and self._twist is not None:
            self._drive(order)
            for controller, publisher in self._trajectories.items():
                joints = topics.CONTROLLERS[controller]
                position = order.position[[JOINTS.index(joint) for joint in joints]]
                seconds = 1 / self.config.safety.rate
                publisher.publish(topics.trajectory(joints, position, seconds))
        elif order.mode is not Mode.WAITING:
            self._drive(order)

    def _drive(self, order: Order) -> None:
        if self._twist is not None and self.config.base:
            speed, yaw = order.speed[topics.BASE], float(self._guard.position[topics.BASE[2]])
            driven = planar_twist(speed, yaw) if speed.any() else (0.0, 0.0, 0.0)
            self._twist.publish(topics.twist(*driven))

    def _say(self) -> None:
        """Log what changed."""
        now = self._guard.mode, self._guard.why
        if now != self._said:
            log.warning("%s%s", now[0].value, f": {now[1]}" if now[1] else "")
        self._said = now

    def _subscribe(self) -> None:
        def listen(kind: type, callback: Callable[..., None], *parts: str) -> None:
            name = topics.topic(self.config.prefix, *parts)
            profile = topics.COMMAND if kind is Empty else topics.SENSOR
            self._spinning.listen(kind, name, callback, profile)

        listen(JointState, self._take_joints, "joint_states")
        listen(Float32MultiArray, self._take_skin, SKIN)
        if self.config.object:
            listen(PointStamped, self._take_object, OBJECT)
        listen(Empty, lambda _: self.emergency_stop("asked for by topic"), "hasm", "emergency_stop")
        listen(Empty, lambda _: self.release(), "hasm", "release")

    def _advertise(self) -> None:
        node, prefix = self._spinning.node, self.config.prefix
        name = topics.topic(prefix, "command_velocity")
        self._twist = node.create_publisher(Twist, name, topics.COMMAND)
        for controller in topics.CONTROLLERS:
            name = topics.topic(prefix, f"{controller}_controller", "command")
            publisher = node.create_publisher(JointTrajectory, name, topics.COMMAND)
            self._trajectories[controller] = publisher
