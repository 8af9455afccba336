"""The thesis's gather: Fourier bins near a frequency, weighted by the window's transform.

Tables hold, for each Fourier bin, the coefficients of an expansion of its amplitude c_rs or
of its power |c_rs|^2 in s = w / wavelength (`diffopt.kernels.expansions`): a wavelength and
a direction enter through the functions of the expansion, a_n, and through the weights of the
bins. Both are real, and where the sums are linear (one window, or tables of powers) they
commute: rows of bins are summed first, the terms last. All sums stand *inside* the modulus
(the thesis's eq. 32 has them outside, which can even turn negative). Bins are taken modulo
the table: it is periodic.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.kernels.dtft import power_spectrum
from diffopt.kernels.phase import TWO_PI, cis_turns

# Rows of bins written out one after the other: a loop pass costs more than the row.
ROWS = 32


def height_scale(
    heights: Float[Array, "ny nx"], *, centred: bool
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Base and scale (micrometres) that map the heights to [-1, 1] (centred) or [0, 1].

    Without slopes: what is expanded about the base in units of the scale does not depend on
    them, and that of a maximum is 0 / 0 where the compiler computes the heights twice and
    rounds them in two ways.
    """
    held = jax.lax.stop_gradient(heights)
    low, high = held.min(), held.max()
    base = 0.5 * (low + high) if centred else low
    span = high - base
    return base, jnp.where(span > 0, span, 1.0)


def _amplitude(re: Array, im: Array) -> Array:
    """Fourier coefficients of re + i im with the origin in the middle, [2, ny, nx]."""
    c = jnp.fft.ifft2(jnp.fft.ifftshift(jax.lax.complex(re, im)))
    return jnp.stack([c.real, c.imag])


def taylor_spectra(
    heights: Float[Array, "ny nx"], terms: int, *, centred: bool
) -> Float[Array, "terms 2 ny nx"]:
    """Fourier coefficients of (i t)^n, t the heights scaled to at most 1 (`height_scale`).

    Parameters
    ----------
    heights
        Heights in micrometres, [ny, nx].
    terms
        Number of powers, n = 0 .. terms - 1.
    centred
        Measure heights from their mid-range instead of from their minimum: half the
        argument, the same |P|^2.

    Returns
    -------
    Array
        ``ifft2((i t)^n)``, FFT order, second axis (real, imaginary).
    """
    base, scale = height_scale(heights, centred=centred)
    t = (heights - base) / scale

    def step(power, _):
        re, im = power
        return (-t * im, t * re), _amplitude(re, im)

    _, spectra = jax.lax.scan(step, (jnp.ones_like(t), jnp.zeros_like(t)), length=terms)
    return spectra


def node_spectra(
    heights: Float[Array, "ny nx"], s: Float[Array, " nodes"]
) -> Float[Array, "nodes 2 ny nx"]:
    """Fourier coefficients of exp(2 pi i s (h - hc)) at a few s, hc the mid-range.

    Parameters
    ----------
    heights
        Heights in micrometres, [ny, nx].
    s
        w / wavelength, cycles per micrometre.

    Returns
    -------
    Array
        ``ifft2``, FFT order, second axis (real, imaginary).
    """
    centre, _ = height_scale(heights, centred=True)

    def one(s):
        return _amplitude(*cis_turns(s * (heights - centre)))

    return jax.lax.map(jax.checkpoint(one, prevent_cse=False), s)


def node_powers(
    heights: Float[Array, "ny nx"], s: Float[Array, " nodes"], *, drop_mean: bool = False
) -> Float[Array, "nodes 1 ny nx"]:
    """|c_rs|^2 of exp(2 pi i s h) at a few s, FFT order; see `dtft.power_spectrum`."""

    def one(s):
        return power_spectrum(heights, s, drop_mean=drop_mean)[None]

    return jax.lax.map(jax.checkpoint(one, prevent_cse=False), s)


def project(
    matrix: Float[Array, "terms nodes"], spectra: Float[Array, "nodes parts ny nx"]
) -> Float[Array, "terms parts ny nx"]:
    """Coefficients of an expansion from spectra at its points."""
    flat = jnp.matmul(matrix, spectra.reshape(spectra.shape[0], -1), precision="highest")
    return flat.reshape(matrix.shape[0], *spectra.shape[1:])


def table(
    spectra: Float[Array, "terms parts ny nx"], reach: int
) -> Float[Array, "nyp nxp parts terms"]:
    """Spectra as the gather reads them: zero frequency in the middle, terms innermost.

    Parameters
    ----------
    spectra
        FFT order; parts are (real, imaginary) of an amplitude, or one power.
    reach
        Bins on either side that the gather will take; the table is padded by as many,
        periodically: zero frequency is at ``[reach + ny // 2, reach + nx // 2]``.
    """
    shifted = jnp.fft.fftshift(jnp.transpose(spectra, (2, 3, 1, 0)), axes=(0, 1))
    return jnp.pad(shifted, ((reach, reach), (reach, reach), (0, 0), (0, 0)), mode="wrap")


def whole_pixels(
    center: Float[Array, "2"], pixel: tuple[float, float]
) -> tuple[Array, Float[Array, "2"]]:
    """A window's position (y, x) in whole pixels, and the rest in micrometres.

    The heights are rolled by the first; `move_origin` takes care of the second.
    """
    steps = jnp.asarray(pixel, center.dtype)
    whole = jnp.round(jax.lax.stop_gradient(center) / steps)
    return whole.astype(jnp.int32), center - whole * steps


def move_origin(
    tables: Float[Array, "nyp nxp 2 terms"], turns: Float[Array, "2"], reach: int
) -> Float[Array, "nyp nxp 2 terms"]:
    """Tables of amplitudes under a window that is not in the middle.

    A window at x0 weighs the bin at f_r by exp(2 pi i (f - f_r) x0) as well. The first
    half is one phase for all bins, which |P|^2 does not see; the second belongs to the bin,
    and with it in the table the weights stay real.

    Parameters
    ----------
    tables
        From `table`, of amplitudes.
    turns
        Position (y, x) over the size of the patch.
    reach
        As for `table`.
    """
    factors = []
    for axis in (0, 1):
        padded = tables.shape[axis]
        # Bins beyond the ends are the aliases that stand there, not those they copy.
        bins = jnp.arange(padded, dtype=turns.dtype) - (reach + (padded - 2 * reach) // 2)
        factors.append(cis_turns(-bins * turns[axis]))
    (yr, yi), (xr, xi) = factors
    re = (jnp.outer(yr, xr) - jnp.outer(yi, xi))[:, :, None]
    im = (jnp.outer(yr, xi) + jnp.outer(yi, xr))[:, :, None]
    a, b = tables[:, :, 0], tables[:, :, 1]
    return jnp.stack([a * re - b * im, a * im + b * re], 2)


def axis_bins(
    samples: int, step: float, frequency: Float[Array, "*batch"], reach: int
) -> tuple[Array, Float[Array, " taps *batch"]]:
    """First bin of the gather in the padded table, and the distance of every bin taken.

    Returns
    -------
    tuple
        Index into the padded axis, [*batch], and f - f_r in cycles per micrometre for the
        ``2 reach + 1`` bins, these on the first axis: the longest axis last is what the
        compiler turns into vector instructions.
    """
    nearest = jnp.round(jax.lax.stop_gradient(frequency) * (samples * step))
    offset = jnp.arange(-reach, reach + 1, dtype=frequency.dtype)
    offset = offset.reshape(-1, *(1,) * frequency.ndim)
    distance = frequency[None] - (nearest[None] + offset) / (samples * step)
    # Zero frequency sits at samples // 2; the table starts `reach` bins earlier.
    index = jnp.mod(nearest.astype(jnp.int32) + samples // 2, samples)
    return index, distance


def gather_bins(
    tables: Float[Array, "nyp nxp parts terms"],
    coefficients: Float[Array, " terms"],
    anchor: tuple[Array, Array],
    *,
    taps: int,
) -> Float[Array, "taps taps parts"]:
    """The expansion in each of the `taps` x `taps` bins at an anchor.

    Parameters
    ----------
    tables
        From `table`.
    coefficients
        a_n at this s.
    anchor
        Index of the first bin (y, x) in the padded table.
    taps
        Bins taken on each axis.
    """
    parts, terms = tables.shape[2:]
    block = jax.lax.dynamic_slice(
        tables.reshape(tables.shape[0], -1),
        (anchor[0], anchor[1] * (parts * terms)),
        (taps, taps * parts * terms),
    )
    out = jnp.matmul(block.reshape(-1, terms), coefficients, precision="highest")
    return out.reshape(taps, taps, parts)


def gather_sum(
    tables: Float[Array, "nyp nxp parts terms"],
    coefficients: Float[Array, " terms"],
    anchor: tuple[Array, Array],
    wx: Float[Array, " taps"],
    wy: Float[Array, " taps"],
) -> Float[Array, " parts"]:
    """Weighted sum of the expansions in the bins at an anchor, the terms summed last.

    Equal to ``wy @ gather_bins(...) @ wx`` at a fraction of its time: each row of bins is
    one run of memory, added up with its weight and stored nowhere in between.

    Parameters
    ----------
    tables, coefficients, anchor
        As in `gather_bins`.
    wx, wy
        Weights of the bins along each axis.
    """
    taps = wx.shape[0]
    parts, terms = tables.shape[2:]
    # Two axes alone: the compiler's gather computes an index for every axis and element.
    rows = tables.reshape(tables.shape[0], -1)
    start = anchor[1] * (parts * terms)

    def add(total, row):
        index, weight = row
        return total + weight * jax.lax.dynamic_slice(
            rows, (index, start), (1, taps * parts * terms)
        ), None

    indices = anchor[0] + jnp.arange(taps, dtype=anchor[0].dtype)
    zero = jnp.zeros((1, taps * parts * terms), tables.dtype)
    total, _ = jax.lax.scan(add, zero, (indices, wy), unroll=min(taps, ROWS))
    columns = jnp.matmul(wx, total.reshape(taps, parts * terms), precision="highest")
    return jnp.matmul(columns.reshape(parts, terms), coefficients, precision="highest")


def coherent(
    tables: Float[Array, "nyp nxp 2 terms"],
    coefficients: Float[Array, " terms"],
    x: tuple[Array, Float[Array, " taps"]],
    y: tuple[Array, Float[Array, " taps"]],
    sigma: Float[Array, ""],
) -> Float[Array, ""]:
    """|P|^2 of one window: the gather with the window's transform, then the modulus.

    Parameters
    ----------
    tables
        Of amplitudes, with the window's position in them (`move_origin`).
    coefficients
        As in `gather_bins`.
    x, y
        From `axis_bins` for each axis.
    sigma
        sigma_s of the window, micrometres.
    """
    wx = jnp.exp(-0.5 * (TWO_PI * sigma * x[1]) ** 2)
    wy = jnp.exp(-0.5 * (TWO_PI * sigma * y[1]) ** 2)
    amplitude = gather_sum(tables, coefficients, (y[0], x[0]), wx, wy)
    return (amplitude**2).sum()


def averaged(
    tables: Float[Array, "nyp nxp parts terms"],
    coefficients: Float[Array, " terms"],
    x: tuple[Array, Float[Array, " taps"]],
    y: tuple[Array, Float[Array, " taps"]],
    spread: Float[Array, ""],
) -> Float[Array, ""]:
    """|P|^2 averaged over window positions: the gather of |c|^2 with the squared weights.

    Parameters
    ----------
    tables
        Of powers (one part), or of amplitudes (two), whose square is then taken for each
        bin: four to six times the time.
    coefficients, x, y
        As in `coherent`.
    spread
        Width of exp(-df^2 / spread^2), cycles per micrometre.
    """
    wx = jnp.exp(-((x[1] / spread) ** 2))
    wy = jnp.exp(-((y[1] / spread) ** 2))
    if tables.shape[2] == 1:
        return gather_sum(tables, coefficients, (y[0], x[0]), wx, wy)[0]
    bins = gather_bins(tables, coefficients, (y[0], x[0]), taps=wx.shape[0])
    return jnp.vdot(wy, jnp.matmul((bins**2).sum(-1), wx, precision="highest"))


def omitted_weight(reach: int, step_over_sigma: float) -> float:
    """Bound on the sum of exp(-|f - f_rs|^2 / sigma_f^2) over the bins not gathered.

    Parameters
    ----------
    reach
        Bins taken on either side of the nearest one.
    step_over_sigma
        Bin distance over sigma_f: 2 pi sigma_s / L, on the coarser axis.
    """
    a, edge = step_over_sigma**2, reach + 0.5
    tail = 2.0 * sum(math.exp(-a * (edge + k) ** 2) for k in range(200))
    whole = 1.0 + 2.0 * sum(math.exp(-a * max(k - 0.5, 0.0) ** 2) for k in range(1, 400))
    return 2.0 * tail * whole


def truncation_bound(reach: int, step_over_sigma: float, *, squared: bool) -> float:
    """Bound on what the gather of +-`reach` bins leaves out of |P|^2, relative to a mirror.

    Parameters
    ----------
    reach, step_over_sigma
        As in `omitted_weight`.
    squared
        Whether weights are squared (averaged over positions): there the omitted sum is at
        most the largest omitted weight, as sum |c|^2 = 1. For one window, Cauchy-Schwarz
        with the same sum bounds the amplitude.
    """
    if squared:
        return math.exp(-(((reach + 0.5) * step_over_sigma) ** 2))
    amplitude = math.sqrt(omitted_weight(reach, step_over_sigma))
    return 2.0 * amplitude + amplitude**2
