"""The body that a dataset describes."""

from pathlib import Path

import numpy as np

from hasm_torch._assets import asset_path
from hasm_torch.config import Body
from hasm_torch.lerobot.episodes import EpisodeSet
from hasm_torch.robot.urdf import read_urdf


def body_of(data: EpisodeSet, urdf: Path | None = None) -> Body:
    """Joints and skin of a dataset, with the joint limits of a URDF.

    Args:
        data: The episodes; they must have a tactile feature.
        urdf: The robot's URDF; by default the bundled HSR's.

    Returns:
        The body, in the order of the dataset's vectors.

    Raises:
        ValueError: If the dataset has no skin, or the URDF lacks one of its joints.
    """
    if not data.skin:
        raise ValueError(
            f"dataset {data.root} has no tactile feature with skin patches in its info: expected "
            "observation.tactile with patches, cells and normals"
        )
    source = urdf or asset_path("hsr.urdf")
    limits = read_urdf(source).joints
    missing = [name for name in data.joints if name not in limits]
    if missing:
        raise ValueError(
            f"{source} has no joint {', '.join(missing)} of dataset {data.root}; "
            f"its joints: {', '.join(limits)}"
        )
    joints = [limits[name] for name in data.joints]
    patches = list(data.skin.values())
    normals = [np.asarray(patch.normals, dtype=np.float64).mean(axis=0) for patch in patches]
    return Body(
        joints=list(data.joints),
        lower=[float(joint.lower) for joint in joints],
        upper=[float(joint.upper) for joint in joints],
        max_speed=[float(joint.velocity) for joint in joints],
        patches=[patch.name for patch in patches],
        cells=[patch.cells.stop - patch.cells.start for patch in patches],
        directions=[(n / np.linalg.norm(n)).tolist() for n in normals],
        links=[patch.link or "" for patch in patches],
        rate=float(data.fps),
    )
