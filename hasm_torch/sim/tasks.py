"""The constants of the experiments: who touches what, how hard, from which postures.

Demonstrators, evaluation and LeRobot's environment take them from here. Units are m, rad, s and
N; joint positions stand in the order of `JOINTS`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hasm_torch.robot import JOINTS

Array = NDArray[np.float64]

# ---- Where an episode starts unless its reset says otherwise; the base starts where `odom` is.
_BASE = (0.0, 0.0, 0.0)
START_POSES: dict[str, tuple[float, ...]] = {
    "compliance": (0.2, -1.0, 0.0, -0.57, 0.0, 0.0, -0.3, 0.6, *_BASE),
    "grasp": (0.0, -0.30, -0.50, -1.60, 0.50, 0.50, 0.0, 0.30, *_BASE),
}

# ---- Touches, in all experiments.
WRIST_PATCHES = ("wrist_upper", "wrist_under", "wrist_left", "wrist_right")
TORSO_PATCHES = ("torso_front", "torso_left", "torso_right")
# One force for all teaching, in the middle of those that are tested: that the robot then moves
# slower or faster with another force is the memory's doing, not the demonstrator's.
TEACHING_FORCE = 6.0
TEST_FORCES = (2.0, 14.0)  # from a touch that the skin just feels well to nearly all of a finger's

# ---- Experiment 1, pseudo-compliance: one joint yields to the touch of one patch.


@dataclass(frozen=True)
class Behaviour:
    """A one-joint behaviour.

    Attributes:
        name: Its name in the metrics.
        patch: Patch that is touched.
        joint: Joint that yields.
        direction: Sign of the joint's motion.
        task: What is done, in words.
    """

    name: str
    patch: str
    joint: str
    direction: int
    task: str


BEHAVIOURS = (
    Behaviour(
        "arm_down", "wrist_upper", "arm_flex_joint", -1,
        "push the arm down at the upper side of the wrist",
    ),
    Behaviour(
        "arm_up", "wrist_under", "arm_flex_joint", +1,
        "push the arm up at the under side of the wrist",
    ),
    Behaviour(
        "wrist_left", "wrist_left", "wrist_roll_joint", +1, "turn the wrist at its left side"
    ),
    Behaviour(
        "wrist_right", "wrist_right", "wrist_roll_joint", -1, "turn the wrist at its right side"
    ),
)  # fmt: skip
# Joint ranges a second for each newton: 6 N turn the arm by 0.2 rad/s, 10 N the wrist by 0.7 rad/s,
# half of its limit.
COMPLIANCE_SPEED = 0.0125
COMPLIANCE_EPISODES = 3  # of each behaviour, in different postures
# Half widths of the postures that count as upright. In all of them, over the whole range of
# arm_flex and for every cell, arm_flex alone moves the touched point within 26 degrees of the
# force (cos > 0.9; the worst corner has 0.903). A wrist twisted by 0.4 is at 0.87, by 1.0 at 0.5.
UPRIGHT = {"arm_roll_joint": 0.15, "wrist_flex_joint": 0.25, "wrist_roll_joint": 0.15}

# ---- Experiment 2, yield: the touched point moves along the force.
YIELD_WRIST = "yield to pushes on the wrist with the arm"
YIELD_TORSO = "yield to pushes on the torso with the base"
YIELD_GAIN = 0.015  # m/s of the touched point for each newton: 14 N lead a hand by 0.2 m/s
# m/s, in the damped least squares. At their speed limits the arm's joints lead a wrist patch by
# 0.53, 0.18 and 0.10 m/s in its three principal directions (medians over postures): the damping
# tells only near singular ones.
YIELD_DAMPING = 0.05
ARM_JOINTS = JOINTS[:5]  # lift, flex, roll, wrist flex and roll: what yields to the wrist
BASE_JOINTS = JOINTS[-3:]  # x, y and yaw in odom; a push on the torso leads x and y
PUSH_SECONDS = 0.6  # of teaching a patch: all four wrist patches take 2.4 s, 40 episodes 96 s
PUSH_GAP = 0.06  # s between two pushes, in which the finger changes places
PUSH_TILT = 0.15  # standard deviation of how far the led direction is off the force, rad
TREMOR = 0.05  # share of the force by which a human's hand trembles
TREMOR_RATE = (8.0, 10.0)  # Hz, physiological tremor
POSTURE_MARGIN = 0.03  # rad or m from the joint limits at the start
BASE_PLACE = 0.2  # m, largest x and y of the base at the start of a teaching episode; any yaw
WRIST_EPISODES, TORSO_EPISODES = 80, 12  # bundled

# ---- Experiment 3, grasp: one patch reaches, another grasps and retracts.
GRASP = "reach by the upper side of the wrist, grasp and retract by its right side"
REACH_PATCH, GRASP_PATCH = "wrist_upper", "wrist_right"
# From the start to the object held above the table, for an object at its usual place.
GRASP_POSES: dict[str, tuple[float, ...]] = {
    "before": (0.03, -0.75, 0.0, -0.8208, 0.0, 0.25, -0.30, 1.2, *_BASE),
    "around": (0.142, -1.15, 0.0, -0.4208, 0.0, 0.10, -0.45, 1.2, *_BASE),
    "closed": (0.142, -1.15, 0.0, -0.4208, 0.0, 0.10, -0.45, 0.1, *_BASE),
    "lifted": (0.29, -1.00, 0.0, -0.5708, 0.0, 0.0, -0.20, 0.1, *_BASE),
}
# Joint ranges a second for each newton: 10 N lift the arm by 0.14 m/s. The base has no limits; what
# counts as its range makes 14 N lead it just below its speed limits.
GRASP_SPEED = 0.02
BASE_RANGE = (0.6, 0.6, 3.0)
GRASP_PAUSE = 0.4  # s, one in each stage of a demonstration
START_NOISE = 0.05  # standard deviation of the start state, rad; the base starts at rest in odom
LIFT_NOISE_SHARE = 0.2  # noise of the arm lift, m, for each rad of the other joints' noise
NEAR, FAR = 0.05, 0.1  # m, largest displacement of the object in the two sets of demonstrations


def _grid(side: int, reach: float) -> tuple[tuple[float, float], ...]:
    places = np.linspace(-reach, reach, side).tolist()
    return tuple((x, y) for x in places for y in places)


# Displacements (x, y) of the object in the demonstrations: nine, then sixteen.
OBJECT_PLACES = _grid(3, NEAR) + _grid(4, FAR)

OBJECT_ENTRIES = {"object_x": "m", "object_y": "m", "object_z": "m"}
"""Names and units of the object's position, as datasets bind it."""

TASKS = {behaviour.name: behaviour.task for behaviour in BEHAVIOURS} | {
    "grasp": GRASP,
    "yield": YIELD_WRIST,
}
"""What is done in each experiment or behaviour, in words."""


def random_posture(lower: Array, upper: Array, generator: np.random.Generator) -> Array:
    """Every joint anywhere in its range, the base at 0.

    The simulation lets links pass through each other and the floor, so every posture is possible.

    Args:
        lower: (J,) lower limits of `JOINTS`, rad or m; infinite for the base.
        upper: (J,) upper limits.
        generator: Draws the posture.

    Returns:
        (J,) rad or m.
    """
    limited = np.isfinite(lower) & np.isfinite(upper)
    posture = np.zeros(len(lower))
    low, high = lower[limited] + POSTURE_MARGIN, upper[limited] - POSTURE_MARGIN
    posture[limited] = generator.uniform(low, high)
    return posture


def upright_posture(lower: Array, upper: Array, generator: np.random.Generator) -> Array:
    """Every joint anywhere in its range, but forearm and hand in line and hardly twisted.

    Args:
        lower: (J,) lower limits of `JOINTS`, rad or m; infinite for the base.
        upper: (J,) upper limits.
        generator: Draws the posture.

    Returns:
        (J,) rad or m.
    """
    posture = random_posture(lower, upper, generator)
    for joint, reach in UPRIGHT.items():
        posture[JOINTS.index(joint)] = generator.uniform(-reach, reach)
    return posture


def noisy_start(
    home: Array, noise: float, lower: Array, upper: Array, generator: np.random.Generator
) -> Array:
    """A start state near the usual one.

    Args:
        home: (J,) usual start state, rad or m.
        noise: Standard deviation, rad; the arm lift gets `LIFT_NOISE_SHARE` of it in m, the base
            none.
        lower: (J,) lower limits.
        upper: (J,) upper limits.
        generator: Draws the noise.

    Returns:
        (J,) rad or m.
    """
    scale = np.full(len(home), noise)
    scale[JOINTS.index("arm_lift_joint")] *= LIFT_NOISE_SHARE
    scale[[JOINTS.index(joint) for joint in BASE_JOINTS]] = 0.0
    return np.clip(home + scale * generator.standard_normal(len(home)), lower, upper)
