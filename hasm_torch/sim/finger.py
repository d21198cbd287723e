"""A human finger that pushes a skin patch with a set force while the robot moves."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from hasm_torch.sim.scene import FINGER_MASS, FINGER_RADIUS, TIMESTEP

Array = NDArray[np.float64]

_START_GAP = 0.003  # m, between fingertip and skin when a touch begins
_APPROACH_SPEED = 0.15  # m/s, relative to the skin
_APPROACH_TIME = 0.004  # s, in which the approach speed is reached
_LATERAL_FREQUENCY = 60.0  # rad/s, of the critically damped spring along the surface
_AWAY = (0.0, 0.0, -5.0)  # m


class Finger:
    """A free 50 g sphere that stays over one point of the skin, pushed along the live normal.

    The force on the skin is the force on the sphere less its mass times its acceleration, so
    it keeps the set value while the patch moves away or comes closer. Where nothing is touched
    the sphere waits far from the robot.

    Args:
        model: Model with the body "finger" on three slides.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        slide = model.joint("finger/x")
        self._position = slice(int(slide.qposadr[0]), int(slide.qposadr[0]) + 3)
        self._velocity = slice(int(slide.dofadr[0]), int(slide.dofadr[0]) + 3)
        self._lateral_spring = FINGER_MASS * _LATERAL_FREQUENCY**2
        self._lateral_damper = 2 * FINGER_MASS * _LATERAL_FREQUENCY
        self._approach_damper = FINGER_MASS / _APPROACH_TIME
        self._force = 0.0
        self._body = 0
        self._point: Array = np.zeros(3)
        self._normal: Array = np.zeros(3)
        self._placed = False
        self._previous: Array = np.zeros(3)

    def command(self, body: int, point: Array, normal: Array, force: float) -> None:
        """Sets what to touch from the next call of `prepare` on.

        The same point of the same body is pushed on without a break; call `let_go` before going
        to another body.

        Args:
            body: Body that carries the skin.
            point: (3,) point of the skin to stay over, in the body's frame, m.
            normal: (3,) outward unit normal, in the body's frame.
            force: Push against the normal, N; 0 lets go.
        """
        self._placed = self._placed and force > 0.0 and np.array_equal(point, self._point)
        self._body, self._point, self._normal, self._force = body, point, normal, force

    def let_go(self) -> None:
        """Ends the touch with the next call of `prepare`."""
        self._force, self._placed = 0.0, False

    def prepare(self, data: mujoco.MjData) -> bool:
        """Starts a control tick; tells whether its physics steps need `push`.

        A finger that begins to touch appears before its patch, one that lets go is put away.
        """
        # Views into the simulation: looked up once a tick, not in every physics step.
        self._at, self._moving = data.qpos[self._position], data.qvel[self._velocity]
        self._applied = data.qfrc_applied[self._velocity]
        self._origin, self._rotation = data.xpos[self._body], data.xmat[self._body].reshape(3, 3)
        self._applied[:] = 0.0
        if self._force == 0.0:
            self._at[:], self._moving[:] = _AWAY, 0.0
        elif not self._placed:
            target, normal = self._aim()
            velocity = self._point_velocity(data, target)
            self._at[:] = target + normal * (FINGER_RADIUS + _START_GAP)
            self._moving[:] = velocity
            self._previous = target - velocity * TIMESTEP
            self._placed = True
        return self._force > 0.0

    def push(self) -> None:
        """Sets the finger's force for one physics step, from up-to-date positions."""
        target, normal = self._aim()
        error = self._at - target
        slip = self._moving - (target - self._previous) / TIMESTEP
        self._previous = target
        height, speed = float(error @ normal), float(slip @ normal)
        if height > FINGER_RADIUS:
            along = -self._approach_damper * (_APPROACH_SPEED + speed)
        else:
            along = -self._force
        # The spring and damper act along the surface alone: their normal part is taken out.
        along += self._lateral_spring * height + self._lateral_damper * speed
        self._applied[:] = (
            along * normal - self._lateral_spring * error - self._lateral_damper * slip
        )

    def _aim(self) -> tuple[Array, Array]:
        """Where the skin's point is and where its normal points, in the world."""
        return self._origin + self._rotation @ self._point, self._rotation @ self._normal

    def _point_velocity(self, data: mujoco.MjData, point: Array) -> Array:
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(
            self._model, data, mujoco.mjtObj.mjOBJ_XBODY, self._body, velocity, 0
        )
        return velocity[3:] + np.cross(velocity[:3], point - self._origin)
