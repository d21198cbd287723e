"""Rotary embedding in three dimensions: where a touch comes from, written into its code.

A code of d entries is cut into d/3 blocks of three, and block i is turned about the axis n by the
angle w_i theta (paper, eq. rope3d1 and rope3d2):

    R(n, w_i theta) = I + sin(w_i theta) [n]x + (1 - cos(w_i theta)) [n]x^2,
    w_i = 10^(-i/d),  i = 1 .. floor(d/3).

(n, theta) is the rotation of the touch: one axis and one angle an observation, the same axis in
every block. Were each block turned about itself, as one sentence of the paper can be read, nothing
would move, since n x n = 0. Where d is no multiple of 3 the last one or two entries stay as they
are, so norms are kept exactly.

It is smooth in x and in the angle, and in the axis away from zero; a zero axis means no rotation,
whatever the angle, and is a jump where the angle is not zero.
"""

import torch
from torch import Tensor, nn


def rope3d(x: Tensor, axis: Tensor, angle: Tensor) -> Tensor:
    """Turn each block of three entries of `x` about `axis` by w_i times `angle`.

    Args:
        x: (..., d), codes.
        axis: (..., 3), of any length; broadcast against the leading dimensions of `x`. A zero
            axis turns nothing.
        angle: (...), rad, broadcast likewise.

    Returns:
        (..., d) over the broadcast leading dimensions, in the dtype of `x` (integers: in the dtype
        of the angle), computed in float32 or better.

    Raises:
        ValueError: if the axis has no three components.
    """
    if axis.ndim == 0 or axis.shape[-1] != 3:
        raise ValueError(f"expected an axis of shape (..., 3), got {tuple(axis.shape)}")
    dim = x.shape[-1]
    blocks = dim // 3
    dtype = torch.promote_types(torch.promote_types(axis.dtype, angle.dtype), torch.float32)
    if x.is_floating_point():
        dtype = torch.promote_types(dtype, x.dtype)
    index = torch.arange(1, blocks + 1, device=x.device, dtype=dtype)
    phase = angle.to(dtype).unsqueeze(-1) * 10.0 ** (-index / dim)  # w_i theta: (..., blocks)
    axes = _unit(axis.to(dtype)).unsqueeze(-2)  # (..., 1, 3)
    code = x.to(dtype)
    vectors = code[..., : 3 * blocks].unflatten(-1, (blocks, 3))

    # v + sin(p) n x v + (1 - cos(p)) n x (n x v); 1 - cos(p) = 2 sin(p/2)^2 keeps small angles
    shape = torch.broadcast_shapes(vectors.shape[:-2], axes.shape[:-2], phase.shape[:-1])
    vectors = vectors.expand(*shape, blocks, 3)
    first = torch.linalg.cross(axes.expand_as(vectors), vectors)
    second = torch.linalg.cross(axes.expand_as(vectors), first)
    sine = torch.sin(phase).unsqueeze(-1)
    versine = 2.0 * torch.sin(0.5 * phase).square().unsqueeze(-1)
    turned = (vectors + sine * first + versine * second).flatten(-2)
    tail = code[..., 3 * blocks :].expand(*shape, dim - 3 * blocks)
    return torch.cat((turned, tail), -1).to(x.dtype if x.is_floating_point() else dtype)


class RoPE3D(nn.Module):
    """Rotary embedding of codes with `dim` entries; it holds no parameters and no buffers.

    Args:
        dim: d, the number of entries of a code; with fewer than 3 there is nothing to turn.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        if dim < 1:
            raise ValueError(f"expected dim >= 1, got {dim}")
        self.dim = dim

    def forward(self, x: Tensor, axis: Tensor, angle: Tensor) -> Tensor:
        """rope3d(x, axis, angle): (..., dim), (..., 3), (...) -> (..., dim)."""
        if x.shape[-1] != self.dim:
            raise ValueError(f"expected codes of shape (..., {self.dim}), got {tuple(x.shape)}")
        return rope3d(x, axis, angle)

    def extra_repr(self) -> str:
        """Options shown by print."""
        return f"dim={self.dim}"


def _unit(vector: Tensor) -> Tensor:
    """Vectors (..., 3) of length 1; zero stays zero, with a finite gradient."""
    # scaled by the largest entry first, so that squares neither underflow nor overflow
    largest = vector.detach().abs().amax(-1, keepdim=True)
    zero = largest == 0
    scaled = vector / torch.where(zero, 1.0, largest)
    return scaled / torch.where(zero, 1.0, scaled).norm(dim=-1, keepdim=True)
