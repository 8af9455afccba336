"""The words beside the picture: times, and the table of what is in it."""

import html

import numpy as np
from jaxtyping import UInt8

from diffopt.viewer import painting
from diffopt.viewer.screen import PIXELS, Times
from diffopt.viewer.subject import Row

_CELL = "padding:2px 6px;vertical-align:top;border-bottom:1px solid rgba(128,128,128,0.35)"


def status(times: Times | None, text: str) -> str:
    """Measured times and what is going on, as markdown."""
    lines = []
    if times is not None:
        what = (
            f"{times.size[0]}×{times.size[1]} pixels"
            if times.way == PIXELS
            else f"{times.size[0]} vertices"
        )
        lines.append(
            f"{1e3 * times.drawn:.0f} ms to compute {what}, {1e3 * times.shown:.0f} ms until the "
            f"browser had them; {times.rate:.1f} frames/s"
        )
    if text:
        lines.append(f"*{text}*")
    return "\n\n".join(lines) or "…"


def table(rows: list[Row]) -> str:
    """What is in the picture, as HTML; what is out is dim."""
    if not rows:
        return ""
    lines = []
    for row in rows:
        dim = "" if row.included else ";opacity:0.55"
        words = html.escape(row.because)
        if row.settings:
            words += f"<br><small>{html.escape(row.settings)}</small>"
        lines.append(
            f'<tr style="font-size:12px{dim}"><td style="{_CELL}">{html.escape(row.effect)}</td>'
            f'<td style="{_CELL}">{"in" if row.included else "out"}</td>'
            f'<td style="{_CELL}">{words}</td></tr>'
        )
    return (
        f'<table style="border-collapse:collapse;width:100%;margin:4px 0">{"".join(lines)}</table>'
    )


def backdrop() -> UInt8[np.ndarray, "h w 3"]:
    """What is behind a mesh that the browser draws."""
    return painting.backdrop(360, 4)
