"""An HSR over ROS 2 in place of the simulation, for what was written for that.

step: joint targets ──HSRLink──► robot ──next sample──► the simulation's model, posed like it
"""

from typing import Any, SupportsFloat

import mujoco
import numpy as np
from numpy.typing import NDArray

from hasm_torch.robot import BASE_FRAME
from hasm_torch.ros.link import HSRLink, Reading
from hasm_torch.ros.safety import Mode
from hasm_torch.sim.env import CONTROL_RATE, HSRTouchEnv, TouchPoint
from hasm_torch.sim.touch_env import Observation
from hasm_torch.touch.demonstrations import FELT
from hasm_torch.touch.live import Status


class LiveEnv(HSRTouchEnv):
    """A real robot that is stepped like the simulated one; its samples give the time.

    Its physics stands still: joints are where the robot's are, and the skin feels what its does. A
    cell that did not report counts as untouched.

    Args:
        link: The robot; it is closed with this.
        timeout: How long to wait for the first readings, s.

    Raises:
        TimeoutError: If there are none.
    """

    def __init__(self, link: HSRLink, timeout: float) -> None:
        super().__init__("grasp" if link.config.object else "compliance")
        super().reset()  # the simulated fingers are put away, for good
        self._link = link
        self._take(link.wait(timeout))

    def touch_all(self, touches: Any) -> None:
        """Nothing: a person touches the robot.

        Raises:
            ValueError: A touch is asked for.
        """
        if touches:
            raise ValueError(f"a live robot is pushed by hand, got {sorted(touches)}")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Look where the robot is; it is not moved.

        Raises:
            ValueError: It shall be put somewhere.
        """
        if options:
            raise ValueError(f"a live robot is not put anywhere, got {sorted(options)}")
        self._take(self._link.observe(0.0))
        return self._observation(), self._info()

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Send joint targets, and wait for the next sample, a control step at most."""
        self._link.command(action)
        self._take(self._link.observe(1 / CONTROL_RATE))
        return self._observation(), 0.0, False, False, self._info()

    def status(self) -> Status:
        """What the robot is doing."""
        mode, dry = self._link.mode, self._link.config.dry_run
        told = "Dry run, nothing is sent" if dry else "Live"
        told += f": {self._link.why or mode.value}"
        return Status(dry, mode is Mode.EMERGENCY, mode in (Mode.DRIVING, Mode.HOLDING), told)

    def emergency_stop(self) -> None:
        """Stop the robot until released."""
        self._link.emergency_stop("asked for on the page")

    def release(self) -> None:
        """End an emergency stop."""
        self._link.release()

    def close(self) -> None:
        """Stop the base and leave."""
        super().close()
        self._link.close()

    def _take(self, reading: Reading) -> None:
        """Pose the model like the robot."""
        self._set_joints(reading.state.astype(np.float64))
        mujoco.mj_kinematics(self.model, self.data)
        if reading.object is not None:
            base, address = self.data.body(BASE_FRAME), self.model.joint("object").qposadr[0]
            place = base.xpos + base.xmat.reshape(3, 3) @ reading.object
            self.data.qpos[address : address + 3] = place
            mujoco.mj_kinematics(self.model, self.data)
        self.skin_forces = np.nan_to_num(reading.skin.astype(np.float64))
        self._touch_points = [self._felt(p) for p in self.skin.patches if self._pressed(p) > FELT]
        self._steps += 1

    def _pressed(self, patch: str) -> float:
        return float(self.skin_forces[self.skin.slices[patch]].sum())

    def _felt(self, patch: str) -> TouchPoint:
        """The force on a patch, as if it were that on its most pressed cell."""
        span = self.skin.slices[patch]
        cell = int(self.skin_forces[span].sum(axis=1).argmax())
        link = self.data.body(self.skin.link[patch])
        turned = link.xmat.reshape(3, 3)
        inward = -turned @ self.skin.normals[span][cell].numpy()
        point = link.xpos + turned @ self.skin.positions[span][cell].numpy()
        return TouchPoint(patch, cell, self._pressed(patch) * inward, point)
