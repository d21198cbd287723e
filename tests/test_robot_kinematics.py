"""The HSR's forward kinematics: reference values, MuJoCo, batches, gradients, errors."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
import pytorch_kinematics
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hasm_torch._assets import asset_path
from hasm_torch.robot import JOINTS, Kinematics
from hasm_torch.robot.urdf import read_urdf

REFERENCE = json.loads((Path(__file__).parent / "data" / "hsr_fk.json").read_text())


@pytest.fixture(scope="module")
def hsr() -> Kinematics:
    return Kinematics()


def random_positions(hsr: Kinematics, *shape: int, seed: int = 0) -> torch.Tensor:
    """(*shape, J) joint positions within the limits."""
    u = torch.rand(*shape, len(JOINTS), generator=torch.Generator().manual_seed(seed))
    return hsr.lower + u.to(hsr.dtype) * (hsr.upper - hsr.lower)


def reference_poses(config: dict) -> dict[str, torch.Tensor]:
    return {
        link: torch.tensor([*rows, 0.0, 0.0, 0.0, 1.0], dtype=torch.float64).reshape(4, 4)
        for link, rows in config["poses"].items()
    }


@pytest.mark.parametrize("config", REFERENCE["configs"], ids=lambda c: c["name"])
def test_matches_reference(hsr: Kinematics, config: dict) -> None:
    poses = hsr.forward_named(config["joints"])
    for link, expected in reference_poses(config).items():
        torch.testing.assert_close(poses[link], expected, rtol=0, atol=1e-6, msg=link)
    # float64 through and through: far below what float32 origins would leave.
    worst = max((poses[n] - e).abs().max() for n, e in reference_poses(config).items())
    assert worst < 1e-11


@pytest.mark.parametrize("config", REFERENCE["configs"], ids=lambda c: c["name"])
def test_joint_vector_equals_names_and_float32_is_close(hsr: Kinematics, config: dict) -> None:
    q = torch.tensor([config["joints"][name] for name in JOINTS], dtype=torch.float64)
    single = Kinematics(dtype=torch.float32).forward(q)
    for link, expected in hsr.forward_named(config["joints"]).items():
        torch.testing.assert_close(hsr.forward(q)[link], expected, rtol=0, atol=1e-14)
        assert single[link].dtype == torch.float32
        torch.testing.assert_close(single[link].double(), expected, rtol=0, atol=2e-6)


def test_matches_mujoco_at_100_random_positions(hsr: Kinematics) -> None:
    spec = mujoco.MjSpec.from_file(str(asset_path("hsr.urdf")))
    assert not spec.compiler.fusestatic
    assert not spec.compiler.discardvisual
    model = spec.compile()
    data = mujoco.MjData(model)
    robot = read_urdf(asset_path("hsr.urdf"))
    rng = np.random.default_rng(0)
    names = hsr.movable
    lower = np.array([robot.joints[n].lower for n in names])
    upper = np.array([robot.joints[n].upper for n in names])
    samples = rng.uniform(lower, upper, size=(100, len(names)))
    poses = hsr.forward_named({n: torch.from_numpy(samples[:, i]) for i, n in enumerate(names)})
    worst = 0.0
    for row, sample in enumerate(samples):
        positions = dict(zip(names, sample))
        for joint in robot.joints.values():
            if joint.mimic is not None:
                leader = positions[joint.mimic.joint]
                positions[joint.name] = joint.mimic.multiplier * leader + joint.mimic.offset
        for name, value in positions.items():
            data.qpos[model.joint(name).qposadr[0]] = value
        mujoco.mj_kinematics(model, data)
        for link in hsr.links:
            body, pose = data.body(link), poses[link][row].numpy()
            worst = max(worst, np.abs(body.xpos - pose[:3, 3]).max())
            worst = max(worst, np.abs(body.xmat.reshape(3, 3) - pose[:3, :3]).max())
    assert worst < 1e-6


def test_matches_the_librarys_own_urdf_reader(hsr: Kinematics) -> None:
    """Only float32 origins and the mimic rules set the two apart."""
    text = asset_path("hsr.urdf").read_bytes()
    chain = pytorch_kinematics.build_chain_from_urdf(text).to(dtype=torch.float64)
    q = random_positions(hsr, 5)
    positions = dict.fromkeys(chain.get_joint_parameter_names(), torch.zeros_like(q[:, 0]))
    positions |= dict(zip(JOINTS, q.T))
    for name, joint in read_urdf(asset_path("hsr.urdf")).joints.items():
        if joint.mimic is not None:
            leader = positions[joint.mimic.joint]
            positions[name] = joint.mimic.multiplier * leader + joint.mimic.offset
    theirs = chain.forward_kinematics(positions)
    for link, pose in hsr.forward(q).items():
        torch.testing.assert_close(theirs[link].get_matrix(), pose, rtol=0, atol=1e-6)


def test_torso_and_fingers_follow(hsr: Kinematics) -> None:
    rest = hsr.forward(torch.zeros(8))
    lifted = hsr.forward_named({"arm_lift_joint": 0.6})
    for link, height in (("arm_lift_link", 0.6), ("torso_lift_link", 0.3), ("head_tilt_link", 0.3)):
        assert (lifted[link] - rest[link])[2, 3].item() == pytest.approx(height, abs=1e-12)
    opened = hsr.forward_named({"hand_motor_joint": 1.0})
    gap = [
        (p["hand_l_finger_tip_frame"] - p["hand_r_finger_tip_frame"])[:3, 3].norm().item()
        for p in (rest, opened)
    ]
    assert gap[0] < 0.02
    assert gap[1] > 0.1


def test_root_is_the_base_frame(hsr: Kinematics) -> None:
    pose = hsr.forward(random_positions(hsr, 3))["base_footprint"]
    torch.testing.assert_close(pose, torch.eye(4, dtype=torch.float64).expand(3, 4, 4))


@settings(max_examples=15, deadline=None)
@given(shape=st.lists(st.integers(0, 3), max_size=3), seed=st.integers(0, 1000))
def test_any_batch_shape_equals_one_by_one(hsr: Kinematics, shape: list[int], seed: int) -> None:
    q = random_positions(hsr, *shape, seed=seed)
    poses = hsr.forward(q)
    assert set(poses) == set(hsr.links)
    palm = poses["hand_palm_link"]
    assert palm.shape == (*shape, 4, 4)
    for index in np.ndindex(*shape):
        alone = hsr.forward(q[index])["hand_palm_link"]
        torch.testing.assert_close(palm[index], alone, rtol=0, atol=1e-13)


def test_names_are_broadcast(hsr: Kinematics) -> None:
    poses = hsr.forward_named({"arm_lift_joint": torch.rand(3, 1), "arm_flex_joint": torch.rand(4)})
    assert poses["hand_palm_link"].shape == (3, 4, 4, 4)


def test_rotations_stay_rotations(hsr: Kinematics) -> None:
    for pose in hsr.forward(random_positions(hsr, 20)).values():
        rotation = pose[:, :3, :3]
        eye = torch.eye(3, dtype=torch.float64).expand_as(rotation)
        torch.testing.assert_close(rotation @ rotation.mT, eye, rtol=0, atol=1e-12)
        torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(20).double())


def test_gradients_to_second_order(hsr: Kinematics) -> None:
    links = ("hand_palm_link", "head_tilt_link", "hand_l_finger_tip_frame")

    def poses(q: torch.Tensor) -> tuple[torch.Tensor, ...]:
        out = hsr.forward(q)
        return tuple(out[link] for link in links)

    q = random_positions(hsr, 2).requires_grad_()
    assert torch.autograd.gradcheck(poses, (q,))
    assert torch.autograd.gradgradcheck(lambda q: hsr.pose(q, "hand_palm_link"), (q[0],))


def test_limits(hsr: Kinematics) -> None:
    assert hsr.joints == JOINTS
    assert hsr.lower.tolist() == [0.0, -2.62, -2.09, -1.92, -1.92, -3.84, -1.57, -0.798]
    assert hsr.upper.tolist() == [0.69, 0.0, 3.84, 1.22, 3.67, 1.75, 0.52, 1.24]
    assert hsr.velocity.tolist() == [0.2, 1.2, 2.0, 1.5, 1.5, 1.0, 1.0, 1.0]


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_rejects_what_is_not_finite(hsr: Kinematics, bad: float) -> None:
    q = torch.zeros(2, 8)
    q[1, 3] = bad
    with pytest.raises(ValueError, match="finite"):
        hsr.forward(q)
    with pytest.raises(ValueError, match="finite"):
        hsr.forward_named({"wrist_flex_joint": bad})


def test_errors_name_what_is_valid(hsr: Kinematics) -> None:
    with pytest.raises(ValueError, match="wrist_roll_joint"):
        hsr.forward(torch.zeros(7))
    with pytest.raises(ValueError, match=r"valid joints are: .*hand_l_spring_proximal_joint"):
        hsr.forward_named({"elbow": 0.0})
    with pytest.raises(ValueError, match="follows 'arm_lift_joint'"):
        hsr.forward_named({"torso_lift_joint": 0.1})
    with pytest.raises(ValueError, match=r"valid links are: .*hand_palm_link"):
        hsr.pose(torch.zeros(8), "tail")
    with pytest.raises(ValueError, match="float16"):
        Kinematics(dtype=torch.float16)
    with pytest.raises(FileNotFoundError, match=r"hsr\.urdf"):
        asset_path("hsr.xml")


ARM = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/>
<joint name="j" type="{kind}"><parent link="a"/><child link="{child}"/></joint>
<joint name="k" type="revolute"><parent link="b"/><child link="c"/>
<mimic joint="{leader}"/></joint></robot>"""


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "planar"}, "planar"),
        ({"child": "z"}, "links are: a, b, c"),
        ({"leader": "k"}, "moves by itself; those are: j"),
        ({"kind": "fixed", "leader": "j"}, "moves by itself"),
        ({"child": "c"}, "one root link"),
        ({}, "lacks the joints arm_lift_joint"),
    ],
)
def test_rejects_other_urdfs(tmp_path: Path, changes: dict[str, str], message: str) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(ARM.format(**{"kind": "continuous", "child": "b", "leader": "j"} | changes))
    with pytest.raises(ValueError, match=message):
        Kinematics(path)


def test_urdf_is_sound_for_simulation() -> None:
    """Every moving link has mass and a possible inertia; every shape is a primitive."""
    text = asset_path("hsr.urdf").read_text()
    assert "mesh" not in text.split("-->", 1)[1]
    model = mujoco.MjSpec.from_string(text).compile()
    for body in range(1, model.nbody):
        inertia = np.sort(model.body_inertia[body])
        if model.body_dofnum[body]:
            assert model.body_mass[body] > 0
            assert inertia[0] > 0
        assert inertia[2] <= inertia[0] + inertia[1] + 1e-12
    assert 30 < model.body_mass.sum() < 40  # published: about 37 kg
