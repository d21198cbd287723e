"""A trained model as files, in the layout of a LeRobot policy.

    config.json               "type": "hasm", the features, and under "model", "body" and "memories"
                              what a HASM is built from
    model.safetensors         its state dict
    policy_preprocessor.json  LeRobot's steps around the policy, none of which changes a value:
    policy_postprocessor.json radians, metres and newtons go in and come out

Source: LeRobot 0.6, `PreTrainedPolicy.from_pretrained` and `PolicyProcessorPipeline`.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig, MemoryShape, as_dict, write_json

if TYPE_CHECKING:
    from hasm_torch.model.hasm import HASM

CONFIG_FILE, WEIGHTS_FILE = "config.json", "model.safetensors"
STATE, TACTILE, ACTION = "observation.state", "observation.tactile", "action"
POINTS = 3  # force points a cell


@dataclass
class Settings:
    """What a model is built from; arguments of ``HASM``."""

    config: HASMConfig
    body: Body
    shapes: dict[str, MemoryShape]


def save(model: "HASM", directory: Path) -> None:
    """Write a model so that ``HASM.from_pretrained`` and LeRobot can load it.

    Args:
        model: The model.
        directory: Made if it is not there.

    Raises:
        RuntimeError: If the model has learned nothing.
    """
    save_weights(model, directory)
    observations, actions = features(model.body)
    content = {
        "type": "hasm",
        "input_features": observations,
        "output_features": actions,
        "model": as_dict(model.config),
        "body": as_dict(model.body),
        "memories": {patch: as_dict(shape) for patch, shape in model.shapes.items()},
    }
    write_json(directory / CONFIG_FILE, content)
    for name, steps in processors(observations, actions).items():
        write_json(directory / f"{name}.json", {"name": name, "steps": steps})


def save_weights(model: "HASM", directory: Path) -> None:
    """Write ``model.safetensors``, whole or not at all; arguments and errors as in ``save``."""
    from safetensors.torch import save_file

    if not model.memories:
        raise RuntimeError("nothing to save: the model has learned nothing yet")
    directory.mkdir(parents=True, exist_ok=True)
    partial = directory / (WEIGHTS_FILE + ".partial")
    save_file({k: v.contiguous() for k, v in model.state_dict().items()}, partial)
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
        shapes = {p: MemoryShape(**shape) for p, shape in content["memories"].items()}
        return Settings(HASMConfig(**content["model"]), Body(**content["body"]), shapes)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise damaged(directory, error) from error


def load_weights(model: "HASM", directory: Path) -> None:
    """Load ``model.safetensors`` into a model built from the same checkpoint's settings.

    Raises:
        ValueError: If the file is damaged, does not fit the settings, or leaves a memory empty or
            partly filled.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        weights = load_file(directory / WEIGHTS_FILE)
        for name, values in weights.items():
            if values.is_floating_point() and not bool(values.isfinite().all()):
                raise ValueError(f"{name} holds NaN or infinity")
        model.load_state_dict(weights, strict=True)
    except (RuntimeError, ValueError, SafetensorError) as error:
        raise damaged(directory, error) from error
    if not model.memories:
        raise ValueError(f"checkpoint {directory} holds no memory; train it with train.py")
    for name, shape in model.shapes.items():
        count = int(model.memory(name).memory.count)
        if count != shape.capacity:
            raise ValueError(
                f"checkpoint {directory}: the memory {name} holds {count} associations, "
                f"expected {shape.capacity}; train again with train.py"
            )


def features(body: Body) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a policy for a body observes and commands, as LeRobot declares it."""
    joints = len(body.joints)
    observations = {STATE: {"type": "STATE", "shape": [joints]}}
    if body.channels:
        observations[TACTILE] = {"type": "STATE", "shape": [body.readings]}
    return observations, {ACTION: {"type": "ACTION", "shape": [joints]}}


def processors(observations: dict[str, Any], actions: dict[str, Any]) -> dict[str, list[Any]]:
    """LeRobot's usual steps before and after a policy, by file name, with nothing normalised.

    LeRobot sets the steps' options by name when it loads them, so none may be left out.
    """
    identity = {"STATE": "IDENTITY", "ACTION": "IDENTITY"}

    def step(name: str, **config: Any) -> dict[str, Any]:
        return {"registry_name": name, "config": config}

    return {
        "policy_preprocessor": [
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
