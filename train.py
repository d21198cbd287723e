"""Store the episodes of a LeRobot dataset in a memory and write a checkpoint.

uv run train.py --dataset.root=datasets/hsr_compliance --output_dir=outputs/train/compliance
"""

import sys

from hasm_torch.apps.command_line import parse_options
from hasm_torch.apps.training import TrainConfig, describe, settings, train


def main() -> None:
    """Train with the options of the command line."""
    config = parse_options(TrainConfig)
    if config.dataset.root is None or config.output_dir is None:
        sys.exit(
            "train.py needs a dataset and a place for the checkpoint, for example "
            "--dataset.root=datasets/hsr_compliance --output_dir=outputs/train/compliance"
        )
    try:
        method = settings(config.method, config.model)
        trained = train(config.dataset.root, method, config.features, config.robot)
        trained.model.save_pretrained(config.output_dir)
    except (OSError, ValueError) as error:
        sys.exit(f"train.py: {error}")
    print(describe(trained))
    print(f"checkpoint: {config.output_dir}")


if __name__ == "__main__":
    main()
