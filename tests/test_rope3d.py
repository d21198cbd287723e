import copy
import math

import numpy as np
import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch.encoders.bipolar import to_bipolar
from hasm_torch.encoders.rope3d import RoPE3D, rope3d

DEVICES = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])
DIMS = (3, 4, 5, 24, 200)


def sample(dim, seed, batch=5, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    x, axis = (torch.randn(batch, n, generator=generator, dtype=dtype) for n in (dim, 3))
    angle = 4 * torch.randn(batch, generator=generator, dtype=dtype)
    return x, axis, angle


def rotation(axis, angle):
    """R(axis, angle) of a single vector in space, without the frequencies."""
    return torch.from_numpy(reference.rodrigues(axis.numpy(), angle.item()))


@pytest.mark.parametrize("device", DEVICES)
@given(dim=st.sampled_from(DIMS), seed=st.integers(0, 999))
@settings(max_examples=15, deadline=None)
def test_matches_the_papers_matrix(device, dim, seed):
    x, axis, angle = sample(dim, seed)
    result = rope3d(x.to(device), axis.to(device), angle.to(device)).cpu()
    for row in range(len(x)):
        matrix = reference.rope3d_matrix(dim, axis[row], angle[row].item())
        np.testing.assert_allclose(result[row], matrix @ x[row].numpy(), rtol=1e-12, atol=1e-12)


@given(dim=st.sampled_from(DIMS), seed=st.integers(0, 999))
@settings(max_examples=15, deadline=None)
def test_keeps_norms_and_composes_about_one_axis(dim, seed):
    x, axis, angle = sample(dim, seed)
    turned = rope3d(x, axis, angle)
    torch.testing.assert_close(turned.norm(dim=-1), x.norm(dim=-1))
    again = rope3d(turned, axis, 0.5 - angle)
    torch.testing.assert_close(again, rope3d(x, axis, torch.tensor(0.5)))
    torch.testing.assert_close(rope3d(turned, -axis, angle), x)


def test_the_same_rotation_keeps_inner_products():
    x, axis, angle = sample(24, 0)
    y = x.flip(0)
    products = (rope3d(x, axis, angle) * rope3d(y, axis, angle)).sum(-1)
    torch.testing.assert_close(products, (x * y).sum(-1))


@given(dim=st.sampled_from(DIMS), seed=st.integers(0, 999), angle=st.floats(-10, 10))
@settings(max_examples=15, deadline=None)
def test_turning_each_block_about_itself_would_do_nothing(dim, seed, angle):
    """Why the axis is the touch's: read literally, the paper's rotation is the identity."""
    x, axis, _ = sample(dim, seed)
    bipolar = to_bipolar(x > 0, torch.float64)
    for code in (x, bipolar):
        literal = reference.rope3d_literal(code[0], angle)
        np.testing.assert_allclose(literal, code[0].numpy(), rtol=0, atol=1e-12)
    if dim > 3 and abs(math.sin(0.4 * angle)) > 0.1:
        assert (rope3d(bipolar, axis, torch.tensor(angle)) - bipolar).abs().max() > 1e-3


@pytest.mark.parametrize("dim", [3, 4, 5, 200])
def test_entries_beyond_the_blocks_stay(dim):
    x, axis, angle = sample(dim, 1)
    rest = dim % 3
    turned = rope3d(x, axis, angle)
    assert torch.equal(turned[..., dim - rest :], x[..., dim - rest :])
    assert (turned[..., : dim - rest] != x[..., : dim - rest]).all()


def test_no_angle_or_no_axis_is_the_identity():
    x, axis, angle = sample(7, 2)
    zero = torch.zeros((), dtype=torch.float64)
    assert torch.equal(rope3d(x, axis, zero), x)
    assert torch.equal(rope3d(x, torch.zeros(3), zero), x)
    assert torch.equal(rope3d(x, torch.zeros_like(axis), angle), x)


@pytest.mark.parametrize("length", [1e-30, 1e-3, 1.0, 1e30])
def test_length_of_the_axis_does_not_matter(length):
    x, axis, angle = sample(9, 3, dtype=torch.float32)
    torch.testing.assert_close(rope3d(x, length * axis, angle), rope3d(x, axis, angle))


def test_broadcasts_leading_dimensions():
    x, axis, angle = sample(10, 4, batch=6)
    result = rope3d(x[:, None], axis[None, :4], angle[:3, None, None])
    assert result.shape == (3, 6, 4, 10)
    torch.testing.assert_close(result[2, 5, 3], rope3d(x[5], axis[3], angle[2]))


def test_gradients_of_every_argument():
    inputs = tuple(t.requires_grad_() for t in sample(8, 5, batch=2))
    assert torch.autograd.gradcheck(rope3d, inputs)


@pytest.mark.parametrize("angle", [0.0, 1.0])
@pytest.mark.parametrize("length", [0.0, 1e-40, 1e-20])
def test_gradients_stay_finite_without_a_rotation(angle, length):
    x = torch.ones(7, requires_grad=True)
    axis = torch.full((3,), length, requires_grad=True)
    theta = torch.tensor(angle, requires_grad=True)
    weight = torch.arange(7.0)
    (rope3d(x, axis, theta) @ weight).backward()
    assert torch.isfinite(x.grad).all()
    assert not axis.grad.isnan().any()
    assert torch.isfinite(theta.grad)


def test_half_precision_codes_keep_their_angles():
    x, axis, angle = sample(24, 6, dtype=torch.float32)
    bipolar = to_bipolar(x > 0)
    module = RoPE3D(24).to(torch.bfloat16)
    result = module(bipolar.bfloat16(), axis, 100 * angle)
    assert result.dtype == torch.bfloat16
    torch.testing.assert_close(result, rope3d(bipolar, axis, 100 * angle).bfloat16())
    assert rope3d(bipolar.to(torch.int8), axis, angle).dtype == torch.float32


def test_module_compiles_whole_and_copies():
    module = RoPE3D(10)
    x, axis, angle = sample(10, 7, dtype=torch.float32)
    compiled = torch.compile(module, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(x, axis, angle), module(x, axis, angle))
    copied = copy.deepcopy(module)
    copied.load_state_dict(module.state_dict())
    assert torch.equal(copied(x, axis, angle), module(x, axis, angle))


def test_errors_say_what_was_expected():
    with pytest.raises(ValueError, match=r"dim >= 1.*got 0"):
        RoPE3D(0)
    with pytest.raises(ValueError, match=r"\(\.\.\., 10\), got \(4, 9\)"):
        RoPE3D(10)(torch.zeros(4, 9), torch.zeros(3), torch.zeros(()))
    with pytest.raises(ValueError, match=r"axis of shape \(\.\.\., 3\), got \(2,\)"):
        rope3d(torch.zeros(9), torch.zeros(2), torch.zeros(()))
