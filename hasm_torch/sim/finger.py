"""A human hand: fingers that push skin patches with set forces while the robot moves.

patches and forces ──Hand──► one Finger a patch ──► MuJoCo
"""

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from hasm_torch.kernels.compiling import compile_kernel
from hasm_torch.robot import Skin
from hasm_torch.sim.assemble import FINGER_MASS, FINGER_RADIUS, FINGERS, TIMESTEP

Array = NDArray[np.float64]

_START_GAP = 0.003  # m, between fingertip and skin when a touch begins
_APPROACH_SPEED = 0.15  # m/s, relative to the skin
_APPROACH_DAMPER = FINGER_MASS / 0.004  # N s/m: the approach speed is reached in 4 ms
# N/m and N s/m along the surface: critically damped, 60 rad/s
_LATERAL_SPRING, _LATERAL_DAMPER = FINGER_MASS * 60.0**2, 2 * FINGER_MASS * 60.0
_AWAY = (0.0, 0.0, -5.0)  # m


class Push(NamedTuple):
    """What one finger does.

    Attributes:
        link: Body that carries the skin.
        point: (3,) point of the skin to stay over, in that body's frame, m.
        normal: (3,) outward unit normal, in that body's frame.
        force: Push against the normal, N; 0 lets go.
        cell: Cell of the patch under the point; None: the point is the patch's centre.
    """

    link: int
    point: Array
    normal: Array
    force: float
    cell: int | None


class TouchPoint(NamedTuple):
    """What one finger does to the skin; positions and directions in `odom`.

    Attributes:
        patch: Skin patch that it pushes.
        cell: Cell of the patch, or None: the patch's centre.
        force: (3,) what it really applies to the skin, N: the sum of its contacts' normal forces,
            zeros before contact.
        point: (3,) where the pushed point of the skin is, m: always the same one of its link.
    """

    patch: str
    cell: int | None
    force: Array
    point: Array


def _push_loop(
    origin: Array,
    rotation: Array,
    point: Array,
    normal: Array,
    force: float,
    position: Array,
    velocity: Array,
    previous: Array,
    applied: Array,
) -> None:
    """Force on a finger for one physics step: a push, and a spring that keeps it over its point.

    Args:
        origin: (3,) where the link is, m.
        rotation: (3, 3) how it is turned.
        point: (3,) the skin's point in the link, m.
        normal: (3,) outward unit normal there.
        force: Push, N.
        position: (3,) centre of the finger, m.
        velocity: (3,) its velocity, m/s.
        previous: (3,) where the skin's point was one step ago; replaced by where it is now.
        applied: (3,) replaced by the force, N.
    """
    outward, error, slip = np.zeros(3), np.zeros(3), np.zeros(3)
    height, speed = 0.0, 0.0
    for i in range(3):
        target = origin[i]
        for j in range(3):
            target += rotation[i, j] * point[j]
            outward[i] += rotation[i, j] * normal[j]
        error[i] = position[i] - target
        slip[i] = velocity[i] - (target - previous[i]) / TIMESTEP
        previous[i] = target
        height += error[i] * outward[i]
        speed += slip[i] * outward[i]
    along = -force
    if height > FINGER_RADIUS:
        along = -_APPROACH_DAMPER * (_APPROACH_SPEED + speed)
    # The spring and damper act along the surface alone: their normal part is taken out.
    along += _LATERAL_SPRING * height + _LATERAL_DAMPER * speed
    for i in range(3):
        lateral = _LATERAL_SPRING * error[i] + _LATERAL_DAMPER * slip[i]
        applied[i] = along * outward[i] - lateral


_push = compile_kernel(_push_loop)  # ten times a control tick: interpreted it takes a third of it


class Finger:
    """A free 50 g sphere that stays over one point of the skin, pushed along the live normal.

    The force on the skin is the force on the sphere less its mass times its acceleration, so
    it keeps the set value while the patch moves away or comes closer. Where nothing is touched
    the sphere waits far from the robot.

    Attributes:
        body: The sphere's body.
        cell: Cell of the patch that it pushes; None: the centre.

    Args:
        model: Model with the finger's body on three slides.
        name: Name of that body.
    """

    def __init__(self, model: mujoco.MjModel, name: str) -> None:
        self._model, self.body = model, model.body(name).id
        slide = model.joint(f"{name}/x")
        self._position = slice(int(slide.qposadr[0]), int(slide.qposadr[0]) + 3)
        self._velocity = slice(int(slide.dofadr[0]), int(slide.dofadr[0]) + 3)
        self._force = 0.0
        self.cell: int | None = None
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
        self._link, self._point, self._normal, self._force, self.cell = push

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
            target, normal = self.aim()
            velocity = self._point_velocity(data, target)
            self._at[:] = target + normal * (FINGER_RADIUS + _START_GAP)
            self._moving[:] = velocity
            self._previous = target - velocity * TIMESTEP
            self._placed = True
        return self._force > 0.0

    def push(self) -> None:
        """Sets the finger's force for one physics step, from up-to-date positions."""
        _push(
            self._origin,
            self._rotation,
            self._point,
            self._normal,
            self._force,
            self._at,
            self._moving,
            self._previous,
            self._applied,
        )

    def aim(self) -> tuple[Array, Array]:
        """Where the skin's point is and where its normal points, (3,) each, in the world.

        Valid from the touch's first `prepare` on.
        """
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

    def points(self, pushes: Mapping[int, Array]) -> list[TouchPoint]:
        """What each finger that pushes does.

        Args:
            pushes: Force of every body that touches the skin onto it, (3,), N.
        """
        return [
            TouchPoint(patch, finger.cell, pushes.get(finger.body, np.zeros(3)), finger.aim()[0])
            for patch, finger in self.touching.items()
            if finger in self._pushing
        ]

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
        point, normal = pushed_point(points, self._normals[span], cell)
        return Push(self._links[patch], point, normal, float(force), cell)


def pushed_point(points: Array, normals: Array, cell: int | None) -> tuple[Array, Array]:
    """Point of a patch that is pushed and the outward unit normal there, (3,) each.

    Args:
        points: (n, 3) centres of the patch's cells, m.
        normals: (n, 3) their outward unit normals.
        cell: Which cell; None: the patch's centre, on a curved patch the cell that is nearest.
    """
    if cell is not None:
        return points[cell], normals[cell]
    middle = points.mean(0)
    if (normals == normals[0]).all():
        return middle, normals[0]
    nearest = int(((points - middle) ** 2).sum(1).argmin())
    return points[nearest], normals[nearest]
