"""Guiding by hand: the robot goes where a person drags its gripper or sets a joint.

grabbed point, where it shall be ──damped least squares──┐
joint, where it shall be ────────────────────────────────┴─► joint speeds ──limits──► target
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

from hasm_torch.robot import JOINTS
from hasm_torch.sim.env import HSRTouchEnv
from hasm_torch.sim.tasks import ARM_JOINTS, BASE_JOINTS
from hasm_torch.sim.teacher import Teacher, damped_least_squares

Array = NDArray[np.float64]

PULL = 4.0  # 1/s: a grabbed point is a quarter of a second behind the hand that drags it
FASTEST = 0.3  # m/s of the grabbed point
SLIDE = 8.0  # 1/s, of a joint to where its slider is
REACHED = 0.004  # rad or m from where the slider is
_END = 0.003  # rad or m: nearer to an end of its range than this a joint is at it
REACH = 5.0  # m from the base: no one drags a gripper farther


class HandGuide(Teacher):
    """A person who moves the robot: a teacher whose law is where it is dragged.

    Attributes:
        base: Whether the mobile base goes along when the gripper is dragged.
    """

    def __init__(self, env: HSRTouchEnv) -> None:
        self._dofs = np.array([int(env.model.joint(name).dofadr[0]) for name in JOINTS])
        self._arm = np.isin(JOINTS, ARM_JOINTS)
        self._whole = self._arm | np.isin(JOINTS, BASE_JOINTS)
        self.base = False
        super().__init__(env)

    def reset(self) -> None:
        """Let go of the robot and start from where it is."""
        self.start_here()
        self._body = 0
        self._local: Array = np.zeros(3)
        self._goal: Array = np.zeros(3)
        self._grabbed = False
        self._slid: dict[int, float] = {}

    def start_here(self) -> None:
        """Lead on from where the robot is, whatever it was asked for before."""
        super().reset()

    @property
    def active(self) -> bool:
        """Whether the person holds the robot."""
        return self._grabbed or bool(self._slid)

    @property
    def slid(self) -> set[int]:
        """Joints on their way to where their sliders are."""
        return set(self._slid)

    def grab(self, body: str, point: Array) -> None:
        """Take hold of a point of a body.

        Args:
            body: Name of the body.
            point: (3,) the point in `odom`, m.

        Raises:
            ValueError: The point is none.
        """
        link = self.env.data.body(body)
        self._body = int(self.env.model.body(body).id)
        self._goal = self._checked(point)
        self._local = link.xmat.reshape(3, 3).T @ (self._goal - link.xpos)
        self._grabbed = True

    def drag(self, point: Array) -> None:
        """Pull the grabbed point to another place, (3,) in `odom`, m.

        Raises:
            ValueError: The place is none, or far beyond reach.
        """
        if self._grabbed:
            self._goal = self._checked(point)

    def let_go(self) -> None:
        """Let go of the grabbed point; joints go on to where their sliders are."""
        self._grabbed = False

    def slide(self, joint: str, position: float) -> None:
        """Move a joint to a position, rad or m; beyond its limits it stops there.

        Raises:
            ValueError: The joint does not exist or the position is not finite.
        """
        if joint not in JOINTS or not np.isfinite(position):
            raise ValueError(f"expected a position of one of {JOINTS}, got {joint!r} at {position}")
        index = JOINTS.index(joint)
        low, high = self.env.joint_lower[index], self.env.joint_upper[index]
        self._slid[index] = float(np.clip(position, low, high))

    def _checked(self, point: Array) -> Array:
        point = np.asarray(point, dtype=np.float64)
        base = self.env.data.body("base_link").xpos
        if point.shape != (3,) or not np.linalg.norm(point - base) <= REACH:
            raise ValueError(f"expected a point within {REACH:g} m of the base, got {point}")
        return point

    def _move(self, target: Array, measured: Array, felt: dict[str, float]) -> Array:
        speed = self._pulled(target) if self._grabbed else np.zeros(len(JOINTS))
        for joint, goal in list(self._slid.items()):
            limit = self.env.joint_speed_limit[joint]
            speed[joint] = np.clip(SLIDE * (goal - target[joint]), -limit, limit)
            if abs(goal - target[joint]) < REACHED and abs(goal - measured[joint]) < REACHED:
                del self._slid[joint]
        return self._lead(target, speed, measured)

    def _pulled(self, target: Array) -> Array:
        """Joint speeds that bring the grabbed point to where it is dragged."""
        model, data = self.env.model, self.env.data
        link = data.body(self._body)
        point = link.xpos + link.xmat.reshape(3, 3) @ self._local
        wanted = PULL * (self._goal - point)
        wanted *= min(1.0, FASTEST / max(float(np.linalg.norm(wanted)), 1e-9))
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_comPos(model, data)  # the Jacobian needs it up to date
        mujoco.mj_jac(model, data, jacobian, None, point, self._body)
        led = (self._whole if self.base else self._arm).copy()
        while True:
            weights = self.env.joint_speed_limit[led] ** 2
            speed = np.zeros(len(JOINTS))
            speed[led] = damped_least_squares(jacobian[:, self._dofs[led]], weights, wanted)
            stuck = led & self._ended(target, speed)
            if not stuck.any():
                return speed
            led &= ~stuck  # a joint at its end stays there, and the others do without it

    def _ended(self, target: Array, speed: Array) -> NDArray[np.bool_]:
        """(J,) whether a joint is asked to go on beyond an end of its range."""
        low = (target <= self.env.joint_lower + _END) & (speed < 0)
        return low | ((target >= self.env.joint_upper - _END) & (speed > 0))
