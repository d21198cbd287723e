"""A robot's skin: where its cells lie, which way they face, and how they move with the robot."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hasm_torch._assets import asset_path
from hasm_torch.robot.kinematics import Kinematics

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

ABOUT = (
    "Skin cells of a robot. Lengths in m, in the frame of each patch's link. 'points' are the three"
    " normal-force sensors of a cell. 'surface', of a flat patch, is the thin box it is made of:"
    " its axes are unit vectors (rows: along a row of cells, across the rows, outward), half_size"
    " runs along them, and the cells lie on its outer face."
)


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
        surfaces: flat patch's name to its box; the cells lie on the box's outer face.
        positions: (C, 3) centres of the cells, m.
        normals: (C, 3) outward unit normals.
        points: (C, 3, 3) the three force points of each cell, m.
    """

    patches: tuple[str, ...]
    slices: dict[str, slice]
    link: dict[str, str]
    surfaces: dict[str, SkinSurface]
    positions: Tensor
    normals: Tensor
    points: Tensor

    @property
    def cells(self) -> int:
        """Number of cells of all patches together."""
        return self.positions.shape[0]

    @classmethod
    def load(cls, path: Path | None = None) -> "Skin":
        """A skin from its file, float64.

        Args:
            path: what ``save`` or ``hasm-skin`` wrote; by default the HSR's ``assets/skin.json``.

        Raises:
            FileNotFoundError: no such file.
            ValueError: the file holds no skin.
        """
        file = asset_path("skin.json") if path is None else path
        try:
            return cls._of(json.loads(file.read_text(encoding="utf-8"))["patches"])
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{file} holds no skin: expected patches with name, link and cells of position, "
                f"normal and three points ({type(error).__name__}: {error})"
            ) from error

    @classmethod
    def _of(cls, patches: list[dict[str, Any]]) -> "Skin":
        slices, start = {}, 0
        for patch in patches:
            slices[patch["name"]] = slice(start, start + len(patch["cells"]))
            start = slices[patch["name"]].stop
        surfaces = {
            patch["name"]: SkinSurface(
                *(
                    torch.tensor(patch["surface"][part], dtype=torch.float64)
                    for part in ("centre", "half_size", "axes")
                )
            )
            for patch in patches
            if "surface" in patch
        }
        positions, normals, points = (
            torch.tensor(
                [cell[part] for patch in patches for cell in patch["cells"]], dtype=torch.float64
            )
            for part in ("position", "normal", "points")
        )
        link = {patch["name"]: patch["link"] for patch in patches}
        return cls(tuple(slices), slices, link, surfaces, positions, normals, points)

    def save(self, path: Path) -> None:
        """Write the skin as ``load`` reads it.

        Args:
            path: JSON to write; an existing one is replaced.
        """
        patches = []
        for name in self.patches:
            span = self.slices[name]
            parts = (self.positions[span], self.normals[span], self.points[span])
            cells = [
                {"position": position, "normal": normal, "points": points}
                for position, normal, points in zip(*(part.tolist() for part in parts))
            ]
            patch: dict[str, Any] = {"name": name, "link": self.link[name]}
            if box := self.surfaces.get(name):
                patch["surface"] = {
                    part: getattr(box, part).tolist() for part in ("centre", "half_size", "axes")
                }
            patches.append(patch | {"cells": cells})
        text = json.dumps({"about": ABOUT, "patches": patches}, indent=1)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="utf-8")

    def poses(self, kinematics: Kinematics, q: Tensor) -> tuple[Tensor, Tensor]:
        """Where the cells are and which way they face.

        Args:
            kinematics: the robot.
            q: (..., J) joint positions, rad or m.

        Returns:
            Positions (..., C, 3) in m and outward unit normals (..., C, 3), in the frame
            ``odom``, of the kinematics' type and device.

        Raises:
            ValueError: what ``Kinematics.forward`` raises.
        """
        poses = kinematics.forward(q)
        positions, normals = [], []
        for name in self.patches:
            pose, cells = poses[self.link[name]], self.slices[name]
            rotation, origin = pose[..., :3, :3].mT, pose[..., None, :3, 3]
            positions.append(self.positions[cells].to(pose) @ rotation + origin)
            normals.append(self.normals[cells].to(pose) @ rotation)
        return torch.cat(positions, dim=-2), torch.cat(normals, dim=-2)
