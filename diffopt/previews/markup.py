"""HTML of a card: pictures, tables and their frame, with everything it needs inside.

Styles are inline, colours and fonts those of the page around, so that cards are legible on
light and dark pages; pictures have a ground of their own. Nothing is fetched and nothing runs.
"""

import base64
import html
import io
import math
import re
from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from diffopt.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Pixels of a picture for each pixel of the page, for displays of high density.
DENSITY = 2.0
#: Pixels of the page for an inch of a figure.
INCH = 100.0
#: Bytes of the pictures of a card: 4/3 of it as text, and tables, stay below 150 kB.
MOST = 90_000

# Half-transparent grey shows on white and on black.
_ROW = "background:transparent;border-bottom:1px solid rgba(128,128,128,0.4);"
_NUMBER = re.compile(r"^[<>≤≥~±]?\s*[+−-]?(\d|∞|—$)")


class Markup(str):
    """Text that is HTML already; every other string is escaped."""

    __slots__ = ()


def escape(text: Any) -> Markup:
    """Text as HTML; `Markup` as it is."""
    return text if isinstance(text, Markup) else Markup(html.escape(str(text), quote=True))


def picture(
    content: "Figure | np.ndarray",
    alt: str,
    *,
    width: float | int | None = None,
    most: int | None = None,
) -> Markup:
    """An ``<img>`` that holds its picture.

    Parameters
    ----------
    content
        A matplotlib figure, which is drawn on white; or an image [h, w], [h, w, 3] or [h, w, 4],
        8-bit or floating in [0, 1] (encoded, as for a display; NaN is drawn as 0).
    alt
        What is seen, for those who do not see it.
    width
        On the page, in its pixels; `INCH` for an inch of a figure, and one for each pixel of an
        image if left out. The picture shrinks with a narrower page.
    most
        Bytes. A picture that is larger is reduced: fewer colours (a figure) or JPEG (an image),
        then fewer pixels.

    Raises
    ------
    InputError
        For an array that is no image.
    """
    if isinstance(content, np.ndarray):
        pixels = _pixels(content)
        found, kind = _encoded_image(pixels, most)
        shown = float(pixels.shape[1] if width is None else width)
        # Few pixels are enlarged as squares, not blurred.
        sharp = "image-rendering:pixelated;" if shown >= 3.0 * pixels.shape[1] else ""
    else:
        shown = float(INCH * content.get_figwidth() if width is None else width)
        found, kind = _encoded_figure(content, shown, most), "png"
        sharp = ""
    data = base64.b64encode(found).decode()
    return Markup(
        f'<img src="data:image/{kind};base64,{data}" alt="{escape(alt)}" width="{shown:.0f}" '
        f'style="width:{shown:.0f}px;max-width:100%;height:auto;{sharp}display:block;margin:0" />'
    )


def key_figures(pairs: Iterable[tuple[Any, Any]]) -> Markup:
    """A table of names and values, a pair in each row."""
    rows = "".join(
        f'<tr style="{_ROW}"><th scope="row" style="{_cell()}font-weight:normal;'
        f'opacity:0.75;white-space:nowrap">{escape(name)}</th>'
        f'<td style="{_cell()}max-width:50ch">{escape(value)}</td></tr>'
        for name, value in pairs
    )
    return Markup(f'<table style="{_TABLE}"><tbody>{rows}</tbody></table>')


def table(
    columns: Sequence[Any],
    rows: Iterable[Sequence[Any]],
    *,
    dimmed: Collection[int] = (),
    strong: Collection[int] = (),
) -> Markup:
    """A table with a head; columns of numbers are set to the right.

    Parameters
    ----------
    columns
        Their titles.
    rows
        Cells, a sequence for each row: text, numbers as text, or `Markup`.
    dimmed, strong
        Numbers of rows that are set back or brought forward.

    Raises
    ------
    InputError
        If a row has another number of cells than there are columns.
    """
    cells = [list(row) for row in rows]
    for row in cells:
        if len(row) != len(columns):
            raise InputError(f"rows: expected {len(columns)} cells in each, received {len(row)}")
    right = [_numeric([row[k] for row in cells]) for k in range(len(columns))]
    head = "".join(
        f'<th scope="col" style="{_cell(r)}font-weight:normal;opacity:0.75;vertical-align:bottom">'
        f"{escape(title)}</th>"
        for title, r in zip(columns, right, strict=True)
    )
    body = []
    for k, row in enumerate(cells):
        style = _ROW + "opacity:0.5;" * (k in dimmed)
        style += "font-weight:bold;" * (k in strong)
        line = "".join(
            f'<td style="{_cell(r)}">{escape(cell)}</td>'
            for cell, r in zip(row, right, strict=True)
        )
        body.append(f'<tr style="{style}">{line}</tr>')
    return Markup(
        f'<div style="overflow-x:auto;max-width:100%"><table style="{_TABLE}"><thead>'
        f'<tr style="{_ROW}">{head}</tr></thead><tbody>{"".join(body)}</tbody>'
        "</table></div>"
    )


def note(text: Any) -> Markup:
    """A sentence in small print, over the whole width of a card."""
    return Markup(
        f'<div style="flex-basis:100%;font-size:12px;opacity:0.75;max-width:90ch">{escape(text)}'
        "</div>"
    )


def folded(summary: Any, content: Any) -> Markup:
    """What is shown at a click on its summary."""
    return Markup(
        '<details style="flex-basis:100%;max-width:100%"><summary style="cursor:pointer;'
        f'opacity:0.75">{escape(summary)}</summary>{escape(content)}</details>'
    )


def spot(colour: Any, size: float | int = 10) -> Markup:
    """A small square of a colour as CSS writes it, for the key of a picture."""
    return Markup(
        f'<span style="display:inline-block;width:{size:g}px;height:{size:g}px;'
        f'background:{escape(colour)};margin-right:5px"></span>'
    )


def card(title: Any, picture: str | None, *parts: str) -> Markup:
    """A title, a picture and what is said about it, side by side where there is room.

    Parameters
    ----------
    title
        Text.
    picture
        HTML of `picture`, or None.
    parts
        HTML of `key_figures`, `table`, `note`, and anything else of this module.
    """
    content = "".join(
        f'<div style="min-width:0;max-width:100%">{part}</div>'
        if not part.startswith(('<div style="flex-basis', "<details"))
        else part
        for part in ((picture,) if picture else ()) + parts
        if part
    )
    return Markup(
        '<div style="font-size:13px;line-height:1.4;color:inherit;max-width:1040px;margin:4px 0">'
        f'<div style="font-weight:600;font-size:14px;margin:0 0 6px 0">{escape(title)}</div>'
        '<div style="display:flex;flex-wrap:wrap;align-items:flex-start;gap:10px 22px">'
        f"{content}</div></div>"
    )


def number(value: Any, digits: int = 4) -> str:
    """A number for people: few digits, a true minus, infinity as a sign."""
    value = float(value)
    if math.isnan(value):
        return "NaN"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value and not 1e-4 <= abs(value) < 1e6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        if "." in mantissa:
            mantissa = mantissa.rstrip("0").rstrip(".")
        return f"{mantissa}e{int(exponent)}".replace("-", "−")
    # Whole numbers of more digits are written out.
    said = f"{value:.0f}" if abs(value) >= 10.0**digits else f"{value:.{digits}g}"
    return said.replace("-", "−")


_TABLE = (
    "border-collapse:collapse;margin:0;font-size:13px;color:inherit;background:transparent;"
    "border:none;font-variant-numeric:tabular-nums"
)


def _cell(right: bool = False) -> str:
    side = "right;white-space:nowrap" if right else "left"
    return f"text-align:{side};padding:2px 14px 2px 0;border:0;vertical-align:top;"


def _numeric(cells: Sequence[Any]) -> bool:
    said = [str(cell).strip() for cell in cells if not isinstance(cell, Markup)]
    said = [cell for cell in said if cell]
    # Sentences that begin with a number are longer.
    return bool(said) and all(_NUMBER.match(cell) and len(cell) <= 24 for cell in said)


def _pixels(image: np.ndarray) -> np.ndarray:
    """8-bit grey, RGB or RGBA."""
    if image.ndim not in (2, 3) or 0 in image.shape or image.shape[2:] not in ((), (3,), (4,)):
        raise InputError(
            f"picture: expected [h, w], [h, w, 3] or [h, w, 4], received {image.shape}"
        )
    if image.dtype == np.uint8:
        return image
    if not np.issubdtype(image.dtype, np.floating):
        raise InputError(f"picture: expected 8-bit or floating values, received {image.dtype}")
    values = np.clip(np.nan_to_num(image, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    return np.round(255.0 * values).astype(np.uint8)


def _encoded_image(pixels: np.ndarray, most: int | None) -> tuple[bytes, str]:
    """The file and its kind: PNG, or JPEG where that is too large."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(pixels))
    found = _written(image, "PNG", optimize=True)
    if most is None or len(found) <= most:
        return found, "png"
    # Noise, which PNG cannot pack. Transparency is kept, with fewer pixels.
    as_jpeg = image.mode != "RGBA"
    while len(found) > most and min(image.size) > 16:
        if as_jpeg:
            found = _written(image, "JPEG", quality=90, subsampling=0)
        else:
            found = _written(image, "PNG", optimize=True)
        if len(found) > most:
            factor = max(0.5, 0.95 * math.sqrt(most / len(found)))
            size = (max(1, round(image.width * factor)), max(1, round(image.height * factor)))
            image = image.resize(size, Image.Resampling.LANCZOS)
    return found, "jpeg" if as_jpeg else "png"


def _encoded_figure(figure: "Figure", width: float, most: int | None) -> bytes:
    """PNG on white; nothing is left in matplotlib's list of open figures."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    FigureCanvasAgg(figure)
    found, density = b"", DENSITY
    while not found or (most is not None and len(found) > most and density > 0.7):
        file = io.BytesIO()
        figure.savefig(
            file, format="png", dpi=density * width / figure.get_figwidth(), facecolor="white"
        )
        # 256 colours are those of a map and the greys of letters: half the size or less.
        image = Image.open(file).convert("RGB")
        found = _written(image, "PNG", optimize=True)
        if most is not None and len(found) > most:
            few = image.quantize(256, dither=Image.Dither.NONE)
            found = _written(few, "PNG", optimize=True)
        density *= 0.8
    return found


def _written(image: Any, kind: str, **options: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()
