"""``eval.py``: roll all experiments out in simulation, or predict the episodes of a dataset."""

import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from hasm_torch.apps.command_line import parse_options
from hasm_torch.apps.teach import record_if_missing, teach
from hasm_torch.evaluation.evaluate import evaluate
from hasm_torch.evaluation.open_loop import open_loop
from hasm_torch.evaluation.options import EvalConfig


def main() -> None:
    """Evaluate with the options of the command line."""
    config = parse_options(EvalConfig)
    try:
        if config.mode == "open_loop":
            open_loop(config)
        else:
            roll_out(config)
    except (OSError, ValueError) as error:
        sys.exit(f"eval.py: {error}")


def roll_out(config: EvalConfig) -> None:
    """Evaluate by rollouts, of demonstrations recorded anew where a seed for them is given."""
    torch.set_num_threads(1)  # a control step's tensors are too small to share between threads
    if config.checkpoint is None and config.teach_seed is None:
        record_if_missing(config.datasets, [f"hsr_{name}" for name in config.experiments])
    with TemporaryDirectory() if config.teach_seed is not None else nullcontext() as folder:
        if folder is not None:
            assert config.teach_seed is not None
            names = [f"hsr_{experiment}" for experiment in config.experiments]
            teach(Path(folder), config.teach_seed, names)
            config = replace(config, datasets=Path(folder))
        evaluate(config)
