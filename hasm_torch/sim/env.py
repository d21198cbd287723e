"""The touched HSR as a Gymnasium environment."""

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from hasm_torch.robot import BASE_FRAME, JOINTS, Skin
from hasm_torch.sim.finger import TouchPoint
from hasm_torch.sim.render import VIEWS
from hasm_torch.sim.scene import (
    OBJECT_HALF_SIZE,
    OBJECT_POSITION,
    TABLE_HEIGHT,
    build_model,
    joint_speed_limits,
)
from hasm_torch.sim.slew import SlewedReference, hsr_reference
from hasm_torch.sim.tasks import START_POSES
from hasm_torch.sim.touch_env import CONTROL_RATE, LARGEST_FORCE, SUBSTEPS, TouchEnv, finite

__all__ = ["CONTROL_RATE", "LARGEST_FORCE", "MAX_EPISODE_STEPS", "HSRTouchEnv", "TouchPoint"]

Array = NDArray[np.float64]

MAX_EPISODE_STEPS = 1500

_OBJECT_OFFSET = 0.01  # m, largest random displacement of the object
_LIFTED = 0.05  # m


class HSRTouchEnv(TouchEnv):
    """An HSR with artificial skin that a human touches with one or two fingers.

    Observation: {"state": (11,) joint positions in the order of `JOINTS`, rad, m for `METRES`;
    "tactile": (cells * 3,) normal forces of all skin cells, N; in "grasp" also
    "environment_state": (3,) centre of the object in the live frame `BASE_FRAME`, m}. Action:
    (11,) joint targets, clipped to the joint limits; the mobile base has none. The world is the
    frame `odom` of the base's joints. One step is a control tick of 20 ms. The reward is 1 while
    the object is lifted and held. An episode has no end of its own: `gymnasium.make` truncates
    it after `MAX_EPISODE_STEPS`.

    `info` holds "is_success" (the object is lifted and held; always False in "compliance"),
    "object_height" (m above the table, 0 without an object), "finger_force" (N, that the skin
    really gets in all), "touched" (first patch that feels its finger, or None), "time" (s).

    Args:
        scene: "compliance" or "grasp".
        render_mode: None or "rgb_array".
    """

    _max_episode_steps: ClassVar[int] = MAX_EPISODE_STEPS

    def __init__(self, scene: str = "compliance", render_mode: str | None = None) -> None:
        self.scene, skin = scene, Skin.load()
        model = build_model(scene, skin)
        home = np.array(START_POSES[scene])
        speed = joint_speed_limits()
        super().__init__(model, skin, JOINTS, speed, home, VIEWS[scene], render_mode)
        if scene == "grasp":
            place = spaces.Box(-np.inf, np.inf, (3,), np.float32)
            observed: spaces.Dict = self.observation_space  # type: ignore[assignment]
            self.observation_space = spaces.Dict({**observed, "environment_state": place})

    @property
    def object_position(self) -> Array | None:
        """Centre of the object in `odom`, (3,), m; None in a scene without one."""
        return self.data.body("object").xpos.copy() if self.scene == "grasp" else None

    def _drive_reference(self) -> SlewedReference:
        limits = self.joint_lower, self.joint_upper, self.joint_speed_limit
        return hsr_reference(*limits, 1 / CONTROL_RATE, SUBSTEPS)

    def _place_object(self, displacement: Any) -> None:
        random_offset = self.np_random.uniform(-_OBJECT_OFFSET, _OBJECT_OFFSET, 2)
        offset = finite(random_offset if displacement is None else displacement, 2, "object")
        if self.scene == "grasp":
            address = int(self.model.joint("object").qposadr[0])
            self.data.qpos[address : address + 2] = np.array(OBJECT_POSITION) + offset

    def _observation(self) -> dict[str, NDArray[np.float32]]:
        observation = super()._observation()
        position = self.object_position
        if position is not None:
            base = self.data.body(BASE_FRAME)
            turned = (position - base.xpos) @ base.xmat.reshape(3, 3)
            observation["environment_state"] = turned.astype(np.float32)
        return observation

    def _info(self) -> dict[str, Any]:
        height, held = self._object_state()
        found = {"is_success": held and height >= _LIFTED, "object_height": height}
        return super()._info() | found

    def _object_state(self) -> tuple[float, bool]:
        """Height of the object above its place on the table, m, and whether the fingers hold it."""
        position = self.object_position
        if position is None:
            return 0.0, False
        height = float(position[2] - TABLE_HEIGHT - OBJECT_HALF_SIZE[2])
        left = self.data.body("hand_l_finger_tip_frame").xpos
        right = self.data.body("hand_r_finger_tip_frame").xpos
        across = left - right
        span = float(np.linalg.norm(across))
        from_middle = position - (left + right) / 2
        aside = abs(float(from_middle @ across)) / span
        return height, aside < span / 2 and float(np.linalg.norm(from_middle)) < 0.1
