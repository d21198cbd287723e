"""How long a sequence a dense associative memory holds, against published theory and simulation.

A random ±1 sequence ξ¹ ... ξᴾ of N entries, whose last pattern is followed by the first, is stored
as associations ξ^μ with the successors ξ^(μ+1). One step of recall is

    ξᵢ' = sgn Σ_μ ξᵢ^(μ+1) f(Σ_(j≠i) ξⱼ^μ xⱼ),    f(m) = m^d or e^m

(Chaudhry, Zavatone-Veth, Krotov, Pehlevan 2023, "Long Sequence Hopfield Memory"). The capacity is
the largest P at which the step from every pattern gives the next one without a wrong entry, in one
set of patterns or in each of 100 sets. The search comes down from above in steps of 1 % of P (at
least 1) with new patterns at every P: this, the closed sequence and the sum over j ≠ i reproduce
the simulated values. With the entry's own term j = i kept, which is what a plain recall of the
layer does, short codes hold more: run with ``--own_term=true`` to see it.

    python -m benchmarks.capacity            # five minutes
    python -m benchmarks.capacity --quick=true
"""

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.machine import RESULTS, print_machine, save_json
from hasm_torch import HeteroAssociativeMemory, to_bipolar
from hasm_torch.apps.command_line import parse_options
from hasm_torch.memory.recall import Interaction

REFERENCE = Path(__file__).parent.parent / "tests" / "data" / "sequence_capacity.json"

# Patterns recalled at a time; a sequence that is too long mostly fails in the first few.
PART = 64

# So many failures in a row end the search for a length that is beyond the capacity.
FAILURES = 10

# A decision nearer to 0 than this share of the largest weight is a tie: a wrong entry.
TIE = 1e-9


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        repeats: Repeats of a capacity in one set.
        repeats_100: Repeats of a capacity in 100 sets.
        own_term: Whether the sum over j keeps j = i.
        quick: Few repeats, short codes only; writes nothing.
        seed: Seed of the patterns.
        threads: CPU threads.
        output_dir: Where the results go.
    """

    repeats: int = 30
    repeats_100: int = 15
    own_term: bool = False
    quick: bool = False
    seed: int = 0
    threads: int = 1
    output_dir: str = str(RESULTS)


class Case(NamedTuple):
    """One simulated capacity of the reference."""

    interaction: Interaction
    neurons: int
    sets: int
    mean: float
    std: float
    n: int


class Measured(NamedTuple):
    """A measured capacity: mean and standard deviation over n repeats."""

    mean: float
    std: float
    n: int


def reference_cases() -> list[Case]:
    """The simulated capacities of the reference."""
    return [Case(**case) for case in json.loads(REFERENCE.read_text())["simulation"]]


def theory(interaction: Interaction, neurons: float) -> tuple[float, float]:
    """Transition and sequence capacity for many neurons.

        N^d / (2 (2d−1)!! ln N)   and   N^d / (2 (d+1) (2d−1)!! ln N)
        b^(N−1) / (2 ln N)        and   b^(N−1) / (2 N ln b),   b = e²/cosh 2

    Args:
        interaction: A degree d or "exponential".
        neurons: N.
    """
    if isinstance(interaction, int):
        odd = math.prod(range(1, 2 * interaction, 2))
        transition = neurons**interaction / (2 * odd * math.log(neurons))
        return transition, transition / (interaction + 1)
    base = math.exp(2) / math.cosh(2)
    power = base ** (neurons - 1)
    return power / (2 * math.log(neurons)), power / (2 * neurons * math.log(base))


def sequence_memory(patterns: Tensor, interaction: Interaction) -> HeteroAssociativeMemory:
    """Store a closed sequence so that one memory gives decisions with and without j = i.

    A code ends with one more entry, by which a query shifts all matches up or down by 1; a
    successor ξ^(μ+1) is followed by ξ^(μ+1) ⊗ ξ^μ. See ``next_pattern``.

    Args:
        patterns: ξ, (P, N) in {−1, +1}.
        interaction: A degree or "exponential".

    Returns:
        The memory, in float64, in which sums of powers of whole numbers are exact.
    """
    length, neurons = patterns.shape
    following = patterns.roll(-1, dims=0)
    memory = HeteroAssociativeMemory(
        neurons + 1, 2 * neurons, length, storage="float32", interaction=interaction
    ).double()
    state = _lengthened(patterns, 1.0)
    memory.write(state, torch.ones_like(state), torch.cat([following, following * patterns], -1))
    return memory


def next_pattern(memory: HeteroAssociativeMemory, pattern: Tensor, own_term: bool) -> Tensor:
    """One step of recall.

    Entry i leaves its own term ξᵢ^μ xᵢ = ±1 out of the match m^μ. As f takes two values there,

        f(m − ξᵢ xᵢ) = (f(m+1) + f(m−1))/2 − ξᵢ xᵢ (f(m+1) − f(m−1))/2,

    so that the sums over μ are recalls with the match shifted up and down by 1.

    Args:
        memory: From ``sequence_memory``.
        pattern: x, (..., N) in {−1, +1}.
        own_term: Whether the match keeps the entry's own term.

    Returns:
        (..., N) in {−1, 0, +1}, 0 where the sum is a tie.
    """
    observation = pattern.new_ones(pattern.shape[-1] + 1)
    decide = partial(memory, observation=observation)
    neurons = pattern.shape[-1]
    if own_term:
        decision = decide(_lengthened(pattern, 0.0))[..., :neurons]
    else:
        above, bound_above = decide(_lengthened(pattern, 1.0)).split(neurons, -1)
        below, bound_below = decide(_lengthened(pattern, -1.0)).split(neurons, -1)
        decision = (above + below - pattern * (bound_above - bound_below)) / 2
    largest = memory.weights(_lengthened(pattern[:1], 1.0)).amax()
    return torch.where(decision.abs() > TIE * largest, decision.sign(), 0.0)


def holds(length: int, neurons: int, interaction: Interaction, own_term: bool,
          generator: torch.Generator) -> bool:  # fmt: skip
    """Whether a random sequence is recalled without a wrong entry."""
    bits = torch.randint(0, 2, (length, neurons), generator=generator)
    patterns = to_bipolar(bits, torch.float64)
    memory = sequence_memory(patterns, interaction)
    following = patterns.roll(-1, dims=0)
    return all(
        torch.equal(next_pattern(memory, now, own_term), wanted)
        for now, wanted in zip(patterns.split(PART), following.split(PART))
    )


def capacity(holds_at: Callable[[int], bool]) -> int:
    """Largest length that holds, searched from above with new patterns at every length.

    Args:
        holds_at: Whether all sets of patterns of a length are recalled; random.
    """
    length = 2
    while any(holds_at(length) for _ in range(FAILURES)):
        length *= 2
    length = length * 3 // 2
    while length > 1 and not holds_at(length):
        length -= max(1, math.ceil(0.01 * length))
    return length


def measure(
    case: Case, repeats: int, generator: torch.Generator, own_term: bool = False
) -> Measured:
    """Measure one capacity of the reference.

    Args:
        case: What to measure.
        repeats: How often.
        generator: Source of the patterns.
        own_term: Whether the sum over j keeps j = i.
    """
    once = partial(
        holds,
        neurons=case.neurons,
        interaction=case.interaction,
        own_term=own_term,
        generator=generator,
    )
    found = torch.tensor(
        [
            float(capacity(lambda length: all(once(length) for _ in range(case.sets))))
            for _ in range(repeats)
        ]
    )
    return Measured(float(found.mean()), float(found.std(correction=0)), repeats)


def standard_errors(measured: Measured, case: Case) -> float:
    """Difference from the reference in joint standard errors, from the pooled variance."""
    if measured.mean == case.mean:
        return 0.0
    squares = measured.n * measured.std**2 + case.n * case.std**2
    pooled = squares / (measured.n + case.n - 2)
    return (measured.mean - case.mean) / math.sqrt(pooled * (1 / measured.n + 1 / case.n))


def bars_overlap(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two means with their standard deviations overlap."""
    return abs(one["mean"] - other["mean"]) <= one["std"] + other["std"]


def main() -> None:
    """Measure every capacity of the reference, print the table and write the results."""
    options = parse_options(Options)
    torch.set_num_threads(options.threads)
    torch.set_grad_enabled(False)
    print_machine()
    cases = [case for case in reference_cases() if not options.quick or case.mean < 60]
    generator = torch.Generator().manual_seed(options.seed)
    print("interaction   N   sets   reference         measured         difference in    s")
    print("                         mean ± std  (n)   mean ± std  (n)  standard errors")
    rows: list[dict[str, Any]] = []
    for case in cases:
        repeats = options.repeats if case.sets == 1 else options.repeats_100
        start = time.perf_counter()
        measured = measure(case, 4 if options.quick else repeats, generator, options.own_term)
        away = standard_errors(measured, case)
        print(
            f"{case.interaction!s:11} {case.neurons:3} {case.sets:6}   "
            f"{case.mean:5.1f} ± {case.std:4.1f} ({case.n:2})   "
            f"{measured.mean:5.1f} ± {measured.std:4.1f} ({measured.n:2})  {away:+8.2f}        "
            f"{time.perf_counter() - start:5.1f}",
            flush=True,
        )
        rows.append(
            {"reference": case._asdict(), "measured": measured._asdict(), "standard_errors": away}
        )
    within = sum(abs(row["standard_errors"]) <= 2 for row in rows)
    overlap = sum(bars_overlap(row["reference"], row["measured"]) for row in rows)
    print(
        f"of {len(rows)}: {within} within 2 joint standard errors, {overlap} with error bars "
        "(one standard deviation) that overlap"
    )
    if not options.quick:
        name = "capacity_own_term" if options.own_term else "capacity"
        print(save_json(options.output_dir, name, {"capacities": rows}))
        print(plot(rows, Path(options.output_dir) / f"{name}.png"))


def plot(rows: list[dict[str, Any]], path: Path) -> Path:
    """Draw capacity against N: theory as lines, both simulations with standard deviations.

    Args:
        rows: Measured and reference values, as in the JSON file.
        path: Where the picture goes.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 7.5), layout="constrained")
    kinds: list[Interaction] = [1, 2, 3, "exponential"]
    for axes, kind in zip(figure.subplots(2, 2).flat, kinds):
        mine = [row for row in rows if row["reference"]["interaction"] == kind]
        sizes = sorted({row["reference"]["neurons"] for row in mine})
        grid = torch.logspace(math.log10(sizes[0] * 0.9), math.log10(sizes[-1] * 1.1), 60).tolist()
        curves = [theory(kind, size) for size in grid]
        axes.plot(grid, [c[0] for c in curves], "k-", label="theory, one transition")
        axes.plot(grid, [c[1] for c in curves], "k--", label="theory, whole sequence")
        for sets, colour in ((1, "tab:blue"), (100, "tab:orange")):
            of_sets = [row for row in mine if row["reference"]["sets"] == sets]
            for which, marker, shift in (("reference", "s", 0.985), ("measured", "o", 1.015)):
                axes.errorbar(
                    [row["reference"]["neurons"] * shift for row in of_sets],
                    [row[which]["mean"] for row in of_sets],
                    yerr=[row[which]["std"] for row in of_sets],
                    fmt=marker,
                    color=colour,
                    markerfacecolor="white" if which == "reference" else colour,
                    capsize=3,
                    label=f"{which}, {'one set' if sets == 1 else '100 sets'}",
                )
        axes.set(xscale="log", yscale="log", xlabel="entries of a code, N")
        axes.set(ylabel="patterns in the sequence, P")
        axes.set(title="exponential" if kind == "exponential" else f"degree {kind}")
        axes.set_xticks(sizes, [str(size) for size in sizes], minor=False)
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    figure.axes[0].legend(fontsize=8)
    figure.suptitle("Longest random sequence recalled without a wrong entry (bars: std of repeats)")
    figure.savefig(path, dpi=110)
    return path


def _lengthened(pattern: Tensor, entry: float) -> Tensor:
    """Codes with one more entry at the end."""
    return torch.nn.functional.pad(pattern, (0, 1), value=entry)


if __name__ == "__main__":
    main()
