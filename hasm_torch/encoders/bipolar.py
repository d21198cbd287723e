"""Bipolar codes: vectors of -1 and +1, and how two of them are bound.

Zeros in a binary code would erase what they multiply, so they are written as -1 (paper, section
"Neuromorphic Encoding"). Two codes are bound by the elementwise product, m = s (x) o (paper,
section "Association Creation").
"""

from typing import Any

import torch
from torch import Tensor


def to_bipolar(bits: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """Write bits as signs: 0 -> -1, 1 -> +1.

    Args:
        bits: (...), zeros and ones of any dtype, bool included.
        dtype: of the result; the dtype of `bits` where that is real, else torch's default dtype.

    Returns:
        (...) in {-1, +1}.
    """
    if dtype is None:
        dtype = bits.dtype if bits.is_floating_point() else torch.get_default_dtype()
    return bits.to(dtype) * 2 - 1


def binarise(x: Tensor) -> Tensor:
    """Sign of each entry, 0 counting as positive, with a straight-through gradient.

    Args:
        x: (...), real.

    Returns:
        (...) in {-1, +1}, in the dtype of `x`. Its gradient reaches `x` unchanged.
    """
    return _StraightThroughSign.apply(x)


def bind(a: Tensor, b: Tensor) -> Tensor:
    """Bind two codes, m = a (x) b, the elementwise product.

    A bipolar code is its own inverse: bind(bind(a, b), b) = a.

    Args:
        a: (..., D).
        b: (..., D), broadcast against `a`.

    Returns:
        (..., D).
    """
    return a * b


class _StraightThroughSign(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        one = torch.ones_like(x)
        return torch.where(x < 0, -one, one)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Tensor:
        return grads[0]
