"""LeRobot's policy type "hasm": ``--policy.type=hasm``."""

from dataclasses import dataclass, field
from math import prod

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import SGDConfig

from hasm_torch import config as settings
from hasm_torch.body import Body
from hasm_torch.episode import ACTION, STATE, TACTILE
from hasm_torch.model.settled import Settled


@PreTrainedConfig.register_subclass("hasm")
@dataclass
class HASMConfig(PreTrainedConfig):
    """Configuration of ``HASMPolicy``.

    Training fills in everything but ``model`` and ``bound``, so that a checkpoint says what it
    needs.

    Attributes:
        model: Settings of the method: ``--policy.model.bits=8``.
        bound: Further observations to bind; None takes those that the dataset declares, see
            ``FeatureMap``.
        body: Joints and skin of the robot.
        settled: What was chosen for the episodes.
        dataset: Fingerprint of the dataset that was learned.
        episodes: Indices of the episodes that the memories hold.
        normalization_mapping: Nothing is normalised: limits and forces have units.
    """

    model: settings.HASMConfig = field(default_factory=settings.HASMConfig)
    bound: list[str] | None = None
    body: Body | None = None
    settled: Settled | None = None
    dataset: str | None = None
    episodes: list[int] = field(default_factory=list)
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "STATE": NormalizationMode.IDENTITY,
            "ENV": NormalizationMode.IDENTITY,
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
        """Check that joints, skin, what else is bound and joint targets fit the body.

        Raises:
            ValueError: If a feature is missing or of another size.
        """
        if self.body is None:
            raise ValueError("policy hasm knows no body yet: it comes from dataset or checkpoint")
        joints = len(self.body.joints)
        needed = {STATE: joints, ACTION: joints, **self.body.observations}
        if self.body.channels:
            needed[TACTILE] = self.body.readings
        declared = {**(self.input_features or {}), **(self.output_features or {})}
        if missing := [key for key in needed if key not in declared]:
            raise ValueError(
                f"policy hasm needs the features {', '.join(needed)}, missing: "
                f"{', '.join(missing)}; there are: {', '.join(declared)}"
            )
        for key, entries in needed.items():
            if prod(declared[key].shape) != entries:
                raise ValueError(
                    f"policy hasm needs {key} with {entries} entries, got shape "
                    f"{tuple(declared[key].shape)}"
                )
