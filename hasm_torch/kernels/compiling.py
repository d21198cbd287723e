"""Compiling a kernel for the CPU, on first use."""

import functools
from collections.abc import Callable
from typing import Any

from hasm_torch import kernels


def compile_kernel(kernel: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Compile a function with numba (which loads in about 0.5 s) and keep the result on disk.

    Args:
        kernel: What is compiled; it runs without the interpreter's lock.
        **options: Further options of ``numba.njit``.

    Returns:
        The compiled function; inside ``kernels.disabled`` it is interpreted.
    """

    @functools.cache
    def compiled() -> Callable[..., Any]:
        import numba

        try:
            return numba.njit(nogil=True, cache=True, **options)(kernel)
        except RuntimeError:  # neither the package's folder nor the user's cache can be written
            return numba.njit(nogil=True, **options)(kernel)

    @functools.wraps(kernel)
    def run(*arguments: Any) -> Any:
        return (compiled() if kernels.enabled() else kernel)(*arguments)

    return run
