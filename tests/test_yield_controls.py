"""The contestants of the yield benchmark that are not in the library, and its statistics."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.baselines.nearest import load, save_nearest
from benchmarks.yield_controls import DEFAULT, MEAN, interval, pick, share, summarise
from hasm_torch import HASM
from hasm_torch.data.body import body_of
from hasm_torch.data.episodes import load_episodes
from hasm_torch.evaluation.along_force import Motion
from hasm_torch.model.control import Touched
from hasm_torch.sim.tasks import YIELD_TORSO

DATASETS = Path(__file__).parents[1] / "datasets"


@pytest.fixture(scope="module")
def data():
    return load_episodes(DATASETS / "hsr_yield")


def test_seeds_draw_demonstrations_at_the_wrist(data):
    torso = [e.index for e in data if e.task == YIELD_TORSO]
    one, other, again = (pick(data, 5, seed) for seed in (1, 2, 1))
    assert [e.index for e in one] == [e.index for e in again] != [e.index for e in other]
    assert [e.index for e in one][5:] == torso
    assert len({e.index for e in one}) == 5 + len(torso)
    with pytest.raises(ValueError, match="at most 80 demonstrations, got 81"):
        pick(data, 81, 0)


def test_the_table_gives_what_the_nearest_sample_did(data, tmp_path):
    few = replace(data, episodes=[*data.episodes[:3], data.episodes[-1]])
    model = HASM(MEAN, body_of(few))
    model.fit(few)
    save_nearest(model, tmp_path)
    table = load(str(tmp_path))
    assert table.settled is not None
    stored = np.load(tmp_path / "nearest.npz")
    patches = model.origins[:, 2]
    for row in (3, 20, 50):  # of the wrist; while the torso is pushed, joints and force stay equal
        patch = int(patches[row])
        coded = stored["keys"][row, :-3] * table.recalling._joint_scale
        positions = np.zeros(11)
        positions[table.settled.joints] = coded
        direction = stored["keys"][row, -3:] / float(stored["weight"])
        touch = Touched(patch, 1.0, 0.5, direction, np.zeros(0))
        found = table.recalling.recall(table.recalling.query(positions, touch), touch)
        np.testing.assert_allclose(found, stored["values"][row])
    # It rolls out like any model.
    skin = torch.zeros(sum(model.body.cells), 3)
    skin[: model.body.cells[0]] = 1.0
    state = torch.from_numpy(few.episodes[0].state[0])
    for _ in range(20):
        state = table.step(state, skin)
    assert (state != torch.from_numpy(few.episodes[0].state[0])).any()


def test_shares_are_compared_case_by_case():
    teacher = np.array([1.0, 1.0, 0.9, 0.2])
    assert share(np.array([0.9, 0.1, -0.5, 0.8]), teacher) == pytest.approx(2 / 3)
    low, high = interval(np.mean, np.arange(100) < 50)
    assert low == pytest.approx(0.4, abs=0.02)
    assert high == pytest.approx(0.6, abs=0.02)

    def motions(*cosines):
        return [Motion(cos, 0.1, 6.0, 0.1, 0.1) for cos in cosines] * 10

    found = summarise(
        {DEFAULT: motions(0.9, 0.9, 0.8, 0.1), "argmax": motions(0.9, 0.2, 0.8, 0.1)},
        motions(1.0, 1.0, 1.0, 1.0),
    )
    assert found[DEFAULT]["share_07_of_teacher"] == 0.75
    assert "default_is_ahead_by" not in found[DEFAULT]
    assert found["argmax"]["default_is_ahead_by"] == pytest.approx(0.25)
    low, high = found["argmax"]["default_is_ahead_by_interval"]
    assert 0.1 < low < 0.25 < high < 0.4
