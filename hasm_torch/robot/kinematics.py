"""Forward kinematics of the HSR, batched and differentiable, on pytorch-kinematics."""

from collections.abc import Mapping, Sequence
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
)
"""State and action of the HSR, in this order everywhere; rad, ``arm_lift_joint`` in m."""


class Kinematics:
    """Poses of the robot's links for given joint positions.

    Joints that follow another (torso and fingers) are set by their mimic rule and are never given.

    Attributes:
        joints: names of the J = 8 joints of ``forward``, in order (``JOINTS``).
        movable: names of all joints that move by themselves: ``joints`` and the finger springs.
        links: names of all links.
        lower: (J,) lower limits, rad or m.
        upper: (J,) upper limits, rad or m.
        velocity: (J,) highest speeds, rad/s or m/s.
        dtype: type of all results.
        device: where they are computed.
    """

    def __init__(
        self,
        urdf: str | Path | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        """Build the chain.

        Args:
            urdf: URDF file that has the joints of ``JOINTS``; the HSR of this package by default.
            dtype: ``torch.float64`` or ``torch.float32``.
            device: where to compute.

        Raises:
            ValueError: another dtype, or a URDF that lacks one of ``JOINTS``.
        """
        if dtype not in (torch.float64, torch.float32):
            raise ValueError(f"expected dtype torch.float64 or torch.float32, got {dtype}")
        robot = read_urdf(asset_path("hsr.urdf") if urdf is None else urdf)
        moving = [j for j in robot.joints.values() if j.type != "fixed"]
        self.movable = tuple(j.name for j in moving if j.mimic is None)
        missing = [name for name in JOINTS if name not in self.movable]
        if missing:
            raise ValueError(
                f"the URDF lacks the joints {', '.join(missing)}; "
                f"joints that move by themselves are: {', '.join(self.movable)}"
            )
        self.joints = JOINTS
        self.links = robot.links
        self.dtype = dtype
        self.device = torch.device(device)
        self._chain = _build_chain(robot).to(dtype=dtype, device=self.device)
        self._followers = {j.name: j.mimic for j in moving if j.mimic is not None}
        mix, offset = _mimic_map(robot, self._chain.get_joint_parameter_names(), self.movable)
        self._offset = offset.to(self.device, dtype)
        self._mix_movable = mix.to(self.device, dtype)
        self._mix_joints = self._mix_movable[[self.movable.index(name) for name in JOINTS]]
        self.lower, self.upper, self.velocity = (
            torch.tensor(values, dtype=dtype, device=self.device)
            for values in zip(
                *(
                    (robot.joints[n].lower, robot.joints[n].upper, robot.joints[n].velocity)
                    for n in JOINTS
                )
            )
        )

    def forward(self, q: Tensor) -> dict[str, Tensor]:
        """Pose of every link, the finger springs at rest.

        Args:
            q: (..., J) positions of ``joints``, rad or m; positions beyond the limits are allowed.

        Returns:
            Link name to (..., 4, 4) homogeneous pose in the frame of ``base_footprint``, m.

        Raises:
            ValueError: the last dimension is not J, or a position is not finite.
        """
        q = torch.as_tensor(q, dtype=self.dtype, device=self.device)
        if q.ndim == 0 or q.shape[-1] != len(JOINTS):
            raise ValueError(
                f"expected joint positions of shape (..., {len(JOINTS)}), got {tuple(q.shape)}; "
                f"the joints are: {', '.join(JOINTS)}"
            )
        return self._poses(q, self._mix_joints)

    def forward_named(self, positions: Mapping[str, Tensor | float]) -> dict[str, Tensor]:
        """Pose of every link for joints given by name.

        Args:
            positions: joint name (one of ``movable``) to a number or tensor, rad or m. Shapes are
                broadcast; joints that are left out stand at 0.

        Returns:
            Link name to (..., 4, 4) homogeneous pose in the frame of ``base_footprint``, m.

        Raises:
            ValueError: an unknown joint, a joint that follows another, or a position that is not
                finite.
        """
        for name in positions:
            if name in self._followers:
                raise ValueError(
                    f"joint {name!r} follows {self._followers[name].joint!r}: give that one"
                )
            if name not in self.movable:
                raise ValueError(
                    f"unknown joint {name!r}; valid joints are: {', '.join(self.movable)}"
                )
        given = [
            torch.as_tensor(positions.get(name, 0.0), dtype=self.dtype, device=self.device)
            for name in self.movable
        ]
        q = torch.stack(torch.broadcast_tensors(*given), dim=-1)
        return self._poses(q, self._mix_movable)

    def pose(self, q: Tensor, link: str) -> Tensor:
        """Pose of one link, the finger springs at rest.

        Args:
            q: (..., J) positions of ``joints``, rad or m.
            link: a name of ``links``.

        Returns:
            (..., 4, 4) homogeneous pose in the frame of ``base_footprint``, m.

        Raises:
            ValueError: an unknown link, or what ``forward`` raises.
        """
        if link not in self.links:
            raise ValueError(f"unknown link {link!r}; valid links are: {', '.join(self.links)}")
        return self.forward(q)[link]

    def _poses(self, q: Tensor, mix: Tensor) -> dict[str, Tensor]:
        """Poses for (..., n) positions whose row of ``mix`` says which joints they move."""
        if not torch.isfinite(q).all():
            raise ValueError("joint positions must be finite, got NaN or infinity")
        batch = q.shape[:-1]
        positions = q.reshape(-1, len(mix)) @ mix + self._offset
        # Plain autograd: the library's own backward is right for first derivatives only.
        poses = self._chain.forward_kinematics_tensor(positions, analytical_grad=False)
        return {
            self._chain.idx_to_frame[i]: pose.reshape(*batch, 4, 4) for i, pose in enumerate(poses)
        }


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


def _mimic_map(
    robot: Urdf, names: Sequence[str], movable: tuple[str, ...]
) -> tuple[Tensor, Tensor]:
    """Affine map from the joints that move by themselves to all joints of the chain.

    Args:
        robot: the robot.
        names: the chain's joints.
        movable: joints that move by themselves.

    Returns:
        (movable, names) matrix and (names,) offset: ``positions = q @ matrix + offset``.
    """
    mix = torch.zeros(len(movable), len(names), dtype=torch.float64)
    offset = torch.zeros(len(names), dtype=torch.float64)
    for column, name in enumerate(names):
        mimic = robot.joints[name].mimic
        if mimic is None:
            mix[movable.index(name), column] = 1.0
        else:
            mix[movable.index(mimic.joint), column] = mimic.multiplier
            offset[column] = mimic.offset
    return mix, offset
