"""The whole model: skin forces and joint positions in, joint targets out.

joint positions ──PlaceCode──────────────────────────────────────────► s ┐
skin forces ──EffectiveForce──Izhikevich──► ρ ──TactileEmbedding──► F     │
            ──cell normals, link rotation──► f̂ ──RoPE3D(F; f̂, θ)──────► o ┤ q = s ⊗ o ⊗ p
further observations ──PlaceCode─────────────────────────────────────► p ┘
                      d = S₋₁ softmax(β Mᵀ q),   reference += spikes · d
"""

import math
from collections import deque
from collections.abc import Iterable
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.encoders.readings import forces_of
from hasm_torch.encoders.skin import SkinEncoder
from hasm_torch.memory.recall import warm_up
from hasm_torch.model import checkpoint, hub, predict
from hasm_torch.model.choose import ARGMAX_BETA
from hasm_torch.model.control import Array, Rollout, limit_speed
from hasm_torch.model.explain import Explanation, explained, explained_moment
from hasm_torch.model.felt import Recording, rate_window, skin_encoder
from hasm_torch.model.fit import FitReport, Fitted, fit, rows, tolerance_of
from hasm_torch.model.learn import forgotten, learned
from hasm_torch.model.lessons import Lessons
from hasm_torch.model.motion import Motion
from hasm_torch.model.recalling import Recalling
from hasm_torch.model.settled import Settled
from hasm_torch.model.table import Table
from hasm_torch.model.timed import Timed


class Known(NamedTuple):
    """An episode that a model knows.

    Attributes:
        number: Its number, which no other one has or will have.
        name: Its name.
        seconds: How long it is.
        associations: Associations that come from it.
        patches: Names of the patches that it touches.
    """

    number: int
    name: str
    seconds: float
    associations: int
    patches: list[str]


class HASM(nn.Module):
    """Encoders and the memory that all skin patches share.

    ``fit`` stores episodes, ``learn`` one more and ``forget`` takes one away; ``step`` gives the
    joint target of one control step, ``explain`` says why, ``reset`` starts a new rollout.

    Attributes:
        settled: What was chosen for the episodes; None before the first ``fit``.
        recalling: The memory with its codes; of a robot that time moves on a ``Timed`` one.
        lessons: What every episode taught.
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
        # As the float32 that targets are given in, so that none is rounded across a limit.
        self._lower, self._upper, self._max_speed = (
            np.array(limit, dtype=np.float32).astype(np.float64)
            for limit in (body.lower, body.upper, body.max_speed)
        )
        self.register_buffer("tolerance", torch.zeros(len(body.joints)))
        self.settled: Settled | None = None
        self.recalling: Recalling | Timed | None = None
        self.skin: SkinEncoder | None = None
        self.lessons = Lessons(body)
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
        if self.config.storage == "bit":
            warm_up()  # so that neither a control step waits nor its rounding depends on the clock
        device = self.tolerance.device
        scale = settled.threshold, settled.current_per_newton
        self.skin = skin_encoder(self.config, self.body, *scale).to(device)
        self.settled, self.recalling = settled, recalling.to(device)
        self._motion: Motion | None = None  # made on the first step, when the tolerance is loaded
        self._keys: Table | None = None

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
        self._put(fitted)
        return fitted.report

    def _put(self, fitted: Fitted) -> None:
        self.lessons = fitted.lessons
        self._settle(fitted.settled, fitted.memory)
        self.tolerance.copy_(tolerance_of(self.body, self.lessons.lag))
        self.reset()

    @torch.no_grad()
    def learn(self, episode: Recording, name: str = "") -> Known:
        """Add one episode; afterwards a new rollout begins.

        The model is then the one that ``fit`` makes of all its episodes with what it chose. What
        was chosen is chosen anew when the number of episodes has doubled since; the drive, and
        threshold and current of the skin, stay.

        Args:
            episode: A recording, as for ``fit``.
            name: A name for people; "episode <number>" by default.

        Returns:
            What is known of it; its number is for ``forget``.

        Raises:
            ValueError: If it does not fit the body, or a model that knows nothing cannot be made
                of it alone; the model is then as it was.
        """
        if self.settled is None or self.recalling is None:
            self._put(fit(self.config, self.body, [episode], self.lessons.next))
        else:
            parts = self.config, self.body, self.settled, self.recalling, self.lessons
            self._put(learned(*parts, episode))
        number = self.lessons.next - 1
        self.lessons.known[number].name = name or f"episode {number}"
        return self.episodes[-1]

    @torch.no_grad()
    def forget(self, number: int) -> None:
        """Forget an episode, as if it had never been learned; what was chosen stays.

        Args:
            number: Number of the episode, see ``episodes``.

        Raises:
            ValueError: If no such episode is known.
        """
        if number not in self.lessons.known:
            raise ValueError(
                f"no episode {number} is known, valid: {', '.join(map(str, self.lessons.known))}"
            )
        if len(self.lessons) == 1:
            del self.lessons.known[number]
            self.settled, self.recalling, self._motion, self._keys = None, None, None, None
            self.reset()
        else:
            assert self.settled is not None
            parts = self.config, self.body, self.settled, self._learned(), self.lessons
            self._put(forgotten(*parts, number))

    @property
    def episodes(self) -> list[Known]:
        """The episodes that are known, in the order in which they were learned."""
        if self.recalling is None:
            return []
        numbers, counts = np.unique(self.origins[:, 0], return_counts=True)
        held = dict(zip(numbers.tolist(), counts.tolist()))
        return [
            Known(
                lesson.number,
                lesson.name,
                lesson.seconds,
                held.get(lesson.number, 0),
                [self.body.patches[p] for p in sorted(lesson.travel)],
            )
            for lesson in self.lessons
        ]

    def explain(self, rollout: Rollout | None = None) -> list[Explanation]:
        """Why the last step moved the robot, one explanation a recall.

        A touch that goes on along a course is explained by the recall that gave the course.

        Args:
            rollout: The control loop; by default the model's own.

        Raises:
            RuntimeError: If the model has learned nothing.
        """
        recalling, rollout = self._learned(), self.rollout if rollout is None else rollout
        if isinstance(recalling, Timed):
            moment = rollout.moment
            return [] if moment is None else [explained_moment(recalling, moment, self.body.rate)]
        assert self.settled is not None
        parts = self.config, self.body, self.settled, recalling
        anew = {asked.touch.patch for asked in rollout.asked}
        going_on = [
            course.asked
            for patch, course in rollout.courses.items()
            if course.asked and patch not in anew and self.body.patches[patch] in rollout.touched
        ]
        asked = [*rollout.asked, *going_on]
        return [explained(*parts, each, self._made_of()) for each in asked]

    def posture(self, row: int) -> Array:
        """(joints,) positions at which an association was made, rad or m."""
        if isinstance(self._learned(), Timed):
            episode, frame, _ = self.origins[row]
            series = self.lessons.known[int(episode)].series
            assert series is not None
            return series.state[int(frame)].numpy()
        return self._made_of().positions[row].copy()

    def _made_of(self) -> Table:
        """What the associations are made of, in their order."""
        if self._keys is None:
            assert self.settled is not None
            lessons = self.lessons
            known = self.config, self.body, self.settled, lessons.samples, lessons.phases
            self._keys = rows(*known)[0]
        return self._keys

    def with_beta(self, beta: float) -> "HASM":
        """A copy, sharing nothing, whose recall has another inverse temperature β.

        Args:
            beta: 0 is the mean of all associations, infinity the argmax.
        """
        self._learned()
        model = deepcopy(self)
        assert model.recalling is not None
        assert model.settled is not None
        model.settled.beta = min(beta, ARGMAX_BETA)
        model.recalling.memory.beta.fill_(model.settled.beta)
        model.reset()
        return model

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
        hold_below: float = 0.0,
    ) -> Tensor:
        """One control step.

        Args:
            state: (joints,) measured joint positions, rad or m.
            skin: (cells, channels) or flat, the skin's readings in the body's layout; None for a
                robot without skin.
            rollout: The control loop to go on with, one a robot; by default the model's own.
            observation: (N,) further observations, where the body binds some.
            hold_below: Confidence (see ``explain``) below which a recall moves nothing, 0 to 1.

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
        rollout.asked, rollout.touched = [], []
        known = _finite(measured)
        if rollout.reference is None:
            if not known:
                raise RuntimeError("no finite joint reading yet, so there is no position to hold")
            rollout.reference = np.minimum(np.maximum(measured, self._lower), self._upper)
        if known and _finite(forces) and _finite(observed):
            assert self.skin is not None
            assert self.recalling is not None
            assert rollout.skin is not None
            felt, means, rollout.skin = self.skin.encode(forces[None, None], rollout.skin)
            motion, push = self._motion or self._moving(), means[0, 0, :, 1:]
            target = motion(
                self.recalling, rollout, measured, (felt[0, 0], push), observed, hold_below
            )
            target = limit_speed(rollout.reference, target, self._max_speed, 1 / self.body.rate)
            rollout.reference = np.minimum(np.maximum(target, self._lower), self._upper)
        return torch.from_numpy(rollout.reference.astype(np.float32)).to(state.device)

    def _moving(self) -> Motion:
        assert self.settled is not None
        tolerance = self.tolerance.cpu().numpy()
        self._motion = Motion(self.config, self.body, self.settled, tolerance)
        return self._motion

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
        return predict.predict(self, episode, ahead, most)

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
        patches = self.body.patches
        return [
            (patches[x.touch.patch], recalling.weights(x.query, x.touch.patch))
            for x in rollout.asked
        ]

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

    def push_to_hub(self, name: str, private: bool = False) -> str:
        """Put a checkpoint with a model card on the Hugging Face hub.

        Args:
            name: "user/name" of the repository, made if it is not there.
            private: Whether a repository that is made is private.

        Returns:
            Address of the commit.

        Raises:
            RuntimeError: If the model has learned nothing.
        """
        self._learned()
        return hub.push(self, name, private)

    @classmethod
    def from_pretrained(cls, name: str | Path, revision: str | None = None) -> "HASM":
        """Load what ``save_pretrained``, ``train.py`` or LeRobot's training wrote.

        Args:
            name: A folder, or "user/name" of a repository of the Hugging Face hub.
            revision: Branch, tag or commit of the repository.

        Raises:
            FileNotFoundError: If there is neither, or a file is missing.
            ValueError: If a file is damaged, holds no memory, or does not belong to the other.
        """
        directory = hub.found(name, revision)
        settings = checkpoint.read_settings(directory)
        try:
            model = cls(settings.config, settings.body, settings.settled)
        except (ValueError, LookupError, TypeError, RuntimeError) as error:
            raise checkpoint.damaged(directory, error) from error
        checkpoint.load_weights(model, directory)
        return model


def _finite(values: NDArray[Any]) -> bool:
    """Whether nothing is NaN or infinite, by a sum, which takes half the time of looking at each.

    Values whose sum overflows in float64 are no readings either.
    """
    return math.isfinite(values.sum(dtype=np.float64))
