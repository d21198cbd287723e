"""One thread a test process: two processes that take two cores each wait for one another."""

import os

import pytest
import torch

from hasm_torch.memory.recall import warm_up

os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the programs that tests start
torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def _compiled() -> None:
    """Recalls are compiled from the first one on, so that equal ones are equal bit for bit."""
    warm_up()
