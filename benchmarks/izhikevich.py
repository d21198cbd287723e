"""Speed of the Izhikevich neurons, beside norse's where that is installed.

Both get the paper's parameters, float32 currents and steps of the same length, without gradients,
on the CPU. The work differs in the integrator: norse makes an explicit Euler step, the neurons
here an implicit one with the instant of the spike inside the step, which costs more arithmetic.
The spike rates printed beside a fine reference say what that buys.

norse is no dependency of the project. To compare, install it beside it, for example

    uv pip install --target=outputs/norse --no-deps norse nir nirtorch h5py
    PYTHONPATH=outputs/norse python -m benchmarks.izhikevich
"""

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.machine import RESULTS, interleaved, print_machine, save_json
from hasm_torch import Izhikevich
from hasm_torch.apps.command_line import parse_options

INSTALL_NORSE = """norse is not installed, so there is no comparison; to get one:
  uv pip install --target=outputs/norse --no-deps norse nir nirtorch h5py
  PYTHONPATH=outputs/norse python -m benchmarks.izhikevich"""

# Length of a step of the reference rate, ms.
FINE_MS = 0.001


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        neurons: Neurons of the long run.
        steps: Steps of the long run.
        patches: Neurons of a streaming step.
        tick_ms: Duration of a control step, ms.
        rounds: Timings of the long run; streaming steps are timed a hundred times as often.
        threads: CPU threads.
        output_dir: Where the result goes.
    """

    neurons: int = 1000
    steps: int = 10_000
    patches: int = 8
    tick_ms: float = 20.0
    rounds: int = 5
    threads: int = 2
    output_dir: str = str(RESULTS)


def norse_population(neurons: int, dt_ms: float) -> Callable[..., Any] | None:
    """Build norse's Izhikevich layer, with the paper's parameters, where norse is installed.

    Args:
        neurons: Number of neurons.
        dt_ms: Length of a step, ms.

    Returns:
        ``(current (T, neurons), state=None)`` gives spikes (T, neurons) and the state; None
        without norse.
    """
    if importlib.util.find_spec("norse") is None:
        return None
    import norse.torch as norse

    ours = Izhikevich()
    # tau_inv turns norse's seconds into the milliseconds of the equations
    parameters = norse.IzhikevichParameters(
        a=ours.a, b=ours.b, c=ours.c, d=ours.d, v_th=ours.v_th, tau_inv=1000.0
    )
    rest = norse.IzhikevichState(torch.full((neurons,), -70.0), torch.full((neurons,), -14.0))
    behaviour = norse.IzhikevichSpikingBehavior(parameters, rest)
    return norse.Izhikevich(behaviour, dt=dt_ms / 1000.0)


def spike_rates(spikes: Tensor, dt_ms: float) -> Tensor:
    """Mean rate over the population of (neurons, T) spikes, 1/s."""
    return spikes.sum(-1).mean() / (spikes.shape[-1] * dt_ms / 1000.0)


def measure(options: Options) -> dict[str, Any]:
    """Time the long run, one integration step and one control step.

    Args:
        options: Sizes and repeats.

    Returns:
        For each piece of work: neuron steps, seconds by implementation, ratio norse / ours as
        the median over the rounds, if norse is there; and the mean spike rates of some twenty of
        the long run's neurons, with those of a fine step.
    """
    neuron = Izhikevich()
    generator = torch.Generator().manual_seed(0)
    levels = 5.0 + 35.0 * torch.rand(options.neurons, 1, generator=generator)
    tick = round(options.tick_ms / neuron.dt_ms)
    work = {
        "long run": (levels, options.steps, options.rounds),
        "streaming, one integration step": (levels[: options.patches], 1, 100 * options.rounds),
        "streaming, one control step": (levels[: options.patches], tick, 20 * options.rounds),
    }
    result: dict[str, Any] = {}
    for name, (level, steps, rounds) in work.items():
        current = level.expand(-1, steps).contiguous()
        by_step = current.T.contiguous()  # each library gets the layout it works in
        _, state = neuron(current)
        calls: dict[str, Callable[[], Any]] = {"ours": lambda c=current, s=state: neuron(c, s)}  # type: ignore[misc]
        norse = norse_population(len(level), neuron.dt_ms)
        if norse is not None:
            _, after = norse(by_step)
            calls["norse"] = lambda c=by_step, s=after, f=norse: f(c, s)  # type: ignore[misc]
        seconds = interleaved(calls, rounds)
        entry: dict[str, Any] = {"neurons": len(level), "steps": steps, "rounds": rounds}
        entry["median_s"] = {key: float(np.median(value)) for key, value in seconds.items()}
        entry["p99_s"] = {key: float(np.quantile(value, 0.99)) for key, value in seconds.items()}
        if norse is not None:
            entry["ratio"] = float(np.median(seconds["norse"] / seconds["ours"]))
        result[name] = entry
    levels = levels[:: max(1, options.neurons // 20)]
    current = levels.expand(-1, options.steps).contiguous()
    rates = {"ours": float(spike_rates(neuron(current)[0], neuron.dt_ms))}
    norse = norse_population(len(levels), neuron.dt_ms)
    if norse is not None:
        spikes, _ = norse(current.T.contiguous())
        rates["norse"] = float(spike_rates(spikes.T, neuron.dt_ms))
    fine = Izhikevich(dt_ms=FINE_MS)
    repeats = round(neuron.dt_ms / FINE_MS) * options.steps
    spikes, _ = fine(levels.double().expand(-1, repeats))
    rates["reference"] = float(spike_rates(spikes, FINE_MS))
    result["spikes_per_s"] = rates
    return result


def main() -> None:
    """Measure, print the table and write the result."""
    options = parse_options(Options)
    torch.set_num_threads(options.threads)
    torch.set_grad_enabled(False)
    print_machine()
    result = measure(options)
    rates = result.pop("spikes_per_s")
    print(f"{'work':34} {'neuron steps':>12} {'ours':>20} {'norse':>20} {'norse/ours':>11}")
    for name, entry in result.items():
        times = {
            key: f"{1e3 * entry['median_s'][key]:9.3f} ms" if key in entry["median_s"] else "-"
            for key in ("ours", "norse")
        }
        count = entry["neurons"] * entry["steps"]
        ratio = f"{entry['ratio']:10.1f}x" if "ratio" in entry else "-"
        print(f"{name:34} {count:12,} {times['ours']:>20} {times['norse']:>20} {ratio:>11}")
    print("mean spikes/s: " + ", ".join(f"{key} {rate:.1f}" for key, rate in rates.items()))
    if "norse" not in rates:
        print(INSTALL_NORSE)
    print(save_json(options.output_dir, "izhikevich", {"work": result, "spikes_per_s": rates}))


if __name__ == "__main__":
    main()
