"""What ``--traces=true`` writes: every figure can be computed from it again."""

import numpy as np
import pytest

from hasm_torch.evaluation.along_force import SETTLED_AFTER
from hasm_torch.evaluation.rollout import run_case
from hasm_torch.evaluation.runner import make_env, make_teacher
from hasm_torch.evaluation.traces import write_traces
from hasm_torch.evaluation.yielding import cases
from hasm_torch.robot import JOINTS


@pytest.fixture(scope="module")
def rolled():
    """The demonstrator's own rollouts of an even push and one on two patches."""
    env = make_env("yield")
    teacher = make_teacher("yield", env)
    kinds = ("even", "two_patches")
    rollouts = [run_case(case, env, teacher) for case in cases(2, 0, kinds=kinds)]
    env.close()
    return rollouts


def test_a_row_a_control_step_of_all_rollouts(rolled, tmp_path):
    traces = [trace for trace, _ in rolled]
    write_traces(tmp_path / "traces.npz", {"yield": traces, "yield/teacher": traces[:1]})
    read = np.load(tmp_path / "traces.npz")
    rows = sum(len(trace.time) for trace in traces) + len(traces[0].time)
    assert read["joint_names"].tolist() == list(JOINTS)
    for name, shape in {
        "experiment": (), "rollout": (), "time": (), "joints": (11,), "target": (11,), "patch": (),
        "cell": (), "force": (3,), "point": (3,), "object": (3,), "finger_patch": (2,),
        "finger_cell": (2,), "finger_force": (2, 3), "finger_point": (2, 3),
    }.items():  # fmt: skip
        assert read[name].shape == (rows, *shape), name
    for name in read.files:
        assert read[name].dtype.kind in "fiU", name  # numbers and texts, nothing pickled
    assert set(read["experiment"]) == {"yield", "yield/teacher"}
    one = (read["experiment"] == "yield") & (read["rollout"] == 1)
    np.testing.assert_array_equal(read["joints"][one], traces[1].state)
    assert set(read["patch"][one]) == {"", "+".join(filter(None, traces[1].patch[40]))}
    assert np.isnan(read["object"]).all()


def test_the_figures_can_be_computed_again(rolled, tmp_path):
    write_traces(tmp_path / "traces.npz", {"yield": [trace for trace, _ in rolled]})
    read = np.load(tmp_path / "traces.npz")
    for number, (_, figures) in enumerate(rolled):
        rows = np.flatnonzero(read["rollout"] == number)
        time, force, point = (read[name][rows] for name in ("time", "force", "point"))
        size = np.linalg.norm(force, axis=1)
        pressed = np.flatnonzero(size > 0.5)
        used = pressed[time[pressed] > time[pressed[0]] + SETTLED_AFTER + 1e-6]
        step = point[used] - point[used - 1]
        power = (force[used] * step).sum()
        expected = power / (size[used] * np.linalg.norm(step, axis=1)).sum()
        assert figures["motion"].cos == pytest.approx(expected)
        assert figures["motion"].cos > 0.7
