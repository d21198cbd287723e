"""Everyone who is rolled out, by name, and what it takes to train them."""

import importlib
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol

from benchmarks.baselines.demonstrations import Candidate
from benchmarks.baselines.learned import act, diffusion
from benchmarks.baselines.learned_training import Training
from benchmarks.baselines.policies import (
    SamplePolicy,
    StandStill,
    dense_memory_candidates,
    neighbour_candidates,
    tuned_neighbour_candidates,
)
from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.data.episodes import Episode
from hasm_torch.evaluation.rollout import Policy
from hasm_torch.model.hasm import HASM

BETAS = (0.1, 0.5, 1.0, 2.0, 5.0, 20.0)
BINARY_BITS = (2, 4, 6, 8)


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
    notes: dict[str, Any] = field(default_factory=dict)


Outcome = tuple[Contestant, dict[str, Any]]
Train = Callable[[str, Body, Sequence[Episode]], Outcome]


def train(
    name: str,
    experiment: str,
    body: Body,
    episodes: Sequence[Episode],
    training: Training | None = None,
) -> Trained:
    """Train a contestant.

    Args:
        name: One of ``CONTESTANTS``.
        experiment: "compliance" or "grasp".
        body: The robot.
        episodes: What is learned.
        training: How a network is trained, by default until its held-out loss stops falling.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make = CONTESTANTS[name]
        if name in LEARNED:
            make = partial(LEARNED[name], training=training or Training())
            for module in LIBRARIES:  # loading them is no training
                importlib.import_module(module)
        begin = time.perf_counter()
        policy, notes = make(experiment, body, episodes)
        seconds = time.perf_counter() - begin
    told = [str(w.message) for w in caught if issubclass(w.category, UserWarning)]
    return Trained(policy, seconds, notes | ({"warnings": told} if told else {}))


def settings() -> dict[str, HASMConfig]:
    """Our own contestants: the default, the paper as written, and one change at a time.

    The default's codes are thermometers of 16 bits.
    """
    default = HASMConfig()
    mine = {
        "default": default,
        "the paper literally": HASMConfig.literal(),
        "without spikes": replace(default, advance="tick"),
        "gray, 8 bits": replace(default, code="gray", bits=8),
    }
    for bits in BINARY_BITS:
        mine[f"binary, {bits} bits"] = replace(default, code="binary", bits=bits)
    mine["real-valued codes"] = replace(default, rebinarise=False, storage="float32")
    mine["one shared memory"] = replace(default, memories="shared")
    mine["one shared memory, real-valued"] = replace(mine["real-valued codes"], memories="shared")
    mine["one shared memory, base frame"] = replace(default, memories="shared", frame="base")
    mine["one shared memory without RoPE3D"] = replace(default, memories="shared", rope=False)
    mine["touch in the base frame"] = replace(default, frame="base")
    mine["every sample stored"] = replace(default, store="sample")
    for beta in BETAS:
        mine[f"beta {beta:g}"] = replace(default, beta=beta)
    return mine


def _hasm(config: HASMConfig) -> Train:
    def make(experiment: str, body: Body, episodes: Sequence[Episode]) -> Outcome:
        model = HASM(config, body)
        report = model.fit(episodes)
        return model, {
            "associations": sum(report.associations.values()),
            "largest_recall_error": max(report.recall_errors.values()),
        }

    return make


def _from_samples(candidates: Callable[[str], list[Candidate]]) -> Train:
    def make(experiment: str, body: Body, episodes: Sequence[Episode]) -> Outcome:
        policy = SamplePolicy(body, episodes, candidates(experiment))
        return policy, {"chosen": policy.choice, "held_out_errors": policy.errors}

    return make


def _stand_still(experiment: str, body: Body, episodes: Sequence[Episode]) -> Outcome:
    return StandStill(), {}


NEIGHBOURS = "nearest neighbours"
TUNED_NEIGHBOURS = "nearest neighbours, tuned"

LIBRARIES = (
    "lerobot.policies.act.modeling_act",
    "lerobot.policies.diffusion.modeling_diffusion",
    "diffusers",
)
LEARNED: dict[str, Callable[..., Outcome]] = {"ACT": act, "Diffusion": diffusion}
CONTESTANTS: dict[str, Train] = {
    **{name: _hasm(config) for name, config in settings().items()},
    "standing still": _stand_still,
    NEIGHBOURS: _from_samples(lambda _: neighbour_candidates()),
    TUNED_NEIGHBOURS: _from_samples(tuned_neighbour_candidates),
    "dense associative memory": _from_samples(lambda _: dense_memory_candidates()),
    **LEARNED,
}
