"""Izhikevich neurons that turn the force on a skin patch into spikes.

    dv/dt = 0.04 v^2 + 5 v + 140 - u + I          (eq. izhi_1)
    du/dt = a (b v - u)                           (eq. izhi_2)
    if v >= v_th:  v <- c,  u <- u + d

v is the membrane potential in mV, u the recovery variable, I the synaptic current, time is in ms
(paper, section "Izhikevich Neuron Coding").

The step size is part of the model. Plain Euler steps see the threshold only at the ends of the
steps, so their rate is several per cent low even at 0.02 ms. Here a step of length h is linearly
implicit in v (Kahan's discretisation of a quadratic vector field): with u frozen at the middle of
the step,

    v(s) = (v + s A) / (1 - s B),    A = 2.5 v + 140 + I - u,    B = 0.04 v + 2.5,

whose crossing of the threshold is known in closed form, tau = (v_th - v) / (A + v_th B). The step
is then split there: reset at tau, and the remaining h - tau run from v = c. The method is of
second order, keeps the resting point exactly, and costs two divisions a step.

Error of the firing rate in per cent against Runge-Kutta steps of 0.001 ms with the paper's
parameters, float64:

    I          3.8     4      5     10     20     40     80    160
    spikes/s   58.1   74.1  115.2  288.4  503.4  833.1   1364   2274
    0.05 ms    +0.0   -0.0   -0.0   -0.0   -0.0   -0.0   -0.1   -0.2
    0.1 ms     -0.7   -0.0   -0.1   -0.1   -0.1   -0.1   -0.4   -0.8    (the default)
    0.25 ms    -1.4   +0.8   -0.5   -0.5   -0.4   -0.7   -2.3   -3.9
    Euler 0.1  +2.0   +0.8   -2.0   -3.7   -5.4   -7.7   -8.4  -12.0

A neuron emits at most one spike a step, which bounds the rate by 1/h (10,000 spikes/s at 0.1 ms).
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from hasm_torch.kernels.izhikevich import izhikevich_op

SURROGATE_SLOPE = 0.1  # 1/mV; one step of the upstroke is some 30 mV long


class IzhikevichState(NamedTuple):
    """State of a population: membrane potential v (mV) and recovery variable u, each (...)."""

    v: Tensor
    u: Tensor


def resting_state(current: Tensor, b: float) -> IzhikevichState:
    """The resting point for I = 0, at which a neuron stays without input.

    It solves 0.04 v^2 + (5 - b) v + 140 = 0 (lower root), u = b v: v = -70 mV, u = -14 for
    b = 0.2. For b so large that there is no resting point, v is the potential of slowest change.

    Args:
        current: (..., T); gives the shape, the device and the dtype.
        b: sensitivity of the recovery variable.

    Returns:
        The state, each part (...), float32 or better.
    """
    v = (b - 5.0 - max((5.0 - b) ** 2 - 22.4, 0.0) ** 0.5) / 0.08
    dtype = torch.promote_types(current.dtype, torch.float32)
    shape = current.shape[:-1]
    potential = torch.full(shape, v, dtype=dtype, device=current.device)
    return IzhikevichState(potential, torch.full_like(potential, b * v))


def izhikevich(
    current: Tensor,
    state: IzhikevichState,
    a: float,
    b: float,
    c: float,
    d: float,
    v_th: float,
    dt_ms: float,
) -> tuple[Tensor, IzhikevichState]:
    """Spikes of Izhikevich neurons, one for each leading index of `current`.

    Runs a compiled kernel on the CPU where no gradient is asked for, and the same arithmetic as
    torch operations elsewhere; both give the same spikes. Gradients reach `current` and `state`:
    exactly through the potential, the recovery variable and the instants of the spikes, and by a
    fast-sigmoid surrogate through the spikes themselves.

    Args:
        current: (..., T) synaptic current I, one sample a step, held over the step.
        state: v and u, each (...), at the start.
        a: rate of the recovery variable, 1/ms.
        b: sensitivity of the recovery variable.
        c: potential after a spike, mV.
        d: increment of the recovery variable at a spike.
        v_th: threshold, mV.
        dt_ms: length of a step, ms.

    Returns:
        Spikes (..., T), 0 or 1 in the dtype of `current`, and the state after the last step. A run
        in chunks that hands on the state equals the whole run exactly.

    Raises:
        ValueError: if the state's shape differs from current's leading dimensions, or dt_ms is
            not positive or so long that one implicit step could jump over the threshold.
    """
    if state.v.shape != current.shape[:-1] or state.u.shape != current.shape[:-1]:
        raise ValueError(
            f"expected a state of shape {tuple(current.shape[:-1])} for a current of shape "
            f"(..., T) = {tuple(current.shape)}, got v {tuple(state.v.shape)} and u "
            f"{tuple(state.u.shape)}; start from resting_state(current, b)"
        )
    if not 0.0 < dt_ms * (0.04 * v_th + 2.5) < 1.0:
        raise ValueError(
            f"expected 0 < dt_ms < 1 / (0.04 v_th + 2.5) = {1 / (0.04 * v_th + 2.5):.3f} ms, "
            f"got dt_ms={dt_ms}; repeat each sample of the current over shorter steps"
        )
    dtype = torch.promote_types(current.dtype, torch.float32)
    drive, v, u = current.to(dtype), state.v.to(dtype), state.u.to(dtype)
    wants_grad = torch.is_grad_enabled() and (
        drive.requires_grad or v.requires_grad or u.requires_grad
    )
    run = _torch_loop if wants_grad or drive.device.type != "cpu" else izhikevich_op
    spikes, v, u = run(drive, v, u, a, b, c, d, v_th, dt_ms)
    return spikes.to(current.dtype), IzhikevichState(v, u)


class Izhikevich(nn.Module):
    """A population of Izhikevich neurons with the parameters of the paper's table.

    Args:
        a: rate of the recovery variable, 1/ms.
        b: sensitivity of the recovery variable.
        c: potential after a spike, mV.
        d: increment of the recovery variable at a spike.
        v_th: threshold, mV.
        dt_ms: length of a step, ms. The rate is within 0.2 % of the exact one from 74 to 833
            spikes/s at the default; see the module's table.
    """

    def __init__(
        self,
        a: float = 0.02,
        b: float = 0.2,
        c: float = -50.0,
        d: float = 0.5,
        v_th: float = 30.0,
        dt_ms: float = 0.1,
    ) -> None:
        super().__init__()
        self.a, self.b, self.c, self.d, self.v_th, self.dt_ms = a, b, c, d, v_th, dt_ms

    def forward(
        self, current: Tensor, state: IzhikevichState | None = None
    ) -> tuple[Tensor, IzhikevichState]:
        """Spikes and the state to go on from.

        Args:
            current: (..., T), one sample every `dt_ms`.
            state: from the previous chunk; the resting point where None.

        Returns:
            Spikes (..., T) in {0, 1} and the state, each part (...).
        """
        if state is None:
            state = resting_state(current, self.b)
        return izhikevich(current, state, self.a, self.b, self.c, self.d, self.v_th, self.dt_ms)

    def extra_repr(self) -> str:
        """Options shown by print."""
        return ", ".join(
            f"{name}={getattr(self, name)}" for name in ("a", "b", "c", "d", "v_th", "dt_ms")
        )


class _SuperSpike(torch.autograd.Function):
    """Heaviside step with the derivative 1 / (1 + slope |x|)^2 (Zenke and Ganguli 2018)."""

    @staticmethod
    def forward(ctx: Any, excess: Tensor) -> Tensor:
        ctx.save_for_backward(excess)
        return (excess >= 0).to(excess.dtype)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Tensor:
        (excess,) = ctx.saved_tensors
        return grads[0] / (1.0 + SURROGATE_SLOPE * excess.abs()) ** 2


def _torch_loop(
    current: Tensor, v: Tensor, u: Tensor,
    a: float, b: float, c: float, d: float, v_th: float, dt_ms: float,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """The step as torch operations. The kernel repeats them in the same order, to the last bit."""
    spikes = []
    for drive in (current + 140.0).unbind(-1):
        u_mid = u + (0.5 * dt_ms * a) * (b * v - u)
        slope = 2.5 * v + (drive - u_mid) + v_th * (0.04 * v + 2.5)
        gap = v_th - v
        excess = dt_ms * slope - gap  # >= 0 if v(s) reaches v_th within the step
        spike = excess >= 0
        spikes.append(_SuperSpike.apply(excess))
        # masked before the division, so that no gradient of 0/0 leaks through the selection
        tau = torch.where(spike, gap, 0.0) / torch.where(spike, slope, 1.0)
        u = torch.where(spike, u + (a * tau) * ((0.5 * b) * (v + v_th) - u) + d, u)
        v = torch.where(spike, c, v)
        rest = dt_ms - tau
        u_mid = u + ((0.5 * a) * rest) * (b * v - u)
        v_next = (v + rest * (2.5 * v + (drive - u_mid))) / (1.0 - rest * (0.04 * v + 2.5))
        v_next = v_next.clamp(max=v_th)  # a second crossing waits for the next step
        u = u + (a * rest) * ((0.5 * b) * (v + v_next) - u_mid)
        v = v_next
    return torch.stack(spikes, -1) if spikes else torch.empty_like(current), v, u
