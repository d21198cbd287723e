"""The controls of one page: everything that a person can do besides dragging."""

from collections.abc import Callable, Sequence
from functools import partial
from html import escape
from typing import Any

import numpy as np
import viser

from hasm_torch.robot import JOINTS, METRES
from hasm_torch.sim.env import LARGEST_FORCE, HSRTouchEnv
from hasm_torch.sim.tasks import BASE_JOINTS, TEACHING_FORCE
from hasm_torch.touch.charts import plain
from hasm_torch.touch.history import Snapshot
from hasm_torch.touch.shelf import Shelf

HELP = (
    "<b>Drag on a green patch</b> to push it: the longer the drag, the harder. Hold <b>Shift</b> "
    "to let the push stay. <b>Drag the gripper</b> to guide the robot. Drag beside it to look "
    "around."
)
HELP_LIVE = (
    "<b>Push the robot's skin</b> with your hand. <b>Drag the gripper</b> to guide the robot. Drag "
    "beside it to look around."
)
_MODES = {"live": "The robot answers your touch", "record": "Recording", "play": "Playing"}
_NOTHING = "nothing saved yet"
_ROOM = 1.0  # m or rad: how far the sliders of the base reach from where it started

Send = Callable[..., None]


class Panel:
    """Buttons, sliders and what the robot says, of one page.

    Args:
        gui: The page's own controls.
        send: Sends a command of this page.
        take_over: Asks for the driver's seat.
        env: Says what patches and joints there are; it is only read.
        shelf: What can be loaded.
        live: Whether the robot is a live one.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        send: Send,
        take_over: Callable[[], None],
        env: HSRTouchEnv,
        shelf: Shelf,
        live: bool = False,
    ) -> None:
        self._gui, self._send, self._shelf = gui, send, shelf
        self._controls: list[Any] = []
        self._state = gui.add_html("")
        if live:
            stop = gui.add_button("EMERGENCY STOP", color="red")
            _when_pressed(stop, partial(send, "emergency"))  # whoever drives
            self._button("Release", partial(send, "release"), "orange")
        self._progress = gui.add_progress_bar(100.0, animated=True, visible=False)
        self._seat = gui.add_button("Take over", color="orange", visible=False)
        _when_pressed(self._seat, take_over)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Teach"):
            self._teach(list(env.skin.patches), HELP_LIVE if live else HELP)
        with tabs.add_tab("Joints"):
            self._move(env)
        with tabs.add_tab("Files"):
            self._keep_files()
        self._driving: bool | None = None

    def show(self, snapshot: Snapshot, driving: bool, free: bool, pages: int) -> None:
        """Show a moment.

        Args:
            snapshot: The moment.
            driving: Whether this page drives.
            free: Whether nobody does.
            pages: How many pages are open.
        """
        if driving != self._driving:
            self._driving = driving
            for control in self._controls:
                control.disabled = not driving
        _set(self._seat, "visible", free and not driving)
        _set(self._state, "content", _told(snapshot, driving, free, pages))
        _set(self._progress, "visible", snapshot.busy is not None)
        _set(self._record, "label", "Stop (R)" if snapshot.mode == "record" else "Record (R)")
        things = [f"{kind} {name}" for kind, name in self._shelf.things()] or [_NOTHING]
        if tuple(things) != tuple(self._things.options):
            self._things.options = tuple(things)
        for joint, (slider, position) in enumerate(zip(self._sliders, snapshot.state)):
            if joint not in snapshot.slid and abs(slider.value - position) > 0.01:
                slider.value = float(np.clip(position, slider.min, slider.max))

    def toggle(self) -> None:
        """Begin a recording, or end the one that goes on."""
        self._send("stop" if self._record.label.startswith("Stop") else "record")

    def show_ghosts(self) -> None:
        """Show three ways to remember, or hide them."""
        self._ghosts.value = not self._ghosts.value
        self._send("ghosts", self._ghosts.value)

    def keep(self) -> None:
        """Keep what was recorded, under the name that was typed in."""
        self._send("keep", self._task.value)

    def push(self) -> None:
        """Push the chosen patch with the chosen force, until it is let go."""
        self._send("pin", self._patch.value, self._force.value)

    def _teach(self, patches: Sequence[str], told: str) -> None:
        gui, send = self._gui, self._send
        gui.add_html(f'<div style="font:12px/1.35 system-ui,sans-serif;color:#444">{told}</div>')
        self._record = self._button("Record (R)", self.toggle, "red")
        self._button("Keep (K)", self.keep, "green")
        self._button("Forget last (F)", lambda: send("forget"))
        self._button("Play its touch (P)", lambda: send("play", None, False))
        self._button("Play its motion (M)", lambda: send("play", None, True))
        self._button("Reset (0)", lambda: send("reset"))
        self._ghosts: Any = gui.add_checkbox("3 ways to recall (G)", False)
        self._on_change(self._ghosts, lambda value: send("ghosts", value))
        sure = gui.add_slider("Move if sure %", 0, 100, 5, 0)
        self._on_change(sure, lambda value: send("sure", value / 100))
        with gui.add_folder("Push without a mouse"):
            self._patch = gui.add_dropdown("Patch", tuple(patches))
            self._force = gui.add_slider("Newtons", 1.0, LARGEST_FORCE, 0.5, TEACHING_FORCE)
            self._button("Push (U)", self.push)
            self._button("Let go (L)", lambda: send("let_go"))
        self._controls += [self._ghosts, sure, self._patch, self._force]

    def _move(self, env: HSRTouchEnv) -> None:
        gui, send = self._gui, self._send
        base = gui.add_checkbox("Base goes along", False)
        self._on_change(base, lambda value: send("base", value))
        self._controls.append(base)
        self._sliders: list[Any] = []
        for joint, low, high in zip(JOINTS, env.joint_lower, env.joint_upper):
            low, high = (-_ROOM, _ROOM) if joint in BASE_JOINTS else (float(low), float(high))
            unit = "m" if joint in METRES else "rad"
            start = float(np.clip(0.0, low, high))
            slider = gui.add_slider(f"{plain(joint)}, {unit}", low, high, 0.01, start)
            self._on_change(slider, partial(send, "slide", joint))
            self._sliders.append(slider)
        self._controls += self._sliders

    def _keep_files(self) -> None:
        gui, send = self._gui, self._send
        self._task = gui.add_text("What you show", "yield to my hand")
        name = gui.add_text("Name", "my_teaching")
        self._button("Save as LeRobot dataset", lambda: send("save", "dataset", name.value))
        self._button("Save checkpoint", lambda: send("save", "checkpoint", name.value))
        self._things = gui.add_dropdown("Saved", (_NOTHING,))
        self._button("Load", self._load)
        self._controls += [self._task, name, self._things]

    def _load(self) -> None:
        kind, _, name = str(self._things.value).partition(" ")
        if self._things.value != _NOTHING:
            self._send("load", kind, name)

    def _button(self, label: str, action: Callable[[], None], colour: Any = None) -> Any:
        button = self._gui.add_button(label, color=colour)
        _when_pressed(button, action)
        self._controls.append(button)
        return button

    def _on_change(self, control: Any, action: Callable[[Any], None]) -> None:
        @control.on_update
        async def _(event: Any) -> None:
            if event.client_id is not None:  # by the person, not by the program
                action(control.value)


def _when_pressed(button: Any, action: Callable[[], None]) -> None:
    @button.on_click
    async def _(_event: Any) -> None:
        action()


def _set(handle: Any, name: str, value: Any) -> None:
    """Set a property; what is as it was is not sent."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)


def _told(snapshot: Snapshot, driving: bool, free: bool, pages: int) -> str:
    said, failed, number = snapshot.said
    mode = (
        _MODES[snapshot.mode]
        if snapshot.known or snapshot.mode != "live"
        else ("The robot knows nothing yet")
    )
    if snapshot.mode == "record" or snapshot.unkept:
        waits = "" if snapshot.mode == "record" else ": ready to keep"
        mode = f"{'Recording' if not waits else 'Recorded'} {snapshot.recorded:.1f} s{waits}"
    seat = "You drive." if driving else "Nobody drives." if free else "Another page drives."
    if pages > 1:
        seat += f" {pages} pages are open."
    if snapshot.busy is not None:
        said, failed = f"{snapshot.busy[0]} … {snapshot.busy[1]:.0f} s", False
    pace = "falls behind" if snapshot.behind else "real time"
    live, pace = "", f"{snapshot.step_ms:.0f} of 20 ms a step: {pace}"
    if snapshot.live is not None:
        pace = ""  # its samples give the time
        colour = "#b03a2e" if snapshot.live.emergency else "#1e5b8f"
        told = escape(snapshot.live.told)
        live = f'<div class="live" style="font-weight:600;color:{colour}">{told}</div>'
    return (
        '<div style="font:12px/1.4 system-ui,sans-serif;color:#444">'
        f'{live}<div class="mode" style="font-size:15px;font-weight:600">{mode}</div>'
        f'<div class="seat">{seat} It knows {snapshot.known} demonstrations.</div>'
        f'<div class="said" data-number="{number}" style="min-height:34px;'
        f'color:{"#b03a2e" if failed else "#1e6b4f"}">{escape(said)}</div>'
        f'<div class="pace" style="color:{"#b03a2e" if snapshot.behind else "#888"}">'
        f"{pace}</div></div>"
    )
