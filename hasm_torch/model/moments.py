"""What a robot that moves by itself did: frames of episodes, and the linear trend through them.

    t = T [1, state, past, touch]

The trend T is the ridge regression of the displacement to the frame ``horizon`` later on the joint
positions, their displacements over some times back and the touch of every patch.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

# Ridge on standardised inputs, as a share of the number of frames.
TREND_RIDGE = 0.01


class Series(NamedTuple):
    """One episode: (T, J) joint positions and (T, P) rate density ρ of every patch, float64."""

    state: Tensor
    touch: Tensor


class Moments(NamedTuple):
    """Frames, K of them.

    Attributes:
        state: (K, J) joint positions, rad or m.
        past: (K, J, N) displacements since so many frames ago, or since the episode's start.
        touch: (K, P) rate densities.
        target: (K, J) displacement to the frame ``horizon`` later.
        episode: (K,) number of the episode in the sequence given.
        frame: (K,) number of the frame in its episode.
    """

    state: Tensor
    past: Tensor
    touch: Tensor
    target: Tensor
    episode: Tensor
    frame: Tensor

    def rows(self, index: Tensor) -> "Moments":
        """Some of them."""
        return Moments(*(column[index] for column in self))


def moments(series: Sequence[Series], past: Sequence[int], horizon: int) -> Moments:
    """The frames that have a successor in their own episode.

    Args:
        series: Episodes.
        past: Frames back of the displacements.
        horizon: Frames ahead of the successor, at least 1.

    Raises:
        ValueError: If no episode is longer than the horizon.
    """
    parts = []
    for number, episode in enumerate(series):
        count = len(episode.state) - horizon
        if count < 1:
            continue
        frame = torch.arange(count)
        now = episode.state[:count]
        back = [now - episode.state[(frame - n).clamp(min=0)] for n in past]
        parts.append(
            Moments(
                now,
                torch.stack(back, dim=-1),
                episode.touch[:count],
                episode.state[horizon:] - now,
                torch.full((count,), number),
                frame,
            )
        )
    if not parts:
        longest = max((len(episode.state) for episode in series), default=0)
        raise ValueError(
            f"no episode is longer than the horizon of {horizon} frames, the longest has "
            f"{longest}: choose a shorter horizon"
        )
    return Moments(*(torch.cat(columns) for columns in zip(*parts)))


def thin(found: Moments, most: int) -> Moments:
    """At most so many moments, evenly spread."""
    if len(found.state) <= most:
        return found
    return found.rows(torch.linspace(0, len(found.state) - 1, most).round().long())


class Trend(nn.Module):
    """The linear trend T.

    Args:
        inputs: Entries of [state, past, touch].
        joints: J.
    """

    mean: Tensor
    scale: Tensor
    middle: Tensor
    slope: Tensor

    def __init__(self, inputs: int, joints: int) -> None:
        super().__init__()
        for name, shape in {
            "mean": (inputs,),
            "scale": (inputs,),
            "middle": (joints,),
            "slope": (inputs, joints),
        }.items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.float64))

    @staticmethod
    def inputs(found: Moments) -> Tensor:
        """[state, past, touch], (K, inputs)."""
        return torch.cat([found.state, found.past.flatten(1), found.touch], dim=1)

    @classmethod
    def through(cls, found: Moments) -> "Trend":
        """The trend of some moments."""
        x = cls.inputs(found)
        trend = cls(x.shape[1], found.state.shape[1])
        trend.mean.copy_(x.mean(0))
        trend.scale.copy_(x.std(0, correction=0).clamp(min=1e-12))
        trend.middle.copy_(found.target.mean(0))
        z = (x - trend.mean) / trend.scale
        gram = z.mT @ z + TREND_RIDGE * len(z) * torch.eye(z.shape[1], dtype=z.dtype)
        trend.slope.copy_(torch.linalg.solve(gram, z.mT @ (found.target - trend.middle)))
        return trend

    def forward(self, found: Moments) -> Tensor:
        """Displacements (K, J) that the trend expects; targets are not looked at."""
        return (self.inputs(found) - self.mean) / self.scale @ self.slope + self.middle
