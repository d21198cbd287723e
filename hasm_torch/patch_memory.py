"""The memory of one skin patch: joint positions in, the next joint positions out.

joints ── PlaceCode ──► s ┐
ρ ── TactileEmbedding ──► F ── RoPE3D ──► o ┤ HeteroAssociativeMemory ──► successor, pace
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hasm_torch.bipolar import binarise
from hasm_torch.config import Body, HASMConfig, MemoryShape
from hasm_torch.memory import HeteroAssociativeMemory
from hasm_torch.place_code import PlaceCode, place_code
from hasm_torch.query_kernel import block_rotations, encode_query
from hasm_torch.rope3d import touch_rotation
from hasm_torch.touch import TactileEmbedding


class PatchMemory(nn.Module):
    """Dedicated memory of a patch over the joints that its touch moves.

    A stored successor is (joint positions, pace): the pace is the number of spikes that the
    episode took to travel the full range of the fastest joint, so that recall at the recorded
    force repeats the recorded speed.

    Attributes:
        joints: (J,) indices of the joints that are coded; ``coded`` holds them as an array.
        span: (J,) array, their ranges, rad or m.
        touch_levels: (L,) stored rate densities ρ; a query is moved to the nearest of them.
        direction: (3,) outward normal of the patch in the frame of its link.
        axis: (3,) rotation axis of the touch in that frame.
        angle: () rotation angle of the touch in that frame, rad.
        rotations: (blocks, 3, 3) the same rotation, scaled for each block of a code.

    Args:
        config: Settings of the method.
        body: Joints and skin of the robot.
        patch: Index of the patch.
        shape: Joints, capacity and number of touch levels.
    """

    joints: Tensor
    touch_levels: Tensor
    direction: Tensor
    axis: Tensor
    angle: Tensor
    rotations: Tensor

    def __init__(self, config: HASMConfig, body: Body, patch: int, shape: MemoryShape) -> None:
        super().__init__()
        self.rebinarise = config.rebinarise
        count = len(shape.joints)
        self.place_code = PlaceCode(
            [body.lower[j] for j in shape.joints],
            [body.upper[j] for j in shape.joints],
            config.neurons,
            config.bits,
            config.width,
            config.code,
        )
        self.embedding = TactileEmbedding(count, config.neurons, config.bits)
        self.memory = HeteroAssociativeMemory(
            count * config.neurons * config.bits, count + 1, shape.capacity, storage=config.storage
        )
        self.register_buffer("joints", torch.tensor(shape.joints, dtype=torch.int64))
        self.coded = np.array(shape.joints)
        self.span = np.array([body.upper[j] - body.lower[j] for j in shape.joints])
        self.register_buffer("touch_levels", torch.zeros(shape.touch_levels))
        direction = torch.tensor(body.directions[patch], dtype=torch.float32)
        self.register_buffer("direction", direction, persistent=False)
        axis, angle = touch_rotation(direction)
        self.register_buffer("axis", axis)
        self.register_buffer("angle", angle)
        rotations = block_rotations(self.memory.code_dim, axis, angle)
        self.register_buffer("rotations", rotations, persistent=False)

    def codes(
        self, positions: Tensor, density: Tensor, link: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Code joint positions and the touch they were felt with.

        Args:
            positions: (..., J) positions of the coded joints, rad or m.
            density: (...,) rate density ρ, 0 to 1.
            link: (..., 3, 3) rotation of the patch's link in the base frame, to tell touches by
                their direction there; without it the link's own frame serves.

        Returns:
            State code s and rotated tactile code o, both (..., D).
        """
        self.place_code.check(positions)
        if len(self.touch_levels):
            nearest = (density.unsqueeze(-1) - self.touch_levels).abs().argmin(-1)
            density = self.touch_levels[nearest]
        return self._encode(positions, density, link)

    def _encode(
        self, positions: Tensor, density: Tensor, link: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """``codes`` of checked positions at a stored rate density."""
        coder = self.place_code
        on_cpu = positions.device.type == "cpu" and not torch.compiler.is_compiling()
        if link is None and on_cpu and positions.dtype == torch.float32:
            return encode_query(positions, density, coder, self.rotations, self.rebinarise)
        levels = coder.levels(positions)
        touch = self.embedding(density, levels).to(positions.dtype)
        axis, angle = self.axis, self.angle
        if link is not None:
            axis, angle = touch_rotation(link.to(self.direction.dtype) @ self.direction)
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
    ) -> None:
        """Store what follows joint positions under a touch.

        Args:
            positions: (K, J) positions of the coded joints, rad or m.
            density: (K,) rate density ρ.
            successor: (K, J) positions that follow, rad or m.
            pace: (K,) spikes a full joint range.
            link: (K, 3, 3) as in ``codes``.
        """
        state, touch = self.codes(positions, density, link)
        self.memory.write(state, touch, torch.cat([successor, pace.unsqueeze(-1)], dim=-1))

    def forward(
        self, positions: Tensor, density: Tensor, link: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Recall what follows joint positions under a touch.

        Args:
            positions: (..., J) positions of the coded joints, rad or m.
            density: (...,) rate density ρ.
            link: (..., 3, 3) as in ``codes``.

        Returns:
            (..., J) positions that follow; (...,) pace, spikes a full joint range.
        """
        decision = self.memory(*self.codes(positions, density, link))
        return decision[..., :-1], decision[..., -1]

    def follow(
        self, positions: NDArray[np.float64], density: float, link: Tensor | None = None
    ) -> tuple[NDArray[np.float64], float]:
        """``forward`` of one query in arrays, for the control loop: (J,) positions and pace."""
        query = torch.from_numpy(positions.astype(np.float32)).to(self.joints.device)
        levels = self.touch_levels.cpu().numpy()
        if len(levels):
            density = float(levels[np.abs(levels - np.float32(density)).argmin()])
        level = torch.tensor(density, dtype=torch.float32, device=self.joints.device)
        state, touch = self._encode(query, level, link)
        decision = self.memory(state, touch).cpu().numpy().astype(np.float64)
        return decision[:-1], float(decision[-1])

    def weights(self, positions: Tensor, density: Tensor, link: Tensor | None = None) -> Tensor:
        """Softmax weight of every stored association; arguments as in ``forward``.

        Returns:
            (..., count), summing to 1.
        """
        return self.memory.weights(self.memory.associate(*self.codes(positions, density, link)))
