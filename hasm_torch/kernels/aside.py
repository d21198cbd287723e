"""Getting a kernel ready beside what goes on, so that the first call need not wait for it."""

import threading
from collections.abc import Callable


class Aside[Kernel]:
    """A kernel that is loaded, and on a new machine compiled, in a thread of its own.

    Args:
        load: Gives the kernel, ready to run.
    """

    def __init__(self, load: Callable[[], Kernel]) -> None:
        self._load = load
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._kernel: Kernel | None = None
        self._error: BaseException | None = None

    def ready(self) -> bool:
        """Whether ``get`` returns at once; the first call begins to load.

        Raises:
            BaseException: What loading raised.
        """
        if self._kernel is None:
            self._begin()
            if self._error is not None:
                raise self._error
        return self._kernel is not None

    def get(self) -> Kernel:
        """The kernel; waits for it.

        Raises:
            BaseException: What loading raised.
        """
        if self._kernel is None:
            self._begin().join()
            if self._error is not None:
                raise self._error
            assert self._kernel is not None
        return self._kernel

    def _begin(self) -> threading.Thread:
        with self._lock:
            if self._thread is None:
                # No daemon: a program that ends meanwhile waits, and the kernel is kept on disk.
                self._thread = threading.Thread(target=self._run, name="hasm-kernel")
                self._thread.start()
            return self._thread

    def _run(self) -> None:
        try:
            self._kernel = self._load()
        except BaseException as error:
            self._error = error
