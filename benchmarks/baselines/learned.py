"""LeRobot's ACT and Diffusion Policy, small, as policies of the benchmark.

They see what the nearest neighbours see. Joints that no episode moves and forces that none holds
are neither seen nor commanded, since a network answers unseen readings with anything.
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from benchmarks.baselines.demonstrations import Baseline, Sensed
from benchmarks.baselines.learned_training import (
    ACTION,
    ENVIRONMENT,
    PADDED,
    STATE,
    Span,
    Training,
    Windows,
    fit,
    gather,
)
from hasm_torch.body import Body
from hasm_torch.episode import Episode

Mode = Literal["absolute", "increment"]


class Setting(NamedTuple):
    """How an experiment is learned.

    Attributes:
        mode: Whether the commands are predicted or how far each goes from the one before.
        state_noise: Standard deviation of what is added to the states while they are learned, in
            standard deviations of the states.
    """

    mode: Mode
    state_noise: float


# Where rollouts begin in postures that no episode holds, predicted commands jump; increments drift
# past the end of a grasp. Compliance has few postures, on which the noise keeps increments from
# depending; what yields depends on them.
SETTINGS = {
    "compliance": Setting("increment", 1.0),
    "yield": Setting("increment", 0.0),
    "grasp": Setting("absolute", 0.0),
}

MOVED = 0.01  # share of its range over which a joint goes if the episodes move it
TOUCHED = 0.1  # N

ACT_CHUNK, ACT_EXECUTED = 20, 10  # samples
DIFFUSION_OBSERVED, DIFFUSION_HORIZON, DIFFUSION_EXECUTED = 2, 16, 8  # samples
BEYOND = 1.5  # how far a denoised action may lie beyond those of the episodes, which reach 1


class Scaling:
    """What a network sees and predicts, from windows and back.

    Args:
        windows: All that is trained on.
        mode: What is predicted.
    """

    def __init__(self, windows: Windows, mode: Mode) -> None:
        self.mode = mode
        state, seen = windows.state[:, -1], windows.seen[:, -1]
        self.moves = state.amax(0) - state.amin(0) > MOVED
        self.mean, self.seen_mean = state.mean(0), seen.mean(0)
        self.gain = torch.where(self.moves, 1.0 / state.std(0).clamp(min=MOVED / 10), 0.0)
        self.seen_gain = 1.0 / (seen.amax(0) - seen.amin(0)).clamp(min=1e-6)
        strongest = windows.touch.abs().amax((0, 1))
        self.touched = torch.where(strongest > TOUCHED, 1.0 / strongest, 0.0)
        value = self._value(windows)
        low, high = value.amin((0, 1)), value.amax((0, 1))
        if mode == "increment":  # standing still is 0
            high = torch.maximum(high, -low)
            low = -high
        self.middle = (low + high) / 2
        self.half = torch.where(self.moves, (high - low) / 2, 1.0)

    def observation(self, sensed: Sensed) -> dict[str, Tensor]:
        """What is seen of readings (..., all), by LeRobot's keys."""
        seen = (sensed.seen - self.seen_mean) * self.seen_gain
        return {
            STATE: (sensed.state - self.mean) * self.gain,
            ENVIRONMENT: torch.cat([sensed.touch * self.touched, seen], dim=-1),
        }

    def batch(self, windows: Windows) -> dict[str, Tensor]:
        """Windows by LeRobot's keys; a single observation has no axis of its own."""
        seen = self.observation(Sensed(windows.state, windows.touch, windows.seen))
        if windows.state.shape[1] == 1:
            seen = {key: value[:, 0] for key, value in seen.items()}
        value = (self._value(windows) - self.middle) / self.half * self.moves
        return {**seen, ACTION: value, PADDED: windows.padded}

    def value(self, predicted: Tensor) -> Tensor:
        """Predictions (..., joints) in shares of the joint ranges."""
        return predicted * self.half + self.middle

    def _value(self, windows: Windows) -> Tensor:
        return windows.action - (windows.before if self.mode == "increment" else 0.0)


class Kind(NamedTuple):
    """How one of LeRobot's policies is made and asked.

    Attributes:
        make: Network of an observation's feature shapes, see ``_features``.
        chunk: Plan (1, horizon, joints) of a network for a batch, drawn with a generator.
        observed: Observations up to the current one that it sees.
        span: Samples that a plan reaches over.
        executed: Commands of a plan that are carried out.
    """

    make: Callable[[dict[str, Any]], nn.Module]
    chunk: Callable[[Any, dict[str, Tensor], torch.Generator], Tensor]
    observed: int
    span: Span
    executed: int


def _make_act(features: dict[str, Any]) -> nn.Module:
    """0.9 M parameters.

    It has no variational encoder, since the episodes hold one way of doing each thing; updates
    take less than half the time without it.
    """
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    config = ACTConfig(
        **features,
        chunk_size=ACT_CHUNK,
        n_action_steps=ACT_EXECUTED,
        dim_model=128,
        n_heads=4,
        dim_feedforward=512,
        n_encoder_layers=3,
        use_vae=False,
        dropout=0.0,
    )
    return ACTPolicy(config)


def _act_chunk(network: Any, batch: dict[str, Tensor], generator: torch.Generator) -> Tensor:
    chunk: Tensor = network.predict_action_chunk(batch)
    return chunk


def _make_diffusion(features: dict[str, Any]) -> nn.Module:
    """2.8 M parameters that denoise in ten DDIM steps."""
    from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

    config = DiffusionConfig(
        **features,
        n_obs_steps=DIFFUSION_OBSERVED,
        horizon=DIFFUSION_HORIZON,
        n_action_steps=DIFFUSION_EXECUTED,
        down_dims=(64, 128, 256),
        kernel_size=3,
        diffusion_step_embed_dim=64,
        noise_scheduler_type="DDIM",
        num_inference_steps=10,
        clip_sample_range=BEYOND,
        do_mask_loss_for_padding=True,
    )
    return DiffusionPolicy(config)


def _diffusion_chunk(network: Any, batch: dict[str, Tensor], generator: torch.Generator) -> Tensor:
    joints = batch[STATE].shape[-1]
    noise = torch.randn((1, DIFFUSION_HORIZON, joints), generator=generator)
    chunk: Tensor = network.predict_action_chunk(batch, noise=noise)
    return chunk


_FIRST = 1 - DIFFUSION_OBSERVED
ACT = Kind(_make_act, _act_chunk, 1, Span(0, ACT_CHUNK - 1), ACT_EXECUTED)
DIFFUSION = Kind(
    _make_diffusion,
    _diffusion_chunk,
    DIFFUSION_OBSERVED,
    Span(_FIRST, _FIRST + DIFFUSION_HORIZON - 1),
    DIFFUSION_EXECUTED,
)


class ChunkPolicy(Baseline):
    """Plans chunks of commands and carries out the first part of each.

    Attributes:
        notes: ``parameters``, ``mode`` and what ``learned_training.fit`` tells.

    Args:
        kind: ``ACT`` or ``DIFFUSION``; the latter needs the package diffusers.
        experiment: "compliance", "yield" or "grasp".
        body: The robot.
        episodes: What is learned.
        training: How.

    Raises:
        ValueError: If there is no such experiment.
    """

    def __init__(
        self,
        kind: Kind,
        experiment: str,
        body: Body,
        episodes: Sequence[Episode],
        training: Training,
    ) -> None:
        if experiment not in SETTINGS:
            raise ValueError(f"unknown experiment {experiment!r}, valid: {', '.join(SETTINGS)}")
        self.kind, self.seed = kind, training.seed
        self.sensed: deque[Sensed] = deque(maxlen=kind.observed)
        self.chunk: deque[Tensor] = deque()
        super().__init__(body)
        mode, state_noise = SETTINGS[experiment]
        series = [self.units.series(episode) for episode in episodes]
        trained, held = gather(series, kind.observed, kind.span, body.rate)
        self.scaling = Scaling(trained, mode)
        # LeRobot's modules draw from the global generator.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(training.seed)
            self.network = kind.make(_features(body))
            noise = state_noise * self.scaling.moves
            batches = self.scaling.batch(trained), self.scaling.batch(held)
            notes = fit(self.network, *batches, training, noise)
        parameters = sum(parameter.numel() for parameter in self.network.parameters())
        self.notes = {"parameters": parameters, "mode": mode, **notes}

    def reset(self) -> None:
        """Forget what was sensed and planned; start from the measured joints."""
        super().reset()
        self.sensed.clear()
        self.chunk.clear()
        self.generator: torch.Generator | None = None

    def way(self, sensed: Sensed) -> Tensor:
        """See ``Baseline``."""
        if not self.sensed:
            self.sensed.extend([sensed] * self.kind.observed)
        self.sensed.append(sensed)
        if not self.chunk:
            self._plan()
        goal = self.chunk.popleft()
        way = goal if self.scaling.mode == "increment" else goal - self.reference
        return way * self.scaling.moves

    def memory_bytes(self) -> int:
        """Bytes of the parameters."""
        return sum(parameter.nbytes for parameter in self.network.parameters())

    def _plan(self) -> None:
        batch = self.scaling.observation(Sensed(*(torch.stack(x)[None] for x in zip(*self.sensed))))
        if self.kind.observed == 1:
            batch = {key: value[:, 0] for key, value in batch.items()}
        if self.generator is None:  # the same noise in every rollout
            self.generator = torch.Generator().manual_seed(self.seed)
        chunk = self.kind.chunk(self.network, batch, self.generator)[0, : self.kind.executed]
        self.chunk.extend(self.scaling.value(chunk))


def _features(body: Body) -> dict[str, Any]:
    """What LeRobot's configurations are told of a robot."""
    from lerobot.configs import FeatureType, PolicyFeature

    joints = (len(body.joints),)
    felt = (len(body.patches) + 3 + sum(body.observations.values()),)
    return {
        "input_features": {
            STATE: PolicyFeature(FeatureType.STATE, joints),
            ENVIRONMENT: PolicyFeature(FeatureType.ENV, felt),
        },
        "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, joints)},
        "device": "cpu",
    }
