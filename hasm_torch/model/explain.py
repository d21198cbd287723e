"""Why the robot moves: on which episodes and moments a recall drew, and how sure it was."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.model.control import Asked
from hasm_torch.model.moments import Moments
from hasm_torch.model.query import parts_of
from hasm_torch.model.recalling import Recalling
from hasm_torch.model.settled import Settled
from hasm_torch.model.table import Table
from hasm_torch.model.timed import Timed

Array = NDArray[np.float64]

LEAST_WEIGHT = 1e-3  # of an association that is named one by one
# A touch whose direction is nearer than 45° to a taught one is known: within it a recall still
# moves along the force by the measure of the experiments, cos > 0.7.
KNOWN_COSINE = 0.7


class Source(NamedTuple):
    """An association that a recall drew on.

    Attributes:
        episode: Number of the episode that it comes from.
        time: When in that episode, s.
        weight: Its weight in the recall.
        row: Which association it is.
    """

    episode: int
    time: float
    weight: float
    row: int


@dataclass
class Explanation:
    """Why a recall said what it said.

    Attributes:
        patch: The touched patch; "" where time moves the robot on.
        sources: Associations of at least a thousandth of the weight, the greatest first.
        episodes: Weight of all associations of each episode, by its number; their sum is 1.
        entropy: Of the weights, nats: 0 where one association decides alone.
        margin: Lead of the best match over the second best, 0 to 2 (as the cosines of their codes).
        confidence: Agreement of the best match with what was asked, 0 to 1.
        posture_known: Whether something was taught within one tuning width of the coded joints.
        touch_known: Whether a touch like this one was taught: of its direction within 45° on this
            rigid body, or of its patch.
    """

    patch: str
    sources: list[Source]
    episodes: dict[int, float]
    entropy: float
    margin: float
    confidence: float
    posture_known: bool
    touch_known: bool = field(default=True)


def explained(
    config: HASMConfig,
    body: Body,
    settled: Settled,
    recalling: Recalling,
    asked: Asked,
    keys: Table,
) -> Explanation:
    """Explain a recall.

    Args:
        config: Settings of the method.
        body: Joints and skin of the robot.
        settled: What was chosen.
        recalling: The memory.
        asked: What it was asked.
        keys: What its associations were made of, in their order.
    """
    patch = asked.touch.patch
    weights = recalling.weights(asked.query, patch)[: len(keys)]
    parts = np.array(parts_of(body, settled.touch))
    rivals = parts[keys.patch] == parts[patch]
    span = np.array(body.upper) - np.array(body.lower)
    tuned = config.width * span[settled.joints] / max(config.neurons - 1, 1)
    apart = np.abs(keys.positions[:, settled.joints] - asked.positions[settled.joints])
    posture = bool((rivals & (apart <= tuned).all(axis=1)).any())
    touch = bool(rivals.any())
    if settled.touch == "direction":
        directions = keys.direction if keys.direction.ndim == 2 else keys.direction[:, 0]
        touch = bool((directions[rivals] @ asked.touch.direction >= KNOWN_COSINE).any())
    confidence, margin = recalling.sureness(asked.query, patch)
    origins = np.stack([keys.episode, keys.frame], axis=1)
    return Explanation(
        body.patches[patch],
        *drawn(weights, origins, body.rate),
        margin=margin,
        confidence=confidence,
        posture_known=posture,
        touch_known=touch,
    )


def explained_moment(recalling: Timed, moment: Moments, rate: float) -> Explanation:
    """Explain a recall of a robot that time moves on."""
    confidence, margin = recalling.sureness(moment)
    origins = recalling.origins.cpu().numpy()
    return Explanation(
        "",
        *drawn(recalling.weights(moment), origins, rate),
        margin=margin,
        confidence=confidence,
        posture_known=recalling.known(moment),
    )


def drawn(
    weights: Array, origins: NDArray[np.int64], rate: float
) -> tuple[list[Source], dict[int, float], float]:
    """Sources, weight of each episode and entropy of some weights.

    Args:
        weights: (K,) their sum is 1.
        origins: (K, 2 or more) episode and sample of each association.
        rate: Samples a second.
    """
    named = np.flatnonzero(weights >= LEAST_WEIGHT)
    named = named[np.argsort(-weights[named], kind="stable")]
    sources = [
        Source(int(origins[k, 0]), float(origins[k, 1] / rate), float(weights[k]), int(k))
        for k in named
    ]
    numbers, which = np.unique(origins[:, 0], return_inverse=True)
    shares = np.bincount(which, weights, minlength=len(numbers))
    episodes = {int(n): float(w) for n, w in zip(numbers, shares) if w > 0}
    present = weights[weights > 0]
    return sources, episodes, float(-(present * np.log(present)).sum())
