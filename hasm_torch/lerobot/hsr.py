"""LeRobot's robot type "hsr": ``--robot.type=hsr``, an HSR over ROS 2.

LeRobot hands a policy the floats of a robot whose names end in ".pos" or ".vel", all in
``observation.state``; the policy's preprocessor takes skin and object out of it again.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from hasm_torch.encoders.readings import FORCES
from hasm_torch.robot import JOINTS, Skin
from hasm_torch.sim.tasks import OBJECT_ENTRIES

if TYPE_CHECKING:
    from hasm_torch.ros.link import HSRLink


@RobotConfig.register_subclass("hsr")
@dataclass(kw_only=True)
class HSRConfig(RobotConfig):
    """Options of the robot.

    Attributes:
        prefix: Before all topics: "/hsrb", or "" on newer stacks.
        dry_run: Whether nothing is sent, only computed and logged.
        base: Whether the mobile base is read and driven.
        object: Whether the place of an object is read.
        connect_timeout: How long to wait for the first readings, s.
        rate: Control rate, Hz.
        stale_after: Age from which a reading is too old to move by, s.
        stop_after: How long a hold lasts until the robot is stopped, s.
    """

    prefix: str = "/hsrb"
    dry_run: bool = True
    base: bool = True
    object: bool = False
    connect_timeout: float = 10.0
    rate: float = 50.0
    stale_after: float = 0.1
    stop_after: float = 0.5


class HSR(Robot):
    """An HSR as LeRobot sees it; its floats are named ``<joint>.pos`` and ``<cell>.<point>.vel``.

    Args:
        config: Its options.
    """

    config_class = HSRConfig
    name = "hsr"

    def __init__(self, config: HSRConfig) -> None:
        super().__init__(config)
        self.config, self.link = config, None  # type: HSRConfig, HSRLink | None
        self._joints = [f"{joint}.pos" for joint in JOINTS]
        slices = Skin.load().slices
        self._further = [
            f"{patch}.{cell}.{point}.vel"
            for patch, cells in slices.items()
            for cell in range(cells.stop - cells.start)
            for point in range(FORCES)
        ]
        if config.object:
            self._further += [f"{entry}.vel" for entry in OBJECT_ENTRIES]

    @property
    def observation_features(self) -> dict[str, type]:
        """Joint positions, rad or m, then forces of the skin, N, then the object's place, m."""
        return dict.fromkeys([*self._joints, *self._further], float)

    @property
    def action_features(self) -> dict[str, type]:
        """Joint targets, rad or m."""
        return dict.fromkeys(self._joints, float)

    @property
    def is_connected(self) -> bool:
        """Whether it is."""
        return self.link is not None

    @property
    def is_calibrated(self) -> bool:
        """An HSR calibrates itself."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Wait until everything was read.

        Raises:
            TimeoutError: If something was not.
        """
        from hasm_torch.ros.link import HSRLink, LinkConfig
        from hasm_torch.ros.safety import SafetyConfig

        if self.link is not None:
            raise DeviceAlreadyConnectedError(f"{self} is connected already")
        c = self.config
        safety = SafetyConfig(rate=c.rate, stale_after=c.stale_after, stop_after=c.stop_after)
        link = HSRLink(LinkConfig(c.prefix, c.dry_run, c.base, c.object, safety=safety))
        try:
            link.wait(c.connect_timeout)
        except TimeoutError:
            link.close()
            raise
        self.link = link

    def calibrate(self) -> None:
        """Nothing: an HSR calibrates itself."""

    def configure(self) -> None:
        """Nothing is to be set."""

    def get_observation(self) -> dict[str, Any]:
        """The next sample, or the last one where none comes within a control step."""
        reading = self._linked().observe(1 / self.config.rate)
        parts = [reading.state, reading.skin.ravel()]
        if reading.object is not None:
            parts.append(reading.object)
        return dict(zip(self.observation_features, np.concatenate(parts).tolist(), strict=True))

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Send joint targets; returns what was sent, NaN where nothing may be."""
        target = np.array([action[name] for name in self._joints], dtype=np.float64)
        return dict(zip(self._joints, self._linked().command(target).tolist(), strict=True))

    def disconnect(self) -> None:
        """Stop the base and leave."""
        self._linked().close()
        self.link = None

    def _linked(self) -> "HSRLink":
        if self.link is None:
            raise DeviceNotConnectedError(f"{self} is not connected: call connect() first")
        return self.link
