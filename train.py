"""Store the episodes of a LeRobot dataset in a memory and write a checkpoint.

uv run train.py --dataset.root=datasets/hsr_compliance --output_dir=outputs/train/compliance
"""

import sys

import draccus

from hasm_torch.training import TrainConfig, describe, settings, train


def main() -> None:
    """Train with the options of the command line."""
    config = draccus.parse(config_class=TrainConfig)
    if config.dataset.root is None or config.output_dir is None:
        sys.exit(
            "train.py needs a dataset and a place for the checkpoint, for example "
            "--dataset.root=datasets/hsr_compliance --output_dir=outputs/train/compliance"
        )
    try:
        trained = train(config.dataset.root, settings(config.method, config.model))
    except (FileNotFoundError, ValueError) as error:
        sys.exit(f"train.py: {error}")
    trained.model.save_pretrained(config.output_dir)
    print(describe(trained))
    print(f"checkpoint: {config.output_dir}")


if __name__ == "__main__":
    main()
