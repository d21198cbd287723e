"""One thread a test process: two processes that take two cores each wait for one another."""

import os

import torch

os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the programs that tests start
torch.set_num_threads(1)
