"""Random joint positions of the HSR."""

import numpy as np

from hasm_torch._assets import asset_path
from hasm_torch.robot import JOINTS
from hasm_torch.robot.urdf import read_urdf

_HSR = [read_urdf(asset_path("hsr.urdf")).joints[name] for name in JOINTS]
# The base has no limits: its joints get a metre and a radian to each side.
LOWER = np.nan_to_num([joint.lower for joint in _HSR], neginf=-1.0)
UPPER = np.nan_to_num([joint.upper for joint in _HSR], posinf=1.0)


def anywhere(rng, *shape):
    """(*shape, 11) joint positions within the limits."""
    return rng.uniform(LOWER, UPPER, (*shape, len(LOWER)))
