"""The settings of the method."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

POSITIVE = ("current_per_newton", "max_rate", "force_window_s", "rate_window_s", "pair_window_s")


@dataclass
class HASMConfig:
    """Settings of the method; what is "auto" or None is chosen from the episodes by ``fit``.

    ``HASMConfig.literal()`` gives the paper's reading instead.

    Attributes:
        neurons: Neurons a joint, N_p.
        bits: Entries a neuron, n.
        width: Tuning width σ in neuron spacings.
        code: "binary", "gray" or "thermometer".
        ranks: Which neurons are the most active ones in the touch code: "fixed", those of a fixed
            order, so that the code tells the force alone; "place", those of the place code.
        threshold: Soft threshold τ on the L1 norm of a cell's forces, in the skin's unit; None is
            0.05 N for a skin that reads newtons, else the resting level of the episodes.
        force_window_s: Window Δt over which the force accumulates, s; at least one sample.
        current_per_newton: Synaptic current a newton of (window-averaged) effective force; None is
            2.5 for a skin that reads newtons, else the strongest touch drives a current of 40.
        spike_dt_ms: Longest integration step of the Izhikevich neurons, ms.
        max_rate: Spike rate R at which the rate density ρ saturates, 1/s.
        rate_window_s: Window in which the spike rate is counted, s.
        pair_window_s: How near a spike must be for a sample to be stored, s.
        pattern: Which series is memorised: the commanded ("action") or the measured ("state")
            joint positions.
        touch: What tells touches apart: "direction" of the force, "patch", or "auto".
        rope: Whether touch codes are rotated by the direction of the force (RoPE3D).
        rope_angle: Angle θ of the rotation, rad; None is 90° for the weighted mean and 45° for the
            first-order read-out.
        frame: Frame of the direction: "base" of the robot, or "link", where it is a constant of
            each cell.
        value: What is recalled: the "displacement" of a spike, the next state of a walk
            ("successor"), the course to the "goal" of a touch, or "auto".
        readout: The weighted "mean" of what is recalled, "first_order", or "auto".
        beta: Inverse temperature β of the inner products; infinity is the argmax.
        joints: Names of the coded joints.
        drive: What moves the robot on: every "spike", or "time" alone; "auto".
        horizon: Samples over which a displacement is taken.
        distinct: Whether a walk keeps distinct states only, see ``memory.successors``; if not, a
            state is followed by that ``horizon`` samples later.
        resolution: Entries in which codes must differ to be distinct.
        storage: How associations are held, see ``HeteroAssociativeMemory``.
    """

    neurons: int = 10
    bits: int = 16
    width: float = 2.0
    code: Literal["binary", "gray", "thermometer"] = "thermometer"
    ranks: Literal["fixed", "place"] = "fixed"
    threshold: float | None = None
    force_window_s: float = 0.06
    current_per_newton: float | None = None
    spike_dt_ms: float = 0.1
    max_rate: float = 800.0
    rate_window_s: float = 0.2
    pair_window_s: float = 0.05
    pattern: Literal["action", "state"] = "action"
    touch: Literal["auto", "direction", "patch"] = "auto"
    rope: bool = True
    rope_angle: float | None = None
    frame: Literal["base", "link"] = "base"
    value: Literal["auto", "displacement", "successor", "goal"] = "auto"
    readout: Literal["auto", "mean", "first_order"] = "auto"
    beta: float | None = None
    joints: list[str] | None = None
    drive: Literal["auto", "spike", "time"] = "auto"
    horizon: int = 5
    distinct: bool = True
    resolution: int = 4
    storage: Literal["float32", "bfloat16", "int8", "bit"] = "bit"

    def __post_init__(self) -> None:
        for name, kind in get_type_hints(type(self)).items():
            valid = get_args(kind)
            if get_origin(kind) is Literal and getattr(self, name) not in valid:
                raise ValueError(
                    f"unknown {name} {getattr(self, name)!r}, valid: {', '.join(valid)}"
                )
        for name in POSITIVE:
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise ValueError(f"{name} must be finite and above 0, got {value}")
        if self.horizon < 1:
            raise ValueError(f"horizon must be at least 1 sample, got {self.horizon}")
        if self.beta is not None and not self.beta >= 0:
            raise ValueError(f"beta must be 0 or above (inf is the argmax), got {self.beta}")

    @classmethod
    def literal(cls) -> "HASMConfig":
        """The paper as written.

        4-bit binary codes of the moved joints, samples and their successors, real-valued codes, one
        recall a control step. β = 2 stands for "a value bigger than 1". The text leaves the step of
        S₋₁ open: 30 samples, 0.6 s at 50 Hz, are the shortest that leave the range of one 4-bit
        code at the speed of the demonstrations. Every patch has a key, as if it had a memory of its
        own.
        """
        return cls(
            bits=4,
            width=1.0,
            code="binary",
            ranks="place",
            pattern="state",
            touch="patch",
            value="successor",
            readout="mean",
            beta=2.0,
            drive="spike",
            horizon=30,
            distinct=False,
            storage="float32",
        )


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a readable JSON file, whole or not at all."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(content, indent=2) + "\n")
    partial.replace(path)


def as_dict(config: Any) -> dict[str, Any]:
    """A dataclass as plain containers."""
    return asdict(config)
