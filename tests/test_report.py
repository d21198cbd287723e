"""The table that an evaluation prints."""

import pytest

from hasm_torch.evaluation.report import table


def metrics(**changes):
    arm = {
        "direction_correct": 1.0, "with_force": 1.0, "spearman": 0.99, "r2": 0.95,
        "tracking": 0.97, "release_drift_rad": 0.001,
    }  # fmt: skip
    wrist = {**arm, "correct_turn": 1.0}
    del wrist["with_force"]
    along = {"share_07_of_teacher": 0.95, "against": 0.0, "travel_of_teacher": 1.0}
    return {
        "compliance": {
            "behaviours": {"arm_up": {**arm, **changes}, "wrist_left": wrist},
            "limit_violations": 0,
        },
        "yield": {
            "along_force": along,
            "episodes": {size: along for size in ("5", "10", "40", "80")},
            "unseen_patch": along,
            "speed": {"spearman": 0.9, "spearman_of_teacher": 0.9},
            "torso": {"base_cos_09": 1.0, "release_drift_rad": 0.0, "limit_violations": 0},
            "release_drift_rad": 0.0,
            "limit_violations": 0,
        },
        "grasp": {
            "success_rate": 0.96, "hold_drift_rad": 0.002, "limit_violations": 0,
            "moved": {"0.02": 1.0, "0.05": 0.95, "0.10": 0.9},
        },
        "train_seconds": 1.5,
        "memory_bytes": 150_000,
        "tick_ms": {"median": 0.3, "p99": 0.9},
    }  # fmt: skip


def marked(found):
    return [line for line in table(found).splitlines() if "!" in line]


def test_the_table_marks_what_misses_its_goal():
    assert not marked(metrics())
    for key, value in (("spearman", 0.97), ("release_drift_rad", 0.02), ("r2", float("nan"))):
        [line] = marked(metrics(**{key: value}))
        assert key in line


@pytest.mark.parametrize(
    ("where", "key", "value", "shown"),
    [
        (("yield", "along_force"), "against", 0.05, "against"),
        (("yield", "along_force"), "travel_of_teacher", 1.3, "travel_of_teacher"),
        (("yield", "along_force"), "travel_of_teacher", None, "travel_of_teacher"),
        (("yield", "torso"), "base_cos_09", 0.9, "base_cos_09"),
        (("grasp", "moved"), "0.10", 0.8, "moved by up to 0.10 m"),
        (("grasp",), "limit_violations", 1, "limit_violations"),
    ],
)
def test_a_figure_that_misses_its_goal_is_marked(where, key, value, shown):
    found = metrics()
    part = found
    for name in where:
        part[name] = dict(part[name])
        part = part[name]
    part[key] = value
    [line] = marked(found)
    assert shown in line


def test_few_demonstrations_need_to_reach_less():
    found = metrics()
    low = found["yield"]["along_force"] | {"share_07_of_teacher": 0.7}
    found["yield"]["episodes"] = dict.fromkeys(("5", "10", "40"), low)
    [line] = marked(found)
    assert "40 episodes" in line


def test_the_table_has_lines_for_what_was_measured_only():
    both = table(metrics())
    assert "train_seconds" in both
    loaded = metrics()
    loaded["train_seconds"] = None
    del loaded["grasp"], loaded["yield"]["episodes"], loaded["yield"]["unseen_patch"]
    shown = table(loaded)
    assert "train_seconds" not in shown
    assert "grasp" not in shown
    assert "episodes" not in shown
    assert "share_07_of_teacher" in shown
