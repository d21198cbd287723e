"""Who drives: one page at a time; the others watch."""

import threading


class Seat:
    """The driver's seat, taken by the first page that comes while it is free."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._driver: int | None = None
        self._pages: set[int] = set()

    @property
    def driver(self) -> int | None:
        """The page that drives, or None."""
        return self._driver

    @property
    def pages(self) -> int:
        """How many pages are open."""
        return len(self._pages)

    def join(self, page: int) -> bool:
        """A page opens; tells whether it drives."""
        with self._lock:
            self._pages.add(page)
            if self._driver is None:
                self._driver = page
            return self._driver == page

    def take(self, page: int) -> bool:
        """A page that watches asks for the seat; tells whether it drives now."""
        with self._lock:
            if self._driver is None and page in self._pages:
                self._driver = page
            return self._driver == page

    def leave(self, page: int) -> bool:
        """A page closes; tells whether it drove."""
        with self._lock:
            self._pages.discard(page)
            drove = self._driver == page
            if drove:
                self._driver = None
            return drove
