"""What each episode taught, kept apart from all others, so that one can be added or forgotten.

The memory is made of these alone: an episode that is learned later is stored as if it had been
there from the beginning, and of one that is forgotten nothing is left.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hasm_torch.body import Body
from hasm_torch.model.moments import Series
from hasm_torch.model.table import Table, empty_table, joined

Array = NDArray[np.float64]

COURSE_POINTS = 32  # of a course; grasps of four straight legs need some eight a leg


@dataclass
class Lesson:
    """What one episode taught.

    Attributes:
        number: Number of the episode, which no other one has or will have.
        seconds: How long it is.
        samples: Stretches of motion under touch.
        phases: Touches.
        lag: (J,) largest distance between target and measured position, rad or m.
        pace: (T − 1, 2) motion of the joints in shares of their speed limits, and spikes, sample
            by sample; not kept in checkpoints.
        series: Positions and touch of a robot that time moves on, else None.
        name: For people.
    """

    number: int
    seconds: float
    samples: Table
    phases: Table
    lag: Array
    pace: Array = field(default_factory=lambda: np.zeros((0, 2)))
    series: Series | None = None
    name: str = ""

    def __post_init__(self) -> None:
        travel = np.ptp(self.phases.moved, axis=1)
        patch, seen = self.phases.patch, self.samples.observation
        self.travel = {int(p): travel[patch == p].max(axis=0) for p in np.unique(patch)}
        density = self.phases.density
        self.density = (density.min(), density.max()) if len(density) else (np.inf, -np.inf)
        some = np.full((2, seen.shape[1]), [[np.inf], [-np.inf]])
        self.observed = np.stack([seen.min(0), seen.max(0)]) if len(seen) else some


class Lessons(nn.Module):
    """The lessons that a model knows, by number, in the order in which they were learned.

    Args:
        body: Joints and skin of the robot.
    """

    def __init__(self, body: Body) -> None:
        super().__init__()
        self.body = body
        self.known: dict[int, Lesson] = {}
        self.next = 0

    def add(self, lesson: Lesson) -> None:
        """Take in a lesson, whose number becomes the next one."""
        lesson.number = self.next
        lesson.name = lesson.name or f"episode {self.next}"
        for table in (lesson.samples, lesson.phases):
            table.episode[:] = lesson.number
        self.known[lesson.number] = lesson
        self.next += 1

    def copy(self) -> "Lessons":
        """The same lessons, to which others can be added without changing these."""
        twin = Lessons(self.body)
        twin.known, twin.next = dict(self.known), self.next
        return twin

    def __iter__(self) -> Iterator[Lesson]:
        """The lessons."""
        return iter(self.known.values())

    def __len__(self) -> int:
        return len(self.known)

    @property
    def samples(self) -> Table:
        """Stretches of motion of all of them."""
        return joined([empty_table(self.body, 0), *(x.samples for x in self)])

    @property
    def phases(self) -> Table:
        """Touches of all of them."""
        return joined([empty_table(self.body, COURSE_POINTS), *(x.phases for x in self)])

    @property
    def lag(self) -> Array:
        """(J,) largest lag of all, rad or m."""
        lags = [lesson.lag for lesson in self]
        return np.max([np.zeros(len(self.body.joints)), *lags], axis=0)

    @property
    def series(self) -> list[Series]:
        """Series of those that have one."""
        return [lesson.series for lesson in self if lesson.series is not None]

    def led(self) -> float:
        """Correlation of motion and spikes; 1 where no sample differs from another.

        In what was taught by touch the joints move where it spikes.
        """
        motion, spiked = np.concatenate([lesson.pace for lesson in self]).T
        if not (np.ptp(motion) > 0 and np.ptp(spiked) > 0):
            return 1.0
        return float(np.corrcoef(motion, spiked)[0, 1])

    def _save_to_state_dict(
        self, destination: dict[str, Tensor], prefix: str, keep_vars: bool
    ) -> None:
        lessons, joints = list(self), len(self.body.joints)
        columns: dict[str, np.ndarray] = {
            "next": np.array(self.next),
            "number": np.array([x.number for x in lessons], dtype=np.int64),
            "seconds": np.array([x.seconds for x in lessons]),
            "name": _written([x.name for x in lessons]),
            "lag": np.array([x.lag for x in lessons]).reshape(-1, joints),
        }
        for name, table in (("samples", self.samples), ("phases", self.phases)):
            columns |= {f"{name}.{column}": values for column, values in vars(table).items()}
        if self.series:
            columns["series.length"] = np.array([len(s.state) for s in self.series])
            for i, name in enumerate(Series._fields):
                columns[f"series.{name}"] = torch.cat([s[i] for s in self.series]).numpy()
        for name, column in columns.items():
            destination[prefix + name] = torch.from_numpy(np.ascontiguousarray(column))

    def _load_from_state_dict(
        self,
        state_dict: dict[str, Tensor],
        prefix: str,
        local_metadata: dict,
        strict: bool,
        missing_keys: list[str],
        unexpected_keys: list[str],
        error_msgs: list[str],
    ) -> None:
        found = {
            name.removeprefix(prefix): values.cpu().numpy()
            for name, values in state_dict.items()
            if name.startswith(prefix)
        }
        try:
            self._restore(found)
        except KeyError as error:
            missing_keys.append(prefix + error.args[0])
        except (ValueError, IndexError, TypeError) as error:
            error_msgs.append(f"what the episodes taught does not fit together: {error}")

    def _restore(self, found: dict[str, np.ndarray]) -> None:
        tables = []
        for name, points in (("samples", 0), ("phases", COURSE_POINTS)):
            wanted = vars(empty_table(self.body, points))
            table = Table(**{column: found[f"{name}.{column}"] for column in wanted})
            count = len(table)
            for column, values in vars(table).items():
                expected = (count, *wanted[column].shape[1:])
                if values.shape != expected:
                    raise ValueError(f"expected {name}.{column} {expected}, got {values.shape}")
            tables.append(table)
        series: list[Series | None] = [None] * len(found["number"])
        if "series.length" in found:
            lengths = found["series.length"].tolist()
            columns = [
                torch.from_numpy(found[f"series.{n}"]).split(lengths) for n in Series._fields
            ]
            series = [Series(*parts) for parts in zip(*columns, strict=True)]
        names = json.loads(bytes(found["name"]))
        rest = zip(found["number"], found["seconds"], found["lag"], series, names, strict=True)
        self.known = {}
        for number, seconds, lag, part, name in rest:
            samples, phases = (table.rows(table.episode == number) for table in tables)
            lesson = Lesson(int(number), float(seconds), samples, phases, lag)
            lesson.series, lesson.name = part, name
            self.known[lesson.number] = lesson
        self.next = int(found["next"])


def _written(names: list[str]) -> NDArray[np.uint8]:
    """Names as numbers, the only thing that a checkpoint's tensors hold."""
    return np.frombuffer(json.dumps(names).encode(), dtype=np.uint8).copy()
