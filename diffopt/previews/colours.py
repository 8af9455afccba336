"""Colours as labelled squares."""

from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np

from diffopt import checks
from diffopt.errors import InputError
from diffopt.previews import bundles, markup

Space = Literal["xyz", "rgb"]
#: What linear sRGB may exceed [0, 1] by before a colour counts as out of gamut: whites of
#: tables of other steps differ by 7e-4, and a step of 8 bits near white is 9e-3 wide.
MARGIN = 2e-3
#: Most squares in a row of swatches.
MOST = 64


class Swatches:
    """A row of colours; a notebook shows them as squares with their labels.

    Attributes
    ----------
    linear
        sRGB without encoding, [N, 3]; outside [0, 1] for what a display cannot show.
    shown
        What is drawn, encoded, [N, 3] in [0, 1]: colours out of gamut are mixed with grey of
        their luminance, and brighter ones than white scaled to it.
    labels
        N of them.
    """

    def __init__(self, linear: np.ndarray, shown: np.ndarray, labels: tuple[str, ...]) -> None:
        self.linear, self.shown, self.labels = linear, shown, labels

    @property
    def outside(self) -> np.ndarray:
        """Which colours a display cannot show, [N]."""
        return np.any((self.linear < -MARGIN) | (self.linear > 1.0 + MARGIN), axis=-1)

    @property
    def codes(self) -> tuple[str, ...]:
        """What is drawn as ``#rrggbb``."""
        bits = np.round(255.0 * self.shown).astype(int)
        return tuple("#" + "".join(f"{c:02x}" for c in row) for row in bits)

    def __repr__(self) -> str:
        beyond = self.outside
        words = (
            f"{label} {code}{' (out of gamut)' if out else ''}"
            for label, code, out in zip(self.labels, self.codes, beyond, strict=True)
        )
        return f"Swatches({', '.join(words)})"

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        return bundles.bundle(self, row)


def swatches(
    values: Any, labels: Sequence[Any] | None = None, *, space: Space | str = "xyz"
) -> Swatches:
    """Squares of colours for a notebook.

    Parameters
    ----------
    values
        [..., 3]; XYZ with Y = 1 for a perfect reflector under D65, or linear RGB with the
        primaries of sRGB, by `space`.
    labels
        One for each colour; numbers from 1 if left out.
    space
        ``"xyz"`` or ``"rgb"``.

    Raises
    ------
    InputError
        For values that are not finite [..., 3] or more than `MOST`, another number of labels,
        or another space.
    """
    checks.choice("space", str(space), get_args(Space))
    colours = np.asarray(values, np.float64)
    if colours.ndim == 0 or colours.shape[-1] != 3 or colours.size == 0:
        raise InputError(f"values: expected colours [..., 3], received shape {colours.shape}")
    colours = colours.reshape(-1, 3)
    if len(colours) > MOST:
        raise InputError(f"values: expected at most {MOST} colours, received {len(colours)}")
    if not np.isfinite(colours).all():
        raise InputError("values: expected finite numbers, received NaN or infinity")
    names = range(1, len(colours) + 1) if labels is None else labels
    if len(names) != len(colours):
        raise InputError(f"labels: expected {len(colours)}, received {len(names)}")
    from diffopt import colour
    from diffopt.drawing import tones

    matrix = colour.rgb_matrix()
    xyz = colours if space == "xyz" else colours @ np.linalg.inv(matrix).T
    fitted = tones.display(xyz)
    fitted = fitted / np.maximum(fitted.max(-1, keepdims=True), 1.0)
    return Swatches(xyz @ matrix.T, tones.encode(fitted), tuple(str(name) for name in names))


def row(content: Swatches) -> markup.Markup:
    """HTML of the squares, each with its label, its code, and a mark if out of gamut."""
    squares = zip(content.labels, content.codes, content.outside, strict=True)
    return markup.Markup(
        '<div style="display:flex;flex-wrap:wrap;gap:8px;font-size:12px;line-height:1.3">'
        + "".join(_square(label, code, bool(out)) for label, code, out in squares)
        + "</div>"
    )


def _square(label: str, code: str, outside: bool) -> str:
    # A corner cut off, in grey that differs from every ground.
    cut = "linear-gradient(135deg,#fff 0 11px,#000 11px 13px,transparent 13px)," if outside else ""
    said = "<br />out of gamut" if outside else ""
    return (
        '<div style="width:84px;overflow-wrap:anywhere"><div style="width:84px;height:84px;'
        f'box-sizing:border-box;border:1px solid rgba(128,128,128,0.6);background:{cut}{code}" '
        f'role="img" aria-label="{markup.escape(label)}: {code}"></div>'
        f'<div>{markup.escape(label)}</div><div style="opacity:0.75">{code}{said}</div></div>'
    )
