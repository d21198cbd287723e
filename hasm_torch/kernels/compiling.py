"""Compiling a kernel for the CPU, on first use."""

from collections.abc import Callable
from typing import Any


def compile_kernel(kernel: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Compile a function with numba (which loads in about 0.5 s) and keep the result on disk.

    Args:
        kernel: What is compiled; it runs without the interpreter's lock.
        **options: Further options of ``numba.njit``.
    """
    import numba

    try:
        compiled: Callable[..., Any] = numba.njit(nogil=True, cache=True, **options)(kernel)
    except RuntimeError:  # neither the package's folder nor the user's cache can be written
        compiled = numba.njit(nogil=True, **options)(kernel)
    return compiled
