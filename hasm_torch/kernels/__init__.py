"""Compiled loops over arrays; each has a torch form that gives the same.

``disabled`` runs everything without them, which tests and machines without a compiler need.
"""

from collections.abc import Iterator
from contextlib import contextmanager

_state = {"enabled": True}


def enabled() -> bool:
    """Whether compiled loops are used where they serve."""
    return _state["enabled"]


@contextmanager
def disabled() -> Iterator[None]:
    """Use the torch forms inside this context, in the whole process."""
    before, _state["enabled"] = _state["enabled"], False
    try:
        yield
    finally:
        _state["enabled"] = before
