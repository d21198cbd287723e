"""Hamming distances of a packed memory on a GPU, as a Triton kernel."""

import torch
import triton
import triton.language as tl
from torch import Tensor

_TILE = 256  # rows a program looks at together, a multiple of 64


def distances_gpu(signs: Tensor, words: Tensor) -> Tensor:
    """Compares packed queries with every association.

    Args:
        signs: Packed queries, (*batch, queries, width) int32.
        words: (*batch, blocks, width, 64) int32, on the same GPU.

    Returns:
        (*batch, queries, 64 * blocks) int32.
    """
    *batch, queries, width = signs.shape
    rows = words.shape[-3] * words.shape[-1]
    distances = torch.empty(*batch, queries, rows, dtype=torch.int32, device=words.device)
    if distances.numel() > 0:
        programs = signs.shape[:-1].numel() * triton.cdiv(rows, _TILE)
        arguments = signs.contiguous(), words.contiguous(), distances, queries, rows
        with torch.cuda.device_of(words):
            _compare[(programs,)](*arguments, WIDTH=width, TILE=_TILE)
    return distances


@triton.jit
def _compare(signs, words, distances, queries, rows, WIDTH: tl.constexpr, TILE: tl.constexpr):
    program, tiles = tl.program_id(0).to(tl.int64), tl.cdiv(rows, TILE)
    number, row = program // tiles, program % tiles * TILE + tl.arange(0, TILE)
    place = (number // queries * (rows // 64) + row // 64) * (WIDTH * 64) + row % 64
    distance = tl.zeros((TILE,), tl.int32)
    for word in range(WIDTH):
        stored = tl.load(words + place + word * 64, mask=row < rows, other=0)
        query = tl.load(signs + number * WIDTH + word)
        bits = (stored ^ query).to(tl.uint32, bitcast=True)
        # The compiler knows this sum of neighbours for the population count instruction.
        bits = bits - ((bits >> 1) & 0x55555555)
        bits = (bits & 0x33333333) + ((bits >> 2) & 0x33333333)
        bits = (bits + (bits >> 4)) & 0x0F0F0F0F
        distance += ((bits * 0x01010101) >> 24).to(tl.int32)
    tl.store(distances + number * rows + row, distance, mask=row < rows)
