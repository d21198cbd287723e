"""What LeRobot does to the data before and after the policy: nothing that changes a value."""

from dataclasses import dataclass, field
from math import prod
from typing import Any

from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import (
    ObservationProcessorStep,
    PolicyProcessorPipeline,
    ProcessorStepRegistry,
    make_default_pre_post_processors,
)

from hasm_torch.episode import STATE, TACTILE
from hasm_torch.lerobot.configuration_hasm import HASMConfig


@ProcessorStepRegistry.register("hasm_split_state")
@dataclass
class SplitState(ObservationProcessorStep):
    """Takes apart what a live robot reports as one state: joints, skin, what else is bound.

    Attributes:
        sizes: Entries of each observation, in the order in which they follow each other.
    """

    sizes: dict[str, int] = field(default_factory=dict)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """The observation in its parts; one that is in parts already stays as it is."""
        state = observation.get(STATE)
        if len(self.sizes) < 2 or state is None or state.shape[-1] != sum(self.sizes.values()):
            return observation
        parts = state.split(list(self.sizes.values()), dim=-1)
        return {**observation, **dict(zip(self.sizes, parts, strict=True))}

    def get_config(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {"sizes": self.sizes}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """The features of the policy are those in parts."""
        return features


def make_hasm_pre_post_processors(
    config: HASMConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """LeRobot's usual steps, after what a live robot reports is taken apart.

    Args:
        config: Configuration of the policy.
        dataset_stats: Kept with the steps as LeRobot wants it, but not applied.

    Returns:
        The steps before the policy and those after it; positions and forces keep their units.
    """
    before, after = make_default_pre_post_processors(config, dataset_stats)
    bound = config.body.observations if config.body else {}
    declared = config.input_features or {}
    sizes = {k: prod(declared[k].shape) for k in (STATE, TACTILE, *bound) if k in declared}
    before.steps = [SplitState(sizes), *before.steps]
    return before, after
