"""Random joint positions of the HSR."""

import numpy as np

from hasm_torch.robot import Kinematics

_HSR = Kinematics()
# The base has no limits: its joints get a metre and a radian to each side.
LOWER = np.nan_to_num(_HSR.lower.numpy(), neginf=-1.0)
UPPER = np.nan_to_num(_HSR.upper.numpy(), posinf=1.0)


def anywhere(rng, *shape):
    """(*shape, 11) joint positions within the limits."""
    return rng.uniform(LOWER, UPPER, (*shape, len(LOWER)))
