"""Store the episodes of a LeRobot dataset in a memory and write a checkpoint.

uv run train.py --dataset.root=datasets/hsr_yield --output_dir=outputs/train/yield
"""

from hasm_torch.apps.training import main

if __name__ == "__main__":
    main()
