"""Compiled loops over arrays; each has a torch form that gives the same.

``disabled`` runs everything without them, which tests need. Without numba they are not to be had:
everything then runs as torch operations, and says so once.
"""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

_state = {"enabled": True}
_missing = find_spec("numba") is None


def enabled() -> bool:
    """Whether compiled loops are used where they serve."""
    if _missing and _state["enabled"]:
        warnings.warn(
            "numba is not installed, so recall and encoders run as torch operations, which take "
            'several times longer: pip install "hasm-torch[fast]"',
            stacklevel=2,
        )
        _state["enabled"] = False
    return _state["enabled"]


@contextmanager
def disabled() -> Iterator[None]:
    """Use the torch forms inside this context, in the whole process."""
    before, _state["enabled"] = _state["enabled"], False
    try:
        yield
    finally:
        _state["enabled"] = before
