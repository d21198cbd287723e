import copy

import numpy as np
import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch.encoders.place_code import CODES, PlaceCode, place_code, quantise, spike_rates

DEVICES = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])
LOWER, UPPER = [0.0, -2.62, -1.9], [0.69, 0.0, 3.8]
options = {
    "neurons": st.integers(2, 12),
    "width": st.sampled_from([0.3, 1.0, 2.5]),
    "code": st.sampled_from(CODES),
    "bits": st.integers(1, 8),
}


def positions(batch, seed, margin=0.0):
    generator = torch.Generator().manual_seed(seed)
    lower, upper = torch.tensor(LOWER).double(), torch.tensor(UPPER).double()
    fraction = torch.rand(batch, 3, generator=generator, dtype=torch.float64)
    return lower + (upper - lower) * (fraction * (1 + 2 * margin) - margin)


def everywhere(points=2001):
    return torch.linspace(-2.62, 0.0, points, dtype=torch.float64).unsqueeze(-1)


@pytest.mark.parametrize("device", DEVICES)
@given(seed=st.integers(0, 999), **options)
@settings(max_examples=25, deadline=None)
def test_matches_the_paper(device, seed, neurons, width, code, bits):
    encoder = PlaceCode(LOWER, UPPER, neurons, bits, width, code).to(device)
    q = positions(4, seed, margin=0.1)
    levels, codes = encoder.levels(q.to(device)).cpu(), encoder(q.to(device)).cpu()
    for row in range(len(q)):
        expected = reference.place_levels(q[row], LOWER, UPPER, neurons, bits, width, code)
        np.testing.assert_array_equal(levels[row], expected)
        np.testing.assert_array_equal(codes[row], reference.place_bits(expected, bits, code))


def test_thermometer_takes_any_number_of_bits():
    encoder = PlaceCode(LOWER, UPPER, 10, 16, code="thermometer")
    q = positions(1, 0)
    expected = reference.place_levels(q[0], LOWER, UPPER, 10, 16, 1.0, "thermometer")
    np.testing.assert_array_equal(encoder.levels(q)[0], expected)
    np.testing.assert_array_equal(encoder(q)[0], reference.place_bits(expected, 16, "thermometer"))


def test_preferred_positions_span_the_limits():
    lower, upper = torch.tensor([-1.0]), torch.tensor([2.0])
    rates = spike_rates(torch.tensor([[-1.0], [0.0], [2.0]]), lower, upper, 4, 0.5)
    torch.testing.assert_close(rates[:, 0].argmax(-1), torch.tensor([0, 1, 3]))
    torch.testing.assert_close(rates[:, 0].amax(-1), torch.ones(3))
    torch.testing.assert_close(rates[1, 0, 2], torch.tensor(-2.0).exp())


@given(rate=st.floats(0, 1), bits=st.integers(1, 8))
@settings(max_examples=50, deadline=None)
def test_bits_are_the_most_significant_of_eight(rate, bits):
    rates = torch.tensor([rate], dtype=torch.float64)
    full = place_code(quantise(rates, 8, "binary"), 8, "binary")
    assert torch.equal(place_code(quantise(rates, bits, "binary"), bits, "binary"), full[:bits])


def test_neighbouring_levels_differ_in_one_entry():
    for code, bits in (("gray", 6), ("thermometer", 16)):
        top = 2**bits - 1 if code == "gray" else bits
        codes = place_code(torch.arange(top + 1).unsqueeze(-1), bits, code)
        assert ((codes[1:] != codes[:-1]).sum(-1) == 1).all()


def test_finer_codes_tell_more_positions_apart():
    counts = [
        len(PlaceCode([-2.62], [0.0], bits=bits)(everywhere(20001)).unique(dim=0))
        for bits in (2, 4, 6, 8)
    ]
    assert counts[:2] == [51, 249]
    assert counts[0] < counts[1] < counts[2] < counts[3]


@pytest.mark.parametrize("code", CODES)
def test_the_table_holds_every_code(code):
    for bits in (2, 8):
        encoder = PlaceCode([-2.62], [0.0], bits=bits, code=code)
        found = encoder(everywhere(20001)).float().unique(dim=0)
        known = torch.cat([encoder.cell_codes, found]).unique(dim=0)
        assert len(known) == len(encoder.cell_codes.unique(dim=0))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize("bits", [1, 4, 8])
@pytest.mark.parametrize("width", [0.2, 1.0])
def test_every_cell_decodes_to_its_own_code(device, code, bits, width):
    encoder = PlaceCode([-2.62], [0.0], bits=bits, width=width, code=code).to(device)
    assert torch.equal(
        encoder(encoder.decode(encoder.cell_codes.double())).float(), encoder.cell_codes
    )


@given(seed=st.integers(0, 999), code=st.sampled_from(CODES), bits=st.sampled_from([4, 8]))
@settings(max_examples=10, deadline=None)
def test_decodes_positions_to_within_a_cell(seed, code, bits):
    encoder = PlaceCode(LOWER, UPPER, bits=bits, code=code)
    q = positions(20, seed)
    codes = encoder(q)
    decoded = encoder.decode(codes.view(4, 5, -1)).view(20, 3)
    assert torch.equal(encoder(decoded), codes)
    error = (decoded - q).abs() / (encoder.upper - encoder.lower)
    assert error.max() <= encoder.cell_positions.diff().max()


def test_decodes_noisy_and_real_valued_codes():
    generator = torch.Generator().manual_seed(0)
    encoder = PlaceCode(LOWER, UPPER)
    q = positions(500, 1)
    codes = encoder(q)
    scale = 0.01 + torch.rand(codes.shape, generator=generator, dtype=torch.float64)
    assert torch.equal(encoder.decode(codes * scale), encoder.decode(codes))
    flipped = torch.rand(codes.shape, generator=generator) < 0.02
    error = (encoder.decode(torch.where(flipped, -codes, codes)) - q).abs()
    assert (error / (encoder.upper - encoder.lower)).mean() < 0.005


@given(seed=st.integers(0, 999), code=st.sampled_from(CODES))
@settings(max_examples=10, deadline=None)
def test_positions_beyond_the_limits_count_as_the_limit(seed, code):
    encoder = PlaceCode(LOWER, UPPER, code=code)
    q = positions(5, seed, margin=2.0)
    assert torch.equal(encoder(q), encoder(q.clamp(encoder.lower, encoder.upper)))


def test_any_leading_dimensions():
    encoder = PlaceCode(LOWER, UPPER)
    q = positions(6, 2)
    codes = encoder(q)
    assert codes.shape == (6, encoder.code_dim)
    assert encoder.code_dim == 3 * 10 * 4
    assert torch.equal(encoder(q.view(1, 2, 3, 3)), codes.view(1, 2, 3, -1))
    assert torch.equal(encoder(q[0]), codes[0])
    assert encoder(q.float()).dtype == torch.float32
    assert encoder.levels(q).dtype == torch.int32
    assert encoder(q[:0]).shape == (0, encoder.code_dim)


def test_gradients_of_the_rates():
    q = positions(3, 3).requires_grad_()
    lower, upper = torch.tensor(LOWER).double(), torch.tensor(UPPER).double()
    assert torch.autograd.gradcheck(lambda q: spike_rates(q, lower, upper, 5, 1.0), (q,))


def test_limits_survive_conversion():
    q = positions(50, 4).float()
    encoder = PlaceCode(LOWER, UPPER, bits=8)
    expected, decoded = encoder(q), encoder.decode(encoder(q))
    converted = copy.deepcopy(encoder).to(torch.bfloat16)
    assert converted.lower.dtype == torch.float64
    assert torch.equal(converted(q), expected)
    assert torch.equal(converted.decode(expected), decoded)
    assert copy.deepcopy(encoder).float().lower.dtype == torch.float32
    other = PlaceCode([0.0] * 3, [1.0] * 3, bits=8)
    other.load_state_dict(encoder.state_dict())
    assert set(encoder.state_dict()) == {"lower", "upper"}
    assert torch.equal(other(q), expected)
    assert torch.equal(other.decode(expected), decoded)


def test_compiles_whole():
    encoder = PlaceCode(LOWER, UPPER)
    q = positions(4, 5).float()
    encode = torch.compile(encoder, fullgraph=True, backend="eager")
    decode = torch.compile(encoder.decode, fullgraph=True, backend="eager")
    assert torch.equal(encode(q), encoder(q))
    assert torch.equal(decode(encoder(q)), encoder.decode(encoder(q)))


def test_errors_say_what_was_expected():
    encoder = PlaceCode(LOWER, UPPER)
    with pytest.raises(ValueError, match=r"\(\.\.\., 3\), got \(4, 2\)"):
        encoder(torch.zeros(4, 2))
    with pytest.raises(ValueError, match=r"\(\.\.\., 120\), got \(4, 100\)"):
        encoder.decode(torch.zeros(4, 100))
    q = torch.zeros(4, 3)
    q[1, 2] = torch.nan
    q[3, 0] = -torch.inf
    with pytest.raises(ValueError, match=r"joints \[0, 2\]"):
        encoder(q)
    with pytest.raises(ValueError, match=r"lower < upper, got \[1\.0, 1\.0\] for joint 1"):
        PlaceCode([0.0, 1.0], [1.0, 1.0])
    with pytest.raises(ValueError, match=r"one shape \(J,\), got \(1,\) and \(2,\)"):
        PlaceCode([0.0], [1.0, 1.0])
    with pytest.raises(ValueError, match="finite joint limits"):
        PlaceCode([0.0], [torch.inf])
    with pytest.raises(ValueError, match="'grey', expected one of binary, gray, thermometer"):
        PlaceCode([0.0], [1.0], code="grey")
    for code in ("binary", "gray"):
        for bits in (0, 9):
            with pytest.raises(ValueError, match=f"1 to 8 for the {code} code, got {bits}"):
                PlaceCode([0.0], [1.0], bits=bits, code=code)
    with pytest.raises(ValueError, match="bits >= 1, got 0"):
        PlaceCode([0.0], [1.0], bits=0, code="thermometer")
    with pytest.raises(ValueError, match=r"neurons >= 2.*got 1"):
        PlaceCode([0.0], [1.0], neurons=1)
    with pytest.raises(ValueError, match=r"width > 0.*got 0\.0"):
        PlaceCode([0.0], [1.0], width=0.0)
