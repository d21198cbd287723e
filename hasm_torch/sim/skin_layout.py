"""Where the cells of a robot's skin lie: patches on the links of a MuJoCo specification."""

from collections.abc import Sequence

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from hasm_torch.robot import Skin
from hasm_torch.sim.patch import Patch
from hasm_torch.sim.skin_surfaces import LAYERS, Laid, Shape

Array = NDArray[np.float64]

_FLAT = 0.98  # of the pitch, a little less than a cell is wide from flat side to flat side
_SLACK = 1e-5  # m
_TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
}


def lay_out(spec: mujoco.MjSpec, patches: Sequence[Patch]) -> Skin:
    """Lays out cells on a robot.

    Args:
        spec: The robot; it stays as it is.
        patches: What to cover; their cells follow each other in this order.

    Returns:
        The cells, float64.

    Raises:
        ValueError: A name comes twice, a link or geom is unknown or has not the shape named, or no
            cell finds room.
    """
    names = [patch.name for patch in patches]
    if not names or len(set(names)) != len(names):
        raise ValueError(f"expected patches, each with a name of its own, got {names}")
    for patch in patches:
        body_named(spec, patch.link)
    model = spec.copy().compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    slices, surfaces, laid, start = {}, {}, [], 0
    taken: dict[str, list[Array]] = {}
    for patch in patches:
        cells = LAYERS[patch.surface](_shapes(model, data, patch), patch)
        room = _room(cells.positions, patch, taken.setdefault(patch.link, []))
        if not room.any():
            raise ValueError(
                f"no cell of patch {patch.name!r} finds room on the {patch.surface} of "
                f"{patch.link!r} toward {patch.toward}: check toward and the bounds, or take a "
                f"pitch below {patch.pitch} m"
            )
        slices[patch.name] = slice(start, start + int(room.sum()))
        start = slices[patch.name].stop
        if cells.surface is not None and room.all():
            surfaces[patch.name] = cells.surface
        laid.append((Laid(cells.positions[room], cells.axes[room]), patch.pitch))
    positions = np.concatenate([cells.positions for cells, _ in laid])
    normals = np.concatenate([cells.axes[:, 2] for cells, _ in laid])
    points = np.concatenate([_force_points(cells, pitch) for cells, pitch in laid])
    link = {patch.name: patch.link for patch in patches}
    arrays = (torch.from_numpy(part) for part in (positions, normals, points))
    return Skin(tuple(names), slices, link, surfaces, *arrays)


def _room(positions: Array, patch: Patch, taken: list[Array]) -> NDArray[np.bool_]:
    """(n,) which cells lie within the patch's bounds and on no other; `taken` grows by them.

    On a bent link cells of two patches meet, and in a hollow those of one come close.
    """
    lower, upper = patch.bounds
    room = np.zeros(len(positions), bool)
    for number, place in enumerate(positions):
        # A few micrometres, so that a bound on the surface itself leaves its cells.
        inside = (place >= lower - _SLACK).all() and (place <= upper + _SLACK).all()
        apart = all(np.linalg.norm(place - other) >= _FLAT * patch.pitch for other in taken)
        if inside and apart:
            room[number] = True
            taken.append(place)
    return room


def body_named(spec: mujoco.MjSpec, link: str) -> mujoco.MjsBody:
    """A link of a specification.

    Raises:
        ValueError: There is none of this name.
    """
    body = spec.body(link)
    if body is None:
        known = ", ".join(body.name for body in spec.bodies if body.name)
        raise ValueError(f"no link {link!r}; the links are: {known}")
    return body


def cell_axes(normal: Array, points: Array) -> Array:
    """Axes of a cell as rows: along its row, across, outward.

    Args:
        normal: (3,) outward unit normal.
        points: (3, 3) force points, the first of them along the row, m.
    """
    along = points[0] - points.mean(0)
    along /= np.linalg.norm(along)
    return np.stack([along, np.cross(normal, along), normal])


def _force_points(cells: Laid, pitch: float) -> Array:
    """(n, 3, 3) force points of cells: those of neighbours form one triangular grid."""
    angles = np.arange(3) * 2 * np.pi / 3
    offsets = pitch / 3 * np.column_stack([np.cos(angles), np.sin(angles)])
    return cells.positions[:, None] + np.einsum("pa,nax->npx", offsets, cells.axes[:, :2])


def _shapes(model: mujoco.MjModel, data: mujoco.MjData, patch: Patch) -> list[Shape]:
    """The geoms that a patch lies on."""
    mine = np.flatnonzero(model.geom_bodyid == model.body(patch.link).id)
    every = [Shape(model, data, int(geom)) for geom in mine]
    shapes = [s for s in every if patch.geom in ("", s.name)]
    if patch.surface == "mesh" and shapes:
        return shapes
    fitting = [s for s in shapes if s.type == _TYPES.get(patch.surface)]
    # A link is often drawn and touched as the same shape twice.
    fitting = [s for s in fitting if s.collides] or fitting
    if len(fitting) != 1:
        kinds = [
            f"{mujoco.mjtGeom(s.type).name.removeprefix('mjGEOM_').lower()} {s.name!r}"
            for s in every
        ]
        raise ValueError(
            f"patch {patch.name!r} needs one {patch.surface} of {patch.link!r}, found "
            f"{len(fitting)}; its geoms: {', '.join(kinds) or 'none'}. Name one with geom, or take "
            'surface "mesh", which covers whatever is there'
        )
    return fitting
