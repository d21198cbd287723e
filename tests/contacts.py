"""What MuJoCo itself says of contacts, to compare the skin with."""

from typing import Any

import mujoco
import numpy as np


def contact_force(env: Any) -> float:
    """Sum of the normal forces of all contacts, read from MuJoCo one by one."""
    wrench, total = np.zeros(6), 0.0
    for contact in range(env.data.ncon):
        mujoco.mj_contactForce(env.model, env.data, contact, wrench)
        total += wrench[0]
    return total
