"""A human hand: fingers that push skin patches with set forces while the robot moves.

patches and forces ──Hand──► one Finger a patch ──► MuJoCo
"""

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from hasm_torch.robot import Skin
from hasm_torch.sim.scene import FINGER_MASS, FINGER_RADIUS, FINGERS, TIMESTEP

Array = NDArray[np.float64]

_START_GAP = 0.003  # m, between fingertip and skin when a touch begins
_APPROACH_SPEED = 0.15  # m/s, relative to the skin
_APPROACH_TIME = 0.004  # s, in which the approach speed is reached
_LATERAL_FREQUENCY = 60.0  # rad/s, of the critically damped spring along the surface
_AWAY = (0.0, 0.0, -5.0)  # m


class Push(NamedTuple):
    """What one finger does.

    Attributes:
        link: Body that carries the skin.
        point: (3,) point of the skin to stay over, in that body's frame, m.
        normal: (3,) outward unit normal, in that body's frame.
        force: Push against the normal, N; 0 lets go.
    """

    link: int
    point: Array
    normal: Array
    force: float


class Finger:
    """A free 50 g sphere that stays over one point of the skin, pushed along the live normal.

    The force on the skin is the force on the sphere less its mass times its acceleration, so
    it keeps the set value while the patch moves away or comes closer. Where nothing is touched
    the sphere waits far from the robot.

    Attributes:
        body: The sphere's body.

    Args:
        model: Model with the finger's body on three slides.
        name: Name of that body.
    """

    def __init__(self, model: mujoco.MjModel, name: str) -> None:
        self._model, self.body = model, model.body(name).id
        slide = model.joint(f"{name}/x")
        self._position = slice(int(slide.qposadr[0]), int(slide.qposadr[0]) + 3)
        self._velocity = slice(int(slide.dofadr[0]), int(slide.dofadr[0]) + 3)
        self._lateral_spring = FINGER_MASS * _LATERAL_FREQUENCY**2
        self._lateral_damper = 2 * FINGER_MASS * _LATERAL_FREQUENCY
        self._approach_damper = FINGER_MASS / _APPROACH_TIME
        self._force = 0.0
        self._link = 0
        self._point: Array = np.zeros(3)
        self._normal: Array = np.zeros(3)
        self._placed = False
        self._previous: Array = np.zeros(3)

    def command(self, push: Push) -> None:
        """Sets what to touch from the next call of `prepare` on.

        The same point of the same body is pushed on without a break; call `let_go` before going
        to another body.
        """
        same = np.array_equal(push.point, self._point)
        self._placed = self._placed and push.force > 0.0 and same
        self._link, self._point, self._normal, self._force = push

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
        self._origin, self._rotation = data.xpos[self._link], data.xmat[self._link].reshape(3, 3)
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
            self._model, data, mujoco.mjtObj.mjOBJ_XBODY, self._link, velocity, 0
        )
        return velocity[3:] + np.cross(velocity[:3], point - self._origin)


class Hand:
    """The fingers of one hand: each keeps to its patch until the patch is let go.

    Attributes:
        touching: The patches that are touched, in the order given, each with its finger.

    Args:
        model: Model with the bodies `FINGERS`.
        skin: Geometry of the patches.
        largest_force: Up to which a finger pushes, N.
    """

    def __init__(self, model: mujoco.MjModel, skin: Skin, largest_force: float) -> None:
        self._skin, self._largest_force = skin, largest_force
        self._links = {patch: model.body(skin.link[patch]).id for patch in skin.patches}
        self._positions, self._normals = skin.positions.numpy(), skin.normals.numpy()
        self._fingers = [Finger(model, name) for name in FINGERS]
        self._pushing: list[Finger] = []
        self.touching: dict[str, Finger] = {}

    def touch(self, touches: Mapping[str, tuple[float, int | None]]) -> None:
        """Sets what to touch from the next call of `prepare` on.

        Args:
            touches: Force, N, and cell (None: the centre) of every patch touched, at most one
                patch a finger; all other patches are let go.

        Raises:
            ValueError: There are more patches than fingers, a patch or a cell does not exist, or
                a force is out of range.
        """
        if len(touches) > len(self._fingers):
            raise ValueError(
                f"at most {len(self._fingers)} patches can be touched at once, got "
                f"{len(touches)}: {tuple(touches)}; valid patches: {tuple(self._skin.patches)}"
            )
        pushes = {patch: self._push(patch, *touch) for patch, touch in touches.items()}
        kept = {patch: self.touching[patch] for patch in self.touching if patch in pushes}
        free = [finger for finger in self._fingers if finger not in kept.values()]
        for finger in free:
            finger.let_go()
        self.touching = {patch: kept.get(patch) or free.pop(0) for patch in pushes}
        for patch, push in pushes.items():
            self.touching[patch].command(push)

    def prepare(self, data: mujoco.MjData) -> bool:
        """Starts a control tick; tells whether its physics steps need `push`."""
        self._pushing = [finger for finger in self._fingers if finger.prepare(data)]
        return bool(self._pushing)

    def push(self) -> None:
        """Sets the fingers' forces for one physics step, from up-to-date positions."""
        for finger in self._pushing:
            finger.push()

    def _push(self, patch: str, force: float, cell: int | None) -> Push:
        if patch not in self._links:
            raise ValueError(
                f"patch must be None or one of {tuple(self._skin.patches)}, got {patch!r}"
            )
        if not 0.0 <= force <= self._largest_force:
            raise ValueError(f"force must be 0 to {self._largest_force:g} N, got {force}")
        span = self._skin.slices[patch]
        points = self._positions[span]
        if cell is not None and not 0 <= cell < len(points):
            raise ValueError(f"cell of {patch} must be 0 to {len(points) - 1}, got {cell}")
        point = points.mean(0) if cell is None else points[cell]
        return Push(self._links[patch], point, self._normals[span][0], float(force))
