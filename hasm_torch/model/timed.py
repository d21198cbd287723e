"""The memory of a robot that time moves on: what followed joint states like this one.

    q = s ⊗ F_1(κ ρ_1) ⊗ … ⊗ F_P(κ ρ_P),   w = softmax(β Mᵀ q)
    d_j = ⟨d_j x_jᵀ⟩ (⟨x_j x_jᵀ⟩ + λ I)⁻¹ x_j

s is the place code of the joints and of their displacements over some times back, F_p the touch
code of patch p in a fixed order of neurons of its own, and x_j = (1, position of joint j, its last
displacement, the trend t_j). It is the first-order read-out of ``readout`` with the covariates of
each joint: with β → 0 it becomes a linear law, with β → ∞ the best match.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.encoders.place_code import PlaceCode
from hasm_torch.encoders.touch import tactile_embedding
from hasm_torch.memory.layer import HeteroAssociativeMemory
from hasm_torch.memory.recall import pack
from hasm_torch.model.moments import Moments, Trend
from hasm_torch.model.settled import Settled

# Standard deviations to each side over which the neurons of a channel are spread: positions, and
# displacements, whose rare large values would else count like the nearest usual ones.
REACH, PAST_REACH = 3.0, 6.0
RIDGE = 0.01  # on covariates of unit variance
# Associations that take part. Against the softmax over all 29,000 of a recording this costs nothing
# (0.729 and 0.405 of standing still, 0.736 and 0.411 without it), and a read-out takes 0.1 ms.
SHORTLIST = 256
# A code of more entries than this is written with fewer bits: a recall scans all of them.
ENTRIES, BITS = 2048, (16, 8, 4, 2)
QUERIES_AT_ONCE, STORED_AT_ONCE = 128, 8192
FEW_QUERIES = 4
KEY_SEED = 0


class Matches(NamedTuple):
    """The associations that match best: (K, shortlist) their scores, −1 to 1, and rows."""

    scores: Tensor
    rows: Tensor


class Timed(nn.Module):
    """Recalls of a memory whose robot is moved on by time.

    Attributes:
        memory: Associations; a value is the displacement and the covariates of every joint.
        origins: (K, 3) int64: episode, frame and −1 (no patch) of each association.

    Args:
        config: Settings of the method.
        body: Joints and skin of the robot.
        settled: What was chosen; sizes the memory.
    """

    origins: Tensor
    lower: Tensor
    upper: Tensor
    middle: Tensor
    scale: Tensor

    def __init__(self, config: HASMConfig, body: Body, settled: Settled) -> None:
        super().__init__()
        self.config, self.settled = config, settled
        joints, coded = len(body.joints), len(settled.joints)
        channels = coded * (1 + len(settled.past))
        fitting = [b for b in BITS if channels * config.neurons * b <= ENTRIES]
        bits = min(config.bits, (fitting or BITS[-1:])[0])
        self.code_dim = channels * config.neurons * bits
        self._bits, self._patches = bits, len(body.patches) if body.channels else 0
        self.register_buffer("lower", torch.zeros(channels, dtype=torch.float64))
        self.register_buffer("upper", torch.ones(channels, dtype=torch.float64))
        generator = torch.Generator().manual_seed(KEY_SEED)
        self._orders = [
            torch.randperm(self.code_dim, generator=generator) for _ in range(self._patches)
        ]
        self.trend = Trend(joints * (1 + len(settled.past)) + self._patches, joints)
        self.register_buffer("middle", torch.zeros(joints, 3, dtype=torch.float64))
        self.register_buffer("scale", torch.ones(joints, 3, dtype=torch.float64))
        self.memory = HeteroAssociativeMemory(
            self.code_dim,
            joints * 4,
            max(settled.capacity, 1),
            beta=torch.tensor(settled.beta, dtype=torch.float64),
            storage=config.storage,
        )
        self.register_buffer("origins", torch.zeros(settled.capacity, 3, dtype=torch.int64))
        self._coder: list[PlaceCode] = []  # made of the ranges, so no part of a checkpoint
        self._stored: Tensor | None = None

    def store(self, found: Moments) -> None:
        """Learn moments: ranges, trend, associations."""
        self.trend = Trend.through(found)
        coded = self.settled.joints
        position = found.state[:, coded]
        reach = REACH * position.std(0, correction=0)
        lower, upper = [position.mean(0) - reach], [position.mean(0) + reach]
        for back in found.past[:, coded].unbind(-1):
            reach = (PAST_REACH * back.square().mean(0).sqrt()).clamp(min=1e-9)
            lower, upper = [*lower, -reach], [*upper, reach]
        self.lower.copy_(torch.cat(lower))
        self.upper.copy_(torch.cat(upper))
        raw = self._raw_covariates(found)
        self.middle.copy_(raw.mean(0))
        self.scale.copy_(raw.std(0, correction=0).clamp(min=1e-12))
        x = self._covariates(found)[..., 1:]
        codes = self.codes(found).float()
        values = torch.cat([found.target.unsqueeze(-1), x], dim=-1).flatten(1).float()
        self.memory.clear()
        self.memory.write(codes, torch.ones_like(codes), values)
        no_patch = torch.full_like(found.frame, -1)
        self.origins.copy_(torch.stack([found.episode, found.frame, no_patch], dim=1))
        self._stored = None

    def moment(self, history: np.ndarray, touch: np.ndarray) -> Moments:
        """The moment at the end of a history (T, J) under a touch (1, P)."""
        states = torch.from_numpy(history)
        now, last = states[-1:], len(states) - 1
        back = [now - states[max(last - n, 0)] for n in self.settled.past]
        nothing = torch.zeros(1, dtype=torch.int64)
        past = torch.stack(back, dim=-1)
        touched = torch.from_numpy(touch)
        return Moments(now, past, touched, torch.zeros_like(now), nothing, nothing)

    def codes(self, found: Moments) -> Tensor:
        """(K, D) int8 queries, or associations."""
        if not self._coder or not torch.equal(self._coder[0].lower, self.lower):
            neurons, width = self.config.neurons, self.config.width
            limits = self.lower, self.upper
            self._coder = [PlaceCode(*limits, neurons, self._bits, width, self.config.code)]
        coded = self.settled.joints
        channels = torch.cat([found.state[:, coded], *found.past[:, coded].unbind(-1)], dim=1)
        code = self._coder[0](channels).to(torch.int8)
        if self.settled.flip:
            for order, rho in zip(self._orders, found.touch.unbind(-1)):
                touch = tactile_embedding((self.settled.flip * rho).float(), order, 1)
                code = code * -touch.to(torch.int8)
        return code

    def _raw_covariates(self, found: Moments) -> Tensor:
        return torch.stack([found.state, found.past[..., 0], self.trend(found)], dim=-1)

    def _covariates(self, found: Moments) -> Tensor:
        """X of every joint, (K, J, 4)."""
        z = (self._raw_covariates(found) - self.middle) / self.scale
        return torch.cat([torch.ones_like(z[..., :1]), z], dim=-1)

    def match(self, found: Moments) -> Matches:
        """The best matches of some moments."""
        count = int(self.memory.count)
        best = []
        for query in self.codes(found).split(QUERIES_AT_ONCE):
            scores = self._scores(query, count) / self.code_dim
            best.append(scores.topk(min(SHORTLIST, count)))
        columns = [[part.values for part in best], [part.indices for part in best]]
        return Matches(*(torch.cat(column) for column in columns))

    def _scores(self, query: Tensor, count: int) -> Tensor:
        """Mᵀq of ±1 queries, (K, count)."""
        words = self.memory.associations
        if self.memory.storage == "bit" and len(query) < FEW_QUERIES and words.device.type == "cpu":
            # Of a few queries, bits are counted; many are a matrix product.
            rows = [pack(row[None].float())[0, :, :1].numpy() for row in query]
            # Of a negative number NumPy would count the bits of its absolute value.
            apart = [np.bitwise_count((words.numpy() ^ row).view(np.uint32)).sum(1) for row in rows]
            differing = torch.from_numpy(np.stack(apart).reshape(len(query), -1)[:, :count])
            return self.code_dim - 2.0 * differing.float()
        if self._stored is None:
            self._stored = self.memory.stored().sign().to(torch.int8)
        parts = self._stored.split(STORED_AT_ONCE)
        return torch.cat([query.float() @ part.float().mT for part in parts], dim=1)

    def read(self, found: Moments, matches: Matches, beta: float, trend: bool) -> Tensor:
        """(K, J) displacements that some matches mean at a β and with or without the trend."""
        count = 4 if trend else 3
        here = self._covariates(found)[..., :count].float()
        parts = []
        for rows in torch.arange(len(here)).split(QUERIES_AT_ONCE):
            weights = torch.softmax(beta * self.code_dim * matches.scores[rows], dim=-1)
            values = self.memory.successors[matches.rows[rows]].unflatten(-1, (-1, 4)).mT
            d, x = values[..., 0, :], values[..., 1:count, :]  # (k, shortlist, ·, J)
            x = torch.cat([torch.ones_like(x[..., :1, :]), x], dim=-2)
            weighted = weights[:, :, None, None] * x
            squares = torch.einsum("ksaj,ksbj->kjab", weighted, x) + RIDGE * torch.eye(count)
            products = torch.einsum("ksaj,ksj->kja", weighted, d)
            law = torch.linalg.solve(squares, products)
            parts.append((law * here[rows]).sum(-1))
        return torch.cat(parts).double()

    def forward(self, found: Moments) -> Tensor:
        """(K, J) displacements to the frame ``horizon`` later; targets are not looked at."""
        beta = float(self.memory.beta)
        return self.read(found, self.match(found), beta, self.settled.trend)

    def sureness(self, found: Moments) -> tuple[float, float]:
        """Agreement of the best match with a moment, 0 to 1, and its lead over the second."""
        best = self.match(found).scores[0]
        lead = float(best[0] - best[1]) if len(best) > 1 else float("inf")
        return min(max(float(best[0]), 0.0), 1.0), lead

    def confidence(self, found: Moments) -> float:
        """Agreement of the best match with a moment, 0 to 1."""
        return self.sureness(found)[0]

    def known(self, found: Moments) -> bool:
        """Whether the coded joints of a moment are where the neurons are spread."""
        coded = self.settled.joints
        position = found.state[0, coded]
        lower, upper = self.lower[: len(coded)], self.upper[: len(coded)]
        return bool(((position >= lower) & (position <= upper)).all())

    def weights(self, found: Moments) -> np.ndarray:
        """(count,) recall weight of every association for one moment."""
        matches = self.match(found)
        soft = torch.softmax(float(self.memory.beta) * self.code_dim * matches.scores[0], dim=-1)
        weights = torch.zeros(len(self.origins)).scatter(0, matches.rows[0], soft)
        return weights.double().numpy()
