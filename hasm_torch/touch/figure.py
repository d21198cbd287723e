"""The robot as triangles: what a page is sent once, and where its parts are at a moment."""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from hasm_torch.robot import JOINTS
from hasm_torch.sim.scene import FINGERS

Array = NDArray[np.float64]

SIDES = 20  # of what is drawn for a cylinder
_AROUND = 0.002  # m of a ghost around the robot: surfaces in the same place would flicker
_SHOWN = (0, 1)  # geom groups; 3 holds the shapes that collide
_WHEEL = np.linspace(0.0, 2.0 * np.pi, SIDES, endpoint=False)


class Part(NamedTuple):
    """Triangles of one colour that move as one.

    Attributes:
        body: Name of the body in whose frame they are.
        colour: Red, green and blue, 0 to 255.
        vertices: (V, 3) m.
        faces: (F, 3) indices of vertices.
    """

    body: str
    colour: tuple[int, int, int]
    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]


class Pose(NamedTuple):
    """Where a body is in its parent: position (3,) m, orientation (4,) as w, x, y, z.

    In a chain of bodies only those move whose joints do, so that a page is sent little.
    """

    position: Array
    orientation: Array


class Figure:
    """Shapes of a scene, and the pose of every body that moves on its own.

    Bodies without a joint between them are one. The fingers that push and the floor are left out.

    Attributes:
        bodies: Names of the bodies that move on their own, parents before children; "world"
            stands still.
        parents: Index of the parent of each of them.

    Args:
        model: Model of the scene; it is only read.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._shapes: dict[str, dict[tuple[int, int, int], list[int]]] = {}
        for geom in range(model.ngeom):
            kind, name = model.geom_type[geom], model.geom(geom).name
            if (
                model.geom_group[geom] not in _SHOWN
                or kind == mujoco.mjtGeom.mjGEOM_PLANE
                or name.startswith("skin/")
            ):
                continue
            body = model.body(model.body_weldid[model.geom_bodyid[geom]]).name
            red, green, blue = (round(255 * float(c)) for c in model.geom_rgba[geom][:3])
            parts = self._shapes.setdefault(body, {})
            parts.setdefault((red, green, blue), []).append(geom)
        self._ids = sorted({0, *model.body_weldid[1:].tolist()})
        self._ids = [i for i in self._ids if model.body(i).name not in FINGERS]
        self.bodies = [model.body(i).name for i in self._ids]
        outer = model.body_weldid[model.body_parentid[self._ids]]
        self.parents = [self._ids.index(parent) for parent in outer]
        joints = [model.joint(name) for name in JOINTS]
        self._joints = np.array([joint.qposadr[0] for joint in joints])
        mujoco.mj_kinematics(model, self._data)

    def parts(self) -> list[Part]:
        """Everything that is drawn."""
        return [
            self._part(body, colour, geoms)
            for body, colours in self._shapes.items()
            for colour, geoms in colours.items()
        ]

    def shadow(self, colour: tuple[int, int, int]) -> list[Part]:
        """The robot alone in one colour, a part a body."""
        return [
            self._part(body, colour, [g for geoms in colours.values() for g in geoms], _AROUND)
            for body, colours in self._shapes.items()
            if body not in ("world", "object")
        ]

    def link(self, body: str) -> tuple[str, Array, Array]:
        """The body that a link is one with, and the link's place and rotation (3, 3) in it."""
        inner = self._model.body(body).id
        outer = int(self._model.body_weldid[inner])
        place, turned = self._data.xpos, self._data.xmat.reshape(-1, 3, 3)
        rotation = turned[outer].T @ turned[inner]
        return (
            self._model.body(outer).name,
            turned[outer].T @ (place[inner] - place[outer]),
            (rotation),
        )

    def poses(self, qpos: Array) -> list[Pose]:
        """Pose of each of `bodies` for the positions of a simulation."""
        data, found = self._data, []
        data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, data)
        for body, parent in zip(self._ids, self.parents):
            outer, back, turned = self._ids[parent], np.zeros(4), np.zeros(4)
            mujoco.mju_negQuat(back, data.xquat[outer])
            mujoco.mju_mulQuat(turned, back, data.xquat[body])
            away = data.xpos[body] - data.xpos[outer]
            found.append(Pose(away @ data.xmat[outer].reshape(3, 3), turned))
        return found

    def poses_at(self, joints: Array, qpos: Array) -> list[Pose]:
        """The same with the robot's joints at (J,) positions and all else as in a simulation."""
        moved = qpos.copy()
        moved[self._joints] = joints
        model = self._model
        for follower, leader, polynomial in zip(
            model.eq_obj1id, model.eq_obj2id, model.eq_data, strict=True
        ):
            address = model.jnt_qposadr
            moved[address[follower]] = polynomial[0] + polynomial[1] * moved[address[leader]]
        return self.poses(moved)

    def _part(
        self, body: str, colour: tuple[int, int, int], geoms: list[int], around: float = 0.0
    ) -> Part:
        vertices, faces, count = [], [], 0
        root = self._model.body(body).id
        origin, frame = self._data.xpos[root], self._data.xmat[root].reshape(3, 3)
        mujoco.mj_kinematics(self._model, self._data)
        for geom in geoms:
            corners, triangles = _shape(
                int(self._model.geom_type[geom]), self._model.geom_size[geom] + around
            )
            rotation = self._data.geom_xmat[geom].reshape(3, 3)
            world = corners @ rotation.T + self._data.geom_xpos[geom]
            vertices.append((world - origin) @ frame)
            faces.append(triangles + count)
            count += len(corners)
        return Part(
            body,
            colour,
            np.concatenate(vertices).astype(np.float32),
            np.concatenate(faces).astype(np.uint32),
        )


def _shape(kind: int, size: Array) -> tuple[Array, NDArray[np.int64]]:
    """Vertices and faces of a geom; corners are not shared by faces that meet at an edge."""
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return _box(size)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return _turned(np.array([[0, 1], [1, 1], [1, 1], [1, -1], [1, -1], [0, -1]]) * size[:2])
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        angles = np.linspace(0.0, np.pi, SIDES // 2)
        return _turned(size[0] * np.stack([np.sin(angles), np.cos(angles)], axis=1))
    raise ValueError(f"expected boxes, cylinders and spheres, got a geom of type {kind}")


def _turned(outline: Array) -> tuple[Array, NDArray[np.int64]]:
    """What an outline, (N, 2) radius and height from the top down, sweeps about the z axis."""
    radius, height = outline.T
    x, y = radius[:, None] * np.cos(_WHEEL), radius[:, None] * np.sin(_WHEEL)
    vertices = np.stack([x, y, np.broadcast_to(height[:, None], x.shape)], axis=-1)
    ring, side = np.meshgrid(np.arange(len(outline) - 1), np.arange(SIDES), indexing="ij")
    upper, beside = ring * SIDES + side, ring * SIDES + (side + 1) % SIDES
    first = np.stack([upper, upper + SIDES, beside + SIDES], axis=-1)
    second = np.stack([upper, beside + SIDES, beside], axis=-1)
    return vertices.reshape(-1, 3), np.concatenate([first, second]).reshape(-1, 3)


def _box(half: Array) -> tuple[Array, NDArray[np.int64]]:
    square = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], dtype=np.float64)
    sides = []
    for axis in range(3):
        # A cyclic change of axes keeps the outside out; turning about an edge keeps it too.
        sides += [
            np.roll(square, axis + 1, axis=1),
            np.roll(square * [1, -1, -1], axis + 1, axis=1),
        ]
    faces = [np.array([[0, 1, 2], [0, 2, 3]]) + 4 * side for side in range(6)]
    return np.concatenate(sides) * half, np.concatenate(faces)
