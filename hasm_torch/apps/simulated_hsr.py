"""``python -m hasm_torch.apps.simulated_hsr``: the simulated HSR as a ROS node, in real time."""

from dataclasses import dataclass

import torch

from hasm_torch.apps.command_line import parse_options
from hasm_torch.ros.simulated_hsr import SimulatedHSR
from hasm_torch.sim.env import HSRTouchEnv
from hasm_torch.sim.scene import SCENES


@dataclass
class SimulatedConfig:
    """Options of the program.

    Attributes:
        prefix: Before all topics.
        scene: "compliance", the robot alone, or "grasp", with a table and an object.
        seed: Of where the object stands.
    """

    prefix: str = "/hsrb"
    scene: str = "compliance"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.scene not in SCENES:
            raise ValueError(f"scene must be one of {SCENES}, got {self.scene!r}")


def main() -> None:
    """Simulate in real time until the program is ended."""
    config = parse_options(SimulatedConfig)
    torch.set_num_threads(1)
    sim = HSRTouchEnv(config.scene)
    robot = SimulatedHSR(sim, config.prefix)
    seen, _ = sim.reset(seed=config.seed)
    print(f"an HSR with the prefix {config.prefix!r}; Ctrl-C ends it", flush=True)
    try:
        while True:
            sim.touch_all(robot.pushes)
            state, skin, *more = (torch.from_numpy(values) for values in seen.values())
            target = robot.step(state, skin, observation=more[0] if more else None)
            seen, *_ = sim.step(target.numpy())
    except KeyboardInterrupt:
        print("ending")
    finally:
        robot.close()


if __name__ == "__main__":
    main()
