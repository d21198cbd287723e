"""train.py and eval.py as a user calls them."""

import importlib
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hasm_torch import HASM
from hasm_torch.data.training import train
from hasm_torch.evaluation.evaluate import evaluate
from hasm_torch.evaluation.options import EvalConfig
from hasm_torch.evaluation.runner import EXPERIMENTS

ROOT = Path(__file__).parents[1]
DATASETS = ROOT / "datasets"
BEHAVIOURS = ["arm_down", "arm_up", "wrist_left", "wrist_right"]
ALONG_FORCE = {"rollouts", "cos_median", "share_07", "share_07_of_teacher", "against",
               "travel_of_teacher"}  # fmt: skip
FIGURES = ("compliance", "force_speed", "yield", "yield_episodes", "yield_recall",
           "recall_weights", "moved_object")  # fmt: skip
GROUPS = {"compliance", "compliance/teacher", "yield", "yield/teacher", "yield/5", "yield/torso",
          "yield/torso/teacher", "yield/unseen_patch", "yield/unseen_patch/teacher", "grasp",
          "grasp/moved_0.02", "grasp/moved_0.05", "grasp/moved_0.10"}  # fmt: skip


def run(program: str, *options: str, cwd: Path, **environment: str):
    """Run a program of the project in another directory."""
    inherited = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    return subprocess.run(
        [sys.executable, str(ROOT / program), *options],
        cwd=cwd,
        env={**inherited, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )


def refusal(program: str, monkeypatch, capsys, *options: str) -> str:
    """What a program says when it ends without having done anything."""
    monkeypatch.setattr(sys, "argv", [f"{program}.py", *options])
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(program).main()
    said = ended.value.code if isinstance(ended.value.code, str) else ""
    assert ended.value.code not in (0, None)
    return said + capsys.readouterr().err


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """What train.py writes for the grasp."""
    directory = tmp_path_factory.mktemp("train")
    done = run("train.py", f"--dataset.root={DATASETS / 'hsr_grasp'}", "--output_dir=deep/model",
               cwd=directory)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "wrist_upper" in done.stdout
    assert "25 episodes" in done.stdout
    return directory / "deep" / "model"


def test_training_writes_the_model_that_training_makes(checkpoint):
    loaded = HASM.from_pretrained(checkpoint)
    again = train(DATASETS / "hsr_grasp", loaded.config).model
    ours, theirs = loaded.state_dict(), again.state_dict()
    assert set(ours) == set(theirs)
    assert all((ours[name] == theirs[name]).all() for name in ours)


def test_evaluation_trains_rolls_out_and_writes_metrics_without_opengl(tmp_path):
    done = run("eval.py", "--rollouts=1", "--forces=[11]", "--episodes=6", "--traces=true",
               "--output_dir=results", f"--datasets={DATASETS}", cwd=tmp_path,
               MUJOCO_GL="glfw")  # fmt: skip
    assert done.returncode == 0, done.stderr
    results = tmp_path / "results"
    metrics = json.loads((results / "metrics.json").read_text())
    assert set(metrics) == {*EXPERIMENTS, "train_seconds", "memory_bytes", "tick_ms"}
    check_compliance(metrics["compliance"])
    check_yield(metrics["yield"])
    assert metrics["grasp"]["success_rate"] in (0.0, 1.0)
    assert metrics["grasp"]["hold_drift_rad"] <= 0.01
    assert set(metrics["grasp"]["moved"]) == {"0.02", "0.05", "0.10"}
    assert metrics["grasp"]["limit_violations"] == 0
    assert 0 < metrics["train_seconds"] < math.inf
    assert 0 < metrics["memory_bytes"] < 1_000_000
    assert set(metrics["tick_ms"]) == {"median", "p99"}
    assert 0 < metrics["tick_ms"]["median"] <= metrics["tick_ms"]["p99"]

    for name in FIGURES:
        assert (results / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
    traces = np.load(results / "traces.npz")
    assert set(traces["experiment"]) == GROUPS
    assert not list(results.glob("*.mp4"))
    for experiment in EXPERIMENTS:
        assert f"no video of {experiment}" in done.stderr
        assert HASM.from_pretrained(results / "checkpoints" / experiment).patches
    assert "Traceback" not in done.stderr
    assert "success_rate" in done.stdout  # the table
    for name in ("metrics.json", "traces.npz"):
        assert str(Path("results") / name) in done.stdout


def check_compliance(found):
    assert list(found["behaviours"]) == BEHAVIOURS
    for figures in found["behaviours"].values():
        assert figures["direction_correct"] == 1.0
        assert figures["release_drift_rad"] <= 0.01
        assert figures["tracking"] >= 0.9
        assert {"spearman", "r2"} <= set(figures)  # of a single force, these say nothing
        [[force, speed]] = figures["velocities"]
        assert force == pytest.approx(11.0, abs=0.5)
        assert speed > 0.0
    assert found["with_force"] == found["correct_turn"] == 1.0
    assert set(found["along_force"]) == ALONG_FORCE
    assert found["limit_violations"] == 0


def check_yield(found):
    assert set(found["along_force"]) == ALONG_FORCE
    assert list(found["episodes"]) == ["5", "6"]
    assert found["episodes"]["6"] == found["along_force"]
    for part in (*found["episodes"].values(), found["unseen_patch"], found["torso"]["along_force"]):
        assert set(part) >= ALONG_FORCE
        assert part["rollouts"] == 1
    assert found["torso"]["base_cos_09"] == 1.0
    for part in (found, found["torso"]):
        assert part["release_drift_rad"] <= 0.01
        assert part["limit_violations"] == 0


def test_a_checkpoint_is_rolled_out(checkpoint, tmp_path):
    done = run("eval.py", f"--checkpoint={checkpoint}", "--experiments=[grasp]", "--rollouts=1",
               "--forces=[12]", "--render=false", "--output_dir=out", cwd=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert "compliance" not in metrics
    assert metrics["train_seconds"] is None
    assert metrics["grasp"]["rollouts"] == 1
    assert "moved" not in metrics["grasp"]  # nobody knows what it was taught
    assert metrics["memory_bytes"] == HASM.from_pretrained(checkpoint).memory_bytes()


@pytest.mark.parametrize(("program", "options"), [
    ("train.py", ["--dataset.root=nowhere", "--output_dir=out"]),
    ("eval.py", ["--checkpoint=nowhere", "--output_dir=out"]),
])  # fmt: skip
def test_a_missing_path_ends_with_a_message(program, options, tmp_path):
    done = run(program, *options, cwd=tmp_path)
    assert done.returncode != 0
    assert f"{program}:" in done.stderr
    assert "nowhere" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


DATASET = f"--dataset.root={DATASETS / 'hsr_grasp'}"
REFUSED = {
    "nothing given": ("train", [], "--dataset.root="),
    "no place": ("train", [DATASET], "--output_dir="),
    "unknown option": ("train", [DATASET, "--colour=red"], "--colour=red"),
    "unknown choice": ("train", [DATASET, "--model.code=paper"], "thermometer"),
    "no number": ("train", [DATASET, "--model.bits=many"], "many"),
    "impossible setting": ("train", [DATASET, "--model.spike_dt_ms=0"], "above 0"),
    "impossible rate": ("train", [DATASET, "--model.max_rate=-1"], "max_rate must be"),
    "settings lost": ("train", [DATASET, "--method=literal", "--model.bits=8"], "literal fixes"),
    "a file for a directory": ("train", [DATASET, f"--output_dir={__file__}"], "exists"),
    "another folder": ("train", [f"--dataset.root={ROOT / 'tests'}"], "LeRobot"),
    "unknown experiment": ("eval", ["--experiments=[juggling]"], "valid: compliance, yield, grasp"),
    "no experiment": ("eval", ["--experiments=[]"], "valid: compliance, yield, grasp"),
    "no rollout": ("eval", ["--rollouts=0"], "rollouts must be at least 1"),
    "too hard a touch": ("eval", ["--forces=[5,99]"], "forces must be"),
    "negative pauses": ("eval", ["--pauses=-1"], "pauses must be"),
    "unknown method": ("eval", ["--method=magic"], "literal"),
    "missing dataset": ("eval", ["--datasets=nowhere"], "nowhere"),
    "too many demonstrations": (
        "eval",
        ["--episodes=81", "--experiments=[yield]", f"--datasets={DATASETS}"],
        "at most 80",
    ),
    "rollouts ahead": ("eval", ["--mode=open_loop", DATASET, "--rollouts=3"], "no --rollouts"),
    "folds of rollouts": ("eval", ["--folds=3", "--horizon_s=1"], "no --folds, --horizon_s"),
    "taught twice": (
        "eval",
        ["--checkpoint=x", "--model.bits=8", "--episodes=9"],
        "trains nothing, takes no --model, --episodes",
    ),
    "a dataset of rollouts": ("eval", [DATASET], "takes --checkpoint, not --dataset.root"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_done_is_refused_with_a_message(case, tmp_path, monkeypatch, capsys):
    program, options, message = REFUSED[case]
    monkeypatch.chdir(tmp_path)
    if case not in ("nothing given", "no place") and "--output_dir" not in str(options):
        options = [*options, "--output_dir=out"]
    assert message in refusal(program, monkeypatch, capsys, *options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"experiments": ["compliance", "juggling"]}, "unknown experiment 'juggling', valid: comp"),
        ({"experiments": []}, "experiments is empty"),
        ({"rollouts": 0}, "rollouts must be at least 1, got 0"),
        ({"episodes": 0}, "episodes must be at least 1, got 0"),
        ({"forces": [0.4]}, "forces must be 0.5 to"),
        ({"forces": [float("nan")]}, "forces must be 0.5 to"),
        ({"start_noise": -0.1}, "start_noise must be finite and not negative"),
        ({"object_noise": float("inf")}, "object_noise must be finite"),
        ({"pauses": -2}, "pauses must be"),
    ],
)
def test_options_that_cannot_be_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        EvalConfig(**changes)


def test_a_checkpoint_of_another_robot_is_refused(checkpoint, tmp_path):
    model = HASM.from_pretrained(checkpoint)
    model.body.joints[0] = "elbow"
    model.save_pretrained(tmp_path / "other")
    with pytest.raises(ValueError, match="simulated robot has the joints"):
        evaluate(EvalConfig(checkpoint=tmp_path / "other", output_dir=tmp_path / "out"))
    assert not (tmp_path / "out").exists()
