"""The settings of the method."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

SHARED = "shared"  # name of the memory that all patches share


@dataclass
class HASMConfig:
    """Settings of the method; the defaults are what the project measured as best.

    ``HASMConfig.literal()`` gives the paper's reading instead.

    Attributes:
        neurons: Neurons a joint, N_p.
        bits: Entries a neuron, n.
        width: Tuning width σ in neuron spacings.
        code: "binary", "gray" or "thermometer".
        threshold: Soft threshold τ on the L1 norm of a cell's forces, N.
        force_window: Window Δt over which the force accumulates, samples.
        current_per_newton: Synaptic current a newton of (window-averaged) effective force.
        spike_dt_ms: Integration step of the Izhikevich neurons, ms.
        max_rate: Spike rate R at which the rate density ρ saturates, 1/s.
        rate_window_s: Window in which the spike rate is counted, s.
        pair_window_s: How near a spike must be for a sample to be stored, s.
        pattern: Which series is memorised: the commanded ("action") or the measured ("state")
            joint positions.
        store: "distinct" keeps the distinct codes of a walk (see ``successors``); "sample" keeps
            every sample, followed by the sample ``horizon`` later.
        resolution: Entries in which codes must differ to be distinct, with ``store="distinct"``.
        horizon: Samples to the successor, with ``store="sample"``.
        advance: "spike": every spike advances the recall along the walk; "tick": one recall from
            the measured joints a control step.
        code_joints: "moved" codes only the joints that a patch's episodes move and leaves the
            others where they are; "all" codes and commands every joint.
        touch_levels: "nearest" stores one rate density an episode and recalls at the nearest
            stored one; "exact" uses the rate density of each sample as it is.
        ranks: Which neurons are ranked together for the N most active: "joint", those of each
            joint, so that the posture of one does not change the touch code at another; "all".
        memories: "patch" gives every patch a memory of its own; "shared" stores all in one, which
            tells patches apart by the rotation of the touch alone.
        rope: Whether touch codes are rotated (RoPE3D).
        frame: Frame in which the direction of a touch rotates its code: "link", of the link that
            carries the patch, where it is the same in every posture; "base", of the robot's base,
            where it keeps its meaning in space (the bundled HSR's joints only).
        rebinarise: Whether rotated codes return to ±1 by sign before they are bound.
        storage: How associations are held, see ``HeteroAssociativeMemory``.
        beta: Inverse temperature; None derives it from the margin of the stored memory.
    """

    neurons: int = 10
    bits: int = 16
    width: float = 1.0
    code: Literal["binary", "gray", "thermometer"] = "thermometer"
    threshold: float = 0.05
    force_window: int = 3
    current_per_newton: float = 2.5
    spike_dt_ms: float = 0.1
    max_rate: float = 800.0
    rate_window_s: float = 0.2
    pair_window_s: float = 0.05
    pattern: Literal["action", "state"] = "action"
    store: Literal["distinct", "sample"] = "distinct"
    resolution: int = 4
    horizon: int = 1
    advance: Literal["spike", "tick"] = "spike"
    code_joints: Literal["moved", "all"] = "moved"
    touch_levels: Literal["nearest", "exact"] = "nearest"
    ranks: Literal["joint", "all"] = "joint"
    memories: Literal["patch", "shared"] = "patch"
    rope: bool = True
    frame: Literal["link", "base"] = "link"
    rebinarise: bool = True
    storage: Literal["float32", "bfloat16", "int8", "bit"] = "bit"
    beta: float | None = None

    def __post_init__(self) -> None:
        for name, kind in get_type_hints(type(self)).items():
            valid = get_args(kind)
            if get_origin(kind) is Literal and getattr(self, name) not in valid:
                raise ValueError(
                    f"unknown {name} {getattr(self, name)!r}, valid: {', '.join(valid)}"
                )
        for name in ("current_per_newton", "max_rate", "rate_window_s", "pair_window_s"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"{name} must be finite and above 0, got {getattr(self, name)}")

    @classmethod
    def literal(cls) -> "HASMConfig":
        """The paper as written: 4-bit binary codes of all joints, every sample, one recall a tick.

        β = 2 stands for "a value bigger than 1".
        """
        return cls(
            bits=4,
            code="binary",
            pattern="state",
            store="sample",
            advance="tick",
            code_joints="all",
            touch_levels="exact",
            ranks="all",
            rebinarise=False,
            storage="float32",
            beta=2.0,
        )


@dataclass
class MemoryShape:
    """What one patch's memory needs to be built again.

    Attributes:
        joints: Indices of the joints that it codes.
        capacity: Associations that it holds.
        touch_levels: Number of stored rate densities.
        patches: Names of the patches that share the memory; empty where it belongs to one.
    """

    joints: list[int]
    capacity: int
    touch_levels: int
    patches: list[str] = field(default_factory=list)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a readable JSON file, whole or not at all."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(content, indent=2) + "\n")
    partial.replace(path)


def as_dict(config: Any) -> dict[str, Any]:
    """A dataclass as plain containers."""
    return asdict(config)
