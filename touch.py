"""Teach the simulated HSR by hand in a browser.

uv run touch.py
uv run touch.py --teach=empty --scene=grasp
"""

from hasm_torch.apps.touch import main

if __name__ == "__main__":
    main()
