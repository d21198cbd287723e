"""Roll both experiments out in simulation, print one table, write figures and videos.

uv run eval.py
uv run eval.py --checkpoint=outputs/train/compliance --experiments='[compliance]'
"""

import sys

from hasm_torch.command_line import parse_options
from hasm_torch.evaluation.evaluate import EvalConfig, evaluate


def main() -> None:
    """Evaluate with the options of the command line."""
    config = parse_options(EvalConfig)
    try:
        evaluate(config)
    except (OSError, ValueError) as error:
        sys.exit(f"eval.py: {error}")


if __name__ == "__main__":
    main()
