"""One command writes the tables of all pages, from results that are there."""

import json
import shutil
from pathlib import Path

import pytest

from benchmarks import readme_tables
from benchmarks.machine import RESULTS

ROOT = Path(__file__).resolve().parents[1]

PAGE = "before\n<!-- table:{0} -->\nstale\n<!-- /table:{0} -->\nafter\n"


def along(share: float) -> dict:
    return {"share_07_of_teacher": share, "cos_median": 0.9, "against": 0.0,
            "travel_of_teacher": None}  # fmt: skip


@pytest.fixture
def evaluated() -> dict:
    figures = ("direction_correct", "spearman", "r2", "tracking", "release_drift_rad")
    arm, wrist = ({key: value for key in figures} for value in (1.0, 0.5))
    still = {"release_drift_rad": 0.001, "limit_violations": 0}
    episodes = {"10": along(0.7), "40": along(0.8), "80": along(0.95)}
    return {
        "compliance": {
            "behaviours": {"arm_up": arm | {"with_force": 1.0},
                           "wrist_left": wrist | {"correct_turn": 0.25}},
            "limit_violations": 0,
        },
        "yield": {
            "along_force": along(0.95),
            "episodes": episodes,
            "speed": {"spearman": 0.9, "spearman_of_teacher": 0.9},
            "torso": {"base_cos_09": 1.0, "limit_violations": 2} | still,
            "unseen_patch": along(0.8),
        } | still,
        "grasp": {"success_rate": 1.0, "hold_drift_rad": 0.0, "limit_violations": 1,
                  "moved": {"0.02": 1.0, "0.05": 0.9, "0.10": 0.8}},
        "train_seconds": 1.5, "memory_bytes": 1234567, "tick_ms": {"median": 0.3, "p99": 1.0},
    }  # fmt: skip


def folder(path, results: dict, **pages: str):
    (path / "docs").mkdir()
    (path / "results").mkdir()
    for name, content in results.items():
        (path / "results" / f"{name}.json").write_text(json.dumps(content))
    (path / "README.md").write_text(pages.pop("readme", ""))
    for name, text in pages.items():
        (path / "docs" / f"{name}.md").write_text(text)
    return path / "results", path


def test_tables_of_all_pages_are_written(tmp_path, evaluated):
    part = {"seconds_ahead": 0.5, "hasm": 0.41, "ridge": 0.6, "neighbours": None}
    report = {"one_step": part | {"seconds_ahead": 0.02}, "horizon": part}
    figures = {"share_07_of_teacher": 0.9, "share_07_of_teacher_interval": [0.8, 0.95]}
    session = {
        "pushes": 96, "lessons": 8, "taught_s": 113.2, "learned_s": 0.87,
        "tested": {"memory": along(0.8), "argmax": along(0.6)},
        "forgotten": {"weight_before": 0.7, "weight_after": 0.0},
        "grasp": {"lifted": 5, "starts": 5},
    }  # fmt: skip
    results = {
        "eval_default": evaluated, "eval_literal": evaluated, "open_loop_icub": report,
        "open_loop_g1": report,
        "yield_controls": {"sizes": {"10": {"argmax": figures}}},
        "rules": {"variants": {"no tether": figures | {"travel_of_teacher": 1.02}}},
        "teach_in_two_minutes": session, "teach_single_pushes": session | {"pushes": 8},
        "skin_filter": {"faults": {"lost 0.5": {
            variant: {"yield": figures | {"travel_of_teacher": way}, "compliance": {"success": 1}}
            for variant, way in (("no filter", 0.4), ("whole", 0.8), ("without lost", 0.3))
        }}},
    }  # fmt: skip
    both = PAGE.format("default") + PAGE.format("literal")
    names = ("yield", "open_loop", "controls", "rules", "skin_filter", "teach")
    rest = "".join(PAGE.format(name) for name in names)
    done = readme_tables.write(*folder(tmp_path, results, readme=both, method=rest))
    assert len(done) == 8
    readme, method = (tmp_path / "README.md").read_text(), (tmp_path / "docs/method.md").read_text()
    assert "stale" not in readme + method
    assert readme.count("before") == readme.count("after") == 2
    assert "| compliance, the worst: `r2` | ≥ 0.9 | 0.5 | 0.5 |" in readme
    assert "| compliance, the worst: `correct_turn` | ≥ 1.0 | 0.25 | 0.25 |" in readme
    assert "| `memory_bytes` | ≤ 1,000,000 | 1,234,567 | 1,234,567 |" in readme
    assert "| 80 | 0.95 | 0.9 | 0 | none |" in method
    assert "| iCub | 0.5 s | 0.41 | none | 0.6 |" in method
    assert "| argmax | 0.90 (0.80 to 0.95) |" in method
    assert "| no tether | 0.90 (0.80 to 0.95) | 1.02 |" in method
    assert "| lost 0.5 | 0.90, 0.40, 1.00 | 0.90, 0.80, 1.00 | 0.90, 0.30, 1.00 |" in method
    assert "| G1 | 0.5 s | 0.41 | none | 0.6 |" in method
    assert "| pushes shown | 96 | 8 |" in method
    assert "| the same, argmax | 60% | 60% |" in method
    assert "| time of learning, all lessons | 0.87 s | 0.87 s |" in method
    again = readme_tables.write(tmp_path / "results", tmp_path)
    assert again == done
    assert (tmp_path / "README.md").read_text() == readme


def test_tables_of_speed_and_of_another_robot(tmp_path, evaluated):
    size = {"rows": 100000, "dim": 400, "batch": 1}
    results = {
        "another_robot": {"tested": {"standing still": along(0.0) | {"travel_of_teacher": -1e-9}}},
        "recall": {"results": [
            size | {"contestant": "hasm_torch packed", "seconds": 0.0012},
            size | {"contestant": "torch SDPA", "seconds": 1.2037},
        ]},
        "izhikevich": {"work": {"long run": {"neurons": 1000, "steps": 10000, "ratio": 18.56,
                                             "median_s": {"ours": 0.1326, "norse": 2.4657}}}},
        "eval_default": evaluated,
    }  # fmt: skip
    names = ("another_robot", "recall", "izhikevich", "resources")
    page = "".join(PAGE.format(name) for name in names)
    assert len(readme_tables.write(*folder(tmp_path, results, speed=page))) == 4
    speed = (tmp_path / "docs/speed.md").read_text()
    assert "| standing still | 0.00 | 0.00 |" in speed
    assert "| 100,000 x 400, 1 | 1.2 ms |  |  | 1,204 ms |" in speed
    assert "| long run, 1,000 x 10,000 | 133 ms | 2,466 ms | 18.6 |" in speed
    assert "| memory, bytes | ≤ 1,000,000 | 1,234,567 |" in speed
    assert "| control step, 99 of 100, ms |  | 1 |" in speed


def test_what_the_pages_say_is_what_the_results_say(tmp_path):
    """The committed tables are those that the committed results make."""
    (tmp_path / "docs").mkdir()
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    for page in pages:
        shutil.copy(page, tmp_path / page.relative_to(ROOT))
    done = readme_tables.write(RESULTS, tmp_path)
    assert len(done) >= 16
    assert not [line for line in done if "stays as it is" in line or "no table" in line]
    for page in pages:
        assert (tmp_path / page.relative_to(ROOT)).read_text() == page.read_text(), page.name


def test_a_table_without_results_stays_and_is_told(tmp_path):
    page = PAGE.format("controls") + PAGE.format("nonsense")
    told = readme_tables.write(*folder(tmp_path, {}, readme=page))
    assert (tmp_path / "README.md").read_text() == page
    assert "yield_controls.json" in told[0]
    assert "no table 'nonsense'" in told[1]
