"""A filter of faulty skin readings in front of any policy of a rollout."""

from typing import Any

from torch import Tensor

from hasm_torch.encoders.skin_filter import FilterState, SkinFilter
from hasm_torch.evaluation.rollout import Policy


class Filtered:
    """A policy that reads a filtered skin.

        model = HASM(config, body)
        model.fit(episodes)
        policy = Filtered(model, SkinFilter.learn(body, episodes))

    Args:
        policy: The policy.
        skin_filter: The filter of the robot's skin.
    """

    def __init__(self, policy: Policy, skin_filter: SkinFilter) -> None:
        self.policy, self.filter = policy, skin_filter
        self.state: FilterState | None = None

    def reset(self) -> None:
        """Start a new rollout."""
        self.state = None
        self.policy.reset()

    def step(self, state: Tensor, skin: Tensor, **more: Any) -> Tensor:
        """One control step of the policy, with what the filter leaves of the skin."""
        cleaned, self.state = self.filter(skin.reshape(1, -1, 3), self.state)
        return self.policy.step(state, cleaned.reshape(skin.shape), **more)
