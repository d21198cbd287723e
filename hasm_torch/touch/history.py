"""What the page shows of a control step, and of the last seconds."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hasm_torch.sim.env import CONTROL_RATE
from hasm_torch.touch.live import Status

Array = NDArray[np.float64]

SECONDS = 6.0  # of spikes, force and joints that are shown


class History:
    """The last seconds: a row a control step, the newest last.

    Args:
        patches: Number of patches.
        joints: Number of joints.
    """

    def __init__(self, patches: int, joints: int) -> None:
        steps = round(SECONDS * CONTROL_RATE)
        self._rows = np.zeros((2 * steps, patches + joints + 1))
        self._split, self._at = (patches, patches + joints), 0

    def add(self, spikes: Array, state: Array, force: float) -> None:
        """Take in a control step: spikes of every patch, joint positions, force on the skin, N."""
        half = len(self._rows) // 2
        row = np.concatenate([spikes, state, [force]])
        # Written twice, so that the last steps always stand together.
        self._rows[self._at] = self._rows[self._at + half] = row
        self._at = (self._at + 1) % half

    def last(self) -> tuple[Array, Array, Array]:
        """Spikes (T, patches), positions (T, joints) and force (T,) of the last seconds."""
        half = len(self._rows) // 2
        rows = self._rows[self._at : self._at + half].copy()
        spikes, joints, force = np.split(rows, self._split, axis=1)
        return spikes, joints, force[:, 0]


@dataclass(frozen=True)
class Arrow:
    """A push as it is drawn.

    Attributes:
        patch: Patch that is pushed.
        point: (3,) where, in `odom`, m.
        inward: (3,) unit vector in which it is pushed.
        newtons: How hard.
        pinned: Whether it stays.
    """

    patch: str
    point: Array
    inward: Array
    newtons: float
    pinned: bool


@dataclass(frozen=True)
class Reason:
    """One association that the robot's last answer drew on.

    Attributes:
        episode: Number of the demonstration.
        time: When in it, s.
        weight: Its share of the answer to this touch.
        row: Its row in the memory.
        patch: Patch whose touch was answered.
    """

    episode: int
    time: float
    weight: float
    row: int
    patch: str


@dataclass(frozen=True)
class Why:
    """Why the robot moved as it last did.

    Attributes:
        reasons: What it drew on most, greatest weight first.
        confidence: 0 to 1.
        spread: Over how many associations the weights are spread, exp of their entropy.
        posture_known: Whether it was taught near this posture.
        touch_known: Whether it was taught a touch like this one.
    """

    reasons: tuple[Reason, ...]
    confidence: float
    spread: float
    posture_known: bool
    touch_known: bool


@dataclass(frozen=True)
class Snapshot:
    """A moment of a session, never changed once it is made.

    Attributes:
        mode: "live", "record" or "play".
        recorded: Length of the recording, s.
        unkept: Whether a recording waits to be kept.
        qpos: Positions of the simulation.
        state: (J,) joint positions, rad or m.
        slid: Joints on their way to where their sliders are.
        cells: (C,) force on every cell, N.
        arrows: The pushes.
        ghosts: Joint positions of ghosts by name.
        why: Why it last moved, or None.
        history: See `History.last`.
        known: How many demonstrations it knows.
        playable: Numbers of the demonstrations that can be played.
        said: What was said last, whether it was a failure, and its number.
        busy: What is done beside, and for how many seconds.
        step_ms: What 99 of 100 control steps take at most, ms.
        behind: Whether it falls behind real time.
        live: What the live robot is doing; None where it is simulated.
    """

    mode: str
    recorded: float
    unkept: bool
    qpos: Array
    state: Array
    slid: frozenset[int]
    cells: Array
    arrows: tuple[Arrow, ...]
    ghosts: dict[str, Array]
    why: Why | None
    history: tuple[Array, Array, Array]
    known: int
    playable: tuple[int, ...]
    said: tuple[str, bool, int]
    busy: tuple[str, float] | None
    step_ms: float
    behind: bool
    live: Status | None = None
