"""What LeRobot does to the data before and after the policy: nothing that changes a value."""

from typing import Any

from lerobot.processor import PolicyProcessorPipeline, make_default_pre_post_processors

from hasm_torch.lerobot.configuration_hasm import HASMConfig


def make_hasm_pre_post_processors(
    config: HASMConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """LeRobot's usual steps; positions and forces keep their units.

    Args:
        config: Configuration of the policy.
        dataset_stats: Kept with the steps as LeRobot wants it, but not applied.

    Returns:
        The steps before the policy and those after it.
    """
    return make_default_pre_post_processors(config, dataset_stats)
