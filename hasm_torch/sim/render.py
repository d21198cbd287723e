"""Pictures of a scene: the robot, the skin cells coloured by their force, the human fingers."""

import importlib
import os
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from hasm_torch.robot import BASE_FRAME, Skin
from hasm_torch.sim.assemble import FINGER_RADIUS
from hasm_torch.sim.finger import Finger, pushed_point
from hasm_torch.sim.skin_layout import cell_axes

Array = NDArray[np.float64]

HEIGHT, WIDTH = 480, 640

_HOVER = 0.03  # m, gap at which a finger that does not touch is drawn
_FULL_COLOUR = 4.0  # N in one cell
_SKIN_COLOUR = np.array([0.93, 0.72, 0.6, 1.0])
_SLEEVE_COLOUR = np.array([0.25, 0.35, 0.6, 1.0])
# Colours of a cell from no force to `_FULL_COLOUR`.
_CELL_COLOURS = np.array(
    [[0.13, 0.3, 0.24], [0.95, 0.85, 0.1], [1.0, 0.45, 0.05], [0.95, 0.1, 0.05]]
)
# It goes along with the base by this share of its way and stands back by the rest: what the base
# leaves behind stays in the picture.
_ALONG = 0.6
# Azimuth and elevation of the cameras that stand still and see in parallel.
_PARALLEL = {"top": (90.0, -90.0), "side": (90.0, 0.0)}
EXTENTS = {"top": (-0.9, 1.5, -0.9, 0.9), "side": (-0.9, 1.5, -0.1, 1.7)}
"""Left, right, bottom and top of these two pictures in `odom`, m: x and y, and x and z."""


class View(NamedTuple):
    """How the camera that follows looks at a robot.

    Attributes:
        middle: What it looks at while the base stands at 0, m.
        distance: m.
        azimuth: Degrees.
        elevation: Degrees.
        base: Body of a mobile base that it follows; "" for a robot that stands.
    """

    middle: tuple[float, float, float]
    distance: float
    azimuth: float
    elevation: float
    base: str = ""


VIEWS = {
    "compliance": View((0.26, 0.0, 0.72), 1.3, 126.0, -16.0, BASE_FRAME),
    "grasp": View((0.36, 0.0, 0.74), 1.3, 126.0, -18.0, BASE_FRAME),
}
"""The HSR's views."""


class SceneRenderer:
    """Draws a simulation, without shadows.

    Camera "follow" goes along with the mobile base; "top" and "side" stand still and show the
    section `EXTENTS` of the world to scale.

    Args:
        model: Model of the scene.
        skin: Geometry of the cells.
        view: Of the camera that follows.

    Raises:
        RuntimeError: No OpenGL context can be made.
    """

    # A second attempt after a failed one can end the process, so the first answer stands.
    _failure: ClassVar[str | None] = None

    def __init__(self, model: mujoco.MjModel, skin: Skin, view: View) -> None:
        if SceneRenderer._failure is not None:
            raise RuntimeError(SceneRenderer._failure)
        try:
            _choose_backend()
            self._renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
        # MuJoCo's backends fail with errors of many kinds: a missing library, device or display.
        except Exception as error:
            SceneRenderer._failure = (
                "cannot draw the scene: no OpenGL context could be made. Without a display install "
                "libEGL (Debian package libegl1) or set MUJOCO_GL=osmesa and install libOSMesa "
                "(libosmesa6), or make the environment with render_mode=None "
                f"({type(error).__name__}: {error})"
            )
            raise RuntimeError(SceneRenderer._failure) from error
        self._scene_options = mujoco.MjvOption()
        self._visual = model.vis.global_
        self._following = view
        self._base = model.body(view.base or "world").id
        self._angle = float(self._visual.fovy)
        self._hexagon = model.mesh("cell").id
        # The compiler turns a mesh onto its principal axes; drawing turns it back.
        turned_back = np.zeros(9)
        mujoco.mju_quat2Mat(turned_back, model.mesh_quat[self._hexagon])
        self._patches = []
        positions, normals = skin.positions.numpy(), skin.normals.numpy()
        self._cells: dict[str, tuple[int, Array, Array]] = {}
        for name in skin.patches:
            span, body = skin.slices[name], model.body(skin.link[name]).id
            cells = zip(normals[span], skin.points.numpy()[span], strict=True)
            turned = [cell_axes(*cell).T @ turned_back.reshape(3, 3) for cell in cells]
            self._patches.append((span, body, positions[span], turned))
            self._cells[name] = (body, positions[span], normals[span])

    def render(
        self,
        data: mujoco.MjData,
        forces: Array,
        touching: Mapping[str, Finger],
        camera: str,
    ) -> NDArray[np.uint8]:
        """Draws the scene.

        Args:
            data: Simulation, with up-to-date kinematics.
            forces: (cells, 3) skin forces, N.
            touching: Patches with a finger at them.
            camera: "follow", "top" or "side".

        Returns:
            (480, 640, 3) image.

        Raises:
            ValueError: The camera is not known.
        """
        view = self._view(camera, data.xpos[self._base])
        self._renderer.update_scene(data, view, self._scene_options)
        scene = self._renderer.scene
        scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        colours = _colours(forces.sum(1))
        for span, body, positions, rotations in self._patches:
            frame = data.xmat[body].reshape(3, 3)
            world = data.xpos[body] + positions @ frame.T
            for place, rotation, colour in zip(world, rotations, colours[span], strict=True):
                turned = (frame @ rotation).ravel()
                geom = _add(scene, mujoco.mjtGeom.mjGEOM_MESH, np.ones(3), place, turned, colour)
                geom.dataid = 2 * self._hexagon
        for patch, finger in touching.items():
            self._draw_finger(data, scene, patch, finger)
        return self._renderer.render()

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._renderer.close()

    def _view(self, camera: str, base: Array) -> mujoco.MjvCamera:
        """A camera, for the place of the base, (3,), m."""
        view = mujoco.MjvCamera()
        if camera == "follow":
            middle, distance, view.azimuth, view.elevation, _ = self._following
            view.lookat[:] = middle + _ALONG * base
            view.distance = distance + (1 - _ALONG) * float(np.linalg.norm(base))
            self._visual.fovy = self._angle
        elif camera in _PARALLEL:
            left, right, bottom, top = EXTENTS[camera]
            across = (bottom + top) / 2
            view.lookat[:] = (
                (left + right) / 2,
                *((across, 1.0) if camera == "top" else (0, across)),
            )
            view.azimuth, view.elevation = _PARALLEL[camera]
            view.distance, view.orthographic = 4.0, 1
            # What is an angle in perspective is the height of the picture here, m.
            self._visual.fovy = top - bottom
        else:
            raise ValueError(f"camera must be 'follow', 'top' or 'side', got {camera!r}")
        return view

    def _draw_finger(
        self, data: mujoco.MjData, scene: mujoco.MjvScene, patch: str, finger: Finger
    ) -> None:
        body, positions, normals = self._cells[patch]
        frame = data.xmat[body].reshape(3, 3)
        centre, normal = pushed_point(positions, normals, finger.cell)
        outward = frame @ normal
        tip = data.xpos[finger.body].copy()
        if tip[2] < 0:
            tip = data.xpos[body] + frame @ centre + outward * (FINGER_RADIUS + _HOVER)
        knuckle, wrist = tip + outward * 0.07, tip + outward * 0.13
        eye, flat = np.eye(3).ravel(), np.zeros(3)
        sphere = np.full(3, FINGER_RADIUS)
        _add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, sphere, tip, eye, _SKIN_COLOUR)
        for start, end, radius, colour in (
            (tip, knuckle, FINGER_RADIUS, _SKIN_COLOUR),
            (knuckle, wrist, 0.02, _SLEEVE_COLOUR),
        ):
            geom = _add(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, flat, start, eye, colour)
            mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, radius, start, end)


def _choose_backend() -> None:
    """Draws by the backend of MUJOCO_GL, even if mujoco was imported before that was set."""
    chosen = os.environ.get("MUJOCO_GL", "").lower()
    used = importlib.import_module("mujoco.rendering.classic.gl_context")
    if chosen in ("egl", "osmesa") and f"mujoco.{chosen}" != used.GLContext.__module__:
        importlib.reload(used)


def _colours(forces: Array) -> Array:
    """(cells,) forces, N, to (cells, 4) colours."""
    place = np.clip(forces / _FULL_COLOUR, 0, 1) * (len(_CELL_COLOURS) - 1)
    levels = np.arange(len(_CELL_COLOURS))
    channels = [np.interp(place, levels, _CELL_COLOURS[:, c]) for c in range(3)]
    return np.column_stack([*channels, np.ones(len(forces))])


def _add(
    scene: mujoco.MjvScene,
    kind: mujoco.mjtGeom,
    size: Array,
    position: Array,
    rotation: Array,
    colour: Array,
) -> mujoco.MjvGeom:
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, kind, size, position, rotation, colour.astype(np.float32))
    scene.ngeom += 1
    return geom
