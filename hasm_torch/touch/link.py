"""The page in a process of its own: what it draws takes no time from the control loop.

Session ──snapshots──► pipe ──► Far ──► Page ──► browsers
◄──commands─── pipe ◄──
"""

import signal
import threading
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from hasm_torch.touch.history import Snapshot
from hasm_torch.touch.page import Page
from hasm_torch.touch.session import Session
from hasm_torch.touch.shelf import Shelf

SENT = 25  # snapshots a second
_STARTED = 120.0  # s in which the page's process has begun on the slowest machine


class Far:
    """A session in another process, as a page sees it.

    Attributes:
        scene: "compliance" or "grasp".
        shelf: What can be loaded.
        snapshot: The newest moment that came.
        ended: Set when the session is gone.

    Args:
        scene: See above.
        shelf: See above.
        snapshots: Where moments come from.
        commands: Where commands go.
    """

    def __init__(
        self, scene: str, shelf: Shelf, snapshots: Connection, commands: Connection
    ) -> None:
        self.scene, self.shelf = scene, shelf
        self._snapshots, self._commands = snapshots, commands
        self._sending = threading.Lock()
        self.ended = threading.Event()
        self.snapshot: Snapshot = snapshots.recv()
        threading.Thread(target=self._follow, name="snapshots", daemon=True).start()

    def send(self, command: str, *arguments: Any) -> None:
        """Send a command."""
        with self._sending:
            self._commands.send((command, arguments))

    def _follow(self) -> None:
        _until_closed(self._next)
        self.ended.set()

    def _next(self) -> None:
        self.snapshot = self._snapshots.recv()


class PageProcess:
    """Serves a session from another process.

    Attributes:
        address: Where browsers find it.

    Args:
        session: What is shown.
        host: Address to listen at.
        port: Port to listen at; the next free one where it is taken.

    Raises:
        OSError: It cannot listen there.
    """

    def __init__(self, session: Session, host: str, port: int) -> None:
        spawn = get_context("spawn")
        seen, self._snapshots = spawn.Pipe(duplex=False)
        self._commands, sent = spawn.Pipe(duplex=False)
        self._session, self._ending = session, threading.Event()
        where = session.scene, session.shelf.root, host, port
        self._process = spawn.Process(target=_serve, args=(seen, sent, *where), daemon=True)
        self._process.start()
        seen.close()
        sent.close()
        self._snapshots.send(session.snapshot)
        self.address = self._begun()
        for work in (self._show, self._obey):
            threading.Thread(target=_until_closed, args=(work,), daemon=True).start()

    def wait(self) -> None:
        """Wait until the page's process ends."""
        self._process.join()

    def close(self) -> None:
        """Stop serving."""
        self._ending.set()
        self._snapshots.close()
        self._process.join()

    def _begun(self) -> str:
        try:
            if self._commands.poll(_STARTED):
                begun, told = self._commands.recv()
                if begun == "address":
                    return str(told)
                raise OSError(told)
        except EOFError:
            pass
        raise OSError("the page's process did not begin")

    def _show(self) -> None:
        if self._ending.wait(1 / SENT):
            raise EOFError
        self._snapshots.send(self._session.snapshot)

    def _obey(self) -> None:
        command, arguments = self._commands.recv()
        self._session.send(command, *arguments)


def _until_closed(work: Callable[[], None]) -> None:
    """Do something again and again until the other end of a pipe is gone."""
    while True:
        try:
            work()
        except (EOFError, OSError):
            return


def _serve(
    snapshots: Connection, commands: Connection, scene: str, root: Path, host: str, port: int
) -> None:
    """What the page's process does until the session is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever started it ends it
    session = Far(scene, Shelf(root), snapshots, commands)
    try:
        page = Page(session, host, port)
    except OSError as error:
        commands.send(("failed", str(error)))
        return
    commands.send(("address", page.address))
    session.ended.wait()
    page.close()
