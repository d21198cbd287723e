"""The whole model: skin forces and joint positions in, joint targets out.

joint positions ──PlaceCode──────────────────────────────────────────► s ┐
skin forces ──EffectiveForce──Izhikevich──► ρ ──TactileEmbedding──► F     │
            ──cell normals, link rotation──► f̂ ──RoPE3D(F; f̂, θ)──────► o ┤ q = s ⊗ o ⊗ p
further observations ──PlaceCode─────────────────────────────────────► p ┘
                      d = S₋₁ softmax(β Mᵀ q),   reference += spikes · d
"""

from collections import deque
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.encoders.readings import forces_of
from hasm_torch.encoders.skin import SkinEncoder
from hasm_torch.encoders.touch import spike_density
from hasm_torch.model import checkpoint
from hasm_torch.model.control import Array, Rollout, Touched, limit_speed
from hasm_torch.model.felt import PushDirection, Recording, rate_window, skin_encoder
from hasm_torch.model.fit import FitReport, fit, timed_series
from hasm_torch.model.frames import base_indices
from hasm_torch.model.moments import moments
from hasm_torch.model.query import parts_of
from hasm_torch.model.recalling import Recalling
from hasm_torch.model.settled import Settled
from hasm_torch.model.timed import Timed

# A walk that needs more recalls than this in one control step waits for the next one, which
# bounds the time a step takes.
RECALLS_A_STEP = 4


class HASM(nn.Module):
    """Encoders and the memory that all skin patches share.

    ``fit`` stores episodes, ``step`` gives the joint target of one control step, ``reset`` starts
    a new rollout.

    Attributes:
        settled: What was chosen for the episodes; None before the first ``fit``.
        recalling: The memory with its codes; of a robot that time moves on a ``Timed`` one.
        rollout: The control loop that ``step`` goes on with unless it is given another.
        tolerance: (joints,) how far the reference may be from a joint, rad or m.

    Args:
        config: Settings of the method.
        body: Joints and skin of the robot.
        settled: What was chosen, of a model to be loaded; ``fit`` finds it.
    """

    tolerance: Tensor

    def __init__(self, config: HASMConfig, body: Body, settled: Settled | None = None) -> None:
        super().__init__()
        self.config, self.body = config, body
        self._base = base_indices(body)
        self._direction = PushDirection(body, config.frame)
        # As the float32 that targets are given in, so that none is rounded across a limit.
        self._lower, self._upper, self._max_speed = (
            np.array(limit, dtype=np.float32).astype(np.float64)
            for limit in (body.lower, body.upper, body.max_speed)
        )
        self.register_buffer("tolerance", torch.zeros(len(body.joints)))
        self.settled: Settled | None = None
        self.recalling: Recalling | Timed | None = None
        self.skin: SkinEncoder | None = None
        if settled is not None:
            timed = settled.drive == "time"
            self._settle(settled, (Timed if timed else Recalling)(config, body, settled))
        self.reset()

    def _settle(self, settled: Settled, recalling: Recalling | Timed) -> None:
        unknown = [name for name in settled.taught if name not in self.body.patches]
        if unknown:
            raise ValueError(
                f"unknown patches {', '.join(unknown)}, valid: {', '.join(self.body.patches)}"
            )
        device = self.tolerance.device
        scale = settled.threshold, settled.current_per_newton
        self.skin = skin_encoder(self.config, self.body, *scale).to(device)
        self.settled, self.recalling = settled, recalling.to(device)
        # A patch that was never touched is answered where one on the same rigid body was.
        parts = parts_of(self.body, settled.touch)
        taught = {parts[self.body.patches.index(name)] for name in settled.taught}
        self._answers = np.array([part in taught for part in parts])

    def fit(self, episodes: Iterable[Recording]) -> FitReport:
        """Learn episodes, in place of what was learned before; see ``model.fit``.

        Args:
            episodes: Recordings with ``time``, ``state``, ``action`` and ``tactile``, and
                ``observations`` where the body binds some.

        Returns:
            What was learned and chosen.

        Raises:
            ValueError: If there is no episode, no touch, no motion, or a value is not finite; the
                model is then as it was.
        """
        fitted = fit(self.config, self.body, episodes)
        self._settle(fitted.settled, fitted.memory)
        self.tolerance.copy_(fitted.tolerance)
        self.reset()
        return fitted.report

    def reset(self) -> None:
        """Forget the rollout: the next step starts from the measured joints."""
        self.rollout = self.new_rollout()

    def new_rollout(self) -> Rollout:
        """A control loop at its beginning, for ``step``."""
        nothing: Array = np.zeros(len(self.body.patches))
        spikes: deque[Array] = deque([nothing] * rate_window(self.config, self.body))
        return Rollout(spikes, nothing.copy(), nothing, self.skin.start() if self.skin else None)

    @torch.no_grad()
    def step(
        self,
        state: Tensor,
        skin: Tensor | None,
        rollout: Rollout | None = None,
        observation: Tensor | None = None,
    ) -> Tensor:
        """One control step.

        Args:
            state: (joints,) measured joint positions, rad or m.
            skin: (cells, channels) or flat, the skin's readings in the body's layout; None for a
                robot without skin.
            rollout: The control loop to go on with, one a robot; by default the model's own.
            observation: (N,) further observations, where the body binds some.

        Returns:
            (joints,) target joint positions, within the joint limits. A reading that is not
            finite holds the robot at its last target.

        Raises:
            ValueError: If a shape is off.
            RuntimeError: If the model has learned nothing, or the very first joint reading is
                not finite, so that there is nothing to hold.
        """
        measured, forces, observed = self._checked(state, skin, observation)
        rollout = self.rollout if rollout is None else rollout
        rollout.queries, rollout.touched = [], []
        known = bool(np.isfinite(measured).all())
        if rollout.reference is None:
            if not known:
                raise RuntimeError("no finite joint reading yet, so there is no position to hold")
            rollout.reference = np.clip(measured, self._lower, self._upper)
        if known and np.isfinite(forces).all() and np.isfinite(observed).all():
            target = self._moved(rollout, measured, forces, observed)
            target = limit_speed(rollout.reference, target, self._max_speed, 1 / self.body.rate)
            rollout.reference = np.clip(target, self._lower, self._upper)
        return torch.from_numpy(rollout.reference.astype(np.float32)).to(state.device)

    def _moved(
        self, rollout: Rollout, measured: Array, forces: NDArray[np.float32], observed: Array
    ) -> Array:
        """Where the reference goes in one control step."""
        assert self.skin is not None
        assert rollout.skin is not None
        assert rollout.reference is not None
        felt, means, rollout.skin = self.skin.encode(forces[None, None], rollout.skin)
        counts, push = felt[0, 0].astype(np.float64), means[0, 0, :, 1:]
        rollout.count(counts)
        seconds = len(rollout.spikes) / self.body.rate
        rollout.density = spike_density(rollout.total / seconds, self.config.max_rate)
        touched = np.flatnonzero((counts > 0) & self._answers).tolist()
        rollout.touched = [self.body.patches[p] for p in touched]
        if isinstance(self.recalling, Timed):
            return measured + self._onward(rollout, measured) / self.config.horizon
        if not touched:
            return rollout.reference
        assert self.settled is not None
        direction = self._direction.of_patch
        touches = [
            Touched(
                p, counts[p], rollout.density[p], direction(p, push[p], rollout.reference), observed
            )
            for p in touched
        ]
        tolerance = self.tolerance.cpu().numpy()
        if self.settled.value == "displacement":
            target = rollout.reference
            for touch in touches:
                target = target + touch.spikes * self._displacement(rollout, touch)
            # A joint that is held up does not run away from its reference; the others go on.
            return np.clip(target, measured - tolerance, measured + tolerance)
        return self._along_courses(rollout, touches, measured, tolerance)

    def _onward(self, rollout: Rollout, measured: Array) -> Array:
        """Displacement over the horizon of a robot that time moves on, (joints,)."""
        assert isinstance(self.recalling, Timed)
        assert self.settled is not None
        rollout.history.append(measured)
        del rollout.history[: -1 - max(self.settled.past)]
        touch = rollout.density[None, :] if self.body.channels else np.zeros((1, 0))
        rollout.moment = self.recalling.moment(np.array(rollout.history), touch)
        return self.recalling(rollout.moment)[0].cpu().numpy()

    def _displacement(self, rollout: Rollout, touch: Touched) -> Array:
        """What a spike of a touch does to the reference, (joints,)."""
        assert isinstance(self.recalling, Recalling)
        assert rollout.reference is not None
        query = self.recalling.query(rollout.reference, touch)
        rollout.queries.append((touch.patch, query))
        yaw = float(rollout.reference[self._base[2]]) if self._base else 0.0
        return self.recalling.displacement(query, touch, yaw)

    def _along_courses(
        self, rollout: Rollout, touches: list[Touched], measured: Array, tolerance: Array
    ) -> Array:
        """The reference moved along the course of every touch."""
        assert isinstance(self.recalling, Recalling)
        assert self.settled is not None
        assert rollout.reference is not None
        moved = np.array(self.settled.moved)
        here = {touch.patch for touch in touches}
        for patch in [p for p in rollout.courses if p not in here]:
            del rollout.courses[patch]  # another patch leads away from this course
        away = np.abs(measured - rollout.reference) > tolerance
        if away[moved].any():
            if all(touch.patch in rollout.courses for touch in touches):
                return rollout.reference  # the joints are held up: wait for them
            rollout.reference = np.where(
                away, np.clip(measured, self._lower, self._upper), rollout.reference
            )
        target = rollout.reference.copy()
        for touch in touches:
            spikes = touch.spikes
            for _ in range(RECALLS_A_STEP):
                course = rollout.courses.get(touch.patch)
                walking = self.settled.value == "successor"
                if course is None or (walking and course.finished):
                    query = self.recalling.query(target, touch)
                    rollout.queries.append((touch.patch, query))
                    yaw = float(target[self._base[2]]) if self._base else 0.0
                    course = self.recalling.course(query, touch, target, yaw)
                    rollout.courses[touch.patch] = course
                if walking and not self.config.distinct:
                    target[moved] = course.points[-1]
                    del rollout.courses[touch.patch]
                    break
                target[moved], spikes = course.advance(target[moved], spikes)
                if not spikes or not walking:
                    break
        return target

    @torch.no_grad()
    def predict(
        self, episode: Recording, ahead: int, most: int = 10**9
    ) -> tuple[Array, NDArray[np.int64]]:
        """Where the joints will be, in an episode that is watched: open-loop prediction.

        A robot that time moves on is predicted by one recall. One that touch moves is stepped on
        from each frame, its skin as it is felt then, as if the joints followed at once.

        Args:
            episode: The recording.
            ahead: Frames ahead; of a robot that time moves on the ``horizon`` of its settings.
            most: Frames predicted at most, evenly spread.

        Returns:
            (K, joints) predicted displacements, rad or m, and the (K,) frames they start from.

        Raises:
            ValueError: If ``ahead`` is not the horizon of a robot that time moves on.
        """
        recalling, config = self._learned(), self.config
        assert self.settled is not None
        count = max(len(episode.state) - ahead, 0)
        frames = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
        frames = frames[:count]
        if isinstance(recalling, Timed):
            if ahead != config.horizon:
                raise ValueError(f"the memory looks {config.horizon} frames ahead, not {ahead}")
            series = timed_series(config, self.body, self.settled, episode, 0)
            found = moments([series], self.settled.past, ahead).rows(torch.from_numpy(frames))
            return recalling(found).numpy(), frames
        stepped = [self._stepped(episode, frame, ahead) for frame in frames]
        return np.array(stepped).reshape(len(frames), len(self.body.joints)), frames

    def _stepped(self, episode: Recording, frame: int, ahead: int) -> Array:
        """Displacement when the robot goes on from a frame for some more, (joints,)."""
        rollout, seconds = self.new_rollout(), self.config.rate_window_s
        first = max(0, frame - round(2 * seconds * self.body.rate))
        state = torch.from_numpy(np.asarray(episode.state, dtype=np.float32))
        skin = None if episode.tactile is None else torch.from_numpy(np.asarray(episode.tactile))
        more = getattr(episode, "observations", None)
        seen = None if more is None else torch.from_numpy(np.asarray(more))
        for t in range(first, frame + ahead):
            at, here = min(t, frame), state[min(t, frame)]
            felt, also = (None if x is None else x[at] for x in (skin, seen))
            if t == frame:  # up to here the skin was watched, the joints as they were
                rollout.reference, rollout.courses = here.double().numpy(), {}
            if t > frame:
                here = torch.from_numpy(rollout.reference).float()
            self.step(here, felt, rollout, also)
        assert rollout.reference is not None
        return rollout.reference - state[frame].double().numpy()

    @property
    def patches(self) -> list[str]:
        """Names of the patches whose touch was taught."""
        return [] if self.settled is None else self.settled.taught

    @property
    def touched(self) -> list[str]:
        """Patches that spiked in the last step and are answered."""
        return self.rollout.touched

    @property
    def density(self) -> Tensor:
        """(patches,) rate density ρ of every patch at the last step."""
        return torch.from_numpy(self.rollout.density).float()

    @property
    def reference(self) -> Tensor:
        """Joint positions asked for last, (joints,), rad or m.

        Raises:
            RuntimeError: If no step was made since the reset.
        """
        if self.rollout.reference is None:
            raise RuntimeError("no step was made since the reset, so there is no reference yet")
        return torch.from_numpy(self.rollout.reference).float()

    @property
    def origins(self) -> NDArray[np.int64]:
        """(K, 3) episode, sample and patch from which each association comes."""
        return self._learned().origins.cpu().numpy()

    def recalled(self) -> list[tuple[str, Array]]:
        """The recalls of the last step: patch and weight of each association, (K,).

        Where time moves the robot on, no patch is named.
        """
        recalling, rollout = self._learned(), self.rollout
        if isinstance(recalling, Timed):
            return [] if rollout.moment is None else [("", recalling.weights(rollout.moment))]
        return [(self.body.patches[p], recalling.weights(query, p)) for p, query in rollout.queries]

    def memory_bytes(self) -> int:
        """Bytes of all associations and successors held."""
        return self._learned().memory.memory_bytes()

    def _learned(self) -> Recalling | Timed:
        if self.recalling is None:
            raise RuntimeError("the model has learned nothing: call fit or from_pretrained first")
        return self.recalling

    def _checked(
        self, state: Tensor, skin: Tensor | None, observation: Tensor | None
    ) -> tuple[Array, NDArray[np.float32], Array]:
        self._learned()
        joints, more = len(self.body.joints), sum(self.body.observations.values())
        if state.shape != (joints,):
            raise ValueError(f"expected state ({joints},), got {tuple(state.shape)}")
        if more and (observation is None or observation.shape != (more,)):
            came = None if observation is None else tuple(observation.shape)
            raise ValueError(
                f"expected observation ({more},) of {', '.join(self.body.observations)}, got {came}"
            )
        forces = forces_of(self.body, skin).detach().cpu().float().contiguous().numpy()
        observed = np.zeros(0)
        if more and observation is not None:
            observed = observation.detach().cpu().numpy().astype(np.float64)
        return state.detach().cpu().numpy().astype(np.float64), forces, observed

    def save_pretrained(self, directory: str | Path) -> None:
        """Write a checkpoint; see ``checkpoint``.

        Args:
            directory: Made if it is not there.

        Raises:
            RuntimeError: If the model has learned nothing.
        """
        self._learned()
        assert self.settled is not None
        checkpoint.save(
            checkpoint.Settings(self.config, self.body, self.settled),
            self.state_dict(),
            Path(directory),
        )

    @classmethod
    def from_pretrained(cls, directory: str | Path) -> "HASM":
        """Load what ``save_pretrained``, ``train.py`` or LeRobot's training wrote.

        Raises:
            FileNotFoundError: If a file is missing.
            ValueError: If a file is damaged, holds no memory, or does not belong to the other.
        """
        settings = checkpoint.read_settings(Path(directory))
        try:
            model = cls(settings.config, settings.body, settings.settled)
        except (ValueError, LookupError, TypeError, RuntimeError) as error:
            raise checkpoint.damaged(Path(directory), error) from error
        checkpoint.load_weights(model, Path(directory))
        return model
