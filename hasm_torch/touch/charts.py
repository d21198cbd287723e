"""What the robot feels and why it moves, as HTML that a page shows.

Everything is drawn as text: nothing is loaded from anywhere.
"""

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from hasm_torch.robot import JOINTS
from hasm_torch.touch.history import SECONDS, Snapshot, Why

Array = NDArray[np.float64]

WIDTH = 272  # pixels, of all charts
_ROW = 13  # pixels, of a patch in the raster
_NAMES = 82  # pixels, for names on the left
_COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f",
            "#bcbd22", "#17becf", "#000000")  # fmt: skip
_GREY, _BAR, _TEXT = "#e3e6e8", "#2f8f6b", "#444"
_MOST_NEWTONS = 15.0
_STYLE = f"font:12px/1.35 system-ui,sans-serif;color:{_TEXT};width:{WIDTH}px"


def plain(name: str) -> str:
    """A joint's or patch's name as people say it."""
    turn = {"odom_x": "base forward", "odom_y": "base aside", "odom_t": "base turn"}
    return turn.get(name, name.removesuffix("_joint").replace("_", " "))


def felt(snapshot: Snapshot, patches: Sequence[str], lower: Array, upper: Array) -> str:
    """Spikes of each patch, force and joint positions of the last seconds.

    Args:
        snapshot: The moment.
        patches: Names of the patches.
        lower: (J,) lower joint limits, rad or m; minus infinity for none.
        upper: (J,) upper joint limits.
    """
    spikes, joints, force = snapshot.history
    return (
        f'<div style="{_STYLE}">'
        f"<b>What the skin feels</b>, last {SECONDS:g} s (now on the right)"
        f"{_raster(spikes, patches)}"
        f"<b>Force</b> on the skin: {force[-1]:.1f} N{_force(force)}"
        f"<b>Joints</b>, each within its range{_joints(joints, lower, upper)}</div>"
    )


def because(why: Why | None, known: int) -> str:
    """Why the robot last moved: a bar for each association that it drew on most.

    Args:
        why: Why, or None where it has not moved by itself.
        known: How many demonstrations it knows.
    """
    head = f'<div style="{_STYLE}"><b>Why it moves</b>: the moments that it remembers. '
    if not known:
        return f"{head}It knows nothing yet. Record a demonstration and keep it.</div>"
    if why is None:
        return f"{head}It knows {known} demonstrations. Push it to see which of them answer.</div>"
    bars = "".join(
        _bar(i + 1, f"demo {r.episode} at {r.time:.2f} s", r.weight, plain(r.patch))
        for i, r in enumerate(why.reasons)
    )
    new = [
        name
        for name, known_ in (("touch", why.touch_known), ("posture", why.posture_known))
        if not known_
    ]
    sure = f"{100 * why.confidence:.0f} % sure; about {max(1, round(why.spread))} moments share."
    taught = f" This {' and this '.join(new)} was not taught." if new else ""
    return f"{head}<br>{sure}{taught}{bars}</div>"


def _raster(spikes: Array, patches: Sequence[str]) -> str:
    """A row a patch, a stroke for each control step in which it spiked."""
    height = _ROW * len(patches)
    span = WIDTH - _NAMES
    rows, most = [], max(float(spikes.max(initial=0.0)), 1.0)
    for p, patch in enumerate(patches):
        y = _ROW * p
        steps = np.flatnonzero(spikes[:, p])
        strokes = "".join(
            f"M{_NAMES + span * (t + 1) / len(spikes):.0f} {y + _ROW - 1}"
            f"v{-2 - (_ROW - 4) * spikes[t, p] / most:.0f}"
            for t in steps
        )
        rows.append(
            f'<text x="0" y="{y + 10}" font-size="11" fill="{_TEXT}">{escape(plain(patch))}</text>'
            f'<path d="M{_NAMES} {y + _ROW - 0.5}h{span}" stroke="{_GREY}"/>'
            f'<path class="spikes" data-patch="{escape(patch)}" data-count="{len(steps)}" '
            f'd="{strokes}" stroke="#d35400"/>'
        )
    return _svg(height, "".join(rows))


def _force(force: Array) -> str:
    height = 30
    line = _line(force / _MOST_NEWTONS, height, 0, WIDTH)
    return _svg(
        height,
        f'<path d="M0 {height - 0.5}h{WIDTH}M0 .5h{WIDTH}" stroke="{_GREY}"/>'
        f'<text x="2" y="11" font-size="10" fill="#888">{_MOST_NEWTONS:g} N</text>'
        f'<polyline points="{line}" fill="none" stroke="#d35400" stroke-width="1.5"/>',
    )


def _joints(joints: Array, lower: Array, upper: Array) -> str:
    """A line a joint; one without limits is shown within what it did in these seconds."""
    height, lines, keys = 70, [], []
    low = np.where(np.isfinite(lower), lower, joints.min(axis=0) - 0.05)
    high = np.where(np.isfinite(upper), upper, joints.max(axis=0) + 0.05)
    shares = (joints - low) / (high - low)
    for j, (name, colour) in enumerate(zip(JOINTS, _COLOURS, strict=True)):
        points = _line(shares[:, j], height, 0, WIDTH)
        lines.append(f'<polyline points="{points}" fill="none" stroke="{colour}"/>')
        keys.append(f'<span style="color:{colour};white-space:nowrap">&#9644; {plain(name)}</span>')
    border = f'<path d="M0 {height - 0.5}h{WIDTH}M0 .5h{WIDTH}" stroke="{_GREY}"/>'
    key = f'<div style="font-size:10px;line-height:1.25">{" ".join(keys)}</div>'
    return _svg(height, border + "".join(lines)) + key


def _line(shares: Array, height: int, left: int, right: int) -> str:
    """Points of a curve, every other step, shares 0 to 1 from the bottom to the top."""
    shares = np.clip(shares[1::2], 0.0, 1.0)
    x = np.linspace(left, right, len(shares))
    y = (height - 1) * (1.0 - shares) + 0.5
    return " ".join(f"{a:.0f},{b:.1f}" for a, b in zip(x, y))


def _bar(rank: int, label: str, weight: float, patch: str) -> str:
    """A bar that can be pointed at: it presses the button of its number."""
    press = (
        "[...document.querySelectorAll('button')]"
        f".find(b=>b.textContent.trim()==='{rank}')?.click()"
    )
    return (
        f'<div class="recall-bar" data-weight="{weight:.4f}" title="{escape(label)}, touched at '
        f'{escape(patch)}. Its posture is shown in violet." onmouseenter="{press}" '
        f'style="position:relative;height:17px;margin:1px 0;background:#f2f4f5">'
        f'<div style="width:{100 * min(weight, 1.0):.1f}%;height:100%;background:{_BAR};'
        'opacity:.55"></div><span style="position:absolute;left:4px;top:0;line-height:17px">'
        f'{rank}. {escape(label)}</span><span style="position:absolute;right:4px;top:0;'
        f'line-height:17px">{100 * weight:.0f} %</span></div>'
    )


def _svg(height: int, content: str) -> str:
    return (
        f'<svg width="{WIDTH}" height="{height}" viewBox="0 0 {WIDTH} {height}" '
        f'style="display:block;margin:2px 0">{content}</svg>'
    )
