"""Forward kinematics of the HSR, batched and differentiable, on pytorch-kinematics."""

from collections.abc import Sequence
from pathlib import Path

import torch
from pytorch_kinematics import Transform3d
from pytorch_kinematics.chain import Chain
from pytorch_kinematics.frame import Frame, Joint, Link
from torch import Tensor

from hasm_torch._assets import asset_path
from hasm_torch.robot.urdf import Urdf, read_urdf

JOINTS = (
    "arm_lift_joint",
    "arm_flex_joint",
    "arm_roll_joint",
    "wrist_flex_joint",
    "wrist_roll_joint",
    "head_pan_joint",
    "head_tilt_joint",
    "hand_motor_joint",
    "odom_x",
    "odom_y",
    "odom_t",
)
"""State and action of the HSR, in this order everywhere; rad, but m for `METRES`."""

METRES = ("arm_lift_joint", "odom_x", "odom_y")
"""Those of `JOINTS` that slide."""

BASE_FRAME = "base_footprint"
"""Link on the floor that the mobile base carries; the root is ``odom``, where it starts."""


class Kinematics:
    """Poses of a robot's links for given joint positions.

    Joints that follow another (torso and fingers) are set by their mimic rule, unless they are
    among ``joints``. All that is neither given nor following stands at 0.

    Attributes:
        joints: names of the J joints of ``forward``, in order.
        robot: the links and joints of the URDF.
        chain: the tree that pytorch-kinematics built.
        links: names of all links.
        lower: (J,) lower limits, rad or m; minus infinity where there is none.
        upper: (J,) upper limits, rad or m; infinity where there is none.
        velocity: (J,) highest speeds, rad/s or m/s.
        dtype: type of all results.
        device: where they are computed.
    """

    def __init__(
        self,
        urdf: str | Path | None = None,
        joints: Sequence[str] | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        """Build the chain.

        Args:
            urdf: URDF file; the HSR of this package by default.
            joints: joints to give to ``forward``; by default ``JOINTS`` for the HSR, and for
                another URDF all that move and follow no other.
            dtype: ``torch.float64`` or ``torch.float32``.
            device: where to compute.

        Raises:
            ValueError: another dtype, or a URDF in which one of ``joints`` does not move.
        """
        if dtype not in (torch.float64, torch.float32):
            raise ValueError(f"expected dtype torch.float64 or torch.float32, got {dtype}")
        self.robot = read_urdf(asset_path("hsr.urdf") if urdf is None else urdf)
        moving = [j.name for j in self.robot.joints.values() if j.type != "fixed"]
        if joints is None:
            leaders = [name for name in moving if self.robot.joints[name].mimic is None]
            joints = JOINTS if urdf is None else leaders
        missing = [name for name in joints if name not in moving]
        if missing:
            raise ValueError(
                f"the URDF lacks the moving joints {', '.join(missing)}; "
                f"it has: {', '.join(moving)}"
            )
        self.joints = tuple(joints)
        self.links = self.robot.links
        self.dtype, self.device = dtype, torch.device(device)
        self.chain = _build_chain(self.robot).to(dtype=dtype, device=self.device)
        mix, offset = _mimic_map(self.robot, self.chain.get_joint_parameter_names(), self.joints)
        self._mix, self._offset = mix.to(self.device, dtype), offset.to(self.device, dtype)
        given = [self.robot.joints[name] for name in self.joints]
        self.lower, self.upper, self.velocity = (
            torch.tensor(values, dtype=dtype, device=self.device)
            for values in (
                [joint.lower for joint in given],
                [joint.upper for joint in given],
                [joint.velocity for joint in given],
            )
        )

    def forward(self, q: Tensor, frame: str | None = None) -> dict[str, Tensor]:
        """Pose of every link.

        Args:
            q: (..., J) positions of ``joints``, rad or m; positions beyond the limits are allowed.
            frame: link in whose frame the poses are, such as ``BASE_FRAME``; the root by default
                (the HSR's ``odom``).

        Returns:
            Link name to (..., 4, 4) homogeneous pose, m.

        Raises:
            ValueError: the last dimension is not J, a position is not finite, or an unknown frame.
        """
        q = torch.as_tensor(q, dtype=self.dtype, device=self.device)
        if q.ndim == 0 or q.shape[-1] != len(self.joints):
            raise ValueError(
                f"expected joint positions of shape (..., {len(self.joints)}), "
                f"got {tuple(q.shape)}; the joints are: {', '.join(self.joints)}"
            )
        if not torch.isfinite(q).all():
            raise ValueError("joint positions must be finite, got NaN or infinity")
        batch = q.shape[:-1]
        positions = q.reshape(-1, len(self.joints)) @ self._mix + self._offset
        # Plain autograd: the library's own backward is right for first derivatives only.
        poses = self.chain.forward_kinematics_tensor(positions, analytical_grad=False)
        if frame is not None:
            poses = _inverse(poses[self.chain.frame_to_idx[self._known(frame)]]) @ poses
        return {
            self.chain.idx_to_frame[i]: pose.reshape(*batch, 4, 4) for i, pose in enumerate(poses)
        }

    def pose(self, q: Tensor, link: str, frame: str | None = None) -> Tensor:
        """Pose of one link.

        Args:
            q: (..., J) positions of ``joints``, rad or m.
            link: a name of ``links``.
            frame: link in whose frame the pose is; the root by default.

        Returns:
            (..., 4, 4) homogeneous pose, m.

        Raises:
            ValueError: an unknown link, or what ``forward`` raises.
        """
        return self.forward(q, frame)[self._known(link)]

    def _known(self, link: str) -> str:
        if link not in self.links:
            raise ValueError(f"unknown link {link!r}; valid links are: {', '.join(self.links)}")
        return link


def _inverse(pose: Tensor) -> Tensor:
    """Inverse of (..., 4, 4) homogeneous poses."""
    turned = pose[..., :3, :3].mT
    rows = torch.cat([turned, -turned @ pose[..., :3, 3:]], dim=-1)
    return torch.cat([rows, pose[..., 3:, :]], dim=-2)


def _build_chain(robot: Urdf) -> Chain:
    """The tree in the library's own frames, float64.

    The library's URDF reader would round every origin to float32 and drop the mimic rules, so the
    frames are filled here.
    """
    frames = {link: Frame(link, link=Link(link)) for link in robot.links}
    for joint in robot.joints.values():
        frame = frames[joint.child]
        frame.joint = Joint(
            joint.name,
            offset=Transform3d(matrix=joint.origin, dtype=torch.float64),
            joint_type=joint.type,
            axis=joint.axis,
            dtype=torch.float64,
        )
        frames[joint.parent].add_child(frame)
    return Chain(frames[robot.root], dtype=torch.float64)


def _mimic_map(robot: Urdf, names: Sequence[str], joints: tuple[str, ...]) -> tuple[Tensor, Tensor]:
    """Affine map from the joints that are given to all joints of the chain.

    Args:
        robot: the robot.
        names: the chain's joints.
        joints: joints that are given.

    Returns:
        (joints, names) matrix and (names,) offset: ``positions = q @ matrix + offset``.
    """
    mix = torch.zeros(len(joints), len(names), dtype=torch.float64)
    offset = torch.zeros(len(names), dtype=torch.float64)
    for column, name in enumerate(names):
        leader, multiplier, offset[column] = robot.rule(name, joints)
        if leader is not None:
            mix[joints.index(leader), column] = multiplier
    return mix, offset
