"""Checkpoints on the Hugging Face hub: what ``save_pretrained`` writes, and a card."""

import tempfile
from pathlib import Path
from typing import Any

from hasm_torch._extras import require
from hasm_torch.model.checkpoint import CONFIG_FILE, WEIGHTS_FILE

CARD_FILE = "README.md"


def found(name: str | Path, revision: str | None = None) -> Path:
    """The folder of a checkpoint: a folder that is there, else a repository of the hub.

    Args:
        name: A folder, or as text "user/name" of a repository, which is taken from the local cache
            where the hub is not to be reached or ``HF_HUB_OFFLINE`` is set.
        revision: Branch, tag or commit of the repository.

    Raises:
        FileNotFoundError: If there is neither.
    """
    path = Path(name)
    parts = str(name).split("/")
    if isinstance(name, Path) or path.exists() or len(parts) != 2 or not all(parts):
        return path
    require("robot")
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    files = [CONFIG_FILE, WEIGHTS_FILE]
    try:
        return Path(snapshot_download(str(name), revision=revision, allow_patterns=files))
    except (HfHubHTTPError, HFValidationError, LocalEntryNotFoundError) as error:
        raise FileNotFoundError(
            f"expected a folder written by save_pretrained or a repository of the hub, got {name}: "
            "there is no such folder, and no such repository in the cache or within reach"
        ) from error


def push(model: Any, name: str, private: bool = False) -> str:
    """Put a model on the hub, with a card; needs to be logged in there.

    Args:
        model: The ``HASM`` that is put there.
        name: "user/name" of the repository, made if it is not there.
        private: Whether a repository that is made is private.

    Returns:
        Address of the commit.
    """
    require("robot")
    from huggingface_hub import HfApi

    hub = HfApi()
    hub.create_repo(name, private=private, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        model.save_pretrained(folder)
        (Path(folder) / CARD_FILE).write_text(card(model, name))
        done = hub.upload_folder(repo_id=name, folder_path=folder, commit_message="Upload memory")
    return str(done)


def card(model: Any, name: str) -> str:
    """The model card: what a ``HASM`` learned and chose, and what is needed to use it."""
    body, settled = model.body, model.settled
    assert settled is not None
    known, code_dim = model.episodes, model.recalling.code_dim if model.recalling else 0
    seconds = sum(episode.seconds for episode in known)
    joints = ", ".join(f"`{joint}`" for joint in body.joints)
    touch = f"{body.readings} readings of {', '.join(model.patches)}" if body.channels else "none"
    rows = {
        "joints": joints,
        "touch": touch,
        "bound besides": ", ".join(f"`{key}`" for key in body.observations) or "nothing",
        "control rate": f"{body.rate:g} Hz",
        "learned": f"{len(known)} episodes, {seconds:.0f} s, {len(model.origins)} associations",
        "what moves it": f"{settled.drive}, {settled.value}",
        "read-out": f"{settled.readout}, βD = {settled.beta * code_dim:.3g}",
        "size": f"{model.memory_bytes() / 1e3:.0f} kB",
    }
    table = "\n".join(f"| {what} | {said} |" for what, said in rows.items())
    return f"""---
library_name: hasm_torch
pipeline_tag: robotics
tags: [hasm, associative-memory, tactile, lerobot]
---

# {name.rpartition("/")[2]}

A hetero-associative sequential memory that moves a robot by touch, learned with `hasm_torch`.

| | |
| --- | --- |
{table}

```python
from hasm_torch import HASM

model = HASM.from_pretrained("{name}")
target = model.step(state, skin)  # once a control step
```

It is a LeRobot policy of the type `hasm` too: `lerobot-eval --policy.path={name} ...`.
"""
