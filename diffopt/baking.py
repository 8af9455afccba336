"""Baking: |P|^2 over a box of wave vectors, integrated over the spectrum once.

|P|^2 at (u, v, w) and wavelength lambda is a Gaussian sum over the Fourier bins c_rs(s) of
exp(2 pi i s h) near (u, v) / lambda, with s = w / lambda. The bins depend on w and lambda
through s alone and smoothly: a few transforms at Chebyshev points in s serve every
wavelength and every w. The Gaussians are narrow: in blocks of rows and columns each is a
small matrix, so that the cost follows the table and not the heightfield.
"""

import dataclasses
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffopt import bounds
from diffopt.diffraction import DiffractionBRDF
from diffopt.errors import InputError
from diffopt.kernels import frames, gather, phase, spline
from diffopt.lookup import Table
from diffopt.methods import Surface
from diffopt.settings import TableSettings

# Elements of one block of table values that are in flight at once.
BLOCK_ELEMENTS = 1_500_000
# Columns whose bins form one small matrix.
COLUMNS = 32


@dataclasses.dataclass(frozen=True)
class Box:
    """Wave vectors that a table covers: (low, high) of u, v and w, with w within [-2, 0]."""

    u: tuple[float, float]
    v: tuple[float, float]
    w: tuple[float, float]

    @staticmethod
    def around(wave: np.ndarray) -> "Box":
        """The box around wave vectors [n, 3]."""
        low, high = np.asarray(wave, np.float64).min(axis=0), np.asarray(wave).max(axis=0)
        u, v, w = ((float(a), float(b)) for a, b in zip(low, high, strict=True))
        return Box(u, v, w)

    def __post_init__(self) -> None:
        for name in ("u", "v", "w"):
            low, high = getattr(self, name)
            if not (math.isfinite(low) and math.isfinite(high) and low <= high):
                raise InputError(
                    f"{name} must be a range (low, high) with low <= high; received {(low, high)}"
                )
        if self.w[0] < -2.0 - 1e-6 or self.w[1] > 1e-6:
            raise InputError(f"w must lie within [-2, 0]; received {self.w}")


@dataclasses.dataclass(frozen=True)
class Layout:
    """Sizes of a table and of the work to bake it; known before anything is computed.

    Attributes
    ----------
    first, step
        Of u, v and w, as in `diffopt.lookup.Table`.
    columns, rows
        Coefficients in u and v.
    nodes
        Chebyshev points in w.
    intervals
        Spline steps in w.
    spectra
        Chebyshev points in s.
    """

    first: tuple[float, float, float]
    step: tuple[float, float, float]
    columns: int
    rows: int
    nodes: int
    intervals: int
    spectra: int

    def nbytes(self, channels: int, itemsize: int) -> int:
        """Memory of the finished table; baking takes about three times as much."""
        return self.columns * self.rows * (self.intervals + 3) * channels * itemsize


def line_width(surface: Surface, wavelengths: Float[np.ndarray, " L"]) -> Float[np.ndarray, " L"]:
    """Standard deviation of the finest line of |P|^2 in u and v, direction sines.

    For one window |P|^2 is at most as fine as its coherent spot, for the average over
    positions as the Gaussian of source, pixel and window together.
    """
    return wavelengths * bounds.spread(surface, wavelengths) / math.sqrt(2.0)


def height_band(surface: Surface) -> float:
    """Largest |d phase / d s| of |P|^2: 2 pi times the range of the heights."""
    return phase.TWO_PI * float(surface.heights.max() - surface.heights.min())


def layout(surface: Surface, box: Box, wavelengths: np.ndarray, settings: TableSettings) -> Layout:
    """Sizes of a table for a box and settings."""
    step = settings.step * float(line_width(surface, wavelengths).min())
    # Reflection at the ends disturbs the last coefficients; they are left outside.
    pole = spline.decay(settings.order)
    margin = 2 + (math.ceil(math.log(settings.error) / math.log(pole)) if pole > 0.0 else 0)
    counts, firsts = [], []
    for low, high in (box.u, box.v):
        inside = max(1, math.ceil((high - low) / step - 1e-9))
        counts.append(inside + 1 + 2 * margin)
        firsts.append(0.5 * (low + high) - 0.5 * step * (inside + 2 * margin))
    low, high = box.w
    step_w = max(high - low, 1e-3) / settings.intervals
    s_low, s_high = bounds.s_interval(surface, np.array(box.w), wavelengths)
    half = 0.5 * (s_high - s_low) * height_band(surface)
    if surface.coverage != "positions":
        half *= 0.5
    return Layout(
        first=(firsts[0], firsts[1], low - step_w),
        step=(step, step, step_w),
        columns=counts[0],
        rows=counts[1],
        nodes=settings.nodes if surface.follows_w or high - low >= 1e-3 else 1,
        intervals=settings.intervals,
        spectra=phase.chebyshev_nodes(half, settings.error),
    )


def bake(
    brdf: DiffractionBRDF,
    box: Box,
    wavelengths: Float[np.ndarray, " L"],
    weights: Float[np.ndarray, "L K"] | None,
    settings: TableSettings,
    *,
    relative: bool,
    progress: Callable[[int, int], None] | None = None,
) -> Table:
    """Integrate the spectrum over a box of wave vectors.

    Parameters
    ----------
    brdf
        The model, with a coherence window.
    box
        Wave vectors that the table covers.
    wavelengths, weights
        Micrometres, and the weight of each in every channel; without weights each
        wavelength is a channel.
    settings
        Resolution and order.
    relative
        Whether channels are of R/R0 |P|^2 instead of R area / lambda^2 |P|^2.
    progress
        Called with (parts done, parts in all).

    Raises
    ------
    InputError
        If the model has no coherence window or weights facets by the directions
        (``prefactor="kirchhoff"``).
    """
    refuse_table(brdf)
    surface = brdf.surface
    dtype = surface.heights.dtype
    plan = layout(surface, box, wavelengths, settings)
    lam = np.asarray(wavelengths, np.float64)
    if relative:
        before = 1.0 / np.asarray(brdf.fresnel.normal(jnp.asarray(lam, dtype)), np.float64)
    else:
        before = float(brdf.coherent_area) / lam**2
    channels = len(lam) if weights is None else weights.shape[1]
    reach = _reach(surface, lam, settings.error)
    rows = min(plan.rows, max(8, 3 * BLOCK_ELEMENTS // (plan.nodes * plan.columns * channels)))
    blocks = -(-plan.rows // rows)
    rows = -(-plan.rows // blocks)
    low_w, high_w = box.w[0], plan.first[2] + plan.step[2] * (plan.intervals + 1)
    w_nodes = 0.5 * (low_w + high_w) + 0.5 * (high_w - low_w) * np.asarray(
        phase.chebyshev_points(plan.nodes, jnp.float32), np.float64
    )
    line_u = plan.first[0] + plan.step[0] * np.arange(-(-plan.columns // COLUMNS) * COLUMNS)
    line_v = plan.first[1] + plan.step[1] * np.arange(blocks * rows)
    bins = [
        _bins(line, lam, extent, reach)
        for line, extent in ((line_v, surface.extent[0]), (line_u, surface.extent[1]))
    ]
    s_range = jnp.asarray(bounds.s_interval(surface, w_nodes, lam), dtype)
    spectra = _spectra(surface, s_range, plan.spectra, *bins)
    taps = [
        min(count, math.ceil((n - 1) * step * extent / lam.min()) + 2 * reach + 3)
        for (_, count), n, step, extent in zip(
            bins, (rows, COLUMNS), plan.step[1::-1], surface.extent, strict=True
        )
    ]
    matrix = jnp.asarray(spline.from_chebyshev(plan.nodes, plan.intervals), dtype)
    parts = []
    for block in range(blocks):
        part = _bake_block(
            brdf,
            spectra,
            s_range,
            jnp.asarray([bins[0][0], bins[1][0]], jnp.int32),
            jnp.asarray(line_u, dtype),
            jnp.asarray(line_v[block * rows : (block + 1) * rows], dtype),
            jnp.asarray(w_nodes, dtype),
            jnp.asarray(lam, dtype),
            jnp.asarray(before if weights is None else weights * before[:, None], dtype),
            matrix,
            taps=tuple(taps),
        )
        parts.append(part[:, : plan.columns])
        if progress is not None:
            part.block_until_ready()
            progress(block + 1, blocks)
    values = jnp.concatenate(parts)[: plan.rows] if blocks > 1 else parts[0][: plan.rows]
    return Table(
        coefficients=_prefilter(values, settings.order),
        first=jnp.asarray(plan.first, dtype),
        step=jnp.asarray(plan.step, dtype),
        low=jnp.asarray([box.u[0], box.v[0], low_w], dtype),
        high=jnp.asarray([box.u[1], box.v[1], box.w[1]], dtype),
        order=settings.order,
        prefactor=surface.prefactor,
        shadowing=brdf.shadowing,
        relative=relative,
    )


def refuse_table(brdf: DiffractionBRDF) -> None:
    """Raise InputError for a model that cannot be tabulated."""
    if brdf.surface.prefactor == "kirchhoff":
        raise InputError(
            "prefactor 'kirchhoff' weights every facet by the directions and cannot be "
            "tabulated: use method 'direct' or another prefactor"
        )
    if brdf.surface.coverage == "patch":
        raise InputError(
            "method 'table' needs a coherence window: the lines of a bare patch have no "
            "Gaussian shape; give coherence=, or use method 'separable'"
        )


def _reach(surface: Surface, wavelengths: np.ndarray, error: float) -> int:
    """Bins on either side whose Gaussian weight exceeds `error`."""
    spread = float(bounds.spread(surface, wavelengths).max())
    if surface.coverage != "positions":
        spread *= math.sqrt(2.0)
    return math.ceil(math.sqrt(-math.log(0.1 * error)) * spread * max(surface.extent)) + 1


def _bins(line: np.ndarray, lam: np.ndarray, extent: float, reach: int) -> tuple[int, int]:
    """First Fourier bin that a line of u or v needs at any wavelength, and their number."""
    ends = np.outer([line[0], line[-1]], 1.0 / lam) * extent
    first = math.floor(float(ends.min())) - reach - 1
    return first, math.ceil(float(ends.max())) + reach + 2 - first


@eqx.filter_jit
def _spectra(surface, s_range, count, bins_y, bins_x):
    """Bins of the transform at Chebyshev points in s, [count, parts, By, Bx].

    One part, |c|^2, for the average over positions; real and imaginary part of c for one
    window.
    """
    half = 0.5 * (s_range[1] - s_range[0])
    nodes = phase.chebyshev_points(count, s_range.dtype) * half + 0.5 * (s_range[0] + s_range[1])
    (first_y, count_y), (first_x, count_x) = bins_y, bins_x
    r_y, r_x = first_y + np.arange(count_y), first_x + np.arange(count_x)
    heights = surface.heights
    if surface.coverage == "positions":
        values = gather.node_powers(heights, nodes, drop_mean=surface.drop_mean)
    else:
        values = gather.node_spectra(heights, nodes)
    # The spectrum of samples is periodic.
    values = values[:, :, r_y % heights.shape[0]][..., r_x % heights.shape[1]]
    if surface.coverage == "positions":
        return values
    # A window elsewhere turns the phase of every bin.
    dtype = heights.dtype
    turns = (
        jnp.asarray(r_y / surface.extent[0], dtype)[:, None] * surface.center[0]
        + jnp.asarray(r_x / surface.extent[1], dtype)[None, :] * surface.center[1]
    )
    cos, sin = phase.cis_turns(-turns)
    re, im = values[:, 0], values[:, 1]
    cos, sin = cos[None], sin[None]
    return jnp.stack([re * cos - im * sin, re * sin + im * cos], axis=1)


def _gaussians(surface, frequency, first, taps, extent, wavelength):
    """Weights of `taps` bins from `first` for a line of frequencies, [n, taps]."""
    at = (first + jnp.arange(taps, dtype=jnp.int32)).astype(frequency.dtype) / extent
    distance = frequency[:, None] - at[None, :]
    if surface.coverage == "positions":
        return jnp.exp(-((distance / surface.spread(wavelength)) ** 2))
    return jnp.exp(-0.5 * (phase.TWO_PI * surface.sigma * distance) ** 2)


@eqx.filter_jit
def _bake_block(
    brdf, spectra, s_range, first_bins, u, v, w_nodes, wavelengths, weights, matrix, *, taps
):
    """Samples of a block of rows at the spline's places in w, [rows, columns, W, K].

    `weights` [L, K] sum over the wavelengths; [L] keep them apart.
    """
    surface, apart = brdf.surface, weights.ndim == 1
    count, parts, bins_y, bins_x = spectra.shape
    extent_y, extent_x = surface.extent
    groups = u.reshape(-1, COLUMNS)
    middle, half = 0.5 * (s_range[0] + s_range[1]), 0.5 * (s_range[1] - s_range[0])
    nodes = w_nodes.shape[0]
    shape = (nodes, v.shape[0], u.shape[0])
    grid_w, grid_v, grid_u = jnp.meshgrid(w_nodes, v, u, indexing="ij")
    # Corners of the box lie outside all pairs of directions.
    cos_h = jnp.minimum(frames.half_cosine(jnp.stack([grid_u, grid_v, grid_w], -1)), 1.0)

    def offset(frequency, extent, first, taps, bins):
        # The bins around the middle of a line of frequencies, inside what there is.
        centre = 0.5 * (frequency[..., 0] + frequency[..., -1]) * extent
        at = jnp.round(centre).astype(jnp.int32) - taps // 2 - first
        return jnp.clip(at, 0, bins - taps)

    def at_wavelength(total, z):
        wavelength, weight = z
        wave = jnp.stack([jnp.zeros_like(w_nodes)] * 2 + [w_nodes], -1)
        t = (surface.height_phase(wave) / wavelength - middle) / jnp.where(half > 0, half, 1.0)
        to_s = phase.chebyshev_weights(t, count)
        fy, fx = v / wavelength, groups / wavelength
        at_y = offset(fy, extent_y, first_bins[0], taps[0], bins_y)
        rows = jax.lax.dynamic_slice_in_dim(spectra, at_y, taps[0], axis=2)
        rows = jnp.matmul(to_s, rows.reshape(count, -1), precision="highest")
        rows = rows.reshape(nodes * parts, taps[0], bins_x)
        gauss_y = _gaussians(surface, fy, at_y + first_bins[0], taps[0], extent_y, wavelength)
        lines = jnp.einsum("vm,pmx->pvx", gauss_y, rows, precision="highest")
        at_x = offset(fx, extent_x, first_bins[1], taps[1], bins_x)
        gauss_x = jax.vmap(
            lambda f, a: _gaussians(surface, f, a + first_bins[1], taps[1], extent_x, wavelength)
        )(fx, at_x)
        near = jax.vmap(lambda a: jax.lax.dynamic_slice_in_dim(lines, a, taps[1], axis=2))(at_x)
        value = jnp.einsum("gpvm,gum->pvgu", near, gauss_x, precision="highest")
        value = value.reshape(nodes, parts, *shape[1:])
        if surface.coverage == "positions":
            value = value[:, 0] * surface.peak_loss(wavelength)
        else:
            value = (value**2).sum(1)
        value = brdf.fresnel(cos_h.reshape(-1), wavelength[None]).reshape(shape) * value
        if apart:
            return total, value * weight
        return total + value[..., None] * weight[None, None, None, :], None

    zero = None if apart else jnp.zeros((*shape, weights.shape[1]), u.dtype)
    total, each = jax.lax.scan(at_wavelength, zero, (wavelengths, weights))
    if apart:
        return jnp.einsum("wn,knvu->vuwk", matrix, each, precision="highest")
    return jnp.einsum("wn,nvuk->vuwk", matrix, total, precision="highest")


@eqx.filter_jit
def _prefilter(values, order):
    """Spline coefficients in u and v of samples there; in w they are coefficients already."""
    return spline.prefilter(spline.prefilter(values, axis=1, order=order), axis=0, order=order)
