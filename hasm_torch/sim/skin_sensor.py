"""What the robot's skin feels: the contact forces, spread over the force points of the cells."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from hasm_torch.robot import Skin
from hasm_torch.sim.add_skin import plates

Array = NDArray[np.float64]

FOOTPRINT = 0.006  # m, standard deviation of the pressure under a fingertip


def spread(force: float, position: Array, points: Array, width: float = FOOTPRINT) -> Array:
    """Spreads a normal force over force points with a Gaussian footprint.

    Args:
        force: Normal force, N.
        position: (3,) centre of the contact, m.
        points: (..., 3) force points, m.
        width: Standard deviation of the footprint, m.

    Returns:
        (...,) forces, N, >= 0, whose sum is `force` wherever the contact lies.
    """
    squared = ((points - position) ** 2).sum(-1)
    # Relative to the nearest point, so that a contact far from all points keeps its force.
    weights = np.exp((squared.min() - squared) / (2 * width**2))
    return force / weights.sum() * weights


class SkinSensor:
    """Reads the forces of all skin cells from a simulation.

    Attributes:
        pushes: Force of every body that touches the skin onto it at the last reading, (3,), N, in
            the world's frame: the sum of its contact normal forces.

    Args:
        model: Model with the geoms that ``add_skin`` gave to the patches.
        skin: Geometry of the cells.
    """

    def __init__(self, model: mujoco.MjModel, skin: Skin) -> None:
        points = skin.points.numpy()
        self._model = model
        self._cells = len(points)
        self._geom_patch = np.full(model.ngeom, -1)
        self._slices, self._points, self._bodies = [], [], []
        for index, name in enumerate(skin.patches):
            geoms = [model.geom(plate.name).id for plate in plates(skin, name)]
            self._geom_patch[geoms] = index
            self._slices.append(skin.slices[name])
            self._points.append(points[skin.slices[name]])
            self._bodies.append(model.body(skin.link[name]).id)
        self._wrench = np.zeros(6)
        self.pushes: dict[int, Array] = {}

    def read(self, data: mujoco.MjData) -> Array:
        """Normal forces at the three points of every cell, (cells, 3), N.

        Their sum is the sum of the contact normal forces on the skin.
        """
        forces = np.zeros((self._cells, 3))
        self.pushes = {}
        if data.ncon == 0:
            return forces
        geoms = data.contact.geom
        sides = self._geom_patch[geoms]
        patches = sides.max(1)
        for contact in np.flatnonzero(patches >= 0):
            patch = patches[contact]
            body = self._bodies[patch]
            mujoco.mj_contactForce(self._model, data, contact, self._wrench)
            offset = data.contact.pos[contact] - data.xpos[body]
            local = offset @ data.xmat[body].reshape(3, 3)
            forces[self._slices[patch]] += spread(self._wrench[0], local, self._points[patch])
            # A contact's normal points from its first geom to its second.
            second = int(sides[contact, 1] == patch)
            push = self._wrench[0] * (2 * second - 1) * data.contact.frame[contact, :3]
            toucher = int(self._model.geom_bodyid[geoms[contact, 1 - second]])
            self.pushes[toucher] = self.pushes.get(toucher, 0.0) + push
        return forces
