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
from postures import anywhere

from hasm_torch._assets import asset_path
from hasm_torch.robot import BASE_FRAME, JOINTS, METRES, Kinematics
from hasm_torch.robot.urdf import read_urdf

REFERENCE = json.loads((Path(__file__).parent / "data" / "hsr_fk.json").read_text())


@pytest.fixture(scope="module")
def hsr() -> Kinematics:
    return Kinematics()


@pytest.fixture(scope="module")
def springy() -> Kinematics:
    """The HSR with the springs in its fingers, which the reference moves too."""
    return Kinematics(joints=list(REFERENCE["configs"][0]["joints"]))


def random_positions(*shape: int, seed: int = 0) -> torch.Tensor:
    """(*shape, J) joint positions within the limits."""
    return torch.from_numpy(anywhere(np.random.default_rng(seed), *shape))


def posture(**positions: float) -> torch.Tensor:
    """(J,) joint positions, 0 where not named."""
    return torch.tensor([positions.get(name, 0.0) for name in JOINTS], dtype=torch.float64)


def reference_poses(config: dict) -> dict[str, torch.Tensor]:
    return {
        link: torch.tensor([*rows, 0.0, 0.0, 0.0, 1.0], dtype=torch.float64).reshape(4, 4)
        for link, rows in config["poses"].items()
    }


@pytest.mark.parametrize("config", REFERENCE["configs"], ids=lambda c: c["name"])
def test_matches_reference(springy: Kinematics, config: dict) -> None:
    """The reference's frame is that of the base, which stands at 0 there."""
    q = torch.tensor([config["joints"][name] for name in springy.joints], dtype=torch.float64)
    poses, expected = springy.forward(q), reference_poses(config)
    # float64 through and through: far below what float32 origins would leave.
    for link, pose in expected.items():
        torch.testing.assert_close(poses[link], pose, rtol=0, atol=1e-11, msg=link)
    single = Kinematics(joints=springy.joints, dtype=torch.float32).forward(q)
    for link, pose in poses.items():
        assert single[link].dtype == torch.float32
        torch.testing.assert_close(single[link].double(), pose, rtol=0, atol=2e-6)


def test_matches_mujoco_at_100_random_positions() -> None:
    spec = mujoco.MjSpec.from_file(str(asset_path("hsr.urdf")))
    assert not spec.compiler.fusestatic
    assert not spec.compiler.discardvisual
    model = spec.compile()
    data = mujoco.MjData(model)
    robot = read_urdf(asset_path("hsr.urdf"))
    rng = np.random.default_rng(0)
    moving = [j.name for j in robot.joints.values() if j.type != "fixed" and j.mimic is None]
    names = [*JOINTS, *(name for name in moving if name not in JOINTS)]
    springs = rng.uniform(0.0, 0.698, (100, len(names) - len(JOINTS)))
    samples = np.hstack([anywhere(rng, 100), springs])
    poses = Kinematics(joints=names).forward(torch.from_numpy(samples))
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
        for link in robot.links:
            body, pose = data.body(link), poses[link][row].numpy()
            worst = max(worst, np.abs(body.xpos - pose[:3, 3]).max())
            worst = max(worst, np.abs(body.xmat.reshape(3, 3) - pose[:3, :3]).max())
    assert worst < 1e-6


def test_matches_the_librarys_own_urdf_reader(hsr: Kinematics) -> None:
    """Only float32 origins and the mimic rules set the two apart."""
    text = asset_path("hsr.urdf").read_bytes()
    chain = pytorch_kinematics.build_chain_from_urdf(text).to(dtype=torch.float64)
    q = random_positions(5)
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
    rest, lifted = hsr.forward(posture()), hsr.forward(posture(arm_lift_joint=0.6))
    for link, height in (("arm_lift_link", 0.6), ("torso_lift_link", 0.3), ("head_tilt_link", 0.3)):
        assert (lifted[link] - rest[link])[2, 3].item() == pytest.approx(height, abs=1e-12)
    opened = hsr.forward(posture(hand_motor_joint=1.0))
    gap = [
        (p["hand_l_finger_tip_frame"] - p["hand_r_finger_tip_frame"])[:3, 3].norm().item()
        for p in (rest, opened)
    ]
    assert gap[0] < 0.02
    assert gap[1] > 0.1


def test_the_base_moves_all_and_is_left_out_in_its_own_frame(hsr: Kinematics) -> None:
    q = random_positions(5)
    still = q.clone()
    still[:, -3:] = 0.0
    moved, apart, rest = hsr.forward(q), hsr.forward(q, BASE_FRAME), hsr.forward(still)
    x, y, t = q[:, -3:].T
    zero, one = torch.zeros(5).double(), torch.ones(5).double()
    rows = [[t.cos(), -t.sin(), zero, x], [t.sin(), t.cos(), zero, y], [zero, zero, one, zero]]
    base = torch.stack([*(torch.stack(r, -1) for r in rows), torch.eye(4)[3].expand(5, 4)], 1)
    torch.testing.assert_close(moved[BASE_FRAME], base)
    for link in {*hsr.links} - {"odom", "odom_x_link", "odom_y_link"}:
        torch.testing.assert_close(apart[link], rest[link])
        torch.testing.assert_close(moved[link], base @ rest[link])
        torch.testing.assert_close(hsr.pose(q, link, BASE_FRAME), apart[link])


@settings(max_examples=15, deadline=None)
@given(shape=st.lists(st.integers(0, 3), max_size=3), seed=st.integers(0, 1000))
def test_any_batch_shape_equals_one_by_one(hsr: Kinematics, shape: list[int], seed: int) -> None:
    q = random_positions(*shape, seed=seed)
    poses = hsr.forward(q)
    assert set(poses) == set(hsr.links)
    palm = poses["hand_palm_link"]
    assert palm.shape == (*shape, 4, 4)
    for index in np.ndindex(*shape):
        alone = hsr.forward(q[index])["hand_palm_link"]
        torch.testing.assert_close(palm[index], alone, rtol=0, atol=1e-13)


def test_rotations_stay_rotations(hsr: Kinematics) -> None:
    for pose in hsr.forward(random_positions(20)).values():
        rotation = pose[:, :3, :3]
        eye = torch.eye(3, dtype=torch.float64).expand_as(rotation)
        torch.testing.assert_close(rotation @ rotation.mT, eye, rtol=0, atol=1e-12)
        torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(20).double())


def test_gradients_to_second_order(hsr: Kinematics) -> None:
    links = ("hand_palm_link", "head_tilt_link", "hand_l_finger_tip_frame")

    def poses(q: torch.Tensor) -> tuple[torch.Tensor, ...]:
        out = hsr.forward(q)
        return tuple(out[link] for link in links)

    q = random_positions(2).requires_grad_()
    assert torch.autograd.gradcheck(poses, (q,))
    assert torch.autograd.gradgradcheck(lambda q: hsr.pose(q, "hand_palm_link"), (q[0],))


def test_limits(hsr: Kinematics) -> None:
    assert hsr.joints == JOINTS
    free = [float("inf")] * 3
    least = [0.0, -2.62, -2.09, -1.92, -1.92, -3.84, -1.57, -0.798]
    assert hsr.lower.tolist() == [*least, *(-end for end in free)]
    assert hsr.upper.tolist() == [0.69, 0.0, 3.84, 1.22, 3.67, 1.75, 0.52, 1.24, *free]
    assert hsr.velocity.tolist() == [0.2, 1.2, 2.0, 1.5, 1.5, 1.0, 1.0, 1.0, 0.2, 0.2, 1.0]
    slide = [name for name in JOINTS if hsr.robot.joints[name].type == "prismatic"]
    assert slide == list(METRES)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_rejects_what_is_not_finite(hsr: Kinematics, bad: float) -> None:
    q = torch.zeros(2, 11)
    q[1, 3] = bad
    with pytest.raises(ValueError, match="finite"):
        hsr.forward(q)


def test_errors_name_what_is_valid(hsr: Kinematics) -> None:
    with pytest.raises(ValueError, match="wrist_roll_joint"):
        hsr.forward(torch.zeros(8))
    with pytest.raises(ValueError, match=r"lacks the moving joints elbow; it has: odom_x"):
        Kinematics(joints=["elbow"])
    with pytest.raises(ValueError, match=r"valid links are: .*hand_palm_link"):
        hsr.pose(posture(), "tail")
    with pytest.raises(ValueError, match=r"valid links are: .*hand_palm_link"):
        hsr.forward(posture(), frame="tail")
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
