"""Joint configurations that fit the scenes, in the order of `JOINTS` (rad, arm_lift m)."""

START_POSES: dict[str, tuple[float, ...]] = {
    "compliance": (0.2, -1.0, 0.0, -0.57, 0.0, 0.0, -0.3, 0.6),
    "grasp": (0.0, -0.30, -0.50, -1.60, 0.50, 0.50, 0.0, 0.30),
}
"""Where an episode starts unless its reset says otherwise."""

GRASP_POSES: dict[str, tuple[float, ...]] = {
    "before": (0.03, -0.75, 0.0, -0.8208, 0.0, 0.25, -0.30, 1.2),
    "around": (0.142, -1.15, 0.0, -0.4208, 0.0, 0.10, -0.45, 1.2),
    "closed": (0.142, -1.15, 0.0, -0.4208, 0.0, 0.10, -0.45, 0.1),
    "lifted": (0.29, -1.00, 0.0, -0.5708, 0.0, 0.0, -0.20, 0.1),
}
"""From the start of "grasp" to the object held above the table, one pose after the other."""
