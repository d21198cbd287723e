"""The whole model: skin forces and joint positions in, joint targets out.

joint positions ──PlaceCode──► s ┐
skin forces ──EffectiveForce──Izhikevich──► ρ ──TactileEmbedding──► F ──RoPE3D──► o ┤
                                    m = s ⊗ o ──HeteroAssociativeMemory──► joint targets
"""

import json
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from hasm_torch.config import Body, HASMConfig, MemoryShape, as_dict, write_json
from hasm_torch.control import Walk, advance, limit_speed
from hasm_torch.learning import FitReport, Recording, learn
from hasm_torch.patch_memory import PatchMemory
from hasm_torch.skin_encoder import SkinEncoder, SkinState

CONFIG_FILE, WEIGHTS_FILE = "config.json", "model.safetensors"

# A patch that was quiet this long is touched anew, s.
ONSET_AFTER = 0.2


class HASM(nn.Module):
    """Encoders and one dedicated memory a skin patch.

    ``fit`` stores episodes, ``step`` gives the joint target of one control step, ``reset`` starts
    a new rollout.

    Attributes:
        memories: The patches that have learned something, by name.
        touched: Patches with a memory that spiked in the last step.
        density: (patches,) rate density ρ of every patch at the last step.
        tolerance: (joints,) how far a joint may be from its reference before the reference waits
            or, at a new touch, follows the joint, rad or m.

    Args:
        config: Settings of the method.
        body: Joints and skin of the robot.
        shapes: Shapes of the memories by patch, of a model to be loaded; ``fit`` finds them.
    """

    tolerance: Tensor
    lower: Tensor
    upper: Tensor
    max_speed: Tensor

    def __init__(
        self, config: HASMConfig, body: Body, shapes: dict[str, MemoryShape] | None = None
    ) -> None:
        super().__init__()
        self.config, self.body = config, body
        self.skin = SkinEncoder(
            body.cells,
            body.rate,
            config.threshold,
            config.force_window,
            config.current_per_newton,
            config.spike_dt_ms,
        )
        self.shapes: dict[str, MemoryShape] = {}
        self.memories = nn.ModuleDict()
        for patch, shape in (shapes or {}).items():
            self.add_memory(patch, shape)
        self.register_buffer("lower", torch.tensor(body.lower, dtype=torch.float32))
        self.register_buffer("upper", torch.tensor(body.upper, dtype=torch.float32))
        self.register_buffer("max_speed", torch.tensor(body.max_speed, dtype=torch.float32))
        self.register_buffer("tolerance", 0.1 * (self.upper - self.lower))
        self.reset()

    def add_memory(self, patch: str, shape: MemoryShape) -> PatchMemory:
        """Give a patch an empty memory, in place of the one it had."""
        if patch not in self.body.patches:
            raise ValueError(f"unknown patch {patch!r}, valid: {', '.join(self.body.patches)}")
        index = self.body.patches.index(patch)
        memory = PatchMemory(self.config, self.body, index, shape)
        self.shapes[patch], self.memories[patch] = shape, memory
        return memory

    def fit(self, episodes: Iterable[Recording]) -> FitReport:
        """Store episodes; see ``learning.learn``.

        Args:
            episodes: Recordings with ``time``, ``state``, ``action`` and ``tactile``.

        Returns:
            What was stored.

        Raises:
            ValueError: If there is no episode, no touch, or a value is not finite.
        """
        report = learn(self, episodes)
        self.reset()
        return report

    def reset(self) -> None:
        """Forget the rollout: the next step starts from the measured joints."""
        self._walk = Walk()
        self._skin_state: SkinState | None = None
        self.touched: list[str] = []
        self.density = self.lower.new_zeros(len(self.body.patches))
        window = max(1, round(self.config.rate_window_s * self.body.rate))
        self._spikes: deque[Tensor] = deque(maxlen=window)

    @torch.no_grad()
    def step(self, state: Tensor, skin: Tensor) -> Tensor:
        """One control step.

        Args:
            state: (joints,) measured joint positions, rad or m.
            skin: (cells, points) or flat, force of every point of the skin, N.

        Returns:
            (joints,) target joint positions, within the joint limits. A reading that is not
            finite holds the robot at its last target.

        Raises:
            ValueError: If a shape is off.
            RuntimeError: If the model has learned nothing, or the very first joint reading is
                not finite, so that there is nothing to hold.
        """
        state, skin = self._checked(state, skin)
        readable = bool(torch.isfinite(state).all() & torch.isfinite(skin).all())
        walk = self._walk
        if walk.reference is None:
            if not bool(torch.isfinite(state).all()):
                raise RuntimeError("no finite joint reading yet, so there is no position to hold")
            walk.reference = torch.clamp(state, self.lower, self.upper)
        if not readable:
            self.touched = []
            return walk.reference.clone()
        counts, _, self._skin_state = self.skin(skin.unsqueeze(0), self._skin_state)
        self._spikes.append(counts[0])
        self.density = density = self._density()
        self.touched = touched = [
            patch
            for patch, count in zip(self.body.patches, counts[0].tolist())
            if count > 0 and patch in self.memories
        ]
        self._note_onsets(touched, state)
        target = walk.reference
        for patch in touched:
            index = self.body.patches.index(patch)
            target = self._move(target, patch, float(counts[0, index]), density[index], state)
        if touched:
            target = limit_speed(walk.reference, target, self.max_speed, 1.0 / self.body.rate)
            walk.reference = torch.clamp(target, self.lower, self.upper)
        return walk.reference.clone()

    @property
    def reference(self) -> Tensor:
        """Joint positions asked for last, (joints,), rad or m.

        Raises:
            RuntimeError: If no step was made since the reset.
        """
        if self._walk.reference is None:
            raise RuntimeError("no step was made since the reset, so there is no reference yet")
        return self._walk.reference

    def _move(
        self, reference: Tensor, patch: str, spikes: float, density: Tensor, state: Tensor
    ) -> Tensor:
        memory = self.memories[patch]
        assert isinstance(memory, PatchMemory)
        if self.config.advance == "tick":
            moved = reference.clone()
            moved[memory.joints] = memory(state[memory.joints], density)[0]
            return moved
        lag = (state - reference).abs()[memory.joints]
        if bool((lag > self.tolerance[memory.joints]).any()):
            return reference  # the joints are held up: wait for them
        return advance(reference, self._walk, patch, memory, spikes, density)

    def _note_onsets(self, touched: list[str], state: Tensor) -> None:
        """Where a new touch begins, take up joints that were moved meanwhile."""
        walk = self._walk
        assert walk.reference is not None
        onset = ONSET_AFTER * self.body.rate
        if any(walk.quiet.get(patch, onset) >= onset for patch in touched):
            away = (state - walk.reference).abs() > self.tolerance
            if bool(away.any()):
                held = torch.clamp(state, self.lower, self.upper)
                walk.reference = torch.where(away, held, walk.reference)
                walk.goals.clear()
        for patch in list(walk.goals):
            if touched and patch not in touched:
                del walk.goals[patch]  # another patch leads away from this goal
        for patch in self.memories:
            walk.quiet[patch] = 0 if patch in touched else walk.quiet.get(patch, 0) + 1

    def _density(self) -> Tensor:
        """Rate density ρ of every patch over the last window, (patches,)."""
        window = self._spikes.maxlen or 1
        rate = torch.stack(list(self._spikes)).sum(0) * (self.body.rate / window)
        return torch.clamp(rate / self.config.max_rate, 0.0, 1.0)

    def _checked(self, state: Tensor, skin: Tensor) -> tuple[Tensor, Tensor]:
        if not self.memories:
            raise RuntimeError("the model has learned nothing: call fit or from_pretrained first")
        joints, cells = len(self.body.joints), sum(self.body.cells)
        if state.shape != (joints,):
            raise ValueError(f"expected state ({joints},), got {tuple(state.shape)}")
        if skin.ndim == 1 and skin.numel() % cells == 0:
            skin = skin.reshape(cells, -1)
        if skin.ndim != 2 or len(skin) != cells:
            raise ValueError(f"expected skin ({cells}, points) or flat, got {tuple(skin.shape)}")
        return state.to(self.lower), skin.to(self.lower)

    def memory_bytes(self) -> int:
        """Bytes of all associations and successors held."""
        return sum(memory.memory.memory_bytes() for memory in self.memories.values())  # type: ignore[union-attr, operator]

    def save_pretrained(self, directory: str | Path) -> None:
        """Write ``config.json`` and ``model.safetensors``, whole or not at all.

        Args:
            directory: Made if it is not there.

        Raises:
            RuntimeError: If the model has learned nothing.
        """
        from safetensors.torch import save_file

        if not self.memories:
            raise RuntimeError("nothing to save: the model has learned nothing yet")
        directory = Path(directory)
        directory.mkdir(parents=True, exist_ok=True)
        partial = directory / (WEIGHTS_FILE + ".partial")
        save_file({k: v.contiguous() for k, v in self.state_dict().items()}, partial)
        partial.replace(directory / WEIGHTS_FILE)
        content: dict[str, Any] = {
            "config": as_dict(self.config),
            "body": as_dict(self.body),
            "memories": {patch: as_dict(shape) for patch, shape in self.shapes.items()},
        }
        write_json(directory / CONFIG_FILE, content)

    @classmethod
    def from_pretrained(cls, directory: str | Path) -> "HASM":
        """Load what ``save_pretrained`` wrote.

        Raises:
            FileNotFoundError: If a file is missing.
            ValueError: If a file is damaged or the two do not belong together.
        """
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        directory = Path(directory)
        for name in (CONFIG_FILE, WEIGHTS_FILE):
            if not (directory / name).is_file():
                raise FileNotFoundError(
                    f"no {name} in checkpoint {directory}: expected a directory written by "
                    "train.py or HASM.save_pretrained"
                )
        try:
            content = json.loads((directory / CONFIG_FILE).read_text())
            shapes = {p: MemoryShape(**shape) for p, shape in content["memories"].items()}
            model = cls(HASMConfig(**content["config"]), Body(**content["body"]), shapes)
            model.load_state_dict(load_file(directory / WEIGHTS_FILE))
        except (json.JSONDecodeError, KeyError, TypeError, RuntimeError, SafetensorError) as error:
            raise ValueError(
                f"checkpoint {directory} is damaged or from another version: {error}; "
                "train again with train.py"
            ) from error
        return model
