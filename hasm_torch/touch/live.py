"""A robot that is there, as a lesson sees it beyond what a simulation offers."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

REFUSED = {
    **dict.fromkeys(
        ("touch", "press", "lift", "pin"),
        "a live robot is pushed by hand: the page's fingers push the simulated one only",
    ),
    "play": "a demonstration is played from its own start, where a live robot is not put: "
    "push it by hand, and it answers",
}
"""What a live robot is not told by a page, and why."""


@dataclass(frozen=True)
class Status:
    """What a live robot is doing.

    Attributes:
        dry_run: Whether nothing is sent to it.
        emergency: Whether it was stopped until released.
        driven: Whether it follows.
        told: The same in words.
    """

    dry_run: bool
    emergency: bool
    driven: bool
    told: str


@runtime_checkable
class Live(Protocol):
    """What a live robot can do besides."""

    def status(self) -> Status:
        """What it is doing."""

    def emergency_stop(self) -> None:
        """Stop at once, from any thread, until released."""

    def release(self) -> None:
        """End an emergency stop."""
