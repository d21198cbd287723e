"""Nearest neighbours, tuned by cross-validation, and standing still.

They are given what the memory is: speeds are proportional to the force, nothing moves without
touch, and joints that no episode moves do not count. A sample is where a newton leads, and touches
are compared by how the force is spread over the patches and where it points.
"""

from collections.abc import Sequence
from itertools import product

import torch
from torch import Tensor

from benchmarks.baselines.demonstrations import Baseline, Sensed, Series, Units, folds
from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.episode import Episode

HORIZON = HASMConfig().horizon  # samples over which a way is taken, as the memory's displacement
NEIGHBOURS = (1, 4, 16, 64)
SCALES = (0.0, 0.3, 1.0, 3.0)  # of a feature
FOLDS, PASSES = 3, 2
ASKED = 200  # held-out samples of a fold that are predicted
LEAST = 0.5  # N, less is no touch
MOVED = 0.01  # share of its range over which a joint goes if an episode moves it


class StandStill:
    """Holds the posture in which a rollout begins."""

    def __init__(self) -> None:
        self.posture: Tensor | None = None

    def reset(self) -> None:
        """Forget the posture."""
        self.posture = None

    def step(self, state: Tensor, skin: Tensor, *, observation: Tensor | None = None) -> Tensor:
        """The posture of the first step."""
        if self.posture is None:
            self.posture = state.clone()
        return self.posture

    def memory_bytes(self) -> int:
        """Nothing is kept."""
        return 0


class Samples:
    """The touched samples of some episodes: what was sensed, and where a newton led.

    A feature is a joint, how the force is spread over the rigid parts or the patches, its
    direction, or a further observation in shares of its range.

    Attributes:
        features: Name of each.
        of: (columns,) feature of each column.
        values: (K, columns) what was sensed.
        ways: (K, joints) where a newton led.

    Args:
        body: The robot.
        units: Says which joints have limits; where the others stand tells nothing.
        episodes: The episodes.
    """

    def __init__(self, body: Body, units: Units, episodes: Sequence[Series]) -> None:
        way = torch.stack([s.action.amax(0) - s.action.amin(0) for s in episodes]).amax(0)
        self.joints = units.limited & (way > MOVED)
        self.parts = torch.nn.functional.one_hot(torch.tensor(body.groups)).float()
        sensed, self.ways = touched(episodes)
        self.seen_range = (sensed.seen.amax(0) - sensed.seen.amin(0)).clamp(min=1e-6)
        self.values = self.sensed(sensed)
        joints = [name for name, used in zip(body.joints, self.joints.tolist()) if used]
        self.features = [*joints, "part", "patch", "direction", "observation"]
        sizes = [*[1] * len(joints), self.parts.shape[1], len(body.patches), 3]
        sizes.append(self.values.shape[1] - sum(sizes))
        self.of = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes))

    def sensed(self, sensed: Sensed) -> Tensor:
        """The features of samples, (..., columns)."""
        touch = sensed.touch / force_of(sensed.touch)
        patches, direction = touch[..., :-3], touch[..., -3:]
        observed = sensed.seen / self.seen_range
        columns = sensed.state[..., self.joints], patches @ self.parts, patches, direction, observed
        return torch.cat(columns, dim=-1)

    def keys(self, values: Tensor, scales: Tensor) -> Tensor:
        """Where samples (..., columns) lie with some scales (features,); without those of 0."""
        scale = scales[self.of]
        return (values * scale)[..., scale > 0]


def nearest(asked: Tensor, keys: Tensor, ways: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """Distances and ways of the samples nearest to some: (B, most) and (B, most, joints)."""
    found = torch.cdist(asked, keys).topk(min(most, len(keys)), largest=False)
    return found.values, ways[found.indices]


def force_of(touch: Tensor) -> Tensor:
    """Force of touches (..., patches + 3) on all patches together, (..., 1) N."""
    return touch[..., :-3].sum(-1, keepdim=True)


def touched(episodes: Sequence[Series]) -> tuple[Sensed, Tensor]:
    """What was sensed, and ways, of all samples with a touch."""
    columns = zip(*((s.state, s.touch, s.seen, ways_of(s)) for s in episodes))
    state, touch, seen, ways = (torch.cat(column) for column in columns)
    rows = force_of(touch)[:, 0] > LEAST
    return Sensed(state[rows], touch[rows], seen[rows]), ways[rows]


def ways_of(series: Series) -> Tensor:
    """Where a newton leads in one sample, (T, joints); the last action and force stay.

    Both are taken over the horizon, so that a touch that ends within it counts as long as it lasts.
    """
    last = len(series.action) - 1
    ahead = (torch.arange(last + 1).unsqueeze(1) + torch.arange(HORIZON + 1)).clamp(max=last)
    way = series.action[ahead[:, -1]] - series.action
    return way / force_of(series.touch)[ahead[:, 1:]].sum(1).clamp(min=LEAST)


def mean_way(distances: Tensor, ways: Tensor) -> Tensor:
    """Mean of ways (..., k, joints), weighted by the inverse of their distances (..., k)."""
    weight = 1.0 / (distances + 1e-6)
    weight = weight / weight.sum(-1, keepdim=True)
    return (weight.unsqueeze(-1) * ways).sum(-2)


class Neighbours(Baseline):
    """Goes where the nearest samples went, with what predicts held-out episodes best.

    The scales of the features are improved one after the other.

    Attributes:
        neighbours: k.
        scales: (features,) what each feature counts.
        samples: What is known.

    Args:
        body: The robot.
        episodes: What is learned.
    """

    def __init__(self, body: Body, episodes: Sequence[Episode]) -> None:
        super().__init__(body)
        series = [self.units.series(episode) for episode in episodes]
        self.samples = Samples(body, self.units, series)
        parts = [(Samples(body, self.units, rest), held) for rest, held in folds(series, FOLDS)]
        self.scales = torch.ones(len(self.samples.features))
        error, self.neighbours = held_out_error(parts, self.scales)
        for feature, scale in [*product(range(len(self.scales)), SCALES)] * PASSES:
            tried = self.scales.clone()
            tried[feature] = scale
            if not torch.equal(tried, self.scales):
                found, neighbours = held_out_error(parts, tried)
                if found < error:
                    error, self.neighbours, self.scales = found, neighbours, tried
        self.keys = self.samples.keys(self.samples.values, self.scales)

    def way(self, sensed: Sensed) -> Tensor:
        """See ``Baseline``."""
        if force_of(sensed.touch) <= LEAST:
            return torch.zeros_like(sensed.state)
        asked = self.samples.keys(self.samples.sensed(sensed).unsqueeze(0), self.scales)
        way = mean_way(*nearest(asked, self.keys, self.samples.ways, self.neighbours))[0]
        return way * force_of(sensed.touch)

    def memory_bytes(self) -> int:
        """Samples and ways."""
        return self.keys.nbytes + self.samples.ways.nbytes


def held_out_error(
    parts: Sequence[tuple[Samples, Sequence[Series]]], scales: Tensor
) -> tuple[float, int]:
    """Squared error of held-out ways with the best k, and that k; 0 where nothing is held out."""
    errors = dict.fromkeys(NEIGHBOURS, 0.0)
    for samples, held in parts:
        sensed, ways = touched(held)
        rows = torch.linspace(0, len(ways) - 1, min(len(ways), ASKED)).long()
        values = samples.sensed(Sensed(*(column[rows] for column in sensed)))
        asked, keys = samples.keys(values, scales), samples.keys(samples.values, scales)
        distances, found = nearest(asked, keys, samples.ways, max(NEIGHBOURS))
        for k in NEIGHBOURS:
            predicted = mean_way(distances[:, :k], found[:, :k])
            errors[k] += float((predicted - ways[rows]).square().sum())
    best = min(errors, key=lambda k: errors[k])
    return errors[best], best
