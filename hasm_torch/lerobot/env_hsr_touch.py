"""LeRobot's environment type "hsr_touch": ``--env.type=hsr_touch --env.task=yield``."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig

from hasm_torch.encoders.readings import FORCES
from hasm_torch.episode import ACTION, ENVIRONMENT, STATE, TACTILE
from hasm_torch.robot import JOINTS, Skin
from hasm_torch.sim.tasks import BEHAVIOURS

YIELD, TORSO, GRASP = "yield", "torso", "grasp"
TASKS = (*(behaviour.name for behaviour in BEHAVIOURS), YIELD, TORSO, GRASP)
GYM_ID = "hasm_torch/HumanTouch-v0"
# Observations of the environment, and what LeRobot calls them.
NAMES = {ACTION: ACTION, "state": STATE, "tactile": TACTILE, "environment_state": ENVIRONMENT}


def check_task(task: str | None) -> None:
    """Raise ValueError for a task that does not exist."""
    if task not in TASKS:
        raise ValueError(f"unknown task {task!r}, valid: {', '.join(TASKS)}")


@EnvConfig.register_subclass("hsr_touch")
@dataclass
class HSRTouchConfig(EnvConfig):
    """The simulated HSR and a human who touches it; see ``human_env.HumanTouchEnv``.

    Attributes:
        task: "arm_down", "arm_up", "wrist_left", "wrist_right", "yield", "torso" or "grasp".
        force: Force of the touch, N, 0 to 15; None draws it for every episode.
        fps: Control rate, Hz.
    """

    task: str | None = "arm_down"
    force: float | None = None
    fps: int = 50
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=lambda: dict(NAMES))

    def __post_init__(self) -> None:
        check_task(self.task)
        joints = (len(JOINTS),)
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, joints),
            "state": PolicyFeature(FeatureType.STATE, joints),
            "tactile": PolicyFeature(FeatureType.STATE, (FORCES * Skin.load().cells,)),
        }
        if self.task == GRASP:
            self.features["environment_state"] = PolicyFeature(FeatureType.ENV, (3,))

    @property
    def package_name(self) -> str:
        """Module that registers the environment."""
        return __name__

    @property
    def gym_id(self) -> str:
        """Name of the environment in Gymnasium."""
        return GYM_ID

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of the environment."""
        return {"task": self.task, "force": self.force}


gym.register(id=GYM_ID, entry_point="hasm_torch.lerobot.human_env:HumanTouchEnv")
