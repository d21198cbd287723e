"""Checkpoints of the hub, against a cache on this machine: nothing is sent or fetched."""

import re
import shutil
from pathlib import Path

import huggingface_hub
import pytest
import torch
from huggingface_hub import constants
from recordings import episodes, touch, write

from hasm_torch import HASM, HASMConfig
from hasm_torch.data.training import train

COMMIT = "0123456789abcdef0123456789abcdef01234567"


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return train(write("forces", tmp_path_factory.mktemp("set") / "forces"), HASMConfig()).model


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache, and no way to the hub."""
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "cache"


def cached(cache, folder):
    """Lay a folder into the cache as the repository lab/yield."""
    repository = cache / "models--lab--yield"
    shutil.copytree(folder, repository / "snapshots" / COMMIT)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(COMMIT)


def test_a_repository_is_loaded_by_its_name(model, cache, tmp_path):
    model.save_pretrained(tmp_path / "saved")
    cached(cache, tmp_path / "saved")
    for loaded in (HASM.from_pretrained("lab/yield"), HASM.from_pretrained("lab/yield", "main")):
        for name, values in model.state_dict().items():
            assert torch.equal(values, loaded.state_dict()[name]), name
    state, skin = torch.tensor([0.3, 0.2, 0.1]), torch.from_numpy(touch("forces", "fore"))
    for _ in range(5):
        assert torch.equal(loaded.step(state, skin), model.step(state, skin))


def test_a_folder_of_that_name_comes_first(model, cache):
    model.save_pretrained("lab/yield")
    assert HASM.from_pretrained("lab/yield").settled == model.settled


def test_what_is_neither_folder_nor_repository_is_named(cache):
    with pytest.raises(FileNotFoundError, match=r"expected a folder .* or a repository .*lab/none"):
        HASM.from_pretrained("lab/none")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        HASM.from_pretrained("nowhere")


def test_what_is_pushed_can_be_loaded_and_its_card_is_true(model, cache, monkeypatch):
    asked = []

    class Hub:
        def create_repo(self, name, private, exist_ok):
            asked.append((name, private, exist_ok))

        def upload_folder(self, repo_id, folder_path, commit_message):
            cached(cache, folder_path)
            return f"https://hub/{repo_id}/commit/{COMMIT}"

    monkeypatch.setattr(huggingface_hub, "HfApi", Hub)
    address = model.push_to_hub("lab/yield", private=True)
    assert asked == [("lab/yield", True, True)]
    assert address.endswith(COMMIT)
    assert HASM.from_pretrained("lab/yield").settled == model.settled
    card = next(Path(cache).glob("**/README.md")).read_text()
    seconds = sum(len(episode) for episode in episodes("forces")) / model.body.rate
    learned = f"8 episodes, {seconds:.0f} s, {len(model.origins)} associations"
    for said in ("`elbow`, `wrist`, `slide`", learned, model.settled.value, "fore, back"):
        assert said in card, said
    used = re.search(r"```python\n(.*?)```", card, re.DOTALL).group(1)
    state, skin = torch.tensor([0.3, 0.2, 0.1]), torch.zeros(4, 3)
    names = {"state": state, "skin": skin}
    exec(used, names)
    assert names["target"].shape == (3,)
