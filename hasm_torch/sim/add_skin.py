"""Puts skin on any robot: geoms that feel, on the links of a MuJoCo specification.

    patches ──lay_out──► Skin ──add_skin──► geoms of the links ──SkinSensor──► forces of the cells

A flat patch is one thin box, any other is a small plate a cell. All of them are called
"skin/<patch>...", weigh nothing and feel what touches them from outside.
"""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from hasm_torch.robot import Skin
from hasm_torch.sim.assemble import SKIN
from hasm_torch.sim.patch import THICKNESS, Patch
from hasm_torch.sim.skin_layout import body_named, cell_axes, lay_out

Array = NDArray[np.float64]


class Plate(NamedTuple):
    """A box of skin in the frame of its link.

    Attributes:
        name: Name of its geom.
        centre: (3,) m.
        half_size: (3,) half edge lengths along the axes, m.
        axes: (3, 3) unit vectors as rows, the last one outward.
    """

    name: str
    centre: Array
    half_size: Array
    axes: Array


def add_skin(spec: mujoco.MjSpec, patches: Skin | Sequence[Patch], contype: int = SKIN) -> Skin:
    """Puts skin on a robot.

    Args:
        spec: The robot, from MJCF or URDF; the skin's geoms are added to its links.
        patches: What to lay out, or a skin that is laid out.
        contype: Bits by which the skin collides with geoms that have one of them in their
            conaffinity; MuJoCo's own default has the first.

    Returns:
        The skin: where its cells lie.

    Raises:
        ValueError: A link is unknown, or what ``lay_out`` raises.
    """
    skin = patches if isinstance(patches, Skin) else lay_out(spec, patches)
    for patch in skin.patches:
        body = body_named(spec, skin.link[patch])
        for plate in plates(skin, patch):
            quaternion = np.zeros(4)
            mujoco.mju_mat2Quat(quaternion, plate.axes.T.flatten())
            body.add_geom(
                name=plate.name,
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=plate.centre,
                quat=quaternion,
                size=plate.half_size,
                mass=0,
                contype=contype,
                conaffinity=0,
                condim=1,
                group=1,
                rgba=[0.16, 0.2, 0.19, 1],
            )
    return skin


def plates(skin: Skin, patch: str) -> list[Plate]:
    """The boxes of which a patch is made: one if it is flat, else one a cell.

    The plates of cells are as wide as the cells and as high as their rows: on a plane they leave
    no gap.
    """
    surface = skin.surfaces.get(patch)
    if surface is not None:
        box = (surface.centre, surface.half_size, surface.axes)
        return [Plate(f"skin/{patch}", *(part.numpy() for part in box))]
    span = skin.slices[patch]
    made = []
    cells = zip(skin.positions[span].numpy(), skin.normals[span].numpy(), skin.points[span].numpy())
    for number, (position, normal, points) in enumerate(cells):
        pitch = 3 * float(np.linalg.norm(points[0] - points.mean(0)))
        half = np.array([pitch / 2, np.sqrt(3) / 4 * pitch, THICKNESS / 2])
        centre = position - normal * THICKNESS / 2
        made.append(Plate(f"skin/{patch}/{number}", centre, half, cell_axes(normal, points)))
    return made
