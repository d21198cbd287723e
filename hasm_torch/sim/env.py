"""The touched HSR as a Gymnasium environment.

    joint targets ──SlewedReference──► drives ─┐
    touch(patch, force) ──Hand─────────────────┴─► MuJoCo ──► joint state, skin forces

One step is a control tick of 20 ms, in which the physics takes ten steps.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, SupportsFloat

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from hasm_torch.robot import BASE_FRAME, JOINTS, Skin
from hasm_torch.sim.finger import Hand, TouchPoint
from hasm_torch.sim.render import SceneRenderer
from hasm_torch.sim.scene import (
    OBJECT_HALF_SIZE,
    OBJECT_POSITION,
    TABLE_HEIGHT,
    TIMESTEP,
    build_model,
    joint_speed_limits,
)
from hasm_torch.sim.skin_sensor import SkinSensor
from hasm_torch.sim.slew import hsr_reference
from hasm_torch.sim.tasks import START_POSES

Array = NDArray[np.float64]

CONTROL_RATE = 50  # Hz
MAX_EPISODE_STEPS = 1500
LARGEST_FORCE = 15.0  # N; up to here no push drives a joint beyond its limits
SKIN_RANGE = 200.0  # N, where a force point saturates

_SUBSTEPS = round(1 / (CONTROL_RATE * TIMESTEP))
_OBJECT_OFFSET = 0.01  # m, largest random displacement of the object
_LIFTED = 0.05  # m


class HSRTouchEnv(gym.Env[dict[str, NDArray[np.float32]], NDArray[np.float32]]):
    """An HSR with artificial skin that a human touches with one or two fingers.

    Observation: {"state": (11,) joint positions in the order of `JOINTS`, rad, m for `METRES`;
    "tactile": (cells * 3,) normal forces of all skin cells, N; in "grasp" also
    "environment_state": (3,) centre of the object in the live frame `BASE_FRAME`, m}. Action:
    (11,) joint targets, clipped to the joint limits; the mobile base has none. The world is the
    frame `odom` of the base's joints. One step is a control tick of 20 ms. The reward is 1 while
    the object is lifted and held. An episode has no end of its own: `gymnasium.make` truncates
    it after `MAX_EPISODE_STEPS`.

    `info` holds "is_success" (the object is lifted and held; always False in "compliance"),
    "object_height" (m above the table, 0 without an object), "finger_force" (N, that the skin
    really gets in all), "touched" (first patch that feels its finger, or None), "time" (s).

    Args:
        scene: "compliance" or "grasp".
        render_mode: None or "rgb_array".
    """

    _max_episode_steps: ClassVar[int] = MAX_EPISODE_STEPS
    metadata: dict[str, Any] = {  # noqa: RUF012  # declared so by gym.Env
        "render_modes": ["rgb_array"],
        "render_fps": CONTROL_RATE,
    }

    def __init__(self, scene: str = "compliance", render_mode: str | None = None) -> None:
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise ValueError(f"render_mode must be None or one of {modes}, got {render_mode!r}")
        self.scene, self.render_mode = scene, render_mode
        self.skin = Skin.load()
        self.model = build_model(scene, self.skin)
        self.data = mujoco.MjData(self.model)
        joints = [self.model.joint(name) for name in JOINTS]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._dofs = np.array([joint.dofadr[0] for joint in joints])
        limited = self.model.jnt_limited[[joint.id for joint in joints]] > 0
        lower, upper = np.array([joint.range for joint in joints]).T
        self.joint_lower = np.where(limited, lower, -np.inf)
        self.joint_upper = np.where(limited, upper, np.inf)
        self.joint_speed_limit = joint_speed_limits()
        self._reference = hsr_reference(
            self.joint_lower,
            self.joint_upper,
            self.joint_speed_limit,
            1 / CONTROL_RATE,
            _SUBSTEPS,
        )
        self._hand = Hand(self.model, self.skin, LARGEST_FORCE)
        self._sensor = SkinSensor(self.model, self.skin)
        self._renderer: SceneRenderer | None = None
        self.skin_forces: Array = np.zeros((self.skin.cells, 3))
        self._touch_points: list[TouchPoint] = []
        self._steps = 0

        limits = self.joint_lower.astype(np.float32), self.joint_upper.astype(np.float32)
        observed: dict[str, spaces.Space[Any]] = {
            "state": spaces.Box(*limits),
            "tactile": spaces.Box(0.0, SKIN_RANGE, (self.skin.cells * 3,), np.float32),
        }
        if scene == "grasp":
            observed["environment_state"] = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.observation_space: spaces.Space[Any] = spaces.Dict(observed)
        self.action_space = spaces.Box(*limits)

    @property
    def joint_position(self) -> Array:
        """Measured positions of `JOINTS`, (11,), rad or m."""
        return self.data.qpos[self._qpos].copy()

    @property
    def joint_velocity(self) -> Array:
        """Measured velocities of `JOINTS`, (11,), rad/s or m/s."""
        return self.data.qvel[self._dofs].copy()

    @property
    def object_position(self) -> Array | None:
        """Centre of the object in `odom`, (3,), m; None in a scene without one."""
        return self.data.body("object").xpos.copy() if self.scene == "grasp" else None

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

        A moving joint first brakes, within 0.1 s (hand and base 0.25 s) from its full speed.

        Args:
            joints: Names of all joints that are held from now on; [] lets all go, as does a reset.

        Raises:
            ValueError: A joint does not exist.
        """
        unknown = sorted(set(joints) - set(JOINTS))
        if unknown:
            raise ValueError(f"joints to block must be of {JOINTS}, got {unknown}")
        self._reference.hold(np.array([name in joints for name in JOINTS]))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, Any]]:
        """Starts an episode with nothing touched.

        Args:
            seed: Seed of the object's random displacement (up to 1 cm along x and y).
            options: {"joints": (11,) start, "object": (x, y) displacement of the object, m}.

        Raises:
            ValueError: An option is unknown, has another shape or is not finite.
        """
        super().reset(seed=seed)
        options = options or {}
        unknown = sorted(set(options) - {"joints", "object"})
        if unknown:
            raise ValueError(f"reset options are 'joints' and 'object', got {unknown}")
        joints = _vector(options.get("joints", START_POSES[self.scene]), len(JOINTS), "joints")
        random_offset = self.np_random.uniform(-_OBJECT_OFFSET, _OBJECT_OFFSET, 2)
        offset = _vector(options.get("object", random_offset), 2, "object")

        mujoco.mj_resetData(self.model, self.data)
        self._reference.reset(joints)
        self._set_joints(self._reference.position)
        if self.scene == "grasp":
            address = int(self.model.joint("object").qposadr[0])
            self.data.qpos[address : address + 2] = np.array(OBJECT_POSITION) + offset
        self.data.ctrl[:] = self._reference.position
        self.touch(None)
        self._hand.prepare(self.data)
        mujoco.mj_forward(self.model, self.data)
        self._steps, self._touch_points = 0, []
        self.skin_forces = self._sensor.read(self.data)
        return self._observation(), self._info()

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[dict[str, NDArray[np.float32]], SupportsFloat, bool, bool, dict[str, Any]]:
        """Runs one control tick.

        Args:
            action: (11,) joint targets in the order of `JOINTS`, rad, m for `METRES`.

        Raises:
            ValueError: The action has another shape or is not finite.
        """
        target = _vector(action, len(JOINTS), "action")
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
            self._renderer = SceneRenderer(self.model, self.skin, self.scene)
        return self._renderer.render(self.data, self.skin_forces, self._hand.touching, camera)

    def close(self) -> None:
        """Frees the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _set_joints(self, position: Array) -> None:
        self.data.qpos[self._qpos] = position
        for follower, leader, polynomial in zip(
            self.model.eq_obj1id, self.model.eq_obj2id, self.model.eq_data, strict=True
        ):
            address = self.model.jnt_qposadr
            value = polynomial[0] + polynomial[1] * self.data.qpos[address[leader]]
            self.data.qpos[address[follower]] = value

    def _observation(self) -> dict[str, NDArray[np.float32]]:
        state = self.joint_position.astype(np.float32)
        tactile = np.minimum(self.skin_forces.ravel(), SKIN_RANGE).astype(np.float32)
        observation = {"state": state, "tactile": tactile}
        position = self.object_position
        if position is not None:
            base = self.data.body(BASE_FRAME)
            turned = (position - base.xpos) @ base.xmat.reshape(3, 3)
            observation["environment_state"] = turned.astype(np.float32)
        return observation

    def _info(self) -> dict[str, Any]:
        height, held = self._object_state()
        forces = self.skin_forces
        felt = (p for p in self._hand.touching if forces[self.skin.slices[p]].any())
        return {
            "is_success": held and height >= _LIFTED,
            "object_height": height,
            "finger_force": float(forces.sum()),
            "touched": next(felt, None),
            "time": self._steps / CONTROL_RATE,
        }

    def _object_state(self) -> tuple[float, bool]:
        """Height of the object above its place on the table, m, and whether the fingers hold it."""
        position = self.object_position
        if position is None:
            return 0.0, False
        height = float(position[2] - TABLE_HEIGHT - OBJECT_HALF_SIZE[2])
        left = self.data.body("hand_l_finger_tip_frame").xpos
        right = self.data.body("hand_r_finger_tip_frame").xpos
        across = left - right
        span = float(np.linalg.norm(across))
        from_middle = position - (left + right) / 2
        aside = abs(float(from_middle @ across)) / span
        return height, aside < span / 2 and float(np.linalg.norm(from_middle)) < 0.1


def _vector(value: Any, length: int, name: str) -> Array:
    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (length,):
        raise ValueError(f"{name} must have shape ({length},), got {vector.shape}")
    if not np.isfinite(vector).all():
        raise ValueError(f"{name} must be finite, got {vector}")
    return vector
