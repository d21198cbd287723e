"""The HSR's skin: where its cells lie, which way they face, and how they move with the robot."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hasm_torch._assets import asset_path
from hasm_torch.robot.kinematics import Kinematics
from hasm_torch.robot.urdf import read_urdf

PATCHES = (
    "wrist_upper",
    "wrist_under",
    "wrist_left",
    "wrist_right",
    "torso_front",
    "torso_left",
    "torso_right",
    "hand",
)
"""Patches of the HSR's skin; the cells of all patches follow each other in this order."""

_TOLERANCE = 1e-5  # m; the file's numbers have six decimals


@dataclass(frozen=True, eq=False)
class SkinSurface:
    """The thin box of which a flat patch is made, in the frame of its link.

    Attributes:
        centre: (3,) centre of the box, m.
        half_size: (3,) half edge lengths along ``axes``, m.
        axes: (3, 3) unit vectors as rows: along a row of cells, across the rows, outward.
    """

    centre: Tensor
    half_size: Tensor
    axes: Tensor


@dataclass(frozen=True, eq=False)
class Skin:
    """Cells of the skin, C in all, three force points each, in the frames of their links.

    Attributes:
        patches: names of the patches, in order.
        slices: patch name to the range of its cells.
        link: patch name to the link that carries it.
        surfaces: patch name to its box; the cells lie on the box's outer face.
        positions: (C, 3) centres of the cells, m.
        normals: (C, 3) outward unit normals.
        points: (C, 3, 3) the three force points of each cell, m.
        side: side of the hexagonal cell, m.
        flat_to_flat: width of the cell across its flats, m.
    """

    patches: tuple[str, ...]
    slices: dict[str, slice]
    link: dict[str, str]
    surfaces: dict[str, SkinSurface]
    positions: Tensor
    normals: Tensor
    points: Tensor
    side: float
    flat_to_flat: float

    @property
    def cells(self) -> int:
        """Number of cells of all patches together."""
        return self.positions.shape[0]

    @classmethod
    def load(
        cls,
        path: str | Path | None = None,
        urdf: str | Path | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> "Skin":
        """Read the skin from its JSON file and check it.

        Args:
            path: file laid out as ``assets/skin.json``; the HSR's skin by default.
            urdf: robot whose links carry the patches; the HSR by default.
            dtype: type of the tensors.
            device: where they lie.

        Returns:
            The skin.

        Raises:
            ValueError: a patch name used twice, an unknown link, a cell without exactly three
                points, a normal that is not of unit length or not the surface's, a point outside
                its cell, or cells that overlap or leave the surface.
        """
        path = asset_path("skin.json") if path is None else Path(path)
        data = json.loads(path.read_text(encoding="utf-8"))
        links = read_urdf(asset_path("hsr.urdf") if urdf is None else urdf).links
        side, width = float(data["cell"]["side"]), float(data["cell"]["flat_to_flat"])
        slices: dict[str, slice] = {}
        link: dict[str, str] = {}
        surfaces: dict[str, SkinSurface] = {}
        blocks: list[Tensor] = []  # per patch (cells, 5, 3): position, normal, three points
        for patch in data["patches"]:
            name = patch["name"]
            if name in slices:
                raise ValueError(f"patch {name!r} stands twice in {path}; names must differ")
            if patch["link"] not in links:
                raise ValueError(
                    f"patch {name!r} sits on the unknown link {patch['link']!r}; "
                    f"valid links are: {', '.join(links)}"
                )
            block, surface = _cells(patch), _surface(patch)
            _check_patch(name, block, surface, side, width)
            start = sum(len(b) for b in blocks)
            slices[name] = slice(start, start + len(block))
            link[name] = patch["link"]
            surfaces[name] = SkinSurface(*(t.to(device, dtype) for t in surface))
            blocks.append(block)
        cells = torch.cat(blocks).to(device, dtype)
        return cls(
            tuple(slices),
            slices,
            link,
            surfaces,
            cells[:, 0],
            cells[:, 1],
            cells[:, 2:],
            side,
            width,
        )

    def poses(self, kinematics: Kinematics, q: Tensor) -> tuple[Tensor, Tensor]:
        """Where the cells are and which way they face.

        Args:
            kinematics: the robot.
            q: (..., J) joint positions, rad or m.

        Returns:
            Positions (..., C, 3) in m and outward unit normals (..., C, 3), in the frame of
            ``base_footprint``, of the kinematics' type and device.

        Raises:
            ValueError: the robot lacks a patch's link, or what ``Kinematics.forward`` raises.
        """
        missing = sorted(set(self.link.values()) - set(kinematics.links))
        if missing:
            raise ValueError(
                f"the robot lacks the links {', '.join(missing)} that carry skin; "
                f"its links are: {', '.join(kinematics.links)}"
            )
        poses = kinematics.forward(q)
        positions, normals = [], []
        for name in self.patches:
            pose, cells = poses[self.link[name]], self.slices[name]
            rotation, origin = pose[..., :3, :3].mT, pose[..., None, :3, 3]
            positions.append(self.positions[cells].to(pose) @ rotation + origin)
            normals.append(self.normals[cells].to(pose) @ rotation)
        return torch.cat(positions, dim=-2), torch.cat(normals, dim=-2)


def _cells(patch: dict[str, Any]) -> Tensor:
    """(cells, 5, 3) position, normal and three points of each cell of a patch."""
    for number, cell in enumerate(patch["cells"]):
        if len(cell["points"]) != 3:
            raise ValueError(
                f"cell {number} of patch {patch['name']!r} has {len(cell['points'])} force "
                "points; expected 3"
            )
    rows = [[c["position"], c["normal"], *c["points"]] for c in patch["cells"]]
    return torch.tensor(rows, dtype=torch.float64)


def _surface(patch: dict[str, Any]) -> tuple[Tensor, Tensor, Tensor]:
    """Centre, half size and axes of a patch's box."""
    box = patch["surface"]
    centre, half_size, axes = (
        torch.tensor(box[key], dtype=torch.float64) for key in ("centre", "half_size", "axes")
    )
    return centre, half_size, axes


def _check_patch(
    name: str,
    cells: Tensor,
    surface: tuple[Tensor, Tensor, Tensor],
    side: float,
    width: float,
) -> None:
    """Raise ValueError where a patch's cells contradict each other or its surface."""
    centre, half_size, axes = surface
    identity = torch.eye(3, dtype=torch.float64)
    if not torch.allclose(axes @ axes.T, identity, atol=1e-6) or torch.linalg.det(axes) < 0:
        raise ValueError(f"the axes of patch {name!r} must be orthonormal and right-handed")
    positions, normals, points = cells[:, 0], cells[:, 1], cells[:, 2:]
    lengths = normals.norm(dim=-1)
    if (lengths - 1).abs().max() > 1e-6:
        raise ValueError(
            f"normals of patch {name!r} must have length 1, got up to {lengths.max():.6f}"
        )
    if (normals - axes[2]).abs().max() > 1e-6:
        raise ValueError(f"normals of patch {name!r} must be its surface's outward axis")
    # In the surface's own axes: two along the face, the third outward.
    local = (positions - centre) @ axes.T
    if (local[:, 2] - half_size[2]).abs().max() > _TOLERANCE:
        raise ValueError(f"cells of patch {name!r} must lie on the outer face of its surface")
    if (local[:, :2].abs() + width / 2 > half_size[:2] + _TOLERANCE).any():
        raise ValueError(f"cells of patch {name!r} reach beyond its surface")
    offsets = points - positions[:, None]
    if offsets.norm(dim=-1).max() > side or (offsets @ axes[2]).abs().max() > _TOLERANCE:
        raise ValueError(
            f"force points of patch {name!r} must lie in the plane of their cell, "
            f"at most {side} m from its centre"
        )
    pitch = torch.pdist(positions)
    if len(pitch) and pitch.min() < width - _TOLERANCE:
        raise ValueError(
            f"cells of patch {name!r} overlap: {pitch.min():.6f} m from centre to centre, "
            f"at least {width} m expected"
        )
