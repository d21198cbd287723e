"""The skin: its file, its geometry, and how it moves with the robot."""

import numpy as np
import pytest
import torch
from postures import anywhere

from hasm_torch.robot import JOINTS, PATCHES, Kinematics, Skin

SIDE, WIDTH = 0.014, 0.014 * 3**0.5  # m, of a hexagonal cell, the latter across its flats
WRIST = ("wrist_upper", "wrist_under", "wrist_left", "wrist_right")


@pytest.fixture(scope="module")
def hsr() -> Kinematics:
    return Kinematics()


@pytest.fixture(scope="module")
def skin() -> Skin:
    return Skin.load()


def posture(**positions: float) -> torch.Tensor:
    """(J,) joint positions, 0 where not named."""
    return torch.tensor([positions.get(name, 0.0) for name in JOINTS], dtype=torch.float64)


def test_patches_follow_each_other(skin: Skin) -> None:
    assert skin.patches == PATCHES
    indices = [i for name in skin.patches for i in range(skin.cells)[skin.slices[name]]]
    assert indices == list(range(skin.cells))
    assert skin.positions.shape == skin.normals.shape == (skin.cells, 3)
    assert skin.points.shape == (skin.cells, 3, 3)
    assert {skin.link[name] for name in WRIST} == {"wrist_roll_link"}


def test_neighbouring_cells_are_one_width_apart(skin: Skin) -> None:
    """Hexagons touch without overlapping: the pitch is the flat-to-flat width or a little more."""
    for cells in skin.slices.values():
        distance = torch.cdist(skin.positions[cells], skin.positions[cells])
        distance.fill_diagonal_(float("inf"))
        nearest = distance.min(dim=1).values
        assert (nearest >= WIDTH - 1e-6).all()
        assert (nearest <= WIDTH + 5e-4).all()


def test_points_form_one_even_grid(skin: Skin) -> None:
    """A cell's points are centred, and as far from the next cell's as from each other."""
    torch.testing.assert_close(skin.points.mean(dim=1), skin.positions, rtol=0, atol=1e-6)
    for cells in skin.slices.values():
        points = skin.points[cells].reshape(-1, 3)
        distance = torch.cdist(points, points).fill_diagonal_(float("inf"))
        torch.testing.assert_close(
            distance.min(dim=1).values,
            torch.full((len(points),), 0.0245 / 3**0.5).double(),
            rtol=0,
            atol=2e-5,
        )


@pytest.mark.parametrize(
    "q",
    [posture(arm_flex_joint=-torch.pi / 2), posture(wrist_flex_joint=-torch.pi / 2)],
    ids=["arm forward", "arm up, hand forward"],
)
def test_wrist_patches_face_where_their_names_say(
    hsr: Kinematics, skin: Skin, q: torch.Tensor
) -> None:
    positions, normals = skin.poses(hsr, q)
    hand = hsr.forward(q)["hand_palm_link"]
    torch.testing.assert_close(
        hand[:3, 2], torch.tensor([1.0, 0.0, 0.0]).double(), atol=1e-9, rtol=0
    )
    expected = {
        "wrist_upper": (0.0, 0.0, 1.0),
        "wrist_under": (0.0, 0.0, -1.0),
        "wrist_left": (0.0, 1.0, 0.0),
        "wrist_right": (0.0, -1.0, 0.0),
        "torso_front": (1.0, 0.0, 0.0),
        "torso_left": (0.0, 1.0, 0.0),
        "torso_right": (0.0, -1.0, 0.0),
        "hand": (0.0, 0.0, 1.0),
    }
    wrist = hsr.forward(q)["wrist_roll_link"][:3, 3]
    for name, direction in expected.items():
        cells, out = skin.slices[name], torch.tensor(direction).double()
        torch.testing.assert_close(normals[cells], out.expand_as(normals[cells]), atol=1e-9, rtol=0)
        if name in WRIST:
            assert ((positions[cells] - wrist) @ out > 0.03).all()


def test_wrist_patches_are_opposite_or_perpendicular(hsr: Kinematics, skin: Skin) -> None:
    q = torch.from_numpy(anywhere(np.random.default_rng(1), 10))
    _, normals = skin.poses(hsr, q)
    upper, under, left, right = (normals[:, skin.slices[name]].mean(dim=1) for name in WRIST)
    torch.testing.assert_close(upper, -under)
    torch.testing.assert_close(left, -right)
    torch.testing.assert_close((upper * left).sum(-1), torch.zeros(10).double())


def test_cells_move_with_their_link(hsr: Kinematics, skin: Skin) -> None:
    """Poses equal the homogeneous product, and normals turn with the link but do not shift."""
    q = torch.from_numpy(anywhere(np.random.default_rng(2), 2, 3))
    positions, normals = skin.poses(hsr, q)
    assert positions.shape == normals.shape == (2, 3, skin.cells, 3)
    poses = hsr.forward(q)
    for name in PATCHES:
        for cell in range(skin.cells)[skin.slices[name]]:
            pose = poses[skin.link[name]]
            point = torch.cat([skin.positions[cell], torch.ones(1).double()])
            arrow = torch.cat([skin.normals[cell], torch.zeros(1).double()])
            torch.testing.assert_close(positions[:, :, cell], (pose @ point)[..., :3])
            torch.testing.assert_close(normals[:, :, cell], (pose @ arrow)[..., :3])
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(2, 3, skin.cells).double())


def test_wrist_roll_turns_the_wrist_alone(hsr: Kinematics, skin: Skin) -> None:
    _, before = skin.poses(hsr, posture(arm_flex_joint=-torch.pi / 2))
    _, after = skin.poses(hsr, posture(arm_flex_joint=-torch.pi / 2, wrist_roll_joint=torch.pi / 2))
    upper, left = skin.slices["wrist_upper"], skin.slices["wrist_left"]
    torch.testing.assert_close(after[left], before[upper], atol=1e-9, rtol=0)
    torso = skin.slices["torso_front"]
    torch.testing.assert_close(after[torso], before[torso])


def test_torso_skin_rises_with_the_torso(hsr: Kinematics, skin: Skin) -> None:
    low, _ = skin.poses(hsr, posture())
    high, _ = skin.poses(hsr, posture(arm_lift_joint=0.4))
    cells = slice(skin.slices["torso_front"].start, skin.slices["torso_right"].stop)
    rise = torch.tensor([0.0, 0.0, 0.2]).double().expand(21, 3)
    torch.testing.assert_close(high[cells] - low[cells], rise)


def test_poses_have_gradients(hsr: Kinematics, skin: Skin) -> None:
    q = posture(arm_flex_joint=-1.0, wrist_flex_joint=-0.5).requires_grad_()
    assert torch.autograd.gradcheck(lambda q: skin.poses(hsr, q), (q,))


def test_the_file_is_sound(hsr: Kinematics, skin: Skin) -> None:
    """Cells lie on the outer face of their patch's box, points in the plane of their cell."""
    assert set(skin.link.values()) <= set(hsr.robot.links)
    for name, cells in skin.slices.items():
        box = skin.surfaces[name]
        eye = torch.eye(3).double()
        torch.testing.assert_close(box.axes @ box.axes.T, eye, rtol=0, atol=1e-9)
        assert torch.linalg.det(box.axes) > 0
        normals = skin.normals[cells]
        torch.testing.assert_close(normals, box.axes[2].expand_as(normals), rtol=0, atol=1e-9)
        local = (skin.positions[cells] - box.centre) @ box.axes.T
        assert ((local[:, 2] - box.half_size[2]).abs() < 1e-5).all()
        assert (local[:, :2].abs() + WIDTH / 2 < box.half_size[:2] + 1e-5).all()
        offsets = skin.points[cells] - skin.positions[cells, None]
        assert offsets.norm(dim=-1).max() < SIDE
        assert ((offsets @ box.axes[2]).abs() < 1e-5).all()
