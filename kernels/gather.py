"""The thesis's method: Taylor tables by FFT and a Gaussian-window gather.

``exp(i kappa h) = sum_n (i kappa)^n / n! h^n``: each power of the heights is transformed
once, and a direction gathers the Fourier bins near its frequency, weighted by the
transform of the window. Both sums stand *inside* the modulus (the thesis's eq. 32 has them
outside, which can even turn negative). Bins are taken modulo the table: it is periodic.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.kernels.phase import TWO_PI, cis_turns


def taylor_tables(
    heights: Float[Array, "ny nx"], reach: int, *, terms: int, centred: bool
) -> Float[Array, "nyp nxp terms 2"]:
    """Fourier coefficients of the scaled powers of the heights.

    Parameters
    ----------
    heights
        Heights in micrometres, [ny, nx].
    reach
        Bins on either side that the gather will take; the table is padded by as many,
        periodically.
    terms
        Number of powers, n = 0 .. terms - 1.
    centred
        Measure heights from their mid-range instead of from their minimum: half the
        argument, the same |P|^2.

    Returns
    -------
    Array
        ``ifft2(t^n)`` with t the heights scaled to at most 1 (see `height_scale`), zero
        frequency at ``[reach + ny // 2, reach + nx // 2]``, last axis (real, imaginary).
    """
    base, scale = height_scale(heights, centred=centred)
    t = (heights - base) / scale

    def transform(power, _):
        c = jnp.fft.ifft2(jnp.fft.ifftshift(power))
        return power * t, jnp.stack([c.real, c.imag])

    _, tables = jax.lax.scan(transform, jnp.ones_like(t), length=terms)
    tables = jnp.fft.fftshift(jnp.moveaxis(tables, (0, 1), (2, 3)), axes=(0, 1))
    return jnp.pad(tables, ((reach, reach), (reach, reach), (0, 0), (0, 0)), mode="wrap")


def height_scale(
    heights: Float[Array, "ny nx"], *, centred: bool
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Base and scale (micrometres) that map the heights to [-1, 1] (centred) or [0, 1]."""
    low, high = heights.min(), heights.max()
    base = 0.5 * (low + high) if centred else low
    span = high - base
    return base, jnp.where(span > 0, span, 1.0)


def taylor_coefficients(
    argument: Float[Array, ""], terms: int
) -> tuple[Float[Array, " terms"], Float[Array, " terms"]]:
    """Real and imaginary part of (i x)^n / n!, n = 0 .. terms - 1."""
    n = jnp.arange(1, terms, dtype=argument.dtype)
    size = jnp.concatenate([jnp.ones_like(n, shape=(1,)), jnp.cumprod(argument / n)])
    turn = jnp.arange(terms) % 4
    real = jnp.asarray([1.0, 0.0, -1.0, 0.0], dtype=argument.dtype)[turn]
    imag = jnp.asarray([0.0, 1.0, 0.0, -1.0], dtype=argument.dtype)[turn]
    return size * real, size * imag


def gather_bins(
    tables: Float[Array, "nyp nxp terms 2"],
    argument: Float[Array, ""],
    anchor: tuple[Array, Array],
    *,
    taps: int,
) -> tuple[Float[Array, "taps taps"], Float[Array, "taps taps"]]:
    """Coefficients c_rs of exp(i kappa (h - base)) in the `taps` x `taps` bins at an anchor.

    Parameters
    ----------
    tables
        From `taylor_tables`.
    argument
        kappa times the height scale, radians.
    anchor
        Index of the first bin (y, x) in the padded table.
    taps
        Bins taken on each axis.
    """
    terms = tables.shape[2]
    block = jax.lax.dynamic_slice(
        tables, (*anchor, *(jnp.zeros_like(anchor[0]),) * 2), (taps, taps, terms, 2)
    )
    re, im = taylor_coefficients(argument, terms)
    # (block_re + i block_im) (re + i im), summed over the terms, as one matrix product.
    mix = jnp.stack([jnp.stack([re, im], -1), jnp.stack([-im, re], -1)], 1)
    out = jnp.matmul(
        block.reshape(taps * taps, 2 * terms), mix.reshape(2 * terms, 2), precision="highest"
    )
    return out[:, 0].reshape(taps, taps), out[:, 1].reshape(taps, taps)


def axis_bins(
    samples: int, step: float, frequency: Float[Array, ""], reach: int
) -> tuple[Array, Float[Array, " taps"]]:
    """First bin of the gather in the padded table, and the distance of every bin taken.

    Returns
    -------
    tuple
        Index into the padded axis, and f - f_r in cycles per micrometre for the
        ``2 reach + 1`` bins.
    """
    nearest = jnp.round(jax.lax.stop_gradient(frequency) * (samples * step))
    offset = jnp.arange(-reach, reach + 1, dtype=frequency.dtype)
    distance = frequency - (nearest + offset) / (samples * step)
    # Zero frequency sits at samples // 2; the table starts `reach` bins earlier.
    index = jnp.mod(nearest.astype(jnp.int32) + samples // 2, samples)
    return index, distance


def coherent(
    tables: Float[Array, "nyp nxp terms 2"],
    argument: Float[Array, ""],
    x: tuple[Array, Float[Array, " taps"]],
    y: tuple[Array, Float[Array, " taps"]],
    sigma: Float[Array, ""],
    center: Float[Array, "2"],
) -> Float[Array, ""]:
    """|P|^2 of one window: the gather with the window's transform, then the modulus.

    Parameters
    ----------
    tables, argument
        As in `gather_bins`.
    x, y
        From `axis_bins` for each axis.
    sigma
        sigma_s of the window, micrometres.
    center
        Position (y, x) of the window, micrometres.
    """
    taps = x[1].shape[0]
    re, im = gather_bins(tables, argument, (y[0], x[0]), taps=taps)
    factors = []
    for (_, distance), position in ((x, center[1]), (y, center[0])):
        size = jnp.exp(-0.5 * (TWO_PI * sigma * distance) ** 2)
        cos, sin = cis_turns(distance * position)
        factors.append((size * cos, size * sin))
    (xr, xi), (yr, yi) = factors
    rows_re = jnp.matmul(re, xr, precision="highest") - jnp.matmul(im, xi, precision="highest")
    rows_im = jnp.matmul(re, xi, precision="highest") + jnp.matmul(im, xr, precision="highest")
    p_re = jnp.vdot(rows_re, yr) - jnp.vdot(rows_im, yi)
    p_im = jnp.vdot(rows_re, yi) + jnp.vdot(rows_im, yr)
    return p_re**2 + p_im**2


def averaged(
    tables: Float[Array, "nyp nxp terms 2"],
    argument: Float[Array, ""],
    x: tuple[Array, Float[Array, " taps"]],
    y: tuple[Array, Float[Array, " taps"]],
    spread: Float[Array, ""],
    shape: tuple[int, int],
    *,
    drop_mean: bool = False,
) -> Float[Array, ""]:
    """|P|^2 averaged over window positions: the gather of |c|^2 with the squared weights.

    Parameters
    ----------
    tables, argument, x, y
        As in `coherent`.
    spread
        Width of exp(-df^2 / spread^2), cycles per micrometre.
    shape
        Samples (ny, nx) of the heightfield.
    drop_mean
        Leave out the zero order (the mirror part).
    """
    taps = x[1].shape[0]
    re, im = gather_bins(tables, argument, (y[0], x[0]), taps=taps)
    power = re**2 + im**2
    if drop_mean:
        zero = jnp.outer(_is_zero(y[0], shape[0], taps), _is_zero(x[0], shape[1], taps))
        power = jnp.where(zero, 0.0, power)
    wx = jnp.exp(-((x[1] / spread) ** 2))
    wy = jnp.exp(-((y[1] / spread) ** 2))
    return jnp.vdot(wy, jnp.matmul(power, wx, precision="highest"))


def _is_zero(first: Array, samples: int, taps: int) -> Array:
    """Which of the taps is the zero frequency, modulo the table's period."""
    bins = first + jnp.arange(taps, dtype=first.dtype) - (taps // 2 + samples // 2)
    return jnp.mod(bins, samples) == 0


def truncation_bound(reach: int, step_over_sigma: float, *, squared: bool) -> float:
    """Bound on what the gather of +-`reach` bins leaves out of |P|^2, relative to a mirror.

    Parameters
    ----------
    reach
        Bins taken on either side of the nearest one.
    step_over_sigma
        Bin distance over sigma_f: 2 pi sigma_s / L, on the coarser axis.
    squared
        Whether weights are squared (averaged over positions): there the omitted sum is at
        most the largest omitted weight, as sum |c|^2 = 1. For one window, Cauchy-Schwarz
        with the same sum bounds the amplitude.
    """
    edge = reach + 0.5
    if squared:
        return math.exp(-((edge * step_over_sigma) ** 2))
    a = step_over_sigma**2
    tail = 2.0 * sum(math.exp(-a * (edge + k) ** 2) for k in range(200))
    whole = 1.0 + 2.0 * sum(math.exp(-a * max(k - 0.5, 0.0) ** 2) for k in range(1, 400))
    amplitude = math.sqrt(2.0 * tail * whole)
    return 2.0 * amplitude + amplitude**2
