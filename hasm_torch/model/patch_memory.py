"""The memory of one skin patch, or of several: joint positions in, the next joint positions out.

joints ── PlaceCode ──► s ┐
ρ ── TactileEmbedding ──► F ── RoPE3D ──► o ┤ HeteroAssociativeMemory ──► successor, pace

Patches that share a memory are told apart by the rotations R of their touches. Every entry of F
stands several times side by side, so that most blocks of three are ±(1, 1, 1), which two rotations
can map alike. There F is bound with a fixed random ±1 key first: the blocks v then take all eight
sign patterns, E[v vᵀ] = I, and the match of two touches, ⟨R v, R′ v⟩ = trace(RᵀR′) on average,
depends on the angle between them alone. Each touch level has a key of its own: without, a far
state felt at another level can match, since s and F may change sign at the same entries.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig, MemoryShape
from hasm_torch.encoders.bipolar import binarise
from hasm_torch.encoders.place_code import PlaceCode, place_code
from hasm_torch.encoders.rope3d import touch_rotation
from hasm_torch.encoders.touch import TactileEmbedding
from hasm_torch.kernels.query import block_rotations, encode_query
from hasm_torch.memory.layer import HeteroAssociativeMemory

KEY_SEED = 0  # the keys belong to the method: all shared memories have the same
ONE_KEY = torch.zeros((), dtype=torch.int64)


class PatchMemory(nn.Module):
    """Memory of a patch over the joints that its touch moves, or of several patches.

    A stored successor is (joint positions, pace): the pace is the number of spikes that the
    episode took to travel the full range of the fastest joint, so that recall at the recorded
    force repeats the recorded speed. A shared memory recalls besides which joints the touch moves.

    Attributes:
        patches: Names of the patches that the memory serves.
        joints: (J,) indices of the joints that are coded; ``coded`` holds them as an array.
        span: (J,) array, their ranges, rad or m.
        touch_levels: (L,) stored rate densities ρ; a query is moved to the nearest of them.
        directions: (P, 3) outward normal of each patch in the frame of its link.
        keys: (L or 1, D) ±1 that the touch code of each level is bound with; ones where there is
            one patch.
        rotations: (P, blocks, 3, 3) rotation of each patch's touch in that frame, scaled for each
            block of a code.

    Args:
        config: Settings of the method.
        body: Joints and skin of the robot.
        patch: Index of the patch, where the shape names none.
        shape: Joints, capacity, number of touch levels, patches that share the memory.
    """

    joints: Tensor
    touch_levels: Tensor
    directions: Tensor
    keys: Tensor
    rotations: Tensor

    def __init__(self, config: HASMConfig, body: Body, patch: int, shape: MemoryShape) -> None:
        super().__init__()
        self.rebinarise, self.rope = config.rebinarise, config.rope
        self.patches = shape.patches or [body.patches[patch]]
        count = len(shape.joints)
        self.place_code = PlaceCode(
            [body.lower[j] for j in shape.joints],
            [body.upper[j] for j in shape.joints],
            config.neurons,
            config.bits,
            config.width,
            config.code,
        )
        together = count if config.ranks == "all" else 1  # joints whose neurons are ranked together
        self.embedding = TactileEmbedding(together, config.neurons, config.bits)
        self.ranked = together * config.neurons
        self.memory = HeteroAssociativeMemory(
            count * config.neurons * config.bits,
            count + 1 if len(self.patches) == 1 else 2 * count + 1,
            shape.capacity,
            storage=config.storage,
        )
        self.register_buffer("joints", torch.tensor(shape.joints, dtype=torch.int64))
        self.coded = np.array(shape.joints)
        self.span = np.array([body.upper[j] - body.lower[j] for j in shape.joints])
        self.register_buffer("touch_levels", torch.zeros(shape.touch_levels))
        normals = [body.directions[body.patches.index(name)] for name in self.patches]
        self.register_buffer("directions", torch.tensor(normals).float(), persistent=False)
        dim = self.memory.code_dim
        keys = torch.ones(max(1, shape.touch_levels), dim)
        if len(self.patches) > 1:
            generator = torch.Generator().manual_seed(KEY_SEED)
            keys = 2.0 * torch.randint(2, keys.shape, generator=generator) - 1.0
        self.register_buffer("keys", keys, persistent=False)
        turns = [block_rotations(dim, *self.rotation(direction)) for direction in self.directions]
        self.register_buffer("rotations", torch.stack(turns), persistent=False)

    def rotation(self, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Axis (..., 3) and angle (...), rad, by which a touch (..., 3) rotates its code."""
        axis, angle = touch_rotation(direction)
        return axis, angle if self.rope else torch.zeros_like(angle)

    def codes(
        self,
        positions: Tensor,
        density: Tensor,
        link: Tensor | None = None,
        patch: str | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Code joint positions and the touch they were felt with.

        Args:
            positions: (..., J) positions of the coded joints, rad or m.
            density: (...,) rate density ρ, 0 to 1.
            link: (..., 3, 3) rotation of the patch's link in the base frame, to tell touches by
                their direction there; without it the link's own frame serves.
            patch: Which patch is touched; the first by default.

        Returns:
            State code s and rotated tactile code o, both (..., D).
        """
        self.place_code.check(positions)
        if len(self.touch_levels):
            density = self.touch_levels[self._level(density)]
        return self._encode(positions, density, link, patch)

    def _level(self, density: Tensor) -> Tensor:
        """Index of the nearest touch level, (...,); 0 where none is stored."""
        if not len(self.touch_levels):
            return torch.zeros_like(density, dtype=torch.int64)
        return (density.unsqueeze(-1) - self.touch_levels).abs().argmin(-1)

    def _encode(
        self, positions: Tensor, density: Tensor, link: Tensor | None, patch: str | None
    ) -> tuple[Tensor, Tensor]:
        """``codes`` of checked positions at a stored rate density."""
        coder = self.place_code
        touched = 0 if patch is None else self.patches.index(patch)
        on_cpu = positions.device.type == "cpu" and not torch.compiler.is_compiling()
        if link is None and on_cpu and positions.dtype == torch.float32:
            rotations = self.rotations[touched]
            return encode_query(
                positions,
                density,
                coder,
                self.ranked,
                self.keys,
                self._level(density) if len(self.patches) > 1 else ONE_KEY,
                rotations,
                self.rebinarise,
            )
        levels = coder.levels(positions)
        groups = levels.unflatten(-1, (-1, self.ranked))
        touch = self.embedding(density.unsqueeze(-1), groups).flatten(-2)
        touch = touch.to(positions.dtype) * self.keys[self._level(density)].to(positions.dtype)
        direction = self.directions[touched]
        if link is not None:
            direction = link.to(direction.dtype) @ direction
        axis, angle = self.rotation(direction)
        rotated = self.memory.rope(touch, axis, angle)
        state = place_code(levels, coder.bits, coder.code, positions.dtype)
        return state, binarise(rotated) if self.rebinarise else rotated

    def write(
        self,
        positions: Tensor,
        density: Tensor,
        successor: Tensor,
        pace: Tensor,
        link: Tensor | None = None,
        patch: str | None = None,
        moved: Tensor | None = None,
    ) -> None:
        """Store what follows joint positions under a touch.

        Args:
            positions: (K, J) positions of the coded joints, rad or m.
            density: (K,) rate density ρ.
            successor: (K, J) positions that follow, rad or m.
            pace: (K,) spikes a full joint range.
            link: (K, 3, 3) as in ``codes``.
            patch: As in ``codes``.
            moved: (J,) whether the touch moves each joint; a shared memory needs it.
        """
        values = [successor, pace.unsqueeze(-1)]
        if len(self.patches) > 1:
            assert moved is not None
            values.append(moved.to(successor).expand_as(successor))
        self.memory.write(*self.codes(positions, density, link, patch), torch.cat(values, dim=-1))

    def forward(
        self,
        positions: Tensor,
        density: Tensor,
        link: Tensor | None = None,
        patch: str | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Recall what follows joint positions under a touch.

        Args:
            positions: (..., J) positions of the coded joints, rad or m.
            density: (...,) rate density ρ.
            link: (..., 3, 3) as in ``codes``.
            patch: As in ``codes``.

        Returns:
            (..., J) positions that follow, of joints that the touch does not move the present ones;
            (...,) pace, spikes a full joint range.
        """
        decision = self.memory(*self.codes(positions, density, link, patch))
        count = len(self.joints)
        following = decision[..., :count]
        if len(self.patches) > 1:
            following = torch.where(decision[..., count + 1 :] > 0.5, following, positions)
        return following, decision[..., count]

    def touch_level(self, density: float, held: float | None = None) -> float:
        """The stored rate density that stands for a felt one.

        Args:
            density: Felt rate density ρ.
            held: Level of the touch so far. It changes only once ρ has reached another level, so
                that a ρ halfway between two does not switch between their memories.

        Returns:
            The nearest stored level, or ``held``; ρ itself where none is stored.
        """
        levels = self.touch_levels.cpu().numpy()
        if not len(levels):
            return density
        nearest = float(levels[np.abs(levels - np.float32(density)).argmin()])
        if held is None or held == nearest:
            return nearest
        return nearest if (density - nearest) * (nearest - held) >= 0 else held

    def follow(
        self,
        positions: NDArray[np.float64],
        density: float,
        link: Tensor | None = None,
        patch: str | None = None,
    ) -> tuple[NDArray[np.float64], float, NDArray[np.bool_]]:
        """Recall of one query in arrays, for the control loop.

        Args:
            positions: (J,) positions of the coded joints, rad or m.
            density: A stored level, see ``touch_level``.
            link: (3, 3) as in ``codes``.
            patch: As in ``codes``.

        Returns:
            (J,) positions that follow, pace, and (J,) which joints the touch moves.
        """
        query = torch.from_numpy(positions.astype(np.float32)).to(self.joints.device)
        level = torch.tensor(density, dtype=torch.float32, device=self.joints.device)
        state, touch = self._encode(query, level, link, patch)
        decision = self.memory(state, touch).cpu().numpy().astype(np.float64)
        count = len(self.coded)
        moved = np.ones(count, np.bool_) if len(self.patches) == 1 else decision[count + 1 :] > 0.5
        return decision[:count], float(decision[count]), moved

    def weights(
        self,
        positions: Tensor,
        density: Tensor,
        link: Tensor | None = None,
        patch: str | None = None,
    ) -> Tensor:
        """Softmax weight of every stored association; arguments as in ``forward``.

        Returns:
            (..., count), summing to 1.
        """
        return self.memory.weights(
            self.memory.associate(*self.codes(positions, density, link, patch))
        )
