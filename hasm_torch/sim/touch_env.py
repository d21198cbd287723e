"""A robot with skin that a human touches, as a Gymnasium environment; any robot's.

    joint targets ──SlewedReference──► drives ─┐
    touch(patch, force) ──Hand─────────────────┴─► MuJoCo ──► joint state, skin forces

One step is a control tick of 20 ms, in which the physics takes ten steps.
"""

from collections.abc import Mapping, Sequence
from typing import Any, SupportsFloat

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from hasm_torch.robot import Skin
from hasm_torch.sim.assemble import TIMESTEP
from hasm_torch.sim.finger import Hand, TouchPoint
from hasm_torch.sim.render import SceneRenderer, View
from hasm_torch.sim.skin_sensor import SkinSensor
from hasm_torch.sim.slew import SlewedReference, drive_reference

Array = NDArray[np.float64]
Observation = dict[str, NDArray[np.float32]]

CONTROL_RATE = 50  # Hz
LARGEST_FORCE = 15.0  # N; up to here no push drives a joint beyond its limits
SKIN_RANGE = 200.0  # N, where a force point saturates
SUBSTEPS = round(1 / (CONTROL_RATE * TIMESTEP))


class TouchEnv(gym.Env[Observation, NDArray[np.float32]]):
    """A robot whose skin a human touches with one or two fingers.

    Observation: {"state": (J,) joint positions, rad or m; "tactile": (cells * 3,) normal forces of
    all skin cells, N}. Action: (J,) joint targets, clipped to the joint limits. One step is a
    control tick of 20 ms. An episode has no end of its own.

    `info` holds "is_success" (False: there is no task), "object_height" (0: there is no object),
    "finger_force" (N, that the skin really gets in all), "touched" (first patch that feels its
    finger, or None), "time" (s).

    Attributes:
        joints: Names of the joints, in the order of state and action.
        skin: Where the cells lie.
        home: (J,) where an episode starts unless its reset says otherwise, rad or m.

    Args:
        model: The robot with `add_skin`'s geoms, a position actuator a joint in the order of
            `joints`, and the bodies `FINGERS`.
        skin: Geometry of its cells.
        joints: Names of the joints.
        speed_limit: (J,) rad/s or m/s.
        home: (J,) usual start, rad or m.
        view: How the robot is looked at.
        render_mode: None or "rgb_array".

    Raises:
        ValueError: The render mode is unknown.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # declared so by gym.Env
        "render_modes": ["rgb_array"],
        "render_fps": CONTROL_RATE,
    }

    def __init__(
        self,
        model: mujoco.MjModel,
        skin: Skin,
        joints: Sequence[str],
        speed_limit: Array,
        home: Array,
        view: View,
        render_mode: str | None = None,
    ) -> None:
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise ValueError(f"render_mode must be None or one of {modes}, got {render_mode!r}")
        self.render_mode, self._view = render_mode, view
        self.model, self.skin, self.joints, self.home = model, skin, tuple(joints), home
        self.data = mujoco.MjData(model)
        found = [model.joint(name) for name in joints]
        self._qpos = np.array([joint.qposadr[0] for joint in found])
        self._dofs = np.array([joint.dofadr[0] for joint in found])
        limited = model.jnt_limited[[joint.id for joint in found]] > 0
        lower, upper = np.array([joint.range for joint in found]).T
        self.joint_lower = np.where(limited, lower, -np.inf)
        self.joint_upper = np.where(limited, upper, np.inf)
        self.joint_speed_limit = speed_limit
        self._reference = self._drive_reference()
        self._hand = Hand(model, skin, LARGEST_FORCE)
        self._sensor = SkinSensor(model, skin)
        self._renderer: SceneRenderer | None = None
        self.skin_forces: Array = np.zeros((skin.cells, 3))
        self._touch_points: list[TouchPoint] = []
        self._steps = 0

        limits = self.joint_lower.astype(np.float32), self.joint_upper.astype(np.float32)
        self.observation_space: spaces.Space[Any] = spaces.Dict(
            {
                "state": spaces.Box(*limits),
                "tactile": spaces.Box(0.0, SKIN_RANGE, (skin.cells * 3,), np.float32),
            }
        )
        self.action_space = spaces.Box(*limits)

    @property
    def joint_position(self) -> Array:
        """Measured positions of `joints`, (J,), rad or m."""
        return self.data.qpos[self._qpos].copy()

    @property
    def joint_velocity(self) -> Array:
        """Measured velocities of `joints`, (J,), rad/s or m/s."""
        return self.data.qvel[self._dofs].copy()

    @property
    def object_position(self) -> Array | None:
        """Centre of the object in the world, (3,), m; None in a scene without one."""
        return None

    def touch(self, patch: str | None, force: float = 0.0, cell: int | None = None) -> None:
        """Sets what one finger does from the next step on; a second one lets go.

        Args:
            patch: Skin patch to push, or None to let go.
            force: Push along the patch's normal, N, 0 to 15; 0 lets go.
            cell: Cell of the patch to push; its centre where None.

        Raises:
            ValueError: The patch or the cell does not exist, or the force is out of range.
        """
        self._hand.touch({} if patch is None else {patch: (force, cell)})

    def touch_all(self, touches: Mapping[str, float | tuple[float, int | None]]) -> None:
        """Sets what both fingers do from the next step on.

        Args:
            touches: Force on each patch touched, N, 0 to 15, at its centre, or force and cell; one
                finger lets go of a patch with 0 and of one that is not named.

        Raises:
            ValueError: More than two patches are given, a patch or a cell does not exist, or a
                force is out of range.
        """
        pairs = {p: t if isinstance(t, tuple) else (t, None) for p, t in touches.items()}
        self._hand.touch(pairs)

    def touch_points(self) -> list[TouchPoint]:
        """What each finger that pushes did in the last step; empty after a reset."""
        return self._touch_points

    def block(self, joints: Sequence[str]) -> None:
        """Holds joints where they are, whatever the action says, until called without them.

        A moving joint first brakes, within 0.1 s (the HSR's hand and base 0.25 s) from its full
        speed.

        Args:
            joints: Names of all joints that are held from now on; [] lets all go, as does a reset.

        Raises:
            ValueError: A joint does not exist.
        """
        unknown = sorted(set(joints) - set(self.joints))
        if unknown:
            raise ValueError(f"joints to block must be of {self.joints}, got {unknown}")
        self._reference.hold(np.array([name in joints for name in self.joints]))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode with nothing touched.

        Args:
            seed: Seed of what is random: where there is an object, its displacement.
            options: {"joints": (J,) start, "object": (x, y) displacement of the object, m}.

        Raises:
            ValueError: An option is unknown, has another shape or is not finite.
        """
        super().reset(seed=seed)
        options = options or {}
        unknown = sorted(set(options) - {"joints", "object"})
        if unknown:
            raise ValueError(f"reset options are 'joints' and 'object', got {unknown}")
        joints = finite(options.get("joints", self.home), len(self.joints), "joints")
        mujoco.mj_resetData(self.model, self.data)
        self._reference.reset(joints)
        self._set_joints(self._reference.position)
        self._place_object(options.get("object"))
        self.data.ctrl[:] = self._reference.position
        self.touch(None)
        self._hand.prepare(self.data)
        mujoco.mj_forward(self.model, self.data)
        self._steps, self._touch_points = 0, []
        self.skin_forces = self._sensor.read(self.data)
        return self._observation(), self._info()

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Runs one control tick.

        Args:
            action: (J,) joint targets in the order of `joints`, rad or m.

        Raises:
            ValueError: The action has another shape or is not finite.
        """
        target = finite(action, len(self.joints), "action")
        self._reference.stay_near(self.joint_position)
        references = self._reference.plan(target)
        model, data, hand = self.model, self.data, self._hand
        pushing = hand.prepare(data)
        for reference in references:
            data.ctrl[:] = reference
            if pushing:
                mujoco.mj_step1(model, data)
                hand.push()
                mujoco.mj_step2(model, data)
            else:
                mujoco.mj_step(model, data)
        self._steps += 1
        self.skin_forces = self._sensor.read(data)
        # Positions of bodies belong to the start of the last physics step: bring them up to date.
        mujoco.mj_kinematics(model, data)
        self._touch_points = hand.points(self._sensor.pushes)
        info = self._info()
        return self._observation(), float(info["is_success"]), False, False, info

    def render(self, camera: str = "follow") -> NDArray[np.uint8] | None:
        """Image of the scene, (480, 640, 3) uint8; None without a render mode.

        Args:
            camera: "follow", "top" or "side", see `SceneRenderer`.

        Raises:
            RuntimeError: No OpenGL is available.
            ValueError: The camera is not known.
        """
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = SceneRenderer(self.model, self.skin, self._view)
        return self._renderer.render(self.data, self.skin_forces, self._hand.touching, camera)

    def close(self) -> None:
        """Frees the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _drive_reference(self) -> SlewedReference:
        types = self.model.jnt_type[[self.model.joint(name).id for name in self.joints]]
        slides = types == mujoco.mjtJoint.mjJNT_SLIDE
        limits = self.joint_lower, self.joint_upper, self.joint_speed_limit
        return drive_reference(*limits, slides, 1 / CONTROL_RATE, SUBSTEPS)

    def _place_object(self, displacement: Any) -> None:
        """Puts the object where an episode begins; here there is none."""

    def _set_joints(self, position: Array) -> None:
        self.data.qpos[self._qpos] = position
        for follower, leader, polynomial in zip(
            self.model.eq_obj1id, self.model.eq_obj2id, self.model.eq_data, strict=True
        ):
            address = self.model.jnt_qposadr
            value = polynomial[0] + polynomial[1] * self.data.qpos[address[leader]]
            self.data.qpos[address[follower]] = value

    def _observation(self) -> Observation:
        state = self.joint_position.astype(np.float32)
        tactile = np.minimum(self.skin_forces.ravel(), SKIN_RANGE).astype(np.float32)
        return {"state": state, "tactile": tactile}

    def _info(self) -> dict[str, Any]:
        forces = self.skin_forces
        felt = (p for p in self._hand.touching if forces[self.skin.slices[p]].any())
        return {
            "is_success": False,
            "object_height": 0.0,
            "finger_force": float(forces.sum()),
            "touched": next(felt, None),
            "time": self._steps / CONTROL_RATE,
        }


def finite(value: Any, length: int, name: str) -> Array:
    """A vector that is checked.

    Raises:
        ValueError: It has another length or is not finite.
    """
    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (length,):
        raise ValueError(f"{name} must have shape ({length},), got {vector.shape}")
    if not np.isfinite(vector).all():
        raise ValueError(f"{name} must be finite, got {vector}")
    return vector
