"""Pictures of lit objects band of rows by band, so that large ones are never held whole.

What `diffopt.drawing.views` computes of all samples at once takes some 200 bytes for each.
"""

import dataclasses
from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import Bool, Float

from diffopt import colour, lookup
from diffopt.diffraction import DiffractionBRDF
from diffopt.drawing import shapes, views
from diffopt.errors import InputError

#: Samples that are handled at once.
BAND = 2**20
#: Of some rows: their view, the unit vectors to the light (as for `views.photograph`), and which
#: samples it reaches, None for all whose front it faces.
Part = tuple[shapes.View, Float[np.ndarray, "... 3"], Bool[np.ndarray, "h w"] | None]


@dataclasses.dataclass(frozen=True)
class Shot:
    """An object under its light before a camera.

    Attributes
    ----------
    shape
        Rows and columns.
    part
        From rows of the picture to what they see.
    """

    shape: tuple[int, int]
    part: Callable[[slice], Part]


def bands(shape: tuple[int, int]) -> list[slice]:
    """Rows of a picture, an even number of about `BAND` samples at a time."""
    rows, columns = shape
    step = max(2 * (BAND // (2 * columns)), 2)
    return [slice(first, min(first + step, rows)) for first in range(0, rows, step)]


def extremes(shots: Iterable[Shot]) -> Float[np.ndarray, "n 3"]:
    """Wave vectors between which those of all the pictures lie, for `views.bake`.

    Raises
    ------
    InputError
        If no sample is lit and seen.
    """
    found = []
    for shot in shots:
        for rows in bands(shot.shape):
            view, light, _ = shot.part(rows)
            _, wi, wo = views.wave_vectors(view, light)
            if len(wi):
                waves = -(wi + wo)
                found += [waves.min(axis=0), waves.max(axis=0)]
    if not found:
        raise InputError("no sample of the pictures is lit and seen")
    return np.stack(found)


def gathered(shape: tuple[int, int], seen: Callable[[slice], views.Image]) -> views.Image:
    """The image of a whole picture from those of its rows; float32."""
    colours = [np.zeros((*shape, 3), np.float32) for _ in range(2)]
    masks = [np.zeros(shape, bool) for _ in range(2)]
    for rows in bands(shape):
        found = seen(rows)
        colours[0][rows], colours[1][rows] = found.xyz, found.albedo
        masks[0][rows], masks[1][rows] = found.covered, found.neutral
    return views.Image(*colours, *masks)


def photograph(
    brdf: DiffractionBRDF,
    table: lookup.Table,
    shot: Shot,
    *,
    illuminant: colour.IlluminantLike = "D65",
) -> views.Image:
    """`views.photograph` of an object; float32."""

    def seen(rows: slice) -> views.Image:
        view, light, lit = shot.part(rows)
        return views.photograph(brdf, table, view, light, lit=lit, illuminant=illuminant)

    return gathered(shot.shape, seen)
