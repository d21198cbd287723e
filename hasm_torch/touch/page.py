"""The page: a server that draws a session and passes on what people do.

browser ──drags, buttons, keys──► Page ──commands of the driver──► Session
browser ◄──scene, charts, controls── Page ◄──snapshots────────────────┘
"""

import contextlib
import io
import threading
from typing import Any, Protocol

import numpy as np
import viser

from hasm_torch.sim.env import HSRTouchEnv
from hasm_torch.touch.charts import because, felt
from hasm_torch.touch.history import Snapshot
from hasm_torch.touch.lesson import SHOWN_REASONS
from hasm_torch.touch.panel import Panel
from hasm_torch.touch.seat import Seat
from hasm_torch.touch.shelf import Shelf
from hasm_torch.touch.stage import Stage

FRAMES = 20  # a second, of the scene
CHARTS_EVERY, CONTROLS_EVERY = 5, 4  # frames
_SIDE = 300  # pixels, of the panels left and right
_EYE, _LOOKED_AT = (1.15, -1.05, 1.15), (0.22, 0.0, 0.68)  # m
_RANKS = (*(str(rank + 1) for rank in range(SHOWN_REASONS)), "off")


class Shown(Protocol):
    """A session as a page needs it, wherever it runs."""

    scene: str
    shelf: Shelf

    @property
    def snapshot(self) -> Snapshot:
        """The newest moment."""

    def send(self, command: str, *arguments: Any) -> None:
        """Put a command in its queue."""


class LocalServer(viser.ViserServer):
    """A server that nobody can publish: no page may ask for an address outside."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse."""
        return None


class Page:
    """Serves a session to browsers.

    Attributes:
        seat: Which page drives.
        address: Where browsers find it.

    Args:
        session: What is shown; it is started and closed by whoever made it.
        host: Address to listen at; a loopback address keeps everyone else out.
        port: Port to listen at; the next free one where it is taken.
    """

    def __init__(self, session: Shown, host: str = "127.0.0.1", port: int = 8080) -> None:
        self.session, self.seat = session, Seat()
        with contextlib.redirect_stdout(io.StringIO()):  # the address is told once, by whoever asks
            self._server = LocalServer(host, port, label="HASM: teach by touch", verbose=False)
        self.address = f"http://{host}:{self._server.get_port()}"
        self._env = HSRTouchEnv(session.scene)  # its shapes and limits; it is never stepped
        self._stage = Stage(self._server, self._env.model, self._env.skin)
        self._panels: dict[int, Panel] = {}
        self._look()
        self._charts()
        self._listen()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._draw, name="page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._ending.set()
        self._thread.join()
        self._server.stop()

    def _look(self) -> None:
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="small")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_SIDE)
        camera = self._server.initial_camera
        camera.position, camera.look_at, camera.up = _EYE, _LOOKED_AT, (0.0, 0.0, 1.0)

    def _charts(self) -> None:
        gui = self._server.gui
        panel = gui.add_panel()
        with panel.add_tab("Inside the robot"):
            self._why = gui.add_html("")
            postures = gui.add_button_group("Posture of", _RANKS)
            self._felt = gui.add_html("")
        panel.dock_left()
        panel.set_width(_SIDE)

        @postures.on_click
        async def _(event: Any) -> None:
            rank = postures.value
            self._send(event.client_id, "look", None if rank == "off" else int(rank) - 1)

    def _listen(self) -> None:
        """Listen to mouse, keys, and pages that come and go.

        All callbacks are coroutines that only put something in a queue: they run in order.
        """
        for handle in self._stage.skin:
            handle.on_drag("left")(_pushing(self, pin=False))
            handle.on_drag("left", modifier="shift")(_pushing(self, pin=True))
        for handle in self._stage.hand:
            handle.on_drag("left")(_guiding(self))
        for key, label, do in (
            ("R", "Record, or stop recording", lambda panel: panel.toggle()),
            ("K", "Keep what was recorded", lambda panel: panel.keep()),
            ("F", "Forget the last demonstration", "forget"),
            ("P", "Play the touch of the last demonstration", ("play", None, False)),
            ("M", "Play the motion of the last demonstration", ("play", None, True)),
            ("0", "Reset the robot", "reset"),
            ("L", "Let go of all pushes", "let_go"),
            ("G", "Show or hide three ways to recall", lambda panel: panel.show_ghosts()),
            ("U", "Push the chosen patch", lambda panel: panel.push()),
        ):
            self._on_key(key, label, do)

        @self._server.on_client_connect
        async def _(client: viser.ClientHandle) -> None:
            page = client.client_id
            self.seat.join(page)
            self._panels[page] = Panel(
                client.gui,
                lambda command, *arguments: self._send(page, command, *arguments),
                lambda: self._take(page),
                self._env,
                self.session.shelf,
                self.session.snapshot.live is not None,
            )

        @self._server.on_client_disconnect
        async def _(client: viser.ClientHandle) -> None:
            self._panels.pop(client.client_id, None)
            if self.seat.leave(client.client_id):
                self.session.send("left")

    def _on_key(self, key: Any, label: str, do: Any) -> None:
        command = self._server.gui.add_command(label, hotkey=key)

        @command.on_trigger
        async def _(event: Any) -> None:
            panel = self._panels.get(event.client_id)
            if callable(do):
                if panel is not None:
                    do(panel)
            else:
                self._send(event.client_id, *([do] if isinstance(do, str) else do))

    def _send(self, page: int | None, command: str, *arguments: Any) -> None:
        """Pass on what the driver does; the others only watch, but anyone may stop the robot."""
        if command == "emergency" or (page is not None and page == self.seat.driver):
            self.session.send(command, *arguments)

    def _take(self, page: int) -> None:
        self.seat.take(page)

    def _draw(self) -> None:
        frame, snapshot = 0, self.session.snapshot
        # The control loop goes first: while it falls behind, half as much is drawn.
        while not self._ending.wait((1 + snapshot.behind) / FRAMES):
            snapshot = self.session.snapshot
            with self._server.atomic():
                self._stage.draw(snapshot)
            if frame % CHARTS_EVERY == 0:
                self._draw_charts(snapshot)
            if frame % CONTROLS_EVERY == 1:
                driver = self.seat.driver
                for page, panel in list(self._panels.items()):
                    with contextlib.suppress(RuntimeError):  # it was closed a moment ago
                        panel.show(snapshot, page == driver, driver is None, self.seat.pages)
            frame += 1

    def _draw_charts(self, snapshot: Snapshot) -> None:
        env = self._env
        drawn = felt(snapshot, env.skin.patches, env.joint_lower, env.joint_upper)
        why = because(snapshot.why, snapshot.known)
        for handle, content in ((self._felt, drawn), (self._why, why)):
            if handle.content != content:
                handle.content = content


def _pushing(page: Page, pin: bool) -> Any:
    """What a drag on the skin does."""
    begun: dict[int, tuple[float, float]] = {}

    async def drag(event: Any) -> None:
        camera = event.client.camera
        if event.phase == "start":
            begun[event.client_id] = event.start_screen_pos
        at = begun.get(event.client_id, event.end_screen_pos)
        away = np.subtract(event.end_screen_pos, at) * (camera.image_width, camera.image_height)
        pixels = float(np.linalg.norm(away))
        if event.phase == "start":
            eye = np.asarray(camera.position)
            page._send(event.client_id, "touch", eye, event.start_position - eye, pixels)
        elif event.phase == "update":
            page._send(event.client_id, "press", pixels)
        else:
            begun.pop(event.client_id, None)
            page._send(event.client_id, "lift", pin)

    return drag


def _guiding(page: Page) -> Any:
    """What a drag on the gripper does."""

    async def drag(event: Any) -> None:
        if event.phase == "start":
            page._send(event.client_id, "grab", "wrist_roll_link", event.start_position)
        if event.phase == "end":
            page._send(event.client_id, "drop")
        else:
            page._send(event.client_id, "drag", event.end_position)

    return drag
