"""Roll both experiments out in simulation, print one table, write figures and videos.

uv run eval.py
uv run eval.py --checkpoint=outputs/train/compliance --experiments='[compliance]'
"""

import sys

import torch

from hasm_torch.command_line import parse_options
from hasm_torch.evaluation.evaluate import EvalConfig, evaluate


def main() -> None:
    """Evaluate with the options of the command line."""
    config = parse_options(EvalConfig)
    torch.set_num_threads(1)  # a control step's tensors are too small to share between threads
    try:
        evaluate(config)
    except (OSError, ValueError) as error:
        sys.exit(f"eval.py: {error}")


if __name__ == "__main__":
    main()
