"""From joint positions, touch and further observations to the query of the memory.

    q = s ⊗ o ⊗ p
    s = PlaceCode(joint positions)                          (Population Place Coding)
    o = Q · RoPE3D(k ⊗ F(ρ); n = f̂, θ)                      (Tactile Embedding, eq. rope3d1)
    p = PlaceCode(observation), entries shuffled            where something more is bound

f̂ is the direction of the force in the base frame. The fixed random ±1 key k makes the blocks v of
three entries take all eight sign patterns, E[v vᵀ] = I, so that the match of two touches depends on
the angle between them alone; rigid bodies (or patches, where the patch names the function) have
keys of their own, and what was stored of another takes no part (``parts_of``). Q turns each block
by a fixed random orthogonal matrix, which changes no inner product and lets the signs of a block,
one bit an entry, tell directions evenly. The entries of p are shuffled so that they do not change
sign together with those of s. See docs/derivations.md.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hasm_torch import kernels
from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.encoders.place_code import PlaceCode, place_code
from hasm_torch.encoders.rope3d import RoPE3D
from hasm_torch.encoders.touch import TactileEmbedding
from hasm_torch.kernels import query as passes
from hasm_torch.model.settled import Settled

KEY_SEED = 0  # keys and mixing belong to the method: all memories have the same
CODE_NUMBERS = {
    "thermometer": passes.THERMOMETER,
    "gray": passes.GRAY,
    "binary": passes.BINARY,
}


def parts_of(body: Body, touch: str) -> list[int]:
    """What is told apart for certain by what is touched, an integer a patch.

    The rigid body where the direction of the force does the rest, else the patch itself. What was
    stored of another part takes no part in a recall.
    """
    return body.groups if touch == "direction" else list(range(len(body.patches)))


class QueryCode(nn.Module):
    """Codes what the robot does and feels.

    Attributes:
        joints: (J,) indices of the joints that are coded.
        code_dim: D, entries of a query.
        parts: (patches,) key of each patch.

    Args:
        config: Settings of the method.
        body: Joints and skin of the robot.
        settled: What was chosen for the episodes.
    """

    parts: Tensor
    rank: Tensor
    keys: Tensor
    mixing: Tensor
    shuffle: Tensor

    def __init__(self, config: HASMConfig, body: Body, settled: Settled) -> None:
        super().__init__()
        self.joints = np.array(settled.joints)
        lower, upper = ([limits[j] for j in settled.joints] for limits in (body.lower, body.upper))
        neurons, bits, width = config.neurons, config.bits, config.width
        self.place_code = PlaceCode(lower, upper, neurons, bits, width, config.code)
        self.embedding = TactileEmbedding(len(lower), neurons, bits)
        self.code_dim = dim = self.place_code.code_dim
        self.rope = RoPE3D(dim)
        directed = settled.touch == "direction"
        self.angle = settled.angle if directed and config.rope else 0.0
        parts = parts_of(body, settled.touch)
        self.register_buffer("parts", torch.tensor(parts), persistent=False)
        generator = torch.Generator().manual_seed(KEY_SEED)
        order = torch.randperm(len(lower) * neurons, generator=generator)
        rank = order if config.ranks == "fixed" else order[:0]
        self.register_buffer("rank", rank, persistent=False)
        keys = torch.randint(2, (max(parts, default=0) + 1, dim), generator=generator)
        self.register_buffer("keys", 2.0 * keys - 1.0, persistent=False)
        mixing = torch.linalg.qr(torch.randn(dim // 3, 3, 3, generator=generator).double())[0]
        self.register_buffer("mixing", mixing, persistent=False)
        self.observed: PlaceCode | None = None
        shuffle = torch.zeros(0, dtype=torch.int64)
        if settled.observed:
            low, high = zip(*settled.observed)
            self.observed = PlaceCode(low, high, neurons, bits, width, config.code)
            entries = torch.arange(dim) % self.observed.code_dim
            shuffle = entries[torch.randperm(dim, generator=generator)]
        self.register_buffer("shuffle", shuffle, persistent=False)
        phases = self.angle * 10.0 ** (-np.arange(1, dim // 3 + 1) / dim)
        self._part_of, self._no_code = np.array(parts), np.zeros((0, dim), np.float32)
        self._tables = passes.CodeTables(
            self.place_code.lower.numpy(),
            self.place_code.upper.numpy(),
            neurons,
            bits,
            width,
            CODE_NUMBERS[config.code],
            rank.numpy(),
            self.keys.numpy(),
            phases if self.angle else phases[:0],
            mixing.contiguous().numpy(),
        )

    def forward(
        self,
        positions: Tensor,
        density: Tensor,
        patch: Tensor,
        direction: Tensor,
        observation: Tensor | None = None,
    ) -> Tensor:
        """Code queries, or associations, which are coded alike.

        Args:
            positions: (K, all joints) joint positions, rad or m.
            density: (K,) rate density ρ, 0 to 1.
            patch: (K,) which patch is touched.
            direction: (K, 3) f̂, of length 1; zero where nothing pushes.
            observation: (K, N) further observations, where some are bound.

        Returns:
            (K, D) float32.

        Raises:
            ValueError: If a coded position is not finite, or an observation is missing.
        """
        mine = positions[..., self.joints]
        self.place_code.check(mine)
        more = self._observation_code(observation)
        if kernels.enabled() and mine.device.type == "cpu":
            # Contiguous, since another layout would be compiled for itself.
            coded = passes.encode_queries(
                self._tables,
                mine.detach().double().contiguous().numpy(),
                density.detach().double().contiguous().numpy(),
                self.parts[patch].numpy(),
                direction.detach().double().contiguous().numpy(),
                self._no_code if more is None else more.numpy(),
            )
            return torch.from_numpy(coded)
        levels = self.place_code.levels(mine)
        state = place_code(levels, self.place_code.bits, self.place_code.code, torch.float32)
        # The neuron of the first rank is the most active one.
        ranking = -self.rank.expand_as(levels) if len(self.rank) else levels
        touch = self.keys[self.parts[patch]] * self.embedding(density.float(), ranking)
        if self.angle:
            angle = torch.full_like(density, self.angle)
            touch = self._mixed(self.rope(touch, direction.float(), angle), direction)
        return state * touch if more is None else state * touch * more

    def in_arrays(
        self,
        positions: NDArray[np.float64],
        density: float,
        patch: int,
        direction: NDArray[np.float64],
        observation: NDArray[np.float64],
    ) -> Tensor:
        """``forward`` for one control step on the CPU, whose arguments have no leading dimension.

        Returns:
            (D,) float32.
        """
        bound = self._no_code
        if self.observed is not None:
            code = self.observed(torch.from_numpy(observation).float())
            bound = code[self.shuffle][None].numpy()
        return torch.from_numpy(
            passes.encode_queries(
                self._tables,
                positions[self.joints][None],
                np.array([density]),
                self._part_of[patch : patch + 1],
                direction[None],
                bound,
            )
        )[0]

    def _observation_code(self, observation: Tensor | None) -> Tensor | None:
        if self.observed is None:
            return None
        if observation is None:
            raise ValueError(
                f"the memory binds {self.observed.joints} further observations: give "
                "step(..., observation=...)"
            )
        return self.observed(observation.float())[..., self.shuffle]

    def _mixed(self, code: Tensor, direction: Tensor) -> Tensor:
        """Blocks turned by the fixed orthogonal matrices; those of an unturned code stay."""
        blocks = code[:, : 3 * len(self.mixing)].unflatten(-1, (-1, 3))
        mixed = torch.einsum("bij,kbj->kbi", self.mixing.float(), blocks).flatten(1)
        mixed = torch.cat([mixed, code[:, 3 * len(self.mixing) :]], dim=-1)
        return torch.where((direction == 0).all(-1, keepdim=True), code, mixed)
