"""Compiled loops can be switched off, wherever and however long."""

import threading

import numpy as np
import pytest

from hasm_torch import kernels
from hasm_torch.kernels.compiling import compile_kernel


def test_disabled_is_as_long_as_its_context():
    assert kernels.enabled()
    with kernels.disabled():
        assert not kernels.enabled()
        with kernels.disabled():
            assert not kernels.enabled()
        assert not kernels.enabled()
    assert kernels.enabled()
    with pytest.raises(RuntimeError, match="inside"), kernels.disabled():
        raise RuntimeError("inside")
    assert kernels.enabled()


def test_it_counts_in_the_whole_process():
    seen = []
    with kernels.disabled():
        thread = threading.Thread(target=lambda: seen.append(kernels.enabled()))
        thread.start()
        thread.join()
    assert seen == [False]


def test_a_compiled_function_is_interpreted_where_they_are_disabled():
    calls = []

    def double(values, out):
        """Twice the values."""
        for i in range(len(values)):
            out[i] = 2 * values[i]

    def spying(values, out):
        calls.append(len(values))
        double(values, out)

    compiled, spy = compile_kernel(double), compile_kernel(spying)
    assert compiled.__doc__ == "Twice the values."
    values = np.arange(4.0)
    for disabled in (False, True):
        out = np.zeros(4)
        if disabled:
            with kernels.disabled():
                spy(values, out)
        else:
            compiled(values, out)
        np.testing.assert_array_equal(out, 2 * values)
    assert calls == [4]
