"""``hasm-skin``: lay skin cells out on a robot's link.

hasm-skin --model=robot.xml --link=forearm --surface=mesh --toward='[0, 1, 0]' --out=skin.json
hasm-skin --config_path=skin.yaml
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

from hasm_torch.apps.command_line import parse_options
from hasm_torch.robot import Skin
from hasm_torch.sim.any_robot import load_robot
from hasm_torch.sim.patch import Patch
from hasm_torch.sim.skin_layout import lay_out


@dataclass
class SkinConfig(Patch):
    """Lay skin cells out on a robot and write where they lie.

    One patch is described by the options below; several stand in a YAML file as a list "patches",
    each with the same entries, beside "model" and "out": --config_path=skin.yaml.
    """

    model: Path | None = None
    """MJCF or URDF of the robot."""

    out: Path = Path("skin.json")
    """JSON to write: the cells, as simulation, datasets and models read them."""

    patches: list[Patch] = field(default_factory=list)
    """Several patches; the options of a single one are then unused."""


def lay_skin(config: SkinConfig) -> Skin:
    """Lay cells out and write them.

    Args:
        config: What to cover and where to write.

    Returns:
        The cells.

    Raises:
        FileNotFoundError: If there is no such robot.
        ValueError: If it is no robot, or what ``lay_out`` raises.
    """
    if config.model is None:
        raise ValueError("expected --model, the robot's MJCF or URDF")
    skin = lay_out(load_robot(config.model), config.patches or [config])
    skin.save(config.out)
    return skin


def table(skin: Skin) -> str:
    """Cells of each patch and where they lie, for people."""
    rows = [("patch", "link", "cells", "x, y, z of the cells in the link's frame, m")]
    for name in skin.patches:
        places = skin.positions[skin.slices[name]]
        spans = zip(places.min(0).values.tolist(), places.max(0).values.tolist())
        extent = ", ".join(f"{low:.3f} to {high:.3f}" for low, high in spans)
        rows.append((name, skin.link[name], str(len(places)), extent))
    widths = [max(map(len, column)) for column in zip(*rows)]
    lines = ("  ".join(part.ljust(w) for part, w in zip(row, widths)).rstrip() for row in rows)
    return "\n".join(lines)


def main() -> None:
    """Lay out with the options of the command line."""
    config = parse_options(SkinConfig)
    try:
        skin = lay_skin(config)
    except (OSError, ValueError) as error:
        sys.exit(f"hasm-skin: {error}")
    print(f"{table(skin)}\n{config.out}: {skin.cells} cells")


if __name__ == "__main__":
    main()
