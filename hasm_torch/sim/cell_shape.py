"""The shape a skin cell is drawn with."""

import numpy as np
from numpy.typing import NDArray

_SIDE = 0.0125  # m, a little less than a cell has, so that neighbours stand apart
_HALF_THICKNESS = 0.001  # m


def hexagon_vertices() -> NDArray[np.float64]:
    """Vertices of a skin cell as a flat hexagonal prism, (12, 3), m, standing on its centre."""
    angles = np.pi / 6 + np.arange(6) * np.pi / 3
    rim = _SIDE * np.stack([np.cos(angles), np.sin(angles)], 1)
    return np.concatenate(
        [np.column_stack([rim, np.full(6, z)]) for z in (-_HALF_THICKNESS, _HALF_THICKNESS)]
    )
