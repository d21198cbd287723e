"""Options of ``eval.py``."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Literal

from hasm_torch.config import HASMConfig
from hasm_torch.data.episodes import FeatureMap
from hasm_torch.data.training import DatasetConfig, Method, RobotConfig
from hasm_torch.evaluation import grasp
from hasm_torch.evaluation.runner import EXPERIMENTS, check_experiments
from hasm_torch.sim.env import LARGEST_FORCE
from hasm_torch.sim.tasks import START_NOISE, WRIST_EPISODES

# What open-loop prediction takes, and what it shares with rollouts.
OPEN_LOOP = ("dataset", "features", "robot", "folds", "horizon_s")
BOTH = ("mode", "method", "model", "seed", "output_dir")
# What a rollout takes only where it trains its models.
TRAINING = ("datasets", "method", "model", "episodes", "teach_seed")


@dataclass
class EvalConfig:
    """Options of ``eval.py``.

    Attributes:
        mode: "rollout" in simulation, or "open_loop" prediction of a dataset's held-out episodes,
            which takes ``dataset``, ``features``, ``robot``, ``folds``, ``horizon_s``, ``method``,
            ``model``, ``seed`` and ``output_dir`` and nothing else.
        dataset: Dataset of open-loop prediction.
        features: Which of its features are read.
        robot: Which robot recorded it.
        folds: Parts into which its episodes are split; each is predicted by the others.
        horizon_s: How far ahead it is predicted, s, beside one frame ahead.
        checkpoint: Directory written by ``train.py``, rolled out in every experiment named;
            without it models are trained on the bundled episodes.
        experiments: Of "compliance", "yield" and "grasp".
        datasets: Folder of the bundled datasets.
        method: "default", with the settings under ``model``, or "literal", the paper as written.
        model: Settings of the method, where a model is trained.
        episodes: Yield demonstrations at the wrist that are learned, the first ones; curves show
            fewer.
        rollouts: Rollouts of each group: a compliance behaviour, pushes on the wrist or the torso,
            grasps; by default those of ``suite.ROLLOUTS``.
        seed: Seed of everything that the tests draw; the teaching has its own.
        teach_seed: Record all demonstrations anew with this seed and learn those, instead of the
            bundled ones.
        forces: Forces of the touches, N, 0.5 to 15, taken in turn; by default drawn from 2 to
            14 N (compliance, yield) and 3 to 12 N (grasp).
        start_noise: Noise of a grasp's start state, see ``tasks.noisy_start``, rad.
        object_noise: The object stands up to this far from its place along x and y, m.
        pauses: Random pauses in a grasp.
        traces: Whether to write ``traces.npz``, see ``traces.write_traces``.
        render: Whether to make videos.
        rerun: Whether to write a recording of a rollout for the Rerun viewer.
        output_dir: Where results go; by default ``outputs/eval/<time>``, or
            ``outputs/open_loop/<time>``.
    """

    mode: Literal["rollout", "open_loop"] = "rollout"
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    features: FeatureMap = field(default_factory=FeatureMap)
    robot: RobotConfig = field(default_factory=RobotConfig)
    folds: int = 5
    horizon_s: float = 0.5
    checkpoint: Path | None = None
    experiments: list[str] = field(default_factory=lambda: list(EXPERIMENTS))
    datasets: Path = Path("datasets")
    method: Method = "default"
    model: HASMConfig = field(default_factory=HASMConfig)
    episodes: int = WRIST_EPISODES
    rollouts: int | None = None
    seed: int = 0
    teach_seed: int | None = None
    forces: list[float] = field(default_factory=list)
    start_noise: float = START_NOISE
    object_noise: float = grasp.PLACE_NOISE
    pauses: int = grasp.PAUSES
    traces: bool = False
    render: bool = True
    rerun: bool = False
    output_dir: Path | None = None

    def __post_init__(self) -> None:
        if self.mode not in ("rollout", "open_loop"):
            raise ValueError(f"unknown mode {self.mode!r}, valid: rollout, open_loop")
        names = [f.name for f in fields(self)]
        if self.mode == "open_loop":
            self._refuse([n for n in names if n not in OPEN_LOOP + BOTH], "--mode=open_loop")
        elif self.dataset.root is not None:
            raise ValueError(
                "a rollout takes --checkpoint, not --dataset.root: train with train.py first, or "
                "give --mode=open_loop"
            )
        else:
            self._refuse(OPEN_LOOP, "--mode=rollout")
        if self.checkpoint is not None:
            self._refuse(TRAINING, "a rollout of --checkpoint, which trains nothing,")
        check_experiments(self.experiments)
        for name in ("rollouts", "episodes"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        for force in self.forces:
            if not 0.5 <= force <= LARGEST_FORCE:
                raise ValueError(f"forces must be 0.5 to {LARGEST_FORCE:g} N, got {force}")
        for name in ("start_noise", "object_noise", "pauses"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(
                    f"{name} must be finite and not negative, got {getattr(self, name)}"
                )

    def _refuse(self, names: Sequence[str], by: str) -> None:
        """Raise ValueError if an option was given that would be lost."""
        default = {
            f.name: f.default_factory() if callable(f.default_factory) else f.default
            for f in fields(self)
        }
        given = [name for name in names if getattr(self, name) != default[name]]
        if given:
            raise ValueError(f"{by} takes no {', '.join('--' + name for name in given)}")
