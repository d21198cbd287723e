"""How long control steps take, and whether they keep up with real time."""

import contextlib
import os
import time
from collections import deque

import numpy as np

from hasm_torch.sim.env import CONTROL_RATE

PERIOD = 1 / CONTROL_RATE  # s
REMEMBERED = 500  # steps, the last ten seconds
SHARE = 0.99  # of the steps: what they take at most is what counts


def come_first() -> None:
    """Ask the system to run this thread before others; it does where its user may ask for that.

    A browser that draws without a graphics card has more threads than a small machine has cores.
    """
    if hasattr(os, "sched_setscheduler"):  # Linux
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))


class Pace:
    """Waits for the next control step and measures the last ones."""

    def __init__(self) -> None:
        self._took: deque[float] = deque(maxlen=REMEMBERED)
        self._due = time.perf_counter()

    def begin(self) -> None:
        """Wait until the next step is due; steps that were missed are not made up for."""
        now = time.perf_counter()
        if now < self._due:
            time.sleep(self._due - now)
        self._begun = time.perf_counter()
        self._due = max(self._due, self._begun - PERIOD) + PERIOD

    def end(self) -> None:
        """Take down how long the step took."""
        self._took.append(time.perf_counter() - self._begun)

    @property
    def milliseconds(self) -> float:
        """What 99 of 100 of the last steps took at most, ms; 0 before the first."""
        return 1e3 * float(np.quantile(self._took, SHARE)) if self._took else 0.0

    @property
    def behind(self) -> bool:
        """Whether more steps than that took longer than real time allows."""
        return self.milliseconds > 1e3 * PERIOD
