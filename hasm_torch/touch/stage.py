"""The scene of the page: robot, skin, pushes and ghosts, drawn from snapshots."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import viser
from numpy.typing import NDArray

from hasm_torch.evaluation.viewer import colours
from hasm_torch.robot import Skin
from hasm_torch.sim.cell_shape import hexagon_vertices
from hasm_torch.sim.scene import FINGERS
from hasm_torch.touch.figure import Figure, Pose
from hasm_torch.touch.ghosts import WAYS
from hasm_torch.touch.history import Arrow, Snapshot
from hasm_torch.touch.session import POSTURE

Array = NDArray[np.float64]

_GHOST_COLOURS = ((214, 39, 40), (31, 119, 180), (44, 160, 44), (148, 103, 189))
GHOSTS = dict(zip((*WAYS, POSTURE), _GHOST_COLOURS))
"""Colour of every ghost, by its name."""

PLATE, PUSH = (42, 54, 50), (255, 140, 0)
_HAND = ("wrist_roll_link", "hand_l_proximal_link", "hand_r_proximal_link")
GHOSTS_EVERY = 2  # drawings of the robot
_MOVED = 2e-4  # m, or of a quaternion: less is not worth a message
_TELLING = 0.01  # m or rad: a ghost nearer than this to the robot is hidden in it
_ARROW, _ARROW_A_NEWTON = 0.06, 0.012  # m
_GAP = 0.015  # m between the arrow and the cell that it pushes, so that its light is seen


class Stage:
    """What is seen of a lesson.

    Attributes:
        skin: What is dragged to push.
        hand: What is dragged to guide.

    Args:
        server: Where it is drawn.
        model: Model of the scene; it is only read.
        skin: Geometry of the cells.
    """

    def __init__(self, server: viser.ViserServer, model: mujoco.MjModel, skin: Skin) -> None:
        self._scene, self._cells = server.scene, skin
        self._figure = Figure(model)
        self._frame = 0
        self._drawn: dict[str, list[Pose]] = {}
        # An environment map takes nearly all the time of drawing where no graphics card helps.
        self._scene.configure_environment_map(None)
        self._scene.add_light_hemisphere("/sky", ground_color=(190, 190, 195), intensity=2.2)
        self._scene.configure_default_lights(cast_shadow=False)
        self._scene.add_grid("/floor", width=6.0, height=6.0, cell_size=0.25, section_size=1.0)
        self._frames = {"": self._add_frames("/robot")}
        self.skin: list[Any] = []
        self.hand: list[Any] = []
        for number, part in enumerate(self._figure.parts()):
            mesh = self._scene.add_mesh_simple(
                f"{self._path('/robot', part.body)}/{number}",
                part.vertices,
                part.faces,
                color=part.colour,
                cast_shadow=False,
            )
            if part.body in _HAND:
                self.hand.append(mesh)
        self._patches = [self._add_patch(patch) for patch in skin.patches]
        self._lit: Array = np.zeros(skin.cells)
        self._arrows = [self._add_arrow(finger) for finger in FINGERS]
        self._roots: dict[str, Any] = {}
        self._shadows: dict[str, dict[int, Any]] = {}
        for name, colour in GHOSTS.items():
            self._add_ghost(name, colour)

    def draw(self, snapshot: Snapshot) -> None:
        """Show a moment."""
        self._frame += 1
        poses = self._figure.poses(snapshot.qpos)
        self._move("", poses)
        if not np.allclose(self._lit, snapshot.cells, atol=0.02):
            self._lit = snapshot.cells
            for patch, cells in zip(self._cells.patches, self._patches):
                force = snapshot.cells[self._cells.slices[patch]]
                cells.batched_colors = np.asarray(colours(force), dtype=np.uint8)
        self._draw_arrows(snapshot.arrows)
        if self._frame % GHOSTS_EVERY == 0:
            self._draw_ghosts(snapshot, poses)

    def _draw_ghosts(self, snapshot: Snapshot, robot: list[Pose]) -> None:
        """Show of every ghost the parts that are elsewhere than the robot's."""
        for name, root in self._roots.items():
            joints = snapshot.ghosts.get(name)
            away = joints is not None and np.abs(joints - snapshot.state).max() > _TELLING
            root.visible = bool(away)
            if joints is None or not away:
                continue
            poses = self._figure.poses_at(joints, snapshot.qpos)
            self._move(name, poses)
            apart: list[bool] = []
            for i, (pose, here) in enumerate(zip(poses, robot)):
                parent = self._figure.parents[i]
                turned = np.abs(pose.orientation - here.orientation).max() > _TELLING / 2
                moved = turned or np.abs(pose.position - here.position).max() > _TELLING / 2
                apart.append(bool(moved) or (parent < i and apart[parent]))
            for body, shape in self._shadows[name].items():
                if shape.visible != apart[body]:
                    shape.visible = apart[body]

    def _add_frames(self, root: str) -> list[Any]:
        bodies = self._figure.bodies
        return [self._scene.add_frame(self._path(root, name), show_axes=False) for name in bodies]

    def _path(self, root: str, body: str) -> str:
        """Name of a body's frame, under those of all bodies that carry it."""
        index, parents = self._figure.bodies.index(body), self._figure.parents
        names = [body]
        while parents[index] != index:
            index = parents[index]
            names.append(self._figure.bodies[index])
        return "/".join([root, *reversed(names)])

    def _add_ghost(self, name: str, colour: tuple[int, int, int]) -> None:
        root = f"/ghosts/{name}"
        self._roots[name] = self._scene.add_frame(root, show_axes=False, visible=False)
        self._frames[name] = self._add_frames(root)
        hand = self._path(root, "wrist_roll_link")
        self._scene.add_label(f"{hand}/tag", name, anchor="bottom-center")
        self._shadows[name] = {}
        for part in self._figure.shadow(colour):
            index = self._figure.bodies.index(part.body)
            self._shadows[name][index] = self._scene.add_mesh_simple(
                f"{self._path(root, part.body)}/shape",
                part.vertices,
                part.faces,
                color=colour,
                opacity=0.3,
                cast_shadow=False,
            )

    def _add_patch(self, patch: str) -> Any:
        """The cells of a patch, on their plate; both can be dragged."""
        skin, span = self._cells, self._cells.slices[patch]
        body, place, turned = self._figure.link(skin.link[patch])
        surface = skin.surfaces[patch]
        axes = turned @ surface.axes.numpy().T
        self.skin.append(
            self._scene.add_box(
                f"{self._path('/robot', body)}/{patch}",
                color=PLATE,
                dimensions=tuple(2 * surface.half_size.numpy()),
                position=place + turned @ surface.centre.numpy(),
                wxyz=_quaternion(axes),
                cast_shadow=False,
            )
        )
        normal, points = skin.normals[span][0].numpy(), skin.points[span][0].numpy()
        along = points[0] - points.mean(0)
        along /= np.linalg.norm(along)
        cell = turned @ np.column_stack([along, np.cross(normal, along), normal])
        centres = skin.positions[span].numpy() @ turned.T + place
        corners, sides = _hexagon()
        cells = self._scene.add_batched_meshes_simple(
            f"{self._path('/robot', body)}/{patch} cells",
            corners,
            sides,
            np.tile(_quaternion(cell), (len(centres), 1)),
            centres,
            batched_colors=np.asarray(colours(np.zeros(len(centres))), dtype=np.uint8),
            flat_shading=True,
            cast_shadow=False,
        )
        self.skin.append(cells)
        return cells

    def _add_arrow(self, name: str) -> tuple[Any, Any]:
        arrow = self._scene.add_arrows(
            f"/pushes/{name}",
            np.zeros((1, 2, 3)),
            PUSH,
            shaft_radius=0.005,
            head_radius=0.011,
            head_length=0.03,
            visible=False,
        )
        return arrow, self._scene.add_label(f"/newtons/{name}", "", visible=False)

    def _draw_arrows(self, arrows: Sequence[Arrow]) -> None:
        for i, (shape, text) in enumerate(self._arrows):
            shown = i < len(arrows)
            shape.visible = text.visible = shown
            if shown:
                arrow = arrows[i]
                tail = arrow.point - (_ARROW + _ARROW_A_NEWTON * arrow.newtons) * arrow.inward
                tip = arrow.point - _GAP * arrow.inward
                shape.points = np.array([[tail, tip]], dtype=np.float32)
                text.position = tail
                text.text = f"{arrow.newtons:.1f} N" + (", pinned" if arrow.pinned else "")

    def _move(self, name: str, poses: list[Pose]) -> None:
        """Move the frames whose bodies have moved."""
        drawn = self._drawn.get(name)
        if drawn is None:
            far = np.full(4, np.inf)
            drawn = self._drawn[name] = [Pose(far[:3], far) for _ in poses]
        for i, (frame, pose, old) in enumerate(zip(self._frames[name], poses, drawn)):
            shifted = np.abs(pose.position - old.position).max() > _MOVED
            turned = np.abs(pose.orientation - old.orientation).max() > _MOVED
            if shifted:
                frame.position = pose.position
            if turned:
                frame.wxyz = pose.orientation
            drawn[i] = Pose(
                pose.position if shifted else old.position,
                pose.orientation if turned else old.orientation,
            )


def _quaternion(rotation: Array) -> Array:
    found = np.zeros(4)
    mujoco.mju_mat2Quat(found, np.ascontiguousarray(rotation).ravel())
    return found


def _hexagon() -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """A cell: lower rim 0 to 5, upper rim 6 to 11."""
    faces = [(0, i + 1, i) for i in range(1, 5)] + [(6, 6 + i, 7 + i) for i in range(1, 5)]
    for i in range(6):
        j = (i + 1) % 6
        faces += [(i, j, j + 6), (i, j + 6, i + 6)]
    return hexagon_vertices().astype(np.float32), np.array(faces, dtype=np.uint32)
