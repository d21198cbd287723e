import pytest
import torch

from hasm_torch.encoders.bipolar import binarise, bind, to_bipolar


def test_to_bipolar_writes_zeros_as_minus_one():
    expected = torch.tensor([-1.0, 1.0, 1.0])
    for dtype in (torch.bool, torch.uint8, torch.int64, torch.float32):
        result = to_bipolar(torch.tensor([0, 1, 1]).to(dtype))
        assert result.dtype == torch.float32
        assert torch.equal(result, expected)
    assert to_bipolar(torch.zeros(2, dtype=torch.float64)).dtype == torch.float64
    assert to_bipolar(torch.zeros(2), torch.int8).tolist() == [-1, -1]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_binarise_takes_signs_and_counts_zero_as_positive(dtype):
    x = torch.tensor([-2.0, -1e-30, -0.0, 0.0, 3.0, float("inf")], dtype=dtype)
    result = binarise(x)
    assert result.dtype == dtype
    assert result.tolist() == [-1.0, -1.0, 1.0, 1.0, 1.0, 1.0]


def test_binarise_passes_gradients_unchanged():
    x = torch.randn(4, 7, generator=torch.Generator().manual_seed(0), requires_grad=True)
    weight = torch.randn(4, 7, generator=torch.Generator().manual_seed(1))
    (binarise(x) * weight).sum().backward()
    assert torch.equal(x.grad, weight)


def test_binarise_compiles_whole_and_vmaps():
    x = torch.randn(5, 6, generator=torch.Generator().manual_seed(0), requires_grad=True)
    compiled = torch.compile(binarise, fullgraph=True, backend="eager")
    assert torch.equal(compiled(x), binarise(x))
    assert torch.equal(torch.func.vmap(binarise)(x), binarise(x))


def test_bind_is_its_own_inverse_for_bipolar_codes():
    generator = torch.Generator().manual_seed(0)
    a = to_bipolar(torch.randint(0, 2, (3, 1, 50), generator=generator))
    b = to_bipolar(torch.randint(0, 2, (4, 50), generator=generator))
    bound = bind(a, b)
    assert bound.shape == (3, 4, 50)
    assert torch.equal(bind(bound, b), a.expand(3, 4, 50))


def test_binding_keeps_similarity():
    generator = torch.Generator().manual_seed(0)
    a, b, key = to_bipolar(torch.randint(0, 2, (3, 80), generator=generator))
    assert bind(a, key) @ bind(b, key) == a @ b
