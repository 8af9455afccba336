"""Making a measured map fit for use: levelling, filling, cropping, resampling, rotating.

Pure functions on height arrays [ny, nx] in micrometres. Levelling, cropping and resampling
are differentiable in the heights; filling and rotating run on the host and are not.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.errors import InputError

# Half width of the resampling filter in lobes of the sinc, and shape of its Kaiser window: of
# the lower Nyquist frequency, flat to 1e-4 up to 0.87 and 80 dB down from 1.13 (Oppenheim and
# Schafer, Discrete-Time Signal Processing, Kaiser's formulas for attenuation and width).
_LOBES = 20
_KAISER_BETA = 8.0

# Full float32 products: accelerators otherwise round the factors to 10 bits.
_EXACT = "highest"


def level(heights: Float[Array, "ny nx"], order: int = 1) -> Float[Array, "ny nx"]:
    """Subtract the least-squares polynomial of total degree ``order``; 1 is a plane.

    Missing pixels (NaN) take no part in the fit and stay missing.

    Raises
    ------
    InputError
        If ``order`` is not within 0 to 8, or fewer pixels are valid than there are terms.
    """
    _check_order(order)
    ny, nx = heights.shape
    along_y, along_x = _legendre(ny, order), _legendre(nx, order)
    degrees = [(p, q) for p in range(order + 1) for q in range(order + 1 - p)]
    basis = np.stack([np.outer(along_y[p], along_x[q]) for p, q in degrees])
    known = ~jnp.isnan(heights)
    _require_valid(known, len(degrees), "the map")
    fit = _fit(
        heights.reshape(1, -1),
        known.reshape(1, -1),
        jnp.asarray(basis.reshape(len(degrees), -1), heights.dtype),
    )
    return heights - fit.reshape(ny, nx)


def level_lines(heights: Float[Array, "ny nx"], order: int = 0) -> Float[Array, "ny nx"]:
    """Subtract from each scan line (row) its least-squares polynomial of degree ``order``.

    Order 0 removes the offset of each line, which drift and the jumps between lines of a
    scanning probe call for; it also removes real structure that varies along y only.
    Missing pixels (NaN) take no part in the fit and stay missing.

    Raises
    ------
    InputError
        If ``order`` is not within 0 to 8, or a row has fewer valid pixels than terms.
    """
    _check_order(order)
    known = ~jnp.isnan(heights)
    _require_valid(known, order + 1, "a row", axis=1)
    basis = jnp.asarray(_legendre(heights.shape[1], order), heights.dtype)
    return heights - _fit(heights, known, basis)


def fill(heights: Float[Array, "ny nx"], most: float = 0.2) -> Float[Array, "ny nx"]:
    """Fill missing pixels (NaN) with the biharmonic surface through their surroundings.

    Uses ``skimage.restoration.inpaint_biharmonic`` (Damelin and Hoang, "On surface completion
    and image inpainting by biharmonic functions: numerical aspects", 2018). Runs on the host:
    not differentiable.

    Parameters
    ----------
    heights
        Micrometres, NaN where missing.
    most
        Largest share of missing pixels accepted, 0 to 1; beyond it the result would be
        more interpolation than measurement.

    Raises
    ------
    InputError
        If more than ``most`` of the pixels are missing.
    """
    values = np.asarray(heights, dtype=np.float64)
    missing = np.isnan(values)
    share = missing.mean()
    if share > most:
        raise InputError(
            f"{missing.sum()} of {missing.size} pixels ({100 * share:.1f} %) are missing; filling "
            f"accepts {100 * most:.0f} % (most={most:g})"
        )
    if not missing.any():
        return heights
    from skimage.restoration import inpaint_biharmonic

    # Known values to [0, 1]: the function clips to the range of the known pixels and its
    # linear system mixes them with weights of order one.
    low, high = np.nanmin(values), np.nanmax(values)
    scale = high - low if high > low else 1.0
    unit = np.where(missing, 0.0, (values - low) / scale)
    filled = low + scale * inpaint_biharmonic(unit, missing, split_into_regions=True)
    return jnp.asarray(np.where(missing, filled, values), heights.dtype)


def resample(
    heights: Float[Array, "ny nx"],
    pixel: tuple[float, float],
    new_pixel: tuple[float, float],
    *,
    periodic: bool = False,
) -> Float[Array, "my mx"]:
    """Sample the surface anew at another pixel size, low-passed where the new one is coarser.

    The filter is a sinc cut at the lower of the two Nyquist frequencies, under a Kaiser
    window; each output weight sum is 1, so that constants are kept exactly. Both grids share
    their centre. Differentiable in the heights.

    Parameters
    ----------
    heights
        Micrometres, complete.
    pixel, new_pixel
        (dy, dx) in micrometres.
    periodic
        The patch repeats: the new pixel must then divide its extent. Otherwise it is
        mirrored at its edges, and what does not fill a whole pixel is cut off evenly.

    Raises
    ------
    InputError
        If the new map would have fewer than 2 pixels on a side, or the new pixel does not
        divide the extent of a periodic patch.
    """
    along_y, along_x = (
        _resampling_matrix(n, old, new, periodic)
        for n, old, new in zip(heights.shape, pixel, new_pixel, strict=True)
    )
    along_y, along_x = jnp.asarray(along_y, heights.dtype), jnp.asarray(along_x, heights.dtype)
    columns = jnp.matmul(along_y, heights, precision=_EXACT)
    return jnp.matmul(columns, along_x.T, precision=_EXACT)


def rotate(heights: Float[Array, "ny nx"], angle: float) -> Float[Array, "my mx"]:
    """Turn the surface by ``angle`` radians from x towards y, square pixels assumed.

    Quarter turns are exact. Otherwise cubic splines (``scipy.ndimage.affine_transform``) and
    a cut to the largest upright rectangle that holds measured surface only. Runs on the host:
    not differentiable.
    """
    quarters = angle / (math.pi / 2)
    if abs(quarters - round(quarters)) < 1e-9:
        # rot90 turns from the first axis (y) to the second (x): the other way round.
        return jnp.rot90(heights, k=-round(quarters) % 4)
    from scipy.ndimage import affine_transform

    ny, nx = heights.shape
    my, mx = _inscribed(ny, nx, angle)
    c, s = math.cos(angle), math.sin(angle)
    # Output point p shows the input point R(-angle) p; rows of the matrix are y, then x.
    back = np.array([[c, -s], [s, c]])
    centre_in, centre_out = np.array([ny - 1, nx - 1]) / 2, np.array([my - 1, mx - 1]) / 2
    turned = affine_transform(
        np.asarray(heights, dtype=np.float64),
        back,
        offset=tuple(centre_in - back @ centre_out),  # type: ignore[arg-type]
        output_shape=(my, mx),
        order=3,
        mode="mirror",
    )
    return jnp.asarray(turned, heights.dtype)


def _check_order(order: int) -> None:
    if not 0 <= order <= 8:
        raise InputError(f"order={order}: expected a degree from 0 to 8")


def _require_valid(known: Array, terms: int, what: str, axis: int | None = None) -> None:
    counts = known.sum(axis=axis)
    try:
        least = int(counts.min())
    except TypeError:  # traced: the count is not known
        return
    if least < terms:
        raise InputError(f"{what} has {least} valid pixels; the polynomial has {terms} terms")


def _legendre(n: int, order: int) -> np.ndarray:
    """Legendre polynomials 0 to ``order`` at n points on [-1, 1]: [order + 1, n]."""
    return np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, n), order).T


def _fit(
    heights: Float[Array, "lines n"], known: Array, basis: Float[Array, "terms n"]
) -> Float[Array, "lines n"]:
    """Weighted least-squares fit of each line, evaluated everywhere."""
    # The mean goes first: it is all that a large offset does to the sums in float32.
    known = known.astype(heights.dtype)
    values = jnp.where(known > 0, heights, 0)
    mean = jnp.sum(values, axis=1, keepdims=True) / jnp.sum(known, axis=1, keepdims=True)
    values = (values - mean) * known
    gram = jnp.einsum("tn,un,ln->ltu", basis, basis, known, precision=_EXACT)
    right = jnp.einsum("tn,ln->lt", basis, values, precision=_EXACT)
    coefficients = jnp.linalg.solve(gram, right[..., None])[..., 0]
    return jnp.matmul(coefficients, basis, precision=_EXACT) + mean


def _resampling_matrix(n: int, old: float, new: float, periodic: bool) -> np.ndarray:
    """Weights [m, n] of the old samples in each new one."""
    extent = n * old
    m = round(extent / new)
    if periodic and abs(m * new - extent) > 1e-6 * extent:
        nearest = extent / max(m, 2)
        raise InputError(
            f"a pixel of {new:.6g} um does not divide the periodic extent of {extent:.6g} um; "
            f"the nearest that does is {nearest:.8g} um"
        )
    if not periodic:
        m = math.floor(extent / new * (1 + 1e-9))
    if m < 2:
        raise InputError(
            f"a pixel of {new:.6g} um leaves {m} samples of an extent of {extent:.6g} um; "
            "expected at least 2"
        )
    ratio = new / old
    wide = max(ratio, 1.0)
    centres = (n - 1) / 2 + (np.arange(m) - (m - 1) / 2) * ratio
    reach = math.ceil(_LOBES * wide)
    taps = np.floor(centres)[:, None].astype(int) + np.arange(-reach, reach + 2)
    distance = (taps - centres[:, None]) / wide
    inside = np.clip(1.0 - (distance / _LOBES) ** 2, 0.0, None)
    weights = np.sinc(distance) * np.where(inside > 0, np.i0(_KAISER_BETA * np.sqrt(inside)), 0.0)
    weights /= weights.sum(axis=1, keepdims=True)
    if periodic:
        source = taps % n
    else:
        # Mirrored about the outer edges of the first and last pixel.
        folded = taps % (2 * n)
        source = np.minimum(folded, 2 * n - 1 - folded)
    matrix = np.zeros((m, n))
    np.add.at(matrix, (np.arange(m)[:, None], source), weights)
    return matrix


def _inscribed(ny: int, nx: int, angle: float) -> tuple[int, int]:
    """Size of the largest upright rectangle inside an ny x nx rectangle that was turned."""
    s, c = abs(math.sin(angle)), abs(math.cos(angle))
    # Distances between outermost samples, which splines do not leave.
    height, width = ny - 1.0, nx - 1.0
    long, short = max(height, width), min(height, width)
    if short <= 2 * s * c * long or abs(s - c) < 1e-12:
        # Two corners touch the long sides, the others lie within.
        half = short / 2
        x, y = (half / s, half / c) if width >= height else (half / c, half / s)
    else:
        cos_double = c * c - s * s
        x = (width * c - height * s) / cos_double
        y = (height * c - width * s) / cos_double
    return max(math.floor(y + 1e-9) + 1, 1), max(math.floor(x + 1e-9) + 1, 1)
