"""LeRobot's ACT and Diffusion Policy, small, as policies of the benchmark.

They see what the other contestants see: joints as shares of their ranges and the force on each
patch. Two things are done in their favour. Joints that no episode moves and patches that none
touches are neither seen nor commanded, since a network answers unseen readings with anything; and
rollouts of other seeds than the benchmark's chose how each experiment is learned (``SETTINGS``).
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from benchmarks.baselines.demonstrations import largest_way, patch_forces, series_of
from benchmarks.baselines.learned_training import (
    ACTION,
    PADDED,
    STATE,
    TOUCH,
    Span,
    Training,
    Windows,
    fit,
    gather,
)
from hasm_torch.body import Body
from hasm_torch.data.episodes import Episode

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


# Compliance begins in postures that no episode holds, where predicted commands jump and the noise
# keeps increments from depending on the posture. Increments drift past the end of a grasp.
SETTINGS = {"compliance": Setting("increment", 1.0), "grasp": Setting("absolute", 0.0)}

MOVED = 0.01  # share of its range over which a joint goes if the episodes move it
TOUCHED = 0.1  # N
FORCE = 5.0  # N that a network sees as 1

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
        state = windows.state[:, -1]
        self.moves = state.amax(0) - state.amin(0) > MOVED
        self.mean = state.mean(0)
        self.gain = torch.where(self.moves, 1.0 / state.std(0).clamp(min=MOVED / 10), 0.0)
        self.touched = (windows.touch.amax((0, 1)) > TOUCHED) / FORCE
        value = self._value(windows)
        low, high = value.amin((0, 1)), value.amax((0, 1))
        if mode == "increment":  # standing still is 0
            high = torch.maximum(high, -low)
            low = -high
        self.middle = (low + high) / 2
        self.half = torch.where(self.moves, (high - low) / 2, 1.0)

    def observation(self, state: Tensor, touch: Tensor) -> dict[str, Tensor]:
        """What is seen of states (..., joints), shares, and touches (..., patches), N."""
        return {STATE: (state - self.mean) * self.gain, TOUCH: touch * self.touched}

    def batch(self, windows: Windows) -> dict[str, Tensor]:
        """Windows by LeRobot's keys; a single observation has no axis of its own."""
        seen = self.observation(windows.state, windows.touch)
        if windows.state.shape[1] == 1:
            seen = {key: value[:, 0] for key, value in seen.items()}
        value = (self._value(windows) - self.middle) / self.half * self.moves
        return {**seen, ACTION: value, PADDED: windows.padded}

    def value(self, predicted: Tensor) -> Tensor:
        """Predictions (..., joints) in shares of the joint ranges."""
        return predicted * self.half + self.middle

    def _value(self, windows: Windows) -> Tensor:
        return windows.action - (windows.before if self.mode == "increment" else 0.0)


# Predicts (1, horizon, joints) from a batch, with random numbers of the generator.
Predict = Callable[[dict[str, Tensor], torch.Generator], Tensor]


class ChunkPolicy:
    """Plans chunks of commands and carries out the first part of each.

    Args:
        body: The robot.
        network: A LeRobot policy.
        predict: Plans with it.
        scaling: What it sees and predicts.
        observed: Observations up to the current one that it sees.
        executed: Commands of a chunk that are carried out.
        seed: Seed of its noise, which is the same in every rollout.
    """

    def __init__(
        self,
        body: Body,
        network: torch.nn.Module,
        predict: Predict,
        scaling: Scaling,
        observed: int,
        executed: int,
        seed: int,
    ) -> None:
        self.body, self.network, self.predict, self.scaling = body, network, predict, scaling
        self.executed, self.seed = executed, seed
        self.lower, self.upper = torch.tensor(body.lower), torch.tensor(body.upper)
        self.largest = largest_way(body)
        self.seen: deque[tuple[Tensor, Tensor]] = deque(maxlen=observed)
        self.chunk: deque[Tensor] = deque()
        self.reset()

    def reset(self) -> None:
        """Forget what was seen and planned; start from the measured joints."""
        self.seen.clear()
        self.chunk.clear()
        self.reference: Tensor | None = None
        self.generator = torch.Generator().manual_seed(self.seed)

    @torch.no_grad()
    def step(self, state: Tensor, skin: Tensor) -> Tensor:
        """Target of one control step, (joints,)."""
        span = self.upper - self.lower
        share = (state.float() - self.lower) / span
        touch = patch_forces(skin.float().reshape(-1, 3), self.body)
        if self.reference is None:
            self.reference = share.clamp(0.0, 1.0)
            self.seen.extend([(share, touch)] * (self.seen.maxlen or 1))
        self.seen.append((share, touch))
        if not self.chunk:
            self._plan()
        goal = self.chunk.popleft()
        if self.scaling.mode == "increment":
            goal = self.reference + goal
        way = (goal - self.reference) * self.scaling.moves
        excess = (way.abs() / self.largest).amax().clamp(min=1.0)
        self.reference = (self.reference + way / excess).clamp(0.0, 1.0)
        return (self.lower + self.reference * span).clamp(self.lower, self.upper)

    def memory_bytes(self) -> int:
        """Bytes of the parameters."""
        return sum(parameter.nbytes for parameter in self.network.parameters())

    def _plan(self) -> None:
        states, touches = (torch.stack(column)[None] for column in zip(*self.seen))
        batch = self.scaling.observation(states, touches)
        if len(self.seen) == 1:
            batch = {key: value[:, 0] for key, value in batch.items()}
        chunk = self.predict(batch, self.generator)[0, : self.executed]
        self.chunk.extend(self.scaling.value(chunk))


Outcome = tuple[ChunkPolicy, dict[str, Any]]


def act(
    experiment: str, body: Body, episodes: Sequence[Episode], training: Training | None = None
) -> Outcome:
    """Train an Action Chunking Transformer of 0.9 M parameters.

    It has no variational encoder, since the episodes hold one way of doing each thing; updates
    take less than half the time without it.

    Args:
        experiment: "compliance" or "grasp".
        body: The robot.
        episodes: What is learned.
        training: How; ``Training()`` by default.

    Returns:
        The policy; its ``parameters``, its ``mode`` and what ``fit`` tells.
    """
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    config = ACTConfig(
        **_features(body),
        chunk_size=ACT_CHUNK,
        n_action_steps=ACT_EXECUTED,
        dim_model=128,
        n_heads=4,
        dim_feedforward=512,
        n_encoder_layers=3,
        use_vae=False,
        dropout=0.0,
    )

    def make() -> tuple[torch.nn.Module, Predict]:
        network = ACTPolicy(config)
        return network, lambda batch, _: network.predict_action_chunk(batch)

    span = Span(0, ACT_CHUNK - 1)
    return _train(experiment, body, episodes, training, make, 1, span, ACT_EXECUTED)


def diffusion(
    experiment: str, body: Body, episodes: Sequence[Episode], training: Training | None = None
) -> Outcome:
    """Train a Diffusion Policy of 2.8 M parameters that denoises in ten DDIM steps.

    Args and returns are those of ``act``.

    Raises:
        ImportError: Without the package diffusers, which LeRobot's policy needs.
    """
    from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

    config = DiffusionConfig(
        **_features(body),
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
    shape = (1, DIFFUSION_HORIZON, len(body.joints))

    def make() -> tuple[torch.nn.Module, Predict]:
        network = DiffusionPolicy(config)
        return network, lambda batch, generator: network.predict_action_chunk(
            batch, noise=torch.randn(shape, generator=generator)
        )

    first = 1 - DIFFUSION_OBSERVED
    span = Span(first, first + DIFFUSION_HORIZON - 1)
    return _train(
        experiment, body, episodes, training, make, DIFFUSION_OBSERVED, span, DIFFUSION_EXECUTED
    )


def _features(body: Body) -> dict[str, Any]:
    from lerobot.configs import FeatureType, PolicyFeature

    joints, patches = (len(body.joints),), (len(body.patches),)
    return {
        "input_features": {
            STATE: PolicyFeature(FeatureType.STATE, joints),
            TOUCH: PolicyFeature(FeatureType.ENV, patches),
        },
        "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, joints)},
        "device": "cpu",
    }


def _train(
    experiment: str,
    body: Body,
    episodes: Sequence[Episode],
    training: Training | None,
    make: Callable[[], tuple[torch.nn.Module, Predict]],
    observed: int,
    span: Span,
    executed: int,
) -> Outcome:
    if experiment not in SETTINGS:
        raise ValueError(f"unknown experiment {experiment!r}, valid: {', '.join(SETTINGS)}")
    training, (mode, state_noise) = training or Training(), SETTINGS[experiment]
    series = [series_of(episode, body) for episode in episodes]
    trained, held = gather(series, observed, span, body.rate)
    scaling = Scaling(trained, mode)
    # LeRobot's modules draw from the global generator.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(training.seed)
        network, predict = make()
        noise = state_noise * scaling.moves
        notes = fit(network, scaling.batch(trained), scaling.batch(held), training, noise)
    parameters = sum(parameter.numel() for parameter in network.parameters())
    policy = ChunkPolicy(body, network, predict, scaling, observed, executed, training.seed)
    return policy, {"parameters": parameters, "mode": mode, **notes}
