"""Joint states and commands of a bag."""

import numpy as np
from numpy.typing import NDArray

from hasm_torch.data.bags.pairing import Array, Collector, Series, Times, last
from hasm_torch.data.bags.reading import Heard

STATE_TYPE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
ARRAY = "std_msgs/msg/Float64MultiArray"
_FIELDS = {
    STATE_TYPE: {"name", "position"},
    TRAJECTORY: {
        "joint_names",
        "points.positions",
        "points.time_from_start.sec",
        "points.time_from_start.nanosec",
    },
    ARRAY: {"data"},
}


class JointReader:
    """Reads joint positions, measured or commanded.

    Args:
        topic: Where they come from.
        message_type: Type of its messages.
        commands: They are commands; else measured states.
        joints: Names of the joints in a message that holds numbers alone.

    Raises:
        ValueError: Messages of this type do not hold what is wanted.
    """

    def __init__(
        self, topic: str, message_type: str, commands: bool = False, joints: list[str] | None = None
    ) -> None:
        valid = list(_FIELDS) if commands else [STATE_TYPE]
        if message_type not in valid:
            what = "commands of joints" if commands else "joint states"
            raise ValueError(
                f"topic {topic} holds {message_type}, which are no {what} that can be read; these "
                "can:" + "".join(f"\n  {kind}" for kind in valid)
            )
        if message_type == ARRAY and not joints:
            raise ValueError(f"topic {topic} does not name its joints: give --joints in its order")
        self.topic, self.wanted, self._type = topic, _FIELDS[message_type], message_type
        self._names = np.array([joints], "S") if joints else None
        self._collector = Collector()

    def take(self, heard: Heard) -> None:
        """Take the positions of some messages in."""
        if self._type == TRAJECTORY:
            self._trajectory(heard)
        elif self._type == ARRAY:
            assert self._names is not None
            self._add(heard.times, self._names, heard.fields["data"][0].values)
        else:
            (position,) = heard.fields["position"]
            if position.values.shape[1]:  # a message may hold velocities or efforts alone
                names = [leaf.values for leaf in heard.fields["name"]]
                self._add(heard.times, np.concatenate(names, axis=1), position.values)

    def _trajectory(self, heard: Heard) -> None:
        fields, start = heard.fields, heard.times
        for point, position in enumerate(fields["points.positions"]):
            names = np.concatenate([leaf.values for leaf in fields["joint_names"]], axis=1)
            self._add(start, names, position.values, heard.times)
            # the next point is the target from when this one is to be reached
            sec, nanosec = (
                fields[f"points.time_from_start.{part}"][point].values[:, 0].astype(np.int64)
                for part in ("sec", "nanosec")
            )
            start = heard.times + sec * 10**9 + nanosec

    def _add(
        self,
        times: Times,
        names: NDArray[np.bytes_],
        values: NDArray[np.generic],
        issued: Times | None = None,
    ) -> None:
        if names.shape[1] != values.shape[1]:
            raise ValueError(
                f"topic {self.topic}: a message holds {values.shape[1]} positions of "
                f"{names.shape[1]} joints"
            )
        self._collector.add(times, names, np.array([[0]]), values[:, :, None], issued)

    def series(self) -> Series | None:
        """All positions, or None."""
        return self._collector.series()


def chosen(series: Series, joints: list[str], topic: str) -> Series:
    """The joints that are wanted, in their order.

    Raises:
        ValueError: One is not there.
    """
    names = [name for name, _ in series.entries]
    if missing := [name for name in joints if name not in names]:
        raise ValueError(
            f"topic {topic} has no joint {', '.join(missing)}; its joints: {', '.join(names)}"
        )
    mine = [names.index(name) for name in joints]
    return series._replace(entries=[(name, 0) for name in joints], values=series.values[:, mine])


def commanded(series: Series, joints: list[str], at: Times) -> Array:
    """(T, joints) last command of each joint at each sample; NaN before the first one.

    What a trajectory plans for later than the next command of the same joint never counts.
    """
    targets = np.full((len(at), len(joints)), np.nan, np.float32)
    for entry, (name, _) in enumerate(series.entries):
        if name in joints:
            rows = np.flatnonzero(series.reported[:, entry])
            issued = np.unique(series.issued[rows])
            after = np.append(issued, np.iinfo(np.int64).max)
            replaced = after[np.searchsorted(issued, series.issued[rows], side="right")]
            rows = rows[series.times[rows] < replaced]
            only = Series(
                series.times[rows],
                [(name, 0)],
                series.values[rows, entry][:, None],
                series.times[rows],
            )
            targets[:, joints.index(name)] = last(only, at)[:, 0, 0]
    return targets
