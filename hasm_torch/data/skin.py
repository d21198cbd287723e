"""The skin's geometry in a dataset: patches of cells, kept in the tactile feature's ``info``."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from hasm_torch.robot import Skin

UNKNOWN_UNIT = "unknown"
FORCE_CHANNELS = (1, 3, 6)
_GEOMETRY = {"positions": (3,), "normals": (3,), "points": (3, 3)}  # shape of one cell's entry
_WRENCH_NAMES = ({"fx", "fy", "fz", "tx", "ty", "tz"}, {"fx", "fy", "fz", "mx", "my", "mz"})


@dataclass(frozen=True, eq=False)
class SkinPatch:
    """A patch of skin: consecutive cells on one link.

    Attributes:
        name: Name of the patch.
        cells: Which cells of the tactile array ``(T, cells, channels)`` are its own.
        link: Link that carries it, or None where the dataset does not say.
        positions: ``(cells, 3)`` centres in the link's frame, m, or None.
        normals: ``(cells, 3)`` outward unit normals in the link's frame, or None.
        points: ``(cells, 3, 3)`` the force points of each cell in the link's frame, m, or None.
        unit: Unit of its readings.
        channels: Readings a cell: 3 forces, 1 pressure or a wrench of 6.
    """

    name: str
    cells: slice
    link: str | None = None
    positions: np.ndarray | None = None
    normals: np.ndarray | None = None
    points: np.ndarray | None = None
    unit: str = "N"
    channels: int = 3


def skin_patches(skin: "Skin") -> dict[str, SkinPatch]:
    """The patches of a robot's skin, as ``write_episodes`` takes them.

    Args:
        skin: Skin of the robot, normal forces in N at three points a cell.

    Returns:
        The patches by name, in the skin's order.
    """
    positions, normals, points = (
        np.asarray(a, dtype=np.float64) for a in (skin.positions, skin.normals, skin.points)
    )
    patches = {}
    for name in skin.patches:
        cells = skin.slices[name]
        geometry = (positions[cells], normals[cells], points[cells])
        patches[name] = SkinPatch(name, cells, skin.link[name], *geometry)
    return patches


def skin_to_info(skin: Mapping[str, SkinPatch], cells: int, channels: int) -> dict[str, Any]:
    """The ``info`` of a tactile feature, JSON-ready.

    Args:
        skin: Patches by name; together they cover every cell once, in order.
        cells: Cells of the whole skin.
        channels: Readings a cell.

    Raises:
        ValueError: A cell has no patch or two, the units differ, or a geometry has a wrong shape.
    """
    stop = 0
    for name, patch in skin.items():
        if patch.name != name or patch.cells.start != stop or patch.cells.stop <= stop:
            raise ValueError(
                f"Expected patch {name!r} to start at cell {stop} and hold at least one cell, "
                f"got name {patch.name!r} and {patch.cells}. List the patches in cell order."
            )
        stop = patch.cells.stop
    if stop != cells:
        raise ValueError(f"Expected patches covering {cells} cells, got {stop} cells: {list(skin)}")
    units = {patch.unit for patch in skin.values()}
    if len(units) != 1:
        raise ValueError(f"Expected one unit for the whole skin, got {sorted(units)}")
    return {
        "unit": units.pop(),
        "layout": [cells, channels],
        "patches": [_patch_to_info(patch) for patch in skin.values()],
    }


def _patch_to_info(patch: SkinPatch) -> dict[str, Any]:
    count = patch.cells.stop - patch.cells.start
    span = {"start": patch.cells.start, "stop": patch.cells.stop}
    info: dict[str, Any] = {"name": patch.name, **span}
    if patch.link is not None:
        info["link"] = patch.link
    for key, shape in _GEOMETRY.items():
        value = getattr(patch, key)
        if value is None:
            continue
        if np.shape(value) != (count, *shape):
            raise ValueError(
                f"Expected {key} of patch {patch.name!r} of shape {(count, *shape)}, "
                f"got {np.shape(value)}."
            )
        info[key] = np.asarray(value, dtype=np.float64).tolist()
    return info


def skin_from_info(
    feature: Mapping[str, Any], cells: int, channels: int, key: str
) -> dict[str, SkinPatch]:
    """The patches that a tactile feature's ``info`` describes.

    ``info["patches"]`` may hold patch descriptions (name, start, stop and, where known, link,
    positions, normals, points), or names alone, which then share the cells equally. Without it the
    whole skin is one patch called ``skin``.

    Args:
        feature: The feature's entry in ``meta/info.json``.
        cells: Cells of the whole skin.
        channels: Readings a cell.
        key: Name of the feature, for error messages.

    Raises:
        ValueError: The description does not fit the number of cells.
    """
    info = feature.get("info") or {}
    unit = info.get("unit", UNKNOWN_UNIT)
    described = info.get("patches") or [{"name": "skin", "start": 0, "stop": cells}]
    if all(isinstance(patch, str) for patch in described):
        share, rest = divmod(cells, len(described))
        if rest:
            raise ValueError(
                f"{key!r}: {cells} cells cannot be shared equally by the {len(described)} patches "
                f"{described}. Give each patch 'start' and 'stop' in the feature's info."
            )
        described = [
            {"name": name, "start": i * share, "stop": (i + 1) * share}
            for i, name in enumerate(described)
        ]
    skin = {}
    for entry in described:
        try:
            span = slice(int(entry["start"]), int(entry["stop"]))
            geometry = {
                name: np.asarray(entry[name], dtype=np.float64).reshape(
                    span.stop - span.start, *shape
                )
                for name, shape in _GEOMETRY.items()
                if entry.get(name) is not None
            }
            name = entry["name"]
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{key!r}: expected each patch in the feature's info to give name, start, stop and "
                f"geometry of as many cells, got {str(entry)[:200]} ({error})."
            ) from error
        if name in skin or not 0 <= span.start < span.stop <= cells:
            raise ValueError(
                f"{key!r}: patch {name!r} has cells {span.start} to {span.stop}; expected a name "
                f"of its own and cells within 0 to {cells}."
            )
        skin[name] = SkinPatch(
            name, span, entry.get("link"), unit=unit, channels=channels, **geometry
        )
    return skin


def tactile_layout(feature: Mapping[str, Any], key: str) -> tuple[int, int]:
    """Cells and readings a cell of a tactile feature.

    A cell has one reading (pressure), three (forces) or six (a wrench). ``info["layout"]`` decides;
    without it six entries named as a wrench are one, a feature of several dimensions ends in its
    channels where that dimension is 1, 3 or 6, and a flat feature holds pressures.

    Args:
        feature: The feature's entry in ``meta/info.json``.
        key: Name of the feature, for error messages.

    Returns:
        ``(cells, channels)``.

    Raises:
        ValueError: The layout does not fit the feature's shape.
    """
    shape = tuple(feature["shape"])
    layout = (feature.get("info") or {}).get("layout")
    if layout is not None:
        if prod(layout) != prod(shape) or layout[-1] not in FORCE_CHANNELS:
            raise ValueError(
                f"{key!r}: expected a layout with {prod(shape)} entries that ends in 1 (pressure), "
                f"3 (forces) or 6 (wrench), got {layout} in the feature's info."
            )
        channels = layout[-1]
    elif {name.lower() for name in feature_names(feature)} in _WRENCH_NAMES:
        channels = 6
    elif len(shape) > 1 and shape[-1] in FORCE_CHANNELS:
        channels = shape[-1]
    else:
        channels = 1
    return prod(shape) // channels, channels


def held(readings: np.ndarray) -> np.ndarray:
    """Readings (T, entries) where NaN, of a cell that did not report, is its last one, at first 0.

    Args:
        readings: As recorded.
    """
    rows = np.arange(len(readings))[:, None]
    known = np.maximum.accumulate(np.where(np.isnan(readings), -1, rows), axis=0)
    filled = np.take_along_axis(readings, known.clip(min=0), axis=0)
    return np.where(known < 0, np.float32(0.0), filled)


def feature_names(feature: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of a feature's entries; empty where the dataset names none.

    Datasets write them flat, nested in one list, or under a heading such as ``{"motors": [...]}``.
    """
    names = feature.get("names")
    while isinstance(names, Mapping) or (names and isinstance(names[0], list)):
        nested = list(names.values()) if isinstance(names, Mapping) else names
        if len(nested) != 1 or not isinstance(nested[0], list):
            return ()
        names = nested[0]
    return tuple(str(name) for name in names or ())


def same_skin(
    first: Mapping[str, SkinPatch] | None, second: Mapping[str, SkinPatch] | None
) -> bool:
    """Whether two datasets describe the same skin."""
    return _described(first) == _described(second)


def _described(skin: Mapping[str, SkinPatch] | None) -> dict[str, Any] | None:
    if not skin:
        return None
    patches = list(skin.values())
    return skin_to_info(skin, max(patch.cells.stop for patch in patches), patches[0].channels)
