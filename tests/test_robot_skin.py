"""The skin: its file, its geometry, and how it moves with the robot."""

import json
from pathlib import Path

import pytest
import torch

from hasm_torch._assets import asset_path
from hasm_torch.robot import JOINTS, PATCHES, Kinematics, Skin

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
    assert skin.flat_to_flat == pytest.approx(skin.side * 3**0.5, abs=1e-6)
    assert skin.side == 0.014
    for cells in skin.slices.values():
        distance = torch.cdist(skin.positions[cells], skin.positions[cells])
        distance.fill_diagonal_(float("inf"))
        nearest = distance.min(dim=1).values
        assert (nearest >= skin.flat_to_flat - 1e-6).all()
        assert (nearest <= skin.flat_to_flat + 5e-4).all()


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
    hand = hsr.pose(q, "hand_palm_link")
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
    wrist = hsr.pose(q, "wrist_roll_link")[:3, 3]
    for name, direction in expected.items():
        cells, out = skin.slices[name], torch.tensor(direction).double()
        torch.testing.assert_close(normals[cells], out.expand_as(normals[cells]), atol=1e-9, rtol=0)
        if name in WRIST:
            assert ((positions[cells] - wrist) @ out > 0.03).all()


def test_wrist_patches_are_opposite_or_perpendicular(hsr: Kinematics, skin: Skin) -> None:
    u = torch.rand(10, 8, generator=torch.Generator().manual_seed(1)).double()
    _, normals = skin.poses(hsr, hsr.lower + u * (hsr.upper - hsr.lower))
    upper, under, left, right = (normals[:, skin.slices[name]].mean(dim=1) for name in WRIST)
    torch.testing.assert_close(upper, -under)
    torch.testing.assert_close(left, -right)
    torch.testing.assert_close((upper * left).sum(-1), torch.zeros(10).double())


def test_cells_move_with_their_link(hsr: Kinematics, skin: Skin) -> None:
    """Poses equal the homogeneous product, and normals turn with the link but do not shift."""
    u = torch.rand(2, 3, 8, generator=torch.Generator().manual_seed(2)).double()
    q = hsr.lower + u * (hsr.upper - hsr.lower)
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


def test_poses_have_gradients_and_the_robots_type(hsr: Kinematics, skin: Skin) -> None:
    q = posture(arm_flex_joint=-1.0, wrist_flex_joint=-0.5).requires_grad_()
    assert torch.autograd.gradcheck(lambda q: skin.poses(hsr, q), (q,))
    single, _ = skin.poses(Kinematics(dtype=torch.float32), posture())
    assert single.dtype == torch.float32


def _edit(data: dict, change: str) -> None:
    first = data["patches"][0]
    cell = first["cells"][0]
    if change == "link":
        first["link"] = "tail_link"
    elif change == "name":
        data["patches"][1]["name"] = first["name"]
    elif change == "long normal":
        cell["normal"] = [-1.1, 0.0, 0.0]
    elif change == "other normal":
        cell["normal"] = [0.0, 0.0, 1.0]
    elif change == "two points":
        cell["points"].pop()
    elif change == "far point":
        cell["points"][0][2] += 0.02
    elif change == "deep point":
        cell["points"][0][0] += 0.001
    elif change == "overlap":
        cell["position"] = [a + b for a, b in zip(cell["position"], [0.0, -0.005, 0.0])]
        cell["points"] = [[x, y - 0.005, z] for x, y, z in cell["points"]]
    elif change == "beyond":
        cell["position"][1] += 0.05
    elif change == "sunk":
        cell["position"][0] += 0.002
    elif change == "skewed axes":
        first["surface"]["axes"][0] = [0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("link", "unknown link 'tail_link'; valid links are: .*wrist_roll_link"),
        ("name", "stands twice"),
        ("long normal", "length 1"),
        ("other normal", "outward axis"),
        ("two points", "expected 3"),
        ("far point", "force points"),
        ("deep point", "force points"),
        ("overlap", "overlap"),
        ("beyond", "reach beyond"),
        ("sunk", "outer face"),
        ("skewed axes", "orthonormal"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, change: str, message: str) -> None:
    data = json.loads(asset_path("skin.json").read_text())
    _edit(data, change)
    path = tmp_path / "skin.json"
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError, match=message):
        Skin.load(path)


def test_skin_of_another_robot_is_refused(tmp_path: Path, hsr: Kinematics) -> None:
    path = tmp_path / "tail.urdf"
    path.write_text('<robot name="r"><link name="tail"/></robot>')
    with pytest.raises(ValueError, match="valid links are: tail"):
        Skin.load(urdf=path)
