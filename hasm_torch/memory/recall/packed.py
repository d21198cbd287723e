"""Softmax recall over a memory of ±1 codes, one bit an entry.

Layout: a block holds 64 associations; ``words[block, w, row]`` is word w (32 entries, the first in
the lowest bit) of association 64·block + row. Rows of a block lie side by side, so that one
instruction compares the same word of many associations. Entries past the code and rows past the
memory are zero.
"""

import math

import torch
from torch import Tensor

from hasm_torch.memory.recall.dense import Recall, check_shapes, exclude, summarise

ROWS = 64  # associations in a block
WORD = 32  # entries in a word
_PACKED_AT_ONCE = 1 << 24  # entries


def pack(codes: Tensor) -> Tensor:
    """Packs codes by sign, one bit an entry (x >= 0 becomes 1).

    Args:
        codes: (..., rows, dim).

    Returns:
        (..., blocks, words, 64) int32 with blocks = ⌈rows / 64⌉ and words = ⌈dim / 32⌉.
    """
    rows = codes.shape[-2]
    blocks = -(-rows // ROWS)
    step = max(1, _PACKED_AT_ONCE // max(1, codes[..., :1, :].numel()))
    words = torch.cat([_pack_codes(part) for part in codes.split(step, dim=-2)], dim=-2)
    words = torch.nn.functional.pad(words, (0, 0, 0, blocks * ROWS - rows))
    return words.unflatten(-2, (blocks, ROWS)).mT.contiguous()


def unpack(words: Tensor, dim: int) -> Tensor:
    """The codes of a packed memory.

    Args:
        words: (..., blocks, words, 64) int32.
        dim: Entries of a code.

    Returns:
        (..., 64 * blocks, dim) in {-1, +1}, float32; rows never stored are -1.
    """
    shifts = torch.arange(WORD, dtype=torch.int32, device=words.device)
    bits = (words.mT.unsqueeze(-1) >> shifts) & 1
    return bits.flatten(-2)[..., :dim].flatten(-3, -2) * 2.0 - 1.0


def store(words: Tensor, rows: Tensor, codes: Tensor) -> None:
    """Writes codes into rows of a packed memory, in place.

    Args:
        words: (blocks, words, 64) int32.
        rows: (n,) int64.
        codes: (n, dim); the sign counts.
    """
    words[rows // ROWS, :, rows % ROWS] = _pack_codes(codes)


def recall_packed(
    query: Tensor,
    words: Tensor,
    successors: Tensor,
    beta: float | Tensor,
    count: Tensor | None = None,
    mask: Tensor | None = None,
) -> Tensor:
    """Recalls what followed the associations most like the query, from a packed memory.

        d = S₋₁ softmax(β Mᵀ q),   mᵀq = dim - 2·popcount(m xor q)

    No association is approximated: scores are exact integers, weights are float32 and what is left
    out weighs less than 2⁻⁴⁰ of the whole, for every β. The query is binarised by sign, so no
    gradient reaches it; gradients reach β and the successors.

    Args:
        query: q, (*batch, ..., dim), finite; the sign counts.
        words: M as ``pack`` gives it, (*batch, blocks, words, 64) int32: one memory for all queries
            without ``batch``, else a memory for each of its entries.
        successors: S₋₁, (*batch, rows, values) with rows <= 64 * blocks, float32.
        beta: β, a number or a () tensor.
        count: Number of rows filled, () or (*batch,) int64; without it all rows.
        mask: Rows each query may recall, (*batch, ..., rows) bool.

    Returns:
        Decision d, (*batch, ..., values); NaN where no row takes part.

    Raises:
        ValueError: If the shapes do not fit one another, or β is not a number.
    """
    return _recall(query, words, successors, beta, count, mask)[0]


def inspect_packed(
    query: Tensor,
    words: Tensor,
    successors: Tensor,
    beta: float | Tensor,
    count: Tensor | None = None,
    mask: Tensor | None = None,
) -> Recall:
    """Recalls like ``recall_packed`` and tells the best match, its margin and the entropy."""
    decision, match, certainty = _recall(query, words, successors, beta, count, mask)
    return Recall(decision, match, *certainty.unbind(0))


def _recall(
    query: Tensor,
    words: Tensor,
    successors: Tensor,
    beta: float | Tensor,
    count: Tensor | None,
    mask: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Decision, match, and score, margin and entropy stacked."""
    batch, (blocks, width) = words.shape[:-3], words.shape[-3:-1]
    rows = successors.shape[-2]
    check_shapes(query, batch, blocks * ROWS, successors, mask)
    if width != -(-query.shape[-1] // WORD):
        raise ValueError(
            f"expected a query of {WORD * width - WORD + 1} to {WORD * width} entries for "
            f"{width} words a code, got {query.shape[-1]}"
        )
    if not isinstance(beta, Tensor):
        exact = torch.float64 if query.device.type == "cpu" else torch.float32
        beta = torch.full((), beta, dtype=exact, device=query.device)
    if count is None:
        count = torch.full((), rows, dtype=torch.int64, device=query.device)
    learning = torch.is_grad_enabled() and (beta.requires_grad or successors.requires_grad)
    if learning or successors.dtype != torch.float32:
        return _recall_by_torch(query, words, successors, beta, count, mask)
    return _packed_recall(query.detach(), words, successors, beta, count, mask)


def _recall_by_torch(
    query: Tensor,
    words: Tensor,
    successors: Tensor,
    beta: Tensor,
    count: Tensor,
    mask: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """The same recall in torch operations: any device, and gradients for β and the successors."""
    batch, dim, rows = words.shape[:-3], query.shape[-1], successors.shape[-2]
    signs = _pack_codes(query).reshape(*batch, -1, words.shape[-2])
    stored = words.transpose(-3, -2).flatten(-2)
    distances = torch.zeros(
        *signs.shape[:-1], stored.shape[-1], dtype=torch.int32, device=query.device
    )
    for word in range(words.shape[-2]):
        differing = signs[..., :, word].unsqueeze(-1) ^ stored[..., word, :].unsqueeze(-2)
        distances += _count_ones(differing)
    scores = (dim - 2 * distances)[..., :rows].reshape(*query.shape[:-1], rows)
    scores = scores.to(torch.promote_types(successors.dtype, torch.float32))
    logits = (beta * scores).masked_fill(exclude(scores, len(batch), count, mask), -torch.inf)
    recall = summarise(scores, logits, beta, query, successors)
    return recall.decision, recall.match, torch.stack(recall[2:])


def _pack_codes(codes: Tensor) -> Tensor:
    """Codes (..., dim) as words (..., words) int32."""
    words = -(-codes.shape[-1] // WORD)
    bits = torch.nn.functional.pad(codes >= 0, (0, words * WORD - codes.shape[-1]))
    shifts = torch.arange(WORD, dtype=torch.int32, device=codes.device)
    return (bits.unflatten(-1, (words, WORD)) << shifts).sum(-1, dtype=torch.int32)


def _count_ones(bits: Tensor) -> Tensor:
    """Number of ones in every int32, by adding neighbours: pairs, nibbles, bytes."""
    bits = bits - ((bits >> 1) & 0x55555555)
    bits = (bits & 0x33333333) + ((bits >> 2) & 0x33333333)
    bits = (bits + (bits >> 4)) & 0x0F0F0F0F
    return (bits * 0x01010101) >> 24


_library = torch.library.Library("hasm_torch", "FRAGMENT")
_library.define(
    "packed_recall(Tensor query, Tensor words, Tensor successors, Tensor beta, Tensor count, "
    "Tensor? mask) -> (Tensor decision, Tensor match, Tensor certainty)",
    tags=(torch.Tag.pt2_compliant_tag,),
)
_packed_recall = torch.ops.hasm_torch.packed_recall.default


def _on_cpu(
    query: Tensor,
    words: Tensor,
    successors: Tensor,
    beta: Tensor,
    count: Tensor,
    mask: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    from hasm_torch.memory.recall.packed_cpu import scan_cpu

    value = beta.item()
    if math.isnan(value):
        raise ValueError("expected beta to be a number, got NaN")
    if query.dtype != torch.float32:
        query = torch.where(query >= 0, 1.0, -1.0)
    if count.shape != words.shape[:-3]:
        count = count.expand(words.shape[:-3])
    return scan_cpu(
        query.contiguous(),
        words.contiguous(),
        successors.contiguous(),
        value,
        count.contiguous(),
        None if mask is None else mask.contiguous(),
    )


def _on_gpu(
    query: Tensor,
    words: Tensor,
    successors: Tensor,
    beta: Tensor,
    count: Tensor,
    mask: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    try:
        from hasm_torch.memory.recall.packed_gpu import scan_gpu
    except ImportError:  # no Triton on this platform
        return _recall_by_torch(query, words, successors, beta, count, mask)

    batch, leading = words.shape[:-3], query.shape[:-1]
    beta = beta.to(query.device)
    # With a negative beta the farthest row counts; the complement makes it the nearest.
    signs = _pack_codes(torch.where((query >= 0) == (beta >= 0), 1, -1))
    with torch.cuda.device(query.device):
        decision, match, certainty = scan_gpu(
            signs.reshape(*batch, -1, signs.shape[-1]),
            words.contiguous(),
            successors.contiguous(),
            beta,
            count.expand(batch).contiguous(),
            None if mask is None else mask.reshape(*batch, -1, mask.shape[-1]).contiguous(),
            query.shape[-1],
        )
    return (
        decision.reshape(*leading, -1),
        match.reshape(leading),
        certainty.reshape(3, *leading),
    )


def _shapes_only(
    query: Tensor,
    words: Tensor,
    successors: Tensor,
    beta: Tensor,
    count: Tensor,
    mask: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    leading, values = query.shape[:-1], successors.shape[-1]
    return (
        successors.new_empty(*leading, values),
        count.new_empty(leading),
        successors.new_empty(3, *leading),
    )


_library.impl("packed_recall", _on_cpu, "CPU")
_library.impl("packed_recall", _on_gpu, "CUDA")
_library.impl("packed_recall", _recall_by_torch, "CompositeExplicitAutograd")
torch.library.register_fake("hasm_torch::packed_recall", _shapes_only, lib=_library)
