import copy

import numpy as np
import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch.encoders.izhikevich import (
    Izhikevich,
    IzhikevichState,
    _torch_loop,
    izhikevich,
    resting_state,
)
from hasm_torch.kernels import izhikevich as izhikevich_kernel

TABLE = {"a": 0.02, "b": 0.2, "c": -50.0, "d": 0.5, "v_th": 30.0}
CURRENTS = (4.0, 5.0, 10.0, 20.0, 40.0)
DEVICES = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])


def constant(currents, steps, dtype=torch.float64):
    return torch.tensor(currents, dtype=dtype).unsqueeze(-1).repeat(1, steps)


def random_current(neurons, steps, dtype, seed, scale=30.0):
    generator = torch.Generator().manual_seed(seed)
    return scale * torch.rand(neurons, steps, generator=generator, dtype=dtype)


@pytest.fixture(scope="module")
def exact():
    """Spike times (ms) of 250 ms at CURRENTS, to some 1e-4 of the interval between spikes."""
    return reference.izhikevich(CURRENTS, duration=250.0, step=0.01)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rates_match_fine_steps(exact, dtype):
    neuron = Izhikevich()
    spikes, _ = neuron(constant(CURRENTS, 2500, dtype))
    for train, times in zip(spikes, exact[0], strict=True):
        fired = train.nonzero().flatten() * neuron.dt_ms
        count = min(len(fired), len(times)) - 1
        rate = count / (fired[count] - fired[0])
        assert rate.item() == pytest.approx(count / (times[count] - times[0]), rel=5e-3)


def test_spikes_come_at_their_time(exact):
    dt = 0.02
    spikes, _ = Izhikevich(dt_ms=dt)(constant(CURRENTS, 5000))
    for train, times in zip(spikes, exact[0], strict=True):
        fired = train.nonzero().flatten().numpy() * dt
        expected = np.array(times[: len(fired)])
        assert len(fired) > 4
        assert np.abs(fired + dt / 2 - expected).max() < 2 * dt


def test_steps_are_of_second_order():
    """Halving the step divides the error of u after 20 ms and several spikes by four."""
    current = 20.0
    errors = []
    _, _, expected = reference.izhikevich([current], duration=20.0, step=0.001)
    for dt in (0.2, 0.1, 0.05):
        _, state = Izhikevich(dt_ms=dt)(constant([current], round(20 / dt)))
        errors.append(abs(state.u.item() - expected.item()))
    assert errors[0] > 3 * errors[1] > 9 * errors[2]


def test_unstimulated_neurons_rest():
    spikes, state = Izhikevich()(torch.zeros(3, 2000, dtype=torch.float64))
    assert not spikes.any()
    torch.testing.assert_close(state.v, torch.full((3,), -70.0, dtype=torch.float64))
    torch.testing.assert_close(state.u, torch.full((3,), -14.0, dtype=torch.float64))


@given(b=st.floats(0.0, 0.26))
@settings(max_examples=10, deadline=None)
def test_resting_state_is_a_fixed_point(b):
    rest = resting_state(torch.zeros(2, 1, dtype=torch.float64), b)
    torch.testing.assert_close(
        0.04 * rest.v**2 + 5 * rest.v + 140 - rest.u, torch.zeros(2).double()
    )
    torch.testing.assert_close(b * rest.v - rest.u, torch.zeros(2).double())


@given(
    neurons=st.integers(0, 70),
    steps=st.integers(0, 600),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    scale=st.sampled_from([5.0, 40.0, 3000.0]),
    dt=st.floats(0.01, 0.25),
    d=st.sampled_from([0.5, 8.0]),
    seed=st.integers(0, 999),
)
@settings(max_examples=15, deadline=None)
def test_kernel_and_torch_loop_agree_to_the_last_bit(neurons, steps, dtype, scale, dt, d, seed):
    current = random_current(neurons, steps, dtype, seed, scale) - 0.1 * scale
    rest = resting_state(current, 0.2)
    parameters = (0.02, 0.2, -50.0, d, 30.0, dt)
    spikes, state = izhikevich(current, rest, *parameters)
    expected_spikes, v, u = _torch_loop(current, rest.v, rest.u, *parameters)
    assert torch.equal(spikes, expected_spikes)
    assert torch.equal(state.v, v)
    assert torch.equal(state.u, u)
    assert torch.isfinite(v).all()


def test_threads_change_nothing(monkeypatch):
    neurons, steps = 3 * izhikevich_kernel.LANES + 5, 300
    current = random_current(neurons, steps, torch.float32, 0)
    whole, state = Izhikevich()(current)
    monkeypatch.setattr(izhikevich_kernel, "PARALLEL_WORK", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    threaded, threaded_state = Izhikevich()(current)
    assert torch.equal(whole, threaded)
    assert torch.equal(state.v, threaded_state.v)
    assert torch.equal(state.u, threaded_state.u)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("needs_grad", [False, True])
def test_chunks_equal_the_whole(device, needs_grad):
    current = random_current(6, 240, torch.float32, 1).to(device).requires_grad_(needs_grad)
    neuron = Izhikevich()
    whole, end = neuron(current)
    state, parts = None, []
    for chunk in current.split([1, 79, 160], dim=-1):
        spikes, state = neuron(chunk, state)
        parts.append(spikes)
    assert whole.any()
    assert torch.equal(torch.cat(parts, -1), whole)
    assert torch.equal(state.v, end.v)
    assert torch.equal(state.u, end.u)


def test_inputs_are_left_alone():
    current = random_current(4, 100, torch.float32, 2)
    state = resting_state(current, 0.2)
    before = copy.deepcopy((current, state))
    Izhikevich()(current, state)
    assert torch.equal(current, before[0])
    assert torch.equal(state.v, before[1].v)
    assert torch.equal(state.u, before[1].u)


def test_any_leading_dimensions_and_strides():
    neuron = Izhikevich()
    current = random_current(6, 150, torch.float32, 3)
    spikes, state = neuron(current)
    shaped, shaped_state = neuron(current.view(2, 1, 3, 150))
    assert shaped.shape == (2, 1, 3, 150)
    assert shaped_state.v.shape == (2, 1, 3)
    assert torch.equal(shaped.flatten(0, 2), spikes)
    single, single_state = neuron(current[0])
    assert single_state.v.shape == ()
    assert torch.equal(single, spikes[0])
    strided, _ = neuron(current.mT.contiguous().mT)
    assert torch.equal(strided, spikes)
    assert torch.equal(state.v[:1], single_state.v[None])


def test_stronger_currents_fire_faster():
    current = torch.linspace(0, 60, 40).unsqueeze(-1).repeat(1, 5000)
    counts = Izhikevich()(current)[0].sum(-1)
    assert counts[0] == 0
    assert (counts.diff() >= 0).all()
    assert counts[-1] > 5 * counts[4] > 0


def test_half_precision_keeps_its_state_in_float32():
    current = random_current(4, 400, torch.float32, 4).to(torch.bfloat16)
    neuron = Izhikevich().to(torch.bfloat16)
    spikes, state = neuron(current)
    expected, _ = neuron(current.float())
    assert spikes.dtype == torch.bfloat16
    assert state.v.dtype == torch.float32
    assert torch.equal(spikes.float(), expected)


def test_gradients_pass_through_spikes_exactly():
    """The last state depends smoothly on the currents, through the instants of spikes too."""
    current = constant([60.0], 32) + random_current(1, 32, torch.float64, 5, scale=1.0)
    rest = resting_state(current, 0.2)

    def end(current, v, u):
        return izhikevich(current, IzhikevichState(v, u), *TABLE.values(), 0.25)[1]

    assert Izhikevich(dt_ms=0.25)(current)[0].sum() >= 3
    inputs = tuple(x.requires_grad_() for x in (current, rest.v, rest.u))
    assert torch.autograd.gradcheck(end, inputs, eps=1e-7, atol=1e-4, rtol=1e-3)


def test_surrogate_gradient_reaches_the_current():
    current = constant([8.0], 60).requires_grad_()
    spikes, _ = Izhikevich()(current)
    spikes.sum().backward()
    assert torch.isfinite(current.grad).all()
    assert current.grad.sum() > 0


def test_not_a_number_is_not_hidden():
    current = random_current(2, 50, torch.float32, 6)
    current[0, 10] = torch.nan
    _, state = Izhikevich()(current)
    assert state.v[0].isnan()
    assert not state.v[1].isnan()


@pytest.mark.parametrize("steps", [1, 200])
def test_compiles_whole(steps):
    neuron = Izhikevich()
    compiled = torch.compile(neuron, fullgraph=True, backend="eager")
    current = random_current(8, steps, torch.float32, 7)
    spikes, state = neuron(current)
    compiled_spikes, compiled_state = compiled(current)
    assert torch.equal(spikes, compiled_spikes)
    assert torch.equal(state.v, compiled_state.v)


def test_operator_is_registered_correctly():
    current = random_current(2, 5, torch.float32, 8)
    rest = resting_state(current, 0.2)
    torch.library.opcheck(
        izhikevich_kernel.izhikevich_op,
        (current, rest.v, rest.u, *TABLE.values(), 0.1),
        test_utils=("test_schema", "test_faketensor", "test_aot_dispatch_dynamic"),
    )


def test_errors_say_what_was_expected():
    current = torch.zeros(3, 5)
    wrong = resting_state(torch.zeros(2, 5), 0.2)
    with pytest.raises(ValueError, match=r"state of shape \(3,\).*got v \(2,\)"):
        Izhikevich()(current, wrong)
    for dt in (0.0, -1.0, 0.5, float("nan")):
        with pytest.raises(ValueError, match=r"dt_ms < .* = 0\.270 ms"):
            Izhikevich(dt_ms=dt)(current)
