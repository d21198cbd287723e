"""A trained model as files, in the layout of a LeRobot policy.

    config.json               "type": "hasm", the features, and under "model", "body" and "settled"
                              what a HASM is built from
    model.safetensors         its state dict
    policy_preprocessor.json  LeRobot's steps around the policy, none of which changes a value:
    policy_postprocessor.json radians, metres and the skin's own unit go in and come out

Source: LeRobot 0.6, `PreTrainedPolicy.from_pretrained` and `PolicyProcessorPipeline`.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from hasm_torch._extras import require
from hasm_torch.body import Body
from hasm_torch.config import HASMConfig, as_dict, write_json
from hasm_torch.episode import ACTION, STATE, TACTILE
from hasm_torch.model.settled import Settled

CONFIG_FILE, WEIGHTS_FILE = "config.json", "model.safetensors"


@dataclass
class Settings:
    """What a model is built from; arguments of ``HASM``."""

    config: HASMConfig
    body: Body
    settled: Settled


def save(settings: Settings, tensors: dict[str, Tensor], directory: Path) -> None:
    """Write a model so that ``HASM.from_pretrained`` and LeRobot can load it.

    Args:
        settings: What it is built from.
        tensors: Its state dict.
        directory: Made if it is not there.
    """
    save_weights(tensors, directory)
    observations, actions = features(settings.body)
    content = {
        "type": "hasm",
        "input_features": observations,
        "output_features": actions,
        "model": as_dict(settings.config),
        "body": as_dict(settings.body),
        "settled": as_dict(settings.settled),
    }
    write_json(directory / CONFIG_FILE, content)
    for name, steps in processors(observations, actions).items():
        write_json(directory / f"{name}.json", {"name": name, "steps": steps})


def save_weights(tensors: dict[str, Tensor], directory: Path) -> None:
    """Write ``model.safetensors``, whole or not at all; arguments as in ``save``."""
    require("robot")
    from safetensors.torch import save_file

    directory.mkdir(parents=True, exist_ok=True)
    partial = directory / (WEIGHTS_FILE + ".partial")
    save_file({name: values.contiguous() for name, values in tensors.items()}, partial)
    partial.replace(directory / WEIGHTS_FILE)


def read_settings(directory: Path) -> Settings:
    """Read what a saved model is built from.

    Raises:
        FileNotFoundError: If there is no checkpoint.
        ValueError: If its ``config.json`` is damaged or of something else.
    """
    for name in (CONFIG_FILE, WEIGHTS_FILE):
        if not (directory / name).is_file():
            raise FileNotFoundError(
                f"no {name} in checkpoint {directory}: expected a directory written by train.py, "
                "by HASM.save_pretrained, or the pretrained_model directory of LeRobot's training"
            )
    try:
        content = json.loads((directory / CONFIG_FILE).read_text())
        if "settled" not in content and "memories" in content:
            raise ValueError("it is of an older version, with memories a patch")
        parts = content["model"], content["body"], content["settled"]
        return Settings(HASMConfig(**parts[0]), Body(**parts[1]), Settled(**parts[2]))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise damaged(directory, error) from error


def load_weights(model: nn.Module, directory: Path) -> None:
    """Load ``model.safetensors`` into a model built from the same checkpoint's settings.

    Raises:
        ValueError: If the file is damaged, does not fit the settings, or the memory is not full.
    """
    require("robot")
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        weights = load_file(directory / WEIGHTS_FILE)
        for name, values in weights.items():
            if values.is_floating_point() and not bool(values.isfinite().all()):
                raise ValueError(f"{name} holds NaN or infinity")
        # The layer alone would do without origins; a model could then forget nothing.
        missing = [name for name in model.state_dict() if name not in weights]
        if missing:
            raise ValueError(f"it lacks {', '.join(missing)}")
        model.load_state_dict(weights, strict=True)
        for name, values in weights.items():
            if name.endswith("memory.count"):
                part = name.removesuffix("memory.count")
                held = weights[part + ("where" if part + "where" in weights else "origins")]
                if int(values) != len(held):
                    raise ValueError(f"{int(values)} associations held, expected {len(held)}")
    except (RuntimeError, ValueError, KeyError, SafetensorError) as error:
        raise damaged(directory, error) from error


def features(body: Body) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a policy for a body observes and commands, as LeRobot declares it."""
    joints = len(body.joints)
    observations = {STATE: {"type": "STATE", "shape": [joints]}}
    if body.channels:
        observations[TACTILE] = {"type": "STATE", "shape": [body.readings]}
    for name, entries in body.observations.items():
        observations[name] = {"type": "ENV", "shape": [entries]}
    return observations, {ACTION: {"type": "ACTION", "shape": [joints]}}


def processors(observations: dict[str, Any], actions: dict[str, Any]) -> dict[str, list[Any]]:
    """LeRobot's usual steps before and after a policy, by file name, with nothing normalised.

    LeRobot sets the steps' options by name when it loads them, so none may be left out.
    """
    identity = {"STATE": "IDENTITY", "ENV": "IDENTITY", "ACTION": "IDENTITY"}

    def step(name: str, **config: Any) -> dict[str, Any]:
        return {"registry_name": name, "config": config}

    sizes = {name: feature["shape"][0] for name, feature in observations.items()}
    return {
        "policy_preprocessor": [
            step("hasm_split_state", sizes=sizes),
            step("rename_observations_processor", rename_map={}),
            step("to_batch_processor"),
            step("device_processor", device="cpu", float_dtype=None),
            step("normalizer_processor", features={**observations, **actions}, norm_map=identity),
        ],
        "policy_postprocessor": [
            step("unnormalizer_processor", features=actions, norm_map=identity),
            step("device_processor", device="cpu", float_dtype=None),
        ],
    }


def damaged(directory: Path, error: Exception) -> ValueError:
    """What to raise where the files of a checkpoint make no model."""
    return ValueError(
        f"checkpoint {directory} is damaged or from another version: {error}; "
        "train again with train.py"
    )
