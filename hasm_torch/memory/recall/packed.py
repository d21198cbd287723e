"""Recall over a memory of ±1 codes, one bit an entry.

Layout: a block holds 64 associations; ``words[block, w, row]`` is word w (32 entries, the first in
the lowest bit) of association 64·block + row. Rows of a block lie side by side, so that one
instruction compares the same word of many associations. Entries past the code and rows past the
memory are zero.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from hasm_torch import kernels
from hasm_torch.kernels.aside import Aside
from hasm_torch.memory.recall.dense import (
    Recall,
    Stored,
    check_shapes,
    full_precision,
    summarise,
    weigh,
)

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


def recall_packed(query: Tensor, memory: Stored) -> Tensor:
    """Recalls what followed the associations most like the query, from a packed memory.

        d = S₋₁ softmax(β Mᵀ q),   mᵀq = dim - 2·popcount(m xor q)

    No association is approximated: scores are exact integers, and what is left out weighs less than
    2⁻⁴⁰ of the whole, for every β. The query is binarised by sign, so no gradient reaches it;
    gradients reach β and the successors.

    Args:
        query: q, (*batch, ..., dim), finite; the sign counts.
        memory: What is recalled from, with associations as ``pack`` gives them and
            rows <= 64 * blocks.

    Returns:
        Decision d, (*batch, ..., values); NaN where no row takes part.

    Raises:
        ValueError: If the shapes do not fit one another, or β is not a number.
    """
    memory = _checked(query, memory)
    if not _straight(query, memory):
        return _recall(query, memory)[0]
    decision = torch.empty(*query.shape[:-1], memory.successors.shape[-1])
    _scan(query, memory, decision=decision)
    return decision


def inspect_packed(query: Tensor, memory: Stored) -> Recall:
    """Recalls like ``recall_packed`` and tells the best match, its margin and the entropy."""
    memory = _checked(query, memory)
    recall = _scan_all if _straight(query, memory) else _recall
    decision, match, certainty = recall(query, memory)
    return Recall(decision, match, *certainty.unbind(0))


@full_precision
def weights_packed(query: Tensor, memory: Stored) -> Tensor:
    """The weight of every row, (*batch, ..., rows); arguments as in ``recall_packed``."""
    memory = _checked(query, memory)
    if not _straight(query, memory):
        return weigh(_scores(query, memory), memory)
    weights = torch.zeros(*query.shape[:-1], memory.successors.shape[-2])
    _scan(query, memory, weights=weights)
    return weights


def _checked(query: Tensor, memory: Stored) -> Stored:
    """The memory with β and the rows held as tensors, if it fits the query."""
    *_, blocks, width, _ = memory.associations.shape
    check_shapes(query, memory, memory.associations.shape[:-3], blocks * ROWS)
    if width != -(-query.shape[-1] // WORD):
        raise ValueError(
            f"expected a query of {WORD * width - WORD + 1} to {WORD * width} entries for "
            f"{width} words a code, got {query.shape[-1]}"
        )
    if not isinstance(memory.beta, Tensor):
        if math.isnan(memory.beta):
            raise ValueError("expected beta to be a number, got NaN")
        exact = torch.float64 if query.is_cpu else torch.float32
        memory = memory._replace(beta=torch.tensor(memory.beta, dtype=exact, device=query.device))
    if memory.held is None:
        rows = torch.tensor(memory.successors.shape[-2], device=query.device)
        memory = memory._replace(held=rows)
    return memory


def _compiled(memory: Stored) -> bool:
    """Whether the compiled scan serves: it has no gradients, and float32 alone."""
    successors, beta = memory.successors, memory.beta
    learning = successors.requires_grad or (isinstance(beta, Tensor) and beta.requires_grad)
    if learning and torch.is_grad_enabled():
        return False
    if successors.dtype != torch.float32:
        return False
    return torch.compiler.is_compiling() or kernels.enabled()  # compiled, the operator asks


def _straight(query: Tensor, memory: Stored) -> bool:
    """Whether it is called without the dispatcher, which takes as long as the scan of one query."""
    if not query.is_cpu or torch.compiler.is_compiling() or not _compiled(memory):
        return False
    return _compiled_scan.ready()


def _recall(query: Tensor, memory: Stored) -> tuple[Tensor, Tensor, Tensor]:
    """Decision, match, and score, margin and entropy stacked."""
    if not (torch.compiler.is_compiling() and _compiled(memory)):
        return _by_torch(query, memory)  # the operator would do the same
    *arguments, interaction, top_k = memory
    found: tuple[Tensor, Tensor, Tensor] = torch.ops.hasm_torch.packed_recall(
        query.detach(), *arguments, str(interaction), top_k
    )
    return found


@full_precision
def _by_torch(query: Tensor, memory: Stored) -> tuple[Tensor, Tensor, Tensor]:
    """``_recall`` in torch operations: any device, and gradients for β and the successors."""
    recall = summarise(_scores(query, memory), query, memory)
    return recall.decision, recall.match, torch.stack(recall[2:])


def _scores(query: Tensor, memory: Stored) -> Tensor:
    """Mᵀq of the signs, (*batch, ..., rows), in the successors' dtype or float32."""
    words, rows, dim = memory.associations, memory.successors.shape[-2], query.shape[-1]
    signs = _pack_codes(query).reshape(*words.shape[:-3], -1, words.shape[-2])
    distances = (_distances_gpu() if words.is_cuda else _distances)(signs, words)
    scores = (dim - 2 * distances)[..., :rows].reshape(*query.shape[:-1], rows)
    return scores.to(torch.promote_types(memory.successors.dtype, torch.float32))


def _distances(signs: Tensor, words: Tensor) -> Tensor:
    """Hamming distances of packed queries (*batch, queries, width), (*batch, queries, rows)."""
    stored = words.transpose(-3, -2).flatten(-2)
    distances = torch.zeros(
        *signs.shape[:-1], stored.shape[-1], dtype=torch.int32, device=words.device
    )
    for word in range(words.shape[-2]):
        differing = signs[..., :, word].unsqueeze(-1) ^ stored[..., word, :].unsqueeze(-2)
        distances += _count_ones(differing)
    return distances


def _pack_codes(codes: Tensor) -> Tensor:
    """Codes (..., dim) as words (..., words) int32."""
    words = -(-codes.shape[-1] // WORD)
    signs = (codes >= 0).to(torch.int32)
    bits = torch.nn.functional.pad(signs, (0, words * WORD - codes.shape[-1]))
    shifts = torch.arange(WORD, dtype=torch.int32, device=codes.device)
    return (bits.unflatten(-1, (words, WORD)) << shifts).sum(-1, dtype=torch.int32)


def _count_ones(bits: Tensor) -> Tensor:
    """Number of ones in every int32, by adding neighbours: pairs, nibbles, bytes."""
    bits = bits - ((bits >> 1) & 0x55555555)
    bits = (bits & 0x33333333) + ((bits >> 2) & 0x33333333)
    bits = (bits + (bits >> 4)) & 0x0F0F0F0F
    return (bits * 0x01010101) >> 24


@functools.cache
def _distances_gpu() -> Callable[[Tensor, Tensor], Tensor]:
    try:
        from hasm_torch.memory.recall.packed_gpu import distances_gpu
    except ImportError:  # no Triton on this platform
        return _distances
    return distances_gpu


def _load_scan() -> Callable[..., None]:
    """The compiled scan, compiled by running it once."""
    from hasm_torch.memory.recall.packed_cpu import scan_cpu

    words, held = torch.zeros(1, 1, ROWS, dtype=torch.int32), torch.ones((), dtype=torch.int64)
    query, successors, decision = torch.zeros(3, 1).split(1)
    memory = query[0], words, successors, held, None
    scan_cpu(*memory, beta=1.0, interaction="softmax", top_k=None, decision=decision[0])
    return scan_cpu


_compiled_scan = Aside(_load_scan)


def warm_up() -> None:
    """Wait until the packed recall on the CPU is compiled, which takes seconds once a machine.

    Until then a recall runs as torch operations and agrees with the compiled one to within
    rounding.
    """
    if kernels.enabled():
        _compiled_scan.get()


def _scan(query: Tensor, memory: Stored, **wanted: Any) -> None:
    """Runs the scan on the CPU for the results wanted; see ``scan_cpu``."""
    words, successors, beta, held, mask, interaction, top_k = memory
    value = float(beta)
    if math.isnan(value):
        raise ValueError("expected beta to be a number, got NaN")
    if query.dtype != torch.float32:
        query = torch.where(query >= 0, 1.0, -1.0)
    if held is not None and held.ndim != words.ndim - 3:
        held = held.expand(words.shape[:-3])
    tensors = [t if t is None else t.contiguous() for t in (query, words, successors, held, mask)]
    _compiled_scan.get()(*tensors, value, interaction, top_k, **wanted)


def _recall_cpu(query: Tensor, memory: Stored) -> tuple[Tensor, Tensor, Tensor]:
    """``_recall`` in a compiled or exported program, which waits for the scan."""
    return (_scan_all if kernels.enabled() else _by_torch)(query, memory)


def _scan_all(query: Tensor, memory: Stored) -> tuple[Tensor, Tensor, Tensor]:
    """``_recall`` by the scan on the CPU."""
    decision, match, certainty = _room(query, memory)
    _scan(query, memory, decision=decision, match=match, certainty=certainty)
    return decision, match, certainty


def _room(query: Tensor, memory: Stored) -> tuple[Tensor, Tensor, Tensor]:
    """Empty tensors like those that ``_recall`` returns."""
    leading, values = query.shape[:-1], memory.successors
    match = torch.empty(leading, dtype=torch.int64, device=query.device)
    return values.new_empty(*leading, values.shape[-1]), match, values.new_empty(3, *leading)


def _operator(recall: Callable[[Tensor, Stored], tuple[Tensor, Tensor, Tensor]]) -> Any:
    """A form of ``_recall`` as an operator that ``torch.compile`` and ``torch.export`` keep whole.

    An operator is told the interaction as a string.
    """

    def run(query: Tensor, *memory: Any) -> tuple[Tensor, Tensor, Tensor]:
        told = Stored(*memory)
        name = str(told.interaction)
        return recall(query, told._replace(interaction=int(name)) if name.isdecimal() else told)

    return run


_library = torch.library.Library("hasm_torch", "FRAGMENT")
_library.define(
    "packed_recall(Tensor query, Tensor words, Tensor successors, Tensor beta, Tensor held, "
    "Tensor? mask, str interaction, int? top_k) "
    "-> (Tensor decision, Tensor match, Tensor certainty)",
    tags=(torch.Tag.pt2_compliant_tag,),
)
_library.impl("packed_recall", _operator(_recall_cpu), "CPU")
_library.impl("packed_recall", _operator(_by_torch), "CompositeExplicitAutograd")
torch.library.register_fake("hasm_torch::packed_recall", _operator(_room), lib=_library)
