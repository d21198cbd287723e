"""From what the skin felt to where the reference goes, in one control step.

displacement    reference += spikes · d, d recalled at the reference
goal            the reference goes along the course that was recalled when the touch began
successor       it goes towards the recalled next state; there the next one is recalled
time            target = position + d / horizon, spikes or not
"""

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.encoders.touch import spike_density
from hasm_torch.model.control import Array, Asked, Rollout, Touched
from hasm_torch.model.felt import PushDirection
from hasm_torch.model.frames import base_indices
from hasm_torch.model.query import parts_of
from hasm_torch.model.recalling import Recalling
from hasm_torch.model.settled import Settled
from hasm_torch.model.timed import Timed

# A walk that needs more recalls than this in one control step waits for the next one, which
# bounds the time a step takes.
RECALLS_A_STEP = 4


class Motion:
    """Moves references by what is recalled.

    Args:
        config: Settings of the method.
        body: Joints and skin of the robot.
        settled: What was chosen for the episodes.
        tolerance: (joints,) how far the reference may be from a joint, rad or m.
    """

    def __init__(self, config: HASMConfig, body: Body, settled: Settled, tolerance: Array) -> None:
        self.config, self.body, self.settled, self.tolerance = config, body, settled, tolerance
        self._base = base_indices(body)
        self._direction = PushDirection(body, config.frame)
        self._moved = np.array(settled.moved)
        self._lower, self._upper = np.array(body.lower), np.array(body.upper)
        # A patch that was never touched is answered where one on the same rigid body was.
        parts = parts_of(body, settled.touch)
        taught = {parts[body.patches.index(name)] for name in settled.taught}
        self._answers = np.array([part in taught for part in parts])

    def __call__(
        self,
        recalling: Recalling | Timed,
        rollout: Rollout,
        measured: Array,
        felt: tuple[NDArray[np.float32], NDArray[np.float32]],
        observed: Array,
        hold_below: float,
    ) -> Array:
        """Where the reference goes in one control step.

        Args:
            recalling: The memory.
            rollout: The control loop; its reference is set.
            measured: (joints,) measured positions, rad or m.
            felt: (patches,) spikes in the step and (patches, 3) push, N.
            observed: (N,) further observations.
            hold_below: Confidence below which a recall moves nothing.

        Returns:
            (joints,) the target, rad or m, before the speed limits.
        """
        assert rollout.reference is not None
        counts, push = felt[0].astype(np.float64), felt[1]
        rollout.count(counts)
        seconds = len(rollout.spikes) / self.body.rate
        rollout.density = spike_density(rollout.total / seconds, self.config.max_rate)
        touched = np.flatnonzero((counts > 0) & self._answers).tolist()
        rollout.touched = [self.body.patches[p] for p in touched]
        if isinstance(recalling, Timed):
            return self._onward(recalling, rollout, measured, hold_below)
        touches = []
        for p in touched:
            toward = self._direction.of_patch(p, push[p], rollout.reference)
            touches.append(Touched(p, counts[p], rollout.density[p], toward, observed))
        if not touches:
            return rollout.reference
        if self.settled.value != "displacement":
            return self._along_courses(recalling, rollout, touches, measured, hold_below)
        target = rollout.reference
        for touch in touches:
            query = self._ask(recalling, rollout, touch, rollout.reference, hold_below)
            if query is not None:
                yaw = self._yaw(rollout.reference)
                target = target + touch.spikes * recalling.displacement(query, touch, yaw)
        # A joint that is held up does not run away from its reference; the others go on.
        return np.minimum(np.maximum(target, measured - self.tolerance), measured + self.tolerance)

    def _yaw(self, positions: Array) -> float:
        return float(positions[self._base[2]]) if self._base else 0.0

    def _ask(
        self,
        recalling: Recalling,
        rollout: Rollout,
        touch: Touched,
        positions: Array,
        hold_below: float,
    ) -> Tensor | None:
        """The query of a touch; None where the memory is not sure enough of its answer."""
        query = recalling.query(positions, touch)
        rollout.asked.append(Asked(touch, query, positions))
        sure = hold_below <= 0.0 or recalling.confidence(query, touch.patch) >= hold_below
        return query if sure else None

    def _onward(
        self, recalling: Timed, rollout: Rollout, measured: Array, hold_below: float
    ) -> Array:
        """The target of a robot that time moves on."""
        assert rollout.reference is not None
        rollout.history.append(measured)
        del rollout.history[: -1 - max(self.settled.past)]
        touch = rollout.density[None, :] if self.body.channels else np.zeros((1, 0))
        rollout.moment = recalling.moment(np.array(rollout.history), touch)
        if hold_below > 0.0 and recalling.confidence(rollout.moment) < hold_below:
            return rollout.reference
        displacement: Array = recalling(rollout.moment)[0].cpu().numpy()
        return measured + displacement / self.config.horizon

    def _along_courses(
        self,
        recalling: Recalling,
        rollout: Rollout,
        touches: list[Touched],
        measured: Array,
        hold_below: float,
    ) -> Array:
        """The reference moved along the course of every touch."""
        assert rollout.reference is not None
        moved = self._moved
        here = {touch.patch for touch in touches}
        for patch in [p for p in rollout.courses if p not in here]:
            del rollout.courses[patch]  # another patch leads away from this course
        away = np.abs(measured - rollout.reference) > self.tolerance
        if away[moved].any():
            if all(touch.patch in rollout.courses for touch in touches):
                return rollout.reference  # the joints are held up: wait for them
            rollout.reference = np.where(
                away, np.clip(measured, self._lower, self._upper), rollout.reference
            )
        target = rollout.reference.copy()
        walking = self.settled.value == "successor"
        for touch in touches:
            spikes = touch.spikes
            for _ in range(RECALLS_A_STEP):
                course = rollout.courses.get(touch.patch)
                if course is None or (walking and course.finished):
                    query = self._ask(recalling, rollout, touch, target.copy(), hold_below)
                    if query is None:
                        break
                    course = recalling.course(query, touch, target, self._yaw(target))
                    course.asked = rollout.asked[-1]
                    rollout.courses[touch.patch] = course
                if walking and not self.config.distinct:
                    target[moved] = course.points[-1]
                    del rollout.courses[touch.patch]
                    break
                target[moved], spikes = course.advance(target[moved], spikes)
                if not spikes or not walking:
                    break
        return target
