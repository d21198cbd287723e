"""``touch.py``, ``hasm-touch``: teach the HSR, simulated or live, by hand in a browser."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch

from hasm_torch._extras import require
from hasm_torch.apps.command_line import parse_options
from hasm_torch.apps.teach import record_if_missing
from hasm_torch.config import HASMConfig
from hasm_torch.model.hasm import HASM
from hasm_torch.sim.env import HSRTouchEnv
from hasm_torch.sim.scene import SCENES
from hasm_torch.touch.link import PageProcess
from hasm_torch.touch.session import Session
from hasm_torch.touch.shelf import Shelf
from hasm_torch.touch.simulated import BUNDLED, body_in, check_body

# How long a thread keeps Python to itself, s: physics and recall give it away many times a control
# step, and what learns beside them would hand it back after 5 ms each time.
SWITCH_INTERVAL = 0.0005


@dataclass
class HSRConfig:
    """Which live HSR.

    Attributes:
        prefix: Before all its topics: "/hsrb", or "" on newer stacks.
        dry_run: Whether nothing is sent to it, only computed and logged.
        base: Whether its mobile base is read and driven.
        connect_timeout: How long to wait for its first readings, s.
    """

    prefix: str = "/hsrb"
    dry_run: bool = True
    base: bool = True
    connect_timeout: float = 10.0


@dataclass
class TouchConfig:
    """Options of ``touch.py``.

    Attributes:
        robot: "simulated", or "hsr", a live one over ROS 2.
        hsr: Which live one.
        teach: What the robot knows at the start: "bundled" teaching of the scene, or "empty".
        checkpoint: Directory written by ``train.py`` or saved on the page, known in place of that.
        scene: "compliance", the robot alone, or "grasp", with a table and an object.
        datasets: Folder of the bundled datasets.
        model: Settings of the method, where the robot starts empty; by default a touch moves it,
            never time alone.
        output_dir: Folder of what is saved on the page.
        seed: Seed of what resets draw.
        host: Address to listen at: only this machine can reach the default one.
        port: Port to listen at; the next free one where it is taken.
    """

    robot: Literal["simulated", "hsr"] = "simulated"
    hsr: HSRConfig = field(default_factory=HSRConfig)
    teach: Literal["bundled", "empty"] = "bundled"
    checkpoint: Path | None = None
    scene: str = "compliance"
    datasets: Path = Path("datasets")
    model: HASMConfig = field(default_factory=lambda: HASMConfig(drive="spike"))
    output_dir: Path = Path("outputs/touch")
    seed: int = 0
    host: str = "127.0.0.1"
    port: int = 8080

    def __post_init__(self) -> None:
        if self.scene not in SCENES:
            raise ValueError(f"scene must be one of {SCENES}, got {self.scene!r}")
        if not 0 <= self.port < 65536:
            raise ValueError(f"port must be 0 to 65535, got {self.port}")


def open_session(config: TouchConfig) -> Session:
    """A session with what the options ask for; it is not started yet.

    Raises:
        FileNotFoundError: There is no checkpoint.
        ValueError: It does not fit the robot or the scene.
        ModuleNotFoundError: A live robot needs ROS.
        TimeoutError: There is no live robot.
    """
    model = HASM(config.model, body_in(config.scene))
    if config.checkpoint is not None:
        model = HASM.from_pretrained(config.checkpoint)
        check_body(model.body, config.scene)
    env = reach(config.hsr, config.scene) if config.robot == "hsr" else None
    session = Session(config.scene, model, Shelf(config.output_dir), config.seed, env)
    if config.checkpoint is None and config.teach == "bundled":
        record_if_missing(config.datasets, [BUNDLED[config.scene]])
        session.load_bundled(config.datasets)
    return session


def reach(config: HSRConfig, scene: str) -> HSRTouchEnv:
    """What stands for a live HSR."""
    require("ros")
    from hasm_torch.ros.link import HSRLink, LinkConfig
    from hasm_torch.ros.live_env import LiveEnv

    link = HSRLink(LinkConfig(config.prefix, config.dry_run, config.base, scene == "grasp"))
    try:
        return LiveEnv(link, config.connect_timeout)
    except BaseException:
        link.close()
        raise


def main() -> None:
    """Open the page and serve it until the program is ended."""
    config = parse_options(TouchConfig)
    torch.set_num_threads(1)  # a control step's tensors are too small to share between threads
    sys.setswitchinterval(SWITCH_INTERVAL)
    try:
        session = open_session(config)
        page = PageProcess(session, config.host, config.port)
    except (OSError, ValueError, ModuleNotFoundError) as error:
        sys.exit(f"touch.py: {error}")
    session.start()
    print(f"open {page.address} in a browser; Ctrl-C ends it", flush=True)
    try:
        page.wait()
    except KeyboardInterrupt:
        print("ending")
    finally:
        page.close()
        session.close()


if __name__ == "__main__":
    main()
