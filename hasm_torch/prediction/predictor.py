"""The memory that predicts: what followed joint states like this one, joint by joint.

Each joint has a dedicated recall. All share the associations M; the scores of joint j are those of
the association with the joint's own place code c_j appended ``emphasis`` times,

    a_j = Mᵀ q + emphasis_j C_jᵀ c_j,     d_j = S₋₁ softmax(β_j a_j),

so that among alike postures those count most in which joint j itself stood and moved alike. β
follows from the perplexity, see ``anneal``. The recalled state s̄ and recent displacement v̄ differ
from the present s and v, and the prediction makes up for that,

    d_j + shift_j (s_j − s̄_j) + momentum_j (v_j − v̄_j),   s̄ = S w_j,   v̄ = V w_j.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from hasm_torch.body import Body
from hasm_torch.encoders.bipolar import binarise
from hasm_torch.encoders.place_code import PlaceCode, place_code
from hasm_torch.encoders.rope3d import touch_rotation
from hasm_torch.encoders.touch import TactileEmbedding
from hasm_torch.kernels.query import block_rotations
from hasm_torch.memory.layer import HeteroAssociativeMemory
from hasm_torch.prediction.annealing import anneal
from hasm_torch.prediction.own_codes import OwnCodes
from hasm_torch.prediction.series import Moments, thin
from hasm_torch.prediction.settings import PredictionSettings

# Queries of one block; bounds the (block, joints, shortlist) arrays.
_BLOCK = 256
# A joint that varies less than this share of its limits does not move.
_STILL = 1e-6


class Matches(NamedTuple):
    """The associations that match best.

    Attributes:
        rows: (K, shortlist) their rows in the memory.
        scores: (K, shortlist) inner products Mᵀq.
        own: (K, moving joints, shortlist) inner products of the joints' own place codes.
    """

    rows: Tensor
    scores: Tensor
    own: Tensor


class Recalled(NamedTuple):
    """What was recalled, and how the present differs from it.

    Attributes:
        moved: (K, joints) displacement to the successor.
        faster: (K, joints) present recent displacement less the recalled one.
        apart: (K, joints) present position less the recalled one.
    """

    moved: Tensor
    faster: Tensor
    apart: Tensor

    def predict(self, shift: Tensor, momentum: Tensor) -> Tensor:
        """Predicted displacement; see ``PredictionSettings`` for shift and momentum, (joints,)."""
        return self.moved + (shift - 1.0) * self.apart + momentum * self.faster


class JointPredictor(nn.Module):
    """Joint states a horizon ahead, recalled from episodes.

    Attributes:
        moving: Indices of the joints that move in the episodes; the others stay where they are.
        patches: Patches that have a segment of their own.
        memory: Associations m = s ⊗ o; the values are displacement to the successor, recent
            displacement and position of every moving joint.
        cells: (count, channels) cells of the stored place codes, see ``OwnCodes``.

    Args:
        settings: See ``PredictionSettings``.
        body: Joint limits and skin of the robot.
        learned: Moments to store.

    Raises:
        ValueError: If no joint moves, or a list of settings has not one entry a joint.
    """

    cells: Tensor

    def __init__(self, settings: PredictionSettings, body: Body, learned: Moments) -> None:
        super().__init__()
        self.settings = settings
        joints = learned.state.shape[1]
        span = torch.tensor(body.upper, dtype=torch.float64) - torch.tensor(
            body.lower, dtype=torch.float64
        )
        spread = learned.state.std(0, correction=0)
        self.moving = torch.nonzero(spread > _STILL * span).flatten()
        if not len(self.moving):
            raise ValueError("no joint moves in the episodes, so there is nothing to predict")
        self.emphasis = self._of_moving("emphasis", joints, 0.0)
        self.perplexity = self._of_moving("perplexity", joints, 1.0)
        self.shift = self._of_moving("shift", joints, 1.0)
        self.momentum = self._of_moving("momentum", joints, 0.0)
        learned = thin(learned, settings.capacity)
        self.place_code = self._place_code(body, learned)
        channels, bits = self.place_code.joints, self.place_code.bits
        self.own_codes = OwnCodes(self.place_code)
        self.embedding = TactileEmbedding(channels, settings.neurons, bits)
        felt = learned.touch.amax(0) > 0
        self.touch = settings.touch if bool(felt.any()) else 0.0
        each = bool(self.touch) and settings.patches == "each"
        self.patches = torch.nonzero(felt).flatten() if each else felt.new_zeros(0).long()
        self.turns = [
            _turn(self.place_code.code_dim, body.directions[patch])
            for patch in self.patches.tolist()
        ]
        self.segments = len(self.turns) or 1
        self.memory = HeteroAssociativeMemory(
            self.segments * self.place_code.code_dim,
            3 * len(self.moving),
            len(learned.state),
            storage="int8",
        )
        stored = []
        for rows in torch.arange(len(learned.state)).split(_BLOCK):
            part = learned.rows(rows)
            state, touch, levels = self.codes(part)
            values = [x[:, self.moving] for x in (part.target, part.recent, part.state)]
            self.memory.write(state, touch, torch.cat(values, dim=-1).float())
            stored.append(self.own_codes.cells(levels))
        self.register_buffer("cells", torch.cat(stored))

    def _of_moving(self, name: str, joints: int, default: float) -> Tensor:
        values = self.settings.per_joint(name, joints, default)
        return torch.tensor(values, dtype=torch.float32)[self.moving]

    def _place_code(self, body: Body, learned: Moments) -> PlaceCode:
        settings, moving = self.settings, self.moving
        position = learned.state[:, moving]
        if settings.limits == "body":
            lower = torch.tensor(body.lower, dtype=torch.float64)[moving]
            upper = torch.tensor(body.upper, dtype=torch.float64)[moving]
        else:
            middle, reach = position.mean(0), settings.reach * position.std(0, correction=0)
            lower, upper = middle - reach, middle + reach
        if settings.context > 0:
            speed = learned.recent[:, moving].square().mean(0).sqrt()
            reach = settings.reach / settings.context * speed
            reach = torch.where(reach > 0, reach, upper - lower)
            lower, upper = torch.cat([lower, -reach]), torch.cat([upper, reach])
        bits = settings.bits_for(len(lower))
        return PlaceCode(lower, upper, settings.neurons, bits, settings.width, settings.code)

    def codes(self, found: Moments) -> tuple[Tensor, Tensor, Tensor]:
        """Code joint states and touch.

        Args:
            found: K moments; targets are not looked at.

        Returns:
            State code s and tactile code o, both (K, segments · D), and the place neurons' levels
            (K, channels, neurons).
        """
        coder, settings = self.place_code, self.settings
        position = found.state[:, self.moving]
        if settings.context > 0:
            position = torch.cat([position, found.recent[:, self.moving]], dim=-1)
        levels = coder.levels(position)
        state = place_code(levels, coder.bits, coder.code, torch.float32)
        if not self.touch:
            touch = -torch.ones_like(state)  # F of ρ = 0
        elif self.turns:
            density = (self.touch * found.touch[:, self.patches]).float()
            segments = self.embedding(density, levels.unsqueeze(1)).unbind(1)
            pairs = zip(segments, self.turns, strict=True)
            touch = torch.cat([_rotate(code, turn) for code, turn in pairs], dim=-1)
        else:
            touch = self.embedding((self.touch * found.touch.mean(-1)).float(), levels)
        return state.repeat(1, self.segments), touch, levels.unflatten(-1, (coder.joints, -1))

    @torch.no_grad()
    def forward(self, found: Moments) -> Tensor:
        """Predicted displacement to the successor, (K, joints); targets are not looked at."""
        parts = []
        for rows in torch.arange(len(found.state)).split(_BLOCK):
            part = found.rows(rows)
            matches = self.match(part)
            weights = self.weights(matches, self.emphasis, self.perplexity)
            recalled = self.decide(part, matches, weights)
            whole = torch.zeros_like(part.state)
            whole[:, self.moving] = recalled.predict(self.shift, self.momentum)
            parts.append(whole)
        return torch.cat(parts)

    def match(self, found: Moments) -> Matches:
        """The best matches of some moments."""
        state, touch, levels = self.codes(found)
        scores = int8_scores(self.memory, self.memory.associate(state, touch))
        best, rows = scores.topk(min(self.settings.shortlist, scores.shape[1]))
        return Matches(rows, best.float(), self._own(levels, rows))

    def _own(self, levels: Tensor, rows: Tensor) -> Tensor:
        """Inner products of the joints' own place codes."""
        count, here = len(self.moving), self.own_codes.cells(levels)
        own = torch.zeros(len(rows), count, rows.shape[1])
        for channel in range(self.place_code.joints):
            stored = self.cells[:, channel][rows]
            own[:, channel % count] += self.own_codes.products(here[:, channel, None], stored)
        return own

    def weights(self, matches: Matches, emphasis: Tensor, perplexity: Tensor) -> Tensor:
        """Recall weights (K, moving joints, shortlist) for settings of each moving joint."""
        scores = matches.scores.unsqueeze(1) + emphasis.unsqueeze(-1) * matches.own
        if self.settings.beta is not None:
            return torch.softmax(self.settings.beta * scores, dim=-1)
        return anneal(scores, perplexity)

    def decide(self, found: Moments, matches: Matches, weights: Tensor) -> Recalled:
        """What the weights of ``weights`` recall for the moving joints."""
        values = self.memory.successors[matches.rows].unflatten(-1, (3, -1))
        means = torch.einsum("kjs,ksvj->vkj", weights, values).to(found.state.dtype)
        recent, state = found.recent[:, self.moving], found.state[:, self.moving]
        return Recalled(means[0], recent - means[1], state - means[2])


def _turn(dim: int, direction: list[float]) -> Tensor | None:
    """RoPE3D of a touch from a direction, (blocks, 3, 3); None where it turns nothing."""
    axis, angle = touch_rotation(torch.tensor(direction, dtype=torch.float32))
    return block_rotations(dim, axis, angle) if float(angle) else None


def _rotate(code: Tensor, turn: Tensor | None) -> Tensor:
    """Codes (K, D) rotated block by block and taken by sign."""
    if turn is None:
        return code
    blocks, tail = code[:, : 3 * len(turn)], code[:, 3 * len(turn) :]
    turned = torch.einsum("bij,kbj->kbi", turn, blocks.unflatten(-1, (-1, 3)))
    return binarise(torch.cat([turned.flatten(1), tail], dim=-1))


def int8_scores(memory: HeteroAssociativeMemory, query: Tensor) -> Tensor:
    """Inner products of bipolar queries (K, D) with all associations of an int8 memory, exact.

    Returns:
        (K, count), in a common unit.
    """
    stored = memory.associations[: int(memory.count)]
    if query.device.type == "cpu" and torch.backends.mkldnn.is_available():
        return torch._int_mm(query.to(torch.int8), stored.mT) // int(stored.abs().max())
    return query @ memory.stored().mT.to(query.dtype)
