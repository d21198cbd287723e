"""Everyone who is rolled out, by name, what it takes to train them, and where they are kept."""

import importlib
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from benchmarks.baselines.faults import Fault, Faulty
from benchmarks.baselines.learned import ACT, DIFFUSION, ChunkPolicy
from benchmarks.baselines.learned_training import Training
from benchmarks.baselines.neighbours import Neighbours, StandStill
from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.encoders.skin_filter import SkinFilter
from hasm_torch.episode import Episode
from hasm_torch.evaluation.filtered import Filtered
from hasm_torch.evaluation.rollout import Policy
from hasm_torch.model.hasm import HASM

DEFAULT = HASMConfig()
MEAN = replace(DEFAULT, readout="mean")
# The default, the paper as written, and one change at a time; what a change leaves open, ``fit``
# still chooses from the episodes. The direction is taken out of the code of the weighted mean,
# since the first-order read-out also gets it as a covariate.
SETTINGS = {
    "default": DEFAULT,
    "the paper literally": HASMConfig.literal(),
    "mean read-out": MEAN,
    "first-order read-out": replace(DEFAULT, readout="first_order"),
    "mean, argmax": replace(MEAN, beta=float("inf")),
    "mean, RoPE3D off": replace(MEAN, rope=False),
    "mean, rotation constant a patch": replace(MEAN, frame="link"),
    "mean, random key a patch": replace(MEAN, touch="patch"),
    "real-valued codes": replace(DEFAULT, storage="float32"),
}
NETWORKS = {"ACT": ACT, "Diffusion": DIFFUSION}
CONTESTANTS = (*SETTINGS, "nearest neighbours, tuned", "standing still", *NETWORKS)
LIBRARIES = (
    "lerobot.policies.act.modeling_act",
    "lerobot.policies.diffusion.modeling_diffusion",
    "diffusers",
)
POLICY, FILTER = "policy.pt", "filter.pt"


class Contestant(Policy, Protocol):
    """A policy that says how much it keeps."""

    def memory_bytes(self) -> int:
        """Bytes of what was learned."""


@dataclass
class Trained:
    """A trained contestant.

    Attributes:
        policy: The policy.
        seconds: Training time, cross-validation included, s.
        notes: What training chose or warned of.
    """

    policy: Contestant
    seconds: float
    notes: dict[str, Any]


def train(
    name: str, experiment: str, body: Body, episodes: Sequence[Episode], training: Training
) -> Trained:
    """Train a contestant.

    Args:
        name: One of ``CONTESTANTS``.
        experiment: "compliance", "yield" or "grasp".
        body: The robot.
        episodes: What is learned.
        training: How a network is trained.
    """
    if name in NETWORKS:
        for module in LIBRARIES:  # loading them is no training
            importlib.import_module(module)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        begin = time.perf_counter()
        policy, notes = _learned(name, experiment, body, episodes, training)
        seconds = time.perf_counter() - begin
    told = [str(w.message) for w in caught if issubclass(w.category, UserWarning)]
    return Trained(policy, seconds, notes | ({"warnings": told} if told else {}))


def _learned(
    name: str, experiment: str, body: Body, episodes: Sequence[Episode], training: Training
) -> tuple[Contestant, dict[str, Any]]:
    if name in SETTINGS:
        model = HASM(SETTINGS[name], body)
        report = model.fit(episodes)
        return model, {"associations": report.associations, "chosen": report.choices}
    if name in NETWORKS:
        network = ChunkPolicy(NETWORKS[name], experiment, body, episodes, training)
        return network, network.notes
    if name == "standing still":
        return StandStill(), {}
    nearest = Neighbours(body, episodes)
    scales = zip(nearest.samples.features, nearest.scales.tolist())
    chosen = {"k": nearest.neighbours} | {name: scale for name, scale in scales if scale}
    return nearest, {"chosen": chosen}


def save(policy: Policy, body: Body, episodes: Sequence[Episode], directory: Path) -> None:
    """Write a policy, and what a filter of its skin has to know."""
    directory.mkdir(parents=True, exist_ok=True)
    if isinstance(policy, HASM):
        policy.save_pretrained(directory)
    else:
        torch.save(policy, directory / POLICY)
    torch.save(SkinFilter.learn(body, episodes), directory / FILTER)


def load(directory: str, fault: Fault | None = None, filtered: bool = False) -> Policy:
    """A policy that ``save`` wrote.

    Args:
        directory: Where.
        fault: What is wrong with its skin, if anything.
        filtered: Whether the skin filter stands before it.
    """
    path = Path(directory)
    if (path / POLICY).exists():
        policy: Policy = torch.load(path / POLICY, weights_only=False)
    else:
        policy = HASM.from_pretrained(path)
    if filtered:
        policy = Filtered(policy, torch.load(path / FILTER, weights_only=False))
    return policy if fault is None else Faulty(policy, fault)


def loader(fault: Fault | None, filtered: bool) -> Any:
    """``load`` for a ``Runner``, all of whose policies read the same skin."""
    return partial(load, fault=fault, filtered=filtered)


def step_ms(policy: Policy, body: Body, skin: Tensor, steps: int) -> float:
    """Mean time of a control step under one touch, ms.

    The mean, since some policies plan seldom and long.
    """
    state = torch.zeros(len(body.joints))
    for joint in body.limited:
        state[joint] = (body.lower[joint] + body.upper[joint]) / 2
    seen = torch.zeros(sum(body.observations.values()))
    policy.reset()
    spent = []
    for _ in range(steps):
        begin = time.perf_counter()
        state = policy.step(state, skin, observation=seen)
        spent.append(1e3 * (time.perf_counter() - begin))
    policy.reset()
    return float(np.mean(spent))
