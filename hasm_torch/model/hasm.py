"""The whole model: skin forces and joint positions in, joint targets out.

joint positions ──PlaceCode──► s ┐
skin forces ──EffectiveForce──Izhikevich──► ρ ──TactileEmbedding──► F ──RoPE3D──► o ┤
                                    m = s ⊗ o ──HeteroAssociativeMemory──► joint targets
"""

from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from hasm_torch.body import Body
from hasm_torch.config import SHARED, HASMConfig, MemoryShape
from hasm_torch.encoders.readings import forces_of
from hasm_torch.encoders.skin import SkinEncoder, spike_step
from hasm_torch.encoders.skin_filter import FilterState, clean_skin
from hasm_torch.model import checkpoint
from hasm_torch.model.control import Array, Rollout, Walk, advance, limit_speed
from hasm_torch.model.learning import FitReport, Recording, learn
from hasm_torch.model.patch_memory import PatchMemory

if TYPE_CHECKING:
    from hasm_torch.robot import Kinematics

# A patch that was quiet this long is touched anew, s.
ONSET_AFTER = 0.2


class HASM(nn.Module):
    """Encoders and one dedicated memory a skin patch, or one that all patches share.

    ``fit`` stores episodes, ``step`` gives the joint target of one control step, ``reset`` starts
    a new rollout.

    Attributes:
        memories: The memories that hold something: one a patch, by its name, or the shared one.
        patches: Names of the patches that have learned something.
        rollout: The control loop that ``step`` goes on with unless it is given another.
        tolerance: (joints,) how far a joint may be from its reference before the reference waits
            or, at a new touch, follows the joint, rad or m.
        footprint: (cells,) share of its patch's force that each cell took at every touch of the
            episodes, see ``skin_filter``.

    Args:
        config: Settings of the method.
        body: Joints and skin of the robot.
        shapes: Shapes of the memories by patch, of a model to be loaded; ``fit`` finds them.
    """

    tolerance: Tensor
    footprint: Tensor
    lower: Tensor
    upper: Tensor
    max_speed: Tensor

    def __init__(
        self, config: HASMConfig, body: Body, shapes: dict[str, MemoryShape] | None = None
    ) -> None:
        super().__init__()
        self.config, self.body = config, body
        self._kinematics: Kinematics | None = None
        self.skin = SkinEncoder(
            body.cells,
            body.rate,
            config.threshold,
            config.force_window,
            config.current_per_newton,
            spike_step(body.rate, config.spike_dt_ms),
        )
        self.shapes: dict[str, MemoryShape] = {}
        self.memories = nn.ModuleDict()
        for patch, shape in (shapes or {}).items():
            self.add_memory(patch, shape)
        self.register_buffer("lower", torch.tensor(body.lower, dtype=torch.float32))
        self.register_buffer("upper", torch.tensor(body.upper, dtype=torch.float32))
        self.register_buffer("max_speed", torch.tensor(body.max_speed, dtype=torch.float32))
        # As the float32 that targets are given in, so that none is rounded across a limit.
        self._lower, self._upper, self._max_speed = (
            np.array(limit, dtype=np.float32).astype(np.float64)
            for limit in (body.lower, body.upper, body.max_speed)
        )
        self.register_buffer("tolerance", 0.1 * (self.upper - self.lower))
        self.register_buffer("footprint", torch.zeros(sum(body.cells)))
        self.reset()

    def add_memory(self, name: str, shape: MemoryShape) -> PatchMemory:
        """Make an empty memory, in place of the one of that name.

        Args:
            name: The patch that it belongs to, or ``SHARED`` where the shape names the patches.
            shape: What it holds.

        Raises:
            ValueError: If a patch is not the body's.
        """
        for served in shape.patches or [name]:
            if served not in self.body.patches:
                raise ValueError(f"unknown patch {served!r}, valid: {', '.join(self.body.patches)}")
        index = 0 if shape.patches else self.body.patches.index(name)
        memory = PatchMemory(self.config, self.body, index, shape)
        self.shapes[name], self.memories[name] = shape, memory
        return memory

    @property
    def patches(self) -> list[str]:
        """Names of the patches that have learned something."""
        return [patch for name, shape in self.shapes.items() for patch in shape.patches or [name]]

    def memory(self, patch: str) -> PatchMemory:
        """The memory of a patch that has learned something."""
        memory = self.memories[SHARED if self.config.memories == "shared" else patch]
        assert isinstance(memory, PatchMemory)
        return memory

    def link_rotation(self, patch: str, positions: Tensor) -> Tensor | None:
        """Rotation of a patch's link in the base frame, by forward kinematics.

        Args:
            patch: Name of the patch.
            positions: (..., joints) joint positions, rad or m.

        Returns:
            (..., 3, 3), or None where touches are told apart in the link's own frame.

        Raises:
            ValueError: If the body does not say which link carries the patch, or a joint or link
                is not the bundled HSR's.
        """
        if self.config.frame == "link":
            return None
        if not self.body.links:
            raise ValueError('frame="base" needs the link of every patch: give Body(links=...)')
        if self._kinematics is None:
            from hasm_torch.robot import Kinematics

            self._kinematics = Kinematics(device=str(positions.device))
        named = dict(zip(self.body.joints, positions.unbind(-1)))
        pose = self._kinematics.forward_named(named)[
            self.body.links[self.body.patches.index(patch)]
        ]
        return pose[..., :3, :3]

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

    def clean(
        self, forces: Tensor, state: FilterState | None = None
    ) -> tuple[Tensor, FilterState | None]:
        """What a sound skin would have read, see ``skin_filter``.

        Args:
            forces: (T, cells, 3), N.
            state: What an earlier chunk returned.

        Returns:
            (T, cells, 3), N; the state to go on from.
        """
        if not self.body.channels:
            return forces, None
        footprint = self.footprint.cpu().numpy()
        return clean_skin(forces, self.body.cells, self.body.rate, footprint, state)

    def reset(self) -> None:
        """Forget the rollout: the next step starts from the measured joints."""
        self.rollout = self.new_rollout()

    def new_rollout(self) -> Rollout:
        """A control loop at its beginning, for ``step``."""
        window = max(1, round(self.config.rate_window_s * self.body.rate))
        return Rollout(deque(maxlen=window), np.zeros(len(self.body.patches)))

    @torch.no_grad()
    def step(self, state: Tensor, skin: Tensor | None, rollout: Rollout | None = None) -> Tensor:
        """One control step.

        Args:
            state: (joints,) measured joint positions, rad or m.
            skin: (cells, channels) or flat, the skin's readings in the body's layout; None for a
                robot without skin.
            rollout: The control loop to go on with, one a robot; by default the model's own.

        Returns:
            (joints,) target joint positions, within the joint limits. A reading that is not
            finite holds the robot at its last target.

        Raises:
            ValueError: If a shape is off.
            RuntimeError: If the model has learned nothing, or the very first joint reading is
                not finite, so that there is nothing to hold.
        """
        measured, forces = self._checked(state, skin)
        rollout = self.rollout if rollout is None else rollout
        walk = rollout.walk
        known = bool(np.isfinite(measured).all())
        if walk.reference is None:
            if not known:
                raise RuntimeError("no finite joint reading yet, so there is no position to hold")
            walk.reference = np.clip(measured, self._lower, self._upper)
        if not (known and bool(torch.isfinite(forces).all())):
            rollout.touched = []
            return self._target(walk.reference, state)
        felt, rollout.filter = self.clean(forces.unsqueeze(0), rollout.filter)
        spikes, _, rollout.skin = self.skin(felt, rollout.skin)
        counts = spikes[0].cpu().numpy().astype(np.float64)
        rollout.spikes.append(counts)
        rollout.density = density = self._density(rollout.spikes)
        patches = self.patches
        rollout.touched = touched = [
            patch
            for patch, count in zip(self.body.patches, counts)
            if count > 0 and patch in patches
        ]
        self._note_onsets(walk, touched, measured)
        target = walk.reference
        for patch in touched:
            index = self.body.patches.index(patch)
            touch = (float(counts[index]), float(density[index]))
            target = self._move(walk, target, patch, *touch, measured)
        if touched:
            target = limit_speed(walk.reference, target, self._max_speed, 1.0 / self.body.rate)
            walk.reference = np.clip(target, self._lower, self._upper)
        return self._target(walk.reference, state)

    @property
    def touched(self) -> list[str]:
        """Patches with a memory that spiked in the last step."""
        return self.rollout.touched

    @property
    def density(self) -> Tensor:
        """(patches,) rate density ρ of every patch at the last step."""
        return torch.from_numpy(self.rollout.density).float()

    @property
    def reference(self) -> Tensor:
        """Joint positions asked for last, (joints,), rad or m.

        Raises:
            RuntimeError: If no step was made since the reset.
        """
        if self.rollout.walk.reference is None:
            raise RuntimeError("no step was made since the reset, so there is no reference yet")
        return torch.from_numpy(self.rollout.walk.reference).float()

    def _move(
        self,
        walk: Walk,
        reference: Array,
        patch: str,
        spikes: float,
        density: float,
        measured: Array,
    ) -> Array:
        memory = self.memory(patch)
        if self.config.advance == "tick":
            link = self.link_rotation(patch, torch.from_numpy(measured))
            moved = reference.copy()
            level = memory.touch_level(density)
            now = measured[memory.coded]
            following, _, led = memory.follow(now, level, link, patch)
            moved[memory.coded] = np.where(led, following, moved[memory.coded])
            return moved
        lag = np.abs(measured - reference)[memory.coded]
        if (lag > self.tolerance.cpu().numpy()[memory.coded]).any():
            return reference  # the joints are held up: wait for them
        link = self.link_rotation(patch, torch.from_numpy(reference))
        return advance(reference, walk, patch, memory, spikes, density, link)

    def _note_onsets(self, walk: Walk, touched: list[str], measured: Array) -> None:
        """Where a new touch begins, take up joints that were moved meanwhile."""
        assert walk.reference is not None
        onset = ONSET_AFTER * self.body.rate
        anew = [patch for patch in touched if walk.quiet.get(patch, onset) >= onset]
        if anew:
            away = np.abs(measured - walk.reference) > self.tolerance.cpu().numpy()
            if away.any():
                held = np.clip(measured, self._lower, self._upper)
                walk.reference = np.where(away, held, walk.reference)
                walk.goals.clear()
        for patch in list(walk.goals):
            if touched and patch not in touched:
                del walk.goals[patch]  # another patch leads away from this goal
        for patch in anew:
            walk.levels.pop(patch, None)  # how strong the new touch is shows later
        for patch in self.patches:
            walk.quiet[patch] = 0 if patch in touched else walk.quiet.get(patch, 0) + 1

    def _density(self, spikes: deque[Array]) -> Array:
        """Rate density ρ of every patch over the last window, (patches,)."""
        seconds = (spikes.maxlen or 1) / self.body.rate
        return np.clip(np.sum(spikes, axis=0) / (seconds * self.config.max_rate), 0.0, 1.0)

    def _checked(self, state: Tensor, skin: Tensor | None) -> tuple[Array, Tensor]:
        if not self.memories:
            raise RuntimeError("the model has learned nothing: call fit or from_pretrained first")
        joints = len(self.body.joints)
        if state.shape != (joints,):
            raise ValueError(f"expected state ({joints},), got {tuple(state.shape)}")
        forces = forces_of(self.body, skin).to(self.lower)
        return state.detach().cpu().numpy().astype(np.float64), forces

    def _target(self, reference: Array, state: Tensor) -> Tensor:
        """The reference as the caller takes it, float32 on the device of the state."""
        return torch.from_numpy(reference.astype(np.float32)).to(state.device)

    def memory_bytes(self) -> int:
        """Bytes of all associations and successors held."""
        return sum(memory.memory.memory_bytes() for memory in self.memories.values())  # type: ignore[union-attr, operator]

    def save_pretrained(self, directory: str | Path) -> None:
        """Write a checkpoint; see ``checkpoint``.

        Args:
            directory: Made if it is not there.

        Raises:
            RuntimeError: If the model has learned nothing.
        """
        checkpoint.save(self, Path(directory))

    @classmethod
    def from_pretrained(cls, directory: str | Path) -> "HASM":
        """Load what ``save_pretrained``, ``train.py`` or LeRobot's training wrote.

        Raises:
            FileNotFoundError: If a file is missing.
            ValueError: If a file is damaged, holds no memory, or does not belong to the other.
        """
        settings = checkpoint.read_settings(Path(directory))
        try:
            model = cls(settings.config, settings.body, settings.shapes)
        except (ValueError, LookupError, TypeError, RuntimeError) as error:
            raise checkpoint.damaged(Path(directory), error) from error
        checkpoint.load_weights(model, Path(directory))
        return model
