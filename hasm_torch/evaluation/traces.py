"""All rollouts of an evaluation in one file, from which anyone can compute every figure again."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hasm_torch.evaluation.along_force import resultant
from hasm_torch.evaluation.rollout import Trace
from hasm_torch.robot import JOINTS


def write_traces(path: Path, groups: Mapping[str, Sequence[Trace]]) -> None:
    """Write ``traces.npz``, a row a control step.

    ``experiment``: the group's name, "<experiment>/teacher" for the demonstrator's law on the same
    cases; ``rollout``: number of the case in its group; ``time`` (s); ``joints`` and ``target``
    (columns as in ``joint_names``, rad or m); ``patch`` ("" without touch, two joined by "+"),
    ``cell`` (-1 for a patch's centre), ``force`` (3, N, really applied) and ``point`` (3, m, where
    it is applied, NaN without touch) in the frame ``odom``; ``object`` (3, m, NaN without one).
    Two fingers are their resultant at the mean of their points, weighted by their mean forces;
    ``finger_patch``, ``finger_cell``, ``finger_force`` and ``finger_point`` hold each for itself.

    Args:
        path: File to write.
        groups: Rollouts by the name of their group.
    """
    named = [(name, i, trace) for name, traces in groups.items() for i, trace in enumerate(traces)]
    lengths = [len(trace.time) for _, _, trace in named]
    together = [resultant(trace) for _, _, trace in named]
    traces = [trace for _, _, trace in named]
    patches = np.concatenate([trace.patch for trace in traces])
    cells = np.concatenate([trace.cell for trace in traces])
    columns: dict[str, Any] = {
        "experiment": np.repeat([name for name, _, _ in named], lengths),
        "rollout": np.repeat([number for _, number, _ in named], lengths),
        "time": np.concatenate([trace.time for trace in traces]),
        "joints": np.concatenate([trace.state for trace in traces]),
        "target": np.concatenate([trace.target for trace in traces]),
        "patch": np.array(["+".join(filter(None, row)) for row in patches]),
        "cell": cells[:, 0],
        "force": np.concatenate([force for force, _, _ in together]),
        "point": np.concatenate([point for _, point, _ in together]),
        "object": np.concatenate([trace.object for trace in traces]),
        "finger_patch": patches,
        "finger_cell": cells,
        "finger_force": np.concatenate([trace.force for trace in traces]),
        "finger_point": np.concatenate([trace.point for trace in traces]),
    }
    np.savez_compressed(path, joint_names=np.array(JOINTS), **columns)
