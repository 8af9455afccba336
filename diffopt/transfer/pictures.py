"""Pictures of precomputed transfer: its mesh, its views, and how it differs from a reference.

After figures 1, 7, 8 and 9 of the glossy-transfer paper. Pictures are sRGB in [0, 1] unless said
otherwise; figures are of matplotlib, to be written by `diffopt.drawing.pictures.save`.
"""

import dataclasses
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from diffopt.errors import InputError
from diffopt.scenes.camera import Camera
from diffopt.scenes.primary import PrimaryCaster
from diffopt.transfer import tessellation
from diffopt.transfer.raster import Raster
from diffopt.transfer.result import Transfer
from diffopt.transfer.views import hemisphere

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Width of an edge of the mesh, pixels, and the share of the colour of a level over the picture.
_LINE, _TINT = 0.9, 0.55
# Of vertices whose material is matte.
_MATTE = (0.62, 0.62, 0.62)
# Width of a picture in a figure, inches.
_WIDTH = 5.2
# Pixels on a side of the window in which structure is compared, at most.
_WINDOW = 7


class Differences(NamedTuple):
    """How far a picture is from a reference, where the reference shows surfaces.

    Attributes
    ----------
    rmse
        Root of the mean squared difference over all channels, over the mean of the reference.
    ssim
        Structural similarity of the pictures as a display shows them: 1 for the same.
    worst
        Largest difference of all but the worst 1 % of the pixels, over the mean, in the channel
        where it is largest.
    noise
        Root of the mean squared standard error of the reference, over the mean: what of `rmse` is
        not the picture's; NaN where it is not known.
    """

    rmse: float
    ssim: float
    worst: float
    noise: float


def differences(
    found: Float[np.ndarray, "h w 3"],
    expected: Float[np.ndarray, "h w 3"],
    surface: Bool[np.ndarray, "h w"],
    factor: float,
    error: Float[np.ndarray, "h w 3"] | None = None,
) -> Differences:
    """Numbers of a comparison.

    Parameters
    ----------
    found, expected
        Linear RGB; the second is the reference.
    surface
        Which pixels count.
    factor
        Exposure of both for the structural similarity, see `displayed`.
    error
        Standard error of the reference.

    Raises
    ------
    InputError
        If no pixel counts.
    """
    if not surface.any():
        raise InputError("surface must hold a pixel; received none")
    mean = max(float(expected[surface].mean()), 1e-30)
    apart = np.abs(found - expected)[surface]
    worst = float(np.percentile(apart.max(-1), 99.0)) / mean
    noise = math.nan if error is None else math.sqrt(float((error[surface] ** 2).mean())) / mean
    like = _similarity(displayed(found, factor), displayed(expected, factor), surface)
    return Differences(math.sqrt(float((apart**2).mean())) / mean, like, worst, noise)


def _similarity(one: np.ndarray, two: np.ndarray, surface: np.ndarray) -> float:
    from skimage.metrics import structural_similarity

    window = min(_WINDOW, *surface.shape)
    window -= 1 - window % 2
    if window < 3:
        return math.nan
    result: Any = structural_similarity(
        one, two, channel_axis=-1, data_range=1.0, win_size=window, full=True
    )
    return float(result[1][surface].mean())


def displayed(rgb: Float[np.ndarray, "h w 3"], factor: float) -> Float[np.ndarray, "h w 3"]:
    """SRGB in [0, 1] of linear RGB times an exposure, with the tone curve of all our pictures."""
    from diffopt.drawing import tones

    return tones.encode(tones.tone(np.maximum(np.asarray(rgb, np.float64), 0.0), factor))


def initial(transfer: Transfer) -> Raster:
    """What cameras see of the triangles before refinement: the same transfer, at their corners."""
    mesh = transfer.mesh
    return Raster(mesh.vertices, mesh.faces[mesh.level == 0])


class _Hits(NamedTuple):
    """Of the samples of a picture, row by row: triangle (-1: none), corners' shares, distance."""

    triangle: Int[np.ndarray, " S"]
    shares: Float[np.ndarray, "S 3"]
    edge: Float[np.ndarray, " S"]
    facing: Float[np.ndarray, " S"]


def _hits(transfer: Transfer, triangles: np.ndarray, camera: Camera, samples: int) -> _Hits:
    """Fronts of triangles that samples see, and how many pixels the nearest edge is away."""
    columns, rows = camera.resolution
    fine = dataclasses.replace(camera, resolution=(columns * samples, rows * samples))
    origin, along = fine.rays(np.arange(rows * columns * samples**2))
    hits = PrimaryCaster(transfer.mesh.vertices, triangles)(fine)
    which = np.full(len(along), -1)
    which[hits.pixel[hits.front]] = hits.face[hits.front]
    met = transfer.mesh.vertices[triangles[np.maximum(which, 0)]]
    normal = np.cross(met[:, 1] - met[:, 0], met[:, 2] - met[:, 0])
    facing = -(normal * along).sum(-1) / np.maximum(np.linalg.norm(normal, axis=-1), 1e-30)
    corners = met - origin[0]
    across = np.cross(corners[:, [1, 2, 0]], corners[:, [2, 0, 1]])
    matrix = camera.matrix[:3, :3]
    step = math.tan(math.radians(0.5 * camera.field_of_view)) / (0.5 * min(camera.resolution))
    ray = along / -(along @ matrix[:, 2])[:, None]
    weight = np.einsum("skj,sj->sk", across, ray)
    total = weight.sum(-1, keepdims=True)
    total = np.where(total == 0.0, 1.0, total)
    shares = weight / total
    # How fast shares change from pixel to pixel: exact for the rays of a pinhole camera.
    slope = across @ (step * matrix[:, :2])
    slope = (slope - shares[..., None] * slope.sum(1, keepdims=True)) / total[..., None]
    away = np.abs(shares) / np.maximum(np.linalg.norm(slope, axis=-1), 1e-30)
    return _Hits(which, np.clip(shares, 0.0, 1.0), away.min(-1), facing)


def wireframe(
    transfer: Transfer,
    camera: Camera,
    picture: Float[np.ndarray, "h w 3"],
    *,
    samples: int = 3,
    title: str = "",
) -> "Figure":
    """The refined mesh over a picture, triangles in the colours of how often they were split.

    Parameters
    ----------
    transfer
        Whose mesh it is.
    camera
        Of the picture, with its resolution.
    picture
        Shaded, sRGB.
    samples
        On a side of each pixel, for the edges.
    title
        Of the figure.
    """
    mesh = transfer.mesh
    triangles, leaf = tessellation.closed(mesh)
    found = _hits(transfer, triangles, camera, samples)
    split = mesh.level[leaf]
    colours = _colours(int(split.max()) + 1)
    shape = (*camera.shape, 3)
    _same(picture, shape)
    met = found.triangle >= 0
    base = _samples(picture, samples)
    # Grey under the colours, so that these mean the level and nothing else.
    grey = np.broadcast_to(base.mean(-1, keepdims=True), base.shape)
    own = colours[split[np.maximum(found.triangle, 0)]]
    tinted = (1.0 - _TINT) * grey + _TINT * own * (0.35 + 0.65 * grey / max(float(grey.max()), 0.1))
    ink = np.clip((0.5 * _LINE - found.edge) * samples + 0.5, 0.0, 1.0)[:, None]
    inked = tinted * (1.0 - 0.85 * ink)
    pixels = np.where(met[:, None], inked, base)
    leaves = tessellation.leaves(mesh)
    counts = np.bincount(mesh.level[leaves], minlength=len(colours))
    words = [f"split {k} times: {_count(n, 'triangle')}" for k, n in enumerate(counts) if n]
    shown = [c for c, n in zip(colours, counts, strict=True) if n]
    return _with_legend(_averaged(pixels, camera, samples), shown, words, title)


def levels(transfer: Transfer, camera: Camera, *, samples: int = 2, title: str = "") -> "Figure":
    """Levels of viewing directions, in the colour of the nearest vertex of each sample.

    Parameters
    ----------
    transfer, camera
        What, and from where.
    samples
        On a side of each pixel.
    title
        Of the figure.
    """
    found = _hits(transfer, transfer.triangles, camera, samples)
    met = found.triangle >= 0
    corner = np.argmax(found.shares, -1)
    vertex = transfer.triangles[np.maximum(found.triangle, 0), corner]
    most = max(int(transfer.level.max()), 0)
    colours = np.concatenate([_colours(most + 1), [_MATTE]])
    shade = 0.45 + 0.55 * np.clip(found.facing, 0.0, 1.0)
    pixels = np.where(met[:, None], colours[transfer.level[vertex]] * shade[:, None], 1.0)
    counts = np.bincount(transfer.level + 1, minlength=most + 2)
    views = hemisphere(most).counts
    words = [
        f"{_count(views[k], 'view')}: {_count(n, 'vertex')}" for k, n in enumerate(counts[1:]) if n
    ]
    shown = [colours[k] for k, n in enumerate(counts[1:]) if n]
    if counts[0]:
        words.append(f"matte: {_count(counts[0], 'vertex')}")
        shown.append(np.array(_MATTE))
    return _with_legend(_averaged(pixels, camera, samples), shown, words, title)


@dataclasses.dataclass(frozen=True)
class Compared:
    """Pictures of a comparison, linear RGB [h, w, 3].

    Attributes
    ----------
    found, coarse
        By all vertices, and by those before refinement only.
    expected
        The reference.
    error
        Its standard error.
    surface
        Which pixels count, [h, w].
    factor
        Exposure.
    reference
        Words on how the reference was made.
    """

    found: Float[np.ndarray, "h w 3"]
    coarse: Float[np.ndarray, "h w 3"]
    expected: Float[np.ndarray, "h w 3"]
    error: Float[np.ndarray, "h w 3"]
    surface: Bool[np.ndarray, "h w"]
    factor: float
    reference: str = "path tracing"

    @property
    def numbers(self) -> tuple[Differences, Differences]:
        """Of all vertices, and of those before refinement."""
        pair = [
            differences(one, self.expected, self.surface, self.factor, self.error)
            for one in (self.found, self.coarse)
        ]
        return pair[0], pair[1]


def comparison(compared: Compared, *, title: str = "") -> "Figure":
    """Ours, the reference, the initial vertices only, and where ours is off, with numbers."""
    from matplotlib.figure import Figure

    rows, columns = compared.surface.shape
    # Never so flat that captions meet, nor taller than a page.
    tall = _WIDTH * min(max(rows / columns, 0.4), 1.5)
    figure = Figure(figsize=(2.0 * _WIDTH + 1.0, 2.0 * tall + 1.4), layout="constrained")
    axes = figure.subplots(2, 2)
    ours, coarse = compared.numbers
    panels = (
        (compared.found, f"Precomputed transfer\n{_caption(ours)}"),
        (compared.expected, f"Reference: {compared.reference}\n{_noise(ours)}"),
        (compared.coarse, f"Initial vertices only\n{_caption(coarse)}"),
    )
    for place, (picture, words) in zip(axes.flat, panels, strict=False):
        place.imshow(displayed(picture, compared.factor), interpolation="nearest")
        place.set_title(words, fontsize=9)
        place.axis("off")
    mean = max(float(compared.expected[compared.surface].mean()), 1e-30)
    apart = 100.0 * np.abs(compared.found - compared.expected).max(-1) / mean
    last = axes.flat[3]
    # Brighter than the worst 1 % of surfaces nothing needs to be told apart.
    drawn = last.imshow(
        np.where(compared.surface, apart, np.nan),
        cmap="inferno",
        vmin=0.0,
        vmax=max(100.0 * ours.worst, 1e-3),
        interpolation="nearest",
    )
    last.set_title("Difference of the two above\nin the channel where it is largest", fontsize=9)
    last.set(xticks=[], yticks=[], facecolor="0.85")
    label = "difference / % of the mean"
    figure.colorbar(drawn, ax=last, label=label, extend="max", shrink=0.9)
    if title:
        figure.suptitle(title, fontsize=11)
    return figure


def _caption(found: Differences) -> str:
    words = [f"RMSE {percent(found.rmse)} of the mean"]
    if not math.isnan(found.ssim):
        words.append(f"SSIM {found.ssim:.3f}")
    return ", ".join([*words, f"worst 1 % above {percent(found.worst)}"])


def _noise(found: Differences) -> str:
    if math.isnan(found.noise):
        return ""
    return f"standard error {percent(found.noise)} of the mean (part of RMSE)"


def percent(share: float) -> str:
    """A share in words, to two digits."""
    return f"{100.0 * share:.0f} %" if share >= 0.1 else f"{100.0 * share:.2g} %"


def _count(number: Any, name: str) -> str:
    many = "vertices" if name == "vertex" else f"{name}s"
    return f"{number:,} {name if number == 1 else many}"


def _colours(count: int) -> Float[np.ndarray, "n 3"]:
    """Colours of levels from 0 on, blue to red: the same for a level in all pictures."""
    import matplotlib

    places = np.minimum(0.1 + 0.16 * np.arange(count), 0.95)
    return np.asarray(matplotlib.colormaps["turbo"](places))[:, :3]


def _same(picture: np.ndarray, shape: tuple[int, ...]) -> None:
    if picture.shape != shape:
        raise InputError(
            f"picture must have the rows and columns of the camera, {shape}; received "
            f"{picture.shape}"
        )


def _samples(picture: np.ndarray, samples: int) -> Float[np.ndarray, "S 3"]:
    """Pixels repeated for the samples in them, row by row of samples."""
    return np.repeat(np.repeat(picture, samples, 0), samples, 1).reshape(-1, 3)


def _averaged(pixels: np.ndarray, camera: Camera, samples: int) -> Float[np.ndarray, "h w 3"]:
    rows, columns = camera.shape
    return pixels.reshape(rows, samples, columns, samples, 3).mean((1, 3))


def _with_legend(pixels: np.ndarray, colours: list[Any], words: list[str], title: str) -> "Figure":
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    rows, columns = pixels.shape[:2]
    # As large as its pixels at the resolution of files, within reason.
    width = min(max(columns / 100.0, 5.0), 16.0)
    lines = -(-len(words) // 3)
    figure = Figure(
        figsize=(width, width * rows / columns + 0.25 * lines + (0.6 if title else 0.25)),
        layout="constrained",
    )
    axes = figure.add_subplot()
    axes.imshow(np.clip(pixels, 0.0, 1.0), interpolation="nearest")
    axes.axis("off")
    if title:
        axes.set_title(title, fontsize=10)
    handles = [
        Patch(facecolor=tuple(colour), edgecolor="0.3", label=label)
        for colour, label in zip(colours, words, strict=True)
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(3, len(words)), fontsize=8)
    return figure
