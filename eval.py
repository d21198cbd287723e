"""Roll all experiments out in simulation, or predict the episodes of a dataset.

uv run eval.py
uv run eval.py --checkpoint=outputs/train/yield --experiments='[yield]'
uv run eval.py --mode=open_loop --dataset.root=datasets/hsr_grasp --folds=5
"""

from hasm_torch.apps.evaluation import main

if __name__ == "__main__":
    main()
