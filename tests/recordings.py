"""Small datasets of every kind, on which an elbow yields to touch as nobody's robot does."""

from pathlib import Path

import numpy as np
import torch

from hasm_torch.data import Episode, SkinPatch, write_episodes

FPS = 50
JOINTS = ("elbow", "wrist", "slide")
UNITS = ("rad", "rad", "m")
KINDS = ("forces", "pressures", "wrench", "none", "bound")
PLACE = "observation.place"
SIDES = ("fore", "back")  # touch on the first bends the elbow, on the second stretches it
REACHES = (0.6, 0.9, 1.2, 1.5)  # rad, how far episodes bend the elbow


def skin_of(kind: str) -> dict[str, SkinPatch] | None:
    if kind == "none":
        return None
    if kind == "wrench":
        return {"palm": SkinPatch("palm", slice(0, 1), unit="N", channels=6)}
    channels, unit = (1, "kPa") if kind == "pressures" else (3, "N")
    faces = {"fore": [0.0, 0.0, 1.0], "back": [0.0, 0.0, -1.0]}
    return {
        name: SkinPatch(
            name,
            slice(2 * i, 2 * i + 2),
            normals=np.tile(face, (2, 1)),
            unit=unit,
            channels=channels,
        )
        for i, (name, face) in enumerate(faces.items())
    }


def touch(kind: str, side: str, force: float = 6.0) -> np.ndarray | None:
    """One reading of the skin, (cells, channels)."""
    if kind == "none":
        return None
    if kind == "wrench":
        skin = np.zeros((1, 6), np.float32)
        skin[0, 2] = -force if side == "fore" else force
        return skin
    skin = np.zeros((4, 1 if kind == "pressures" else 3), np.float32)
    skin[2 * SIDES.index(side)] = force / skin.shape[1]
    return skin


def episodes(kind: str) -> list[Episode]:
    """Two an elbow reach, one bending and one stretching, from 0 or back to it."""
    made = []
    for reach in REACHES:
        for side in SIDES if kind not in ("none", "bound") else SIDES[:1]:
            way = np.r_[np.zeros(10), np.linspace(0.0, reach, 60), np.full(10, reach)]
            elbow = way if side == "fore" else reach - way
            state = np.stack([elbow, np.full(80, 0.2), np.full(80, 0.1)], axis=1)
            skin = touch(kind, side)
            tactile = None
            if skin is not None:
                tactile = np.zeros((80, *skin.shape), np.float32)
                tactile[10:70] = skin
            made.append(
                Episode(
                    index=len(made),
                    task=f"touch the {side}",
                    time=np.arange(80) / FPS,
                    state=state.astype(np.float32),
                    action=state.astype(np.float32),
                    tactile=tactile,
                    observations=np.full((80, 2), [reach, 1.0], np.float32)
                    if kind == "bound"
                    else None,
                )
            )
    return made


def write(kind: str, root: Path) -> Path:
    """A dataset of a kind: three forces, one pressure, a wrench, no touch, or one thing more."""
    return write_episodes(
        root,
        episodes(kind),
        joints=JOINTS,
        units=UNITS,
        skin=skin_of(kind),
        fps=FPS,
        robot_type="made",
        observations={PLACE: {"reach": "rad", "one": "1"}} if kind == "bound" else None,
    )


def write_all(place: Path) -> dict[str, Path]:
    """A dataset of every kind."""
    return {kind: write(kind, place / kind) for kind in KINDS}


def assert_same(first: torch.nn.Module, second: torch.nn.Module) -> None:
    """Two modules hold the same, bit for bit."""
    mine, theirs = first.state_dict(), second.state_dict()
    assert mine.keys() == theirs.keys()
    for name, values in mine.items():
        assert torch.equal(values, theirs[name]), name
