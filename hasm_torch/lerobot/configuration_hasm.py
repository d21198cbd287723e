"""LeRobot's policy type "hasm": ``--policy.type=hasm``."""

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import SGDConfig

from hasm_torch import config as settings
from hasm_torch.body import Body
from hasm_torch.model.checkpoint import ACTION, STATE, TACTILE


@PreTrainedConfig.register_subclass("hasm")
@dataclass
class HASMConfig(PreTrainedConfig):
    """Configuration of ``HASMPolicy``.

    Training fills in everything but ``model``, so that a checkpoint says what it needs.

    Attributes:
        model: Settings of the method: ``--policy.model.bits=8``.
        body: Joints and skin of the robot.
        memories: Shapes of the memories by patch.
        dataset: Fingerprint of the dataset that was learned.
        episodes: Indices of the episodes that the memories hold.
        normalization_mapping: Nothing is normalised: limits and forces have units.
    """

    model: settings.HASMConfig = field(default_factory=settings.HASMConfig)
    body: Body | None = None
    memories: dict[str, settings.MemoryShape] = field(default_factory=dict)
    dataset: str | None = None
    episodes: list[int] = field(default_factory=list)
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "STATE": NormalizationMode.IDENTITY,
            "ACTION": NormalizationMode.IDENTITY,
        }
    )

    @property
    def observation_delta_indices(self) -> None:
        """A batch needs the present frame only: an episode is read as a whole."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """As ``observation_delta_indices``."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """No reward is used."""
        return None

    def get_optimizer_preset(self) -> SGDConfig:
        """An optimizer that does nothing, because storing needs no gradient."""
        return SGDConfig(lr=0.0, grad_clip_norm=0.0)

    def get_scheduler_preset(self) -> None:
        """No scheduler."""
        return None

    def validate_features(self) -> None:
        """Check that joints, skin and joint targets are there and have the body's sizes.

        Raises:
            ValueError: If a feature is missing or of another size.
        """
        declared = {**(self.input_features or {}), **(self.output_features or {})}
        missing = [key for key in (STATE, TACTILE, ACTION) if key not in declared]
        if missing:
            raise ValueError(
                f"policy hasm needs the features {STATE}, {TACTILE} and {ACTION}, missing: "
                f"{', '.join(missing)}; the data have: {', '.join(declared)}"
            )
        joints = len(self.body.joints) if self.body else declared[STATE].shape[0]
        for key in (STATE, ACTION):
            if tuple(declared[key].shape) != (joints,):
                raise ValueError(
                    f"policy hasm needs {key} of shape ({joints},), one entry a joint, got "
                    f"{tuple(declared[key].shape)}"
                )
