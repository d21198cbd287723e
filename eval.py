"""Roll both experiments out in simulation, or predict the episodes of a dataset.

uv run eval.py
uv run eval.py --checkpoint=outputs/train/compliance --experiments='[compliance]'
uv run eval.py --mode=open_loop --dataset.root=datasets/hsr_grasp --folds=5
"""

import sys

import torch

from hasm_torch.apps.command_line import parse_options
from hasm_torch.evaluation.evaluate import EvalConfig, evaluate
from hasm_torch.evaluation.open_loop import OpenLoopConfig, open_loop


def main() -> None:
    """Evaluate with the options of the command line."""
    config = parse_options(EvalConfig)
    if config.mode == "rollout":
        torch.set_num_threads(1)  # a control step's tensors are too small to share between threads
    try:
        if config.mode == "open_loop":
            open_loop(OpenLoopConfig.of(config))
        else:
            evaluate(config)
    except (OSError, ValueError) as error:
        sys.exit(f"eval.py: {error}")


if __name__ == "__main__":
    main()
