"""Surfaces made by code, to try things on: same key, same surface.

All of them repeat periodically in x and y unless their text says otherwise, and are complete
`Heightfield` objects in micrometres. `make` builds one by name.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from diffopt import discs, gratings
from diffopt.errors import InputError
from diffopt.heightfield import Heightfield, Number, Provenance
from diffopt.io.record import pair
from diffopt.random_fields import bumps, gaussian_field

Key = Any
Pixel = Number | tuple[Number, Number]


def flat(*, shape: tuple[int, int] = (256, 256), pixel: Pixel = 0.05) -> Heightfield:
    """Return a mirror: zero height everywhere."""
    return _heightfield(jnp.zeros(shape, _dtype()), pixel, "flat mirror")


def sinusoidal_grating(
    *,
    period: Number = 2.0,
    amplitude: Number = 0.1,
    shape: tuple[int, int] = (64, 400),
    pixel: Pixel = 0.05,
) -> Heightfield:
    """Return a sinusoidal grating that varies along x; see `gratings.Sinusoidal`.

    Raises
    ------
    InputError
        If the patch does not hold a whole number of periods.
    """
    _whole(shape, pixel, period, "periods")
    return gratings.Sinusoidal(period, amplitude).heightfield(shape, pixel)


def blazed_grating(
    *,
    period: Number = 1.6,
    depth: Number = 0.15,
    shape: tuple[int, int] = (64, 512),
    pixel: Pixel = 0.025,
) -> Heightfield:
    """Return a blazed grating that rises along +x; see `gratings.Blazed`.

    Raises
    ------
    InputError
        If the patch does not hold a whole number of periods.
    """
    _whole(shape, pixel, period, "periods")
    shift = _between_samples(pixel, period)
    return gratings.Blazed(period, depth, shift).heightfield(shape, pixel)


def binary_grating(
    *,
    period: Number = 2.0,
    depth: Number = 0.12,
    duty: Number = 0.5,
    shape: tuple[int, int] = (64, 400),
    pixel: Pixel = 0.05,
) -> Heightfield:
    """Return a binary grating that varies along x; see `gratings.Binary`.

    Raises
    ------
    InputError
        If the patch does not hold a whole number of periods.
    """
    _whole(shape, pixel, period, "periods")
    shift = _between_samples(pixel, period)
    return gratings.Binary(period, depth, duty, shift).heightfield(shape, pixel)


def compact_disc(
    key: Key,
    *,
    shape: tuple[int, int] = (512, 512),
    pixel: Pixel = 0.025,
    pitch: Number = discs.TRACK_PITCH,
    velocity: Number = discs.VELOCITIES[0],
    depth: Number = 0.115,
    width: Number = 0.5,
    wall: Number = 0.1,
) -> Heightfield:
    """Return the pits of a compact disc; tracks run along y, so that colours spread along x.

    The metal layer with its pits going down, lit in air. Seen through the polycarbonate, whose
    index is about 1.55, they are bumps of 1.55 times the optical height: pass
    ``depth=-1.55 * 0.115``. Pitch, run lengths and velocity are those of the standards (see
    `diffopt.discs`). Depth and width are no part of them; 0.11 to 0.12 um and 0.5 um are usual
    (Bouwhuis et al., Principles of Optical Disc Systems, 1985).

    Runs of pit and land alternate at random within the limits of the code; its merging bits
    and frames are not modelled, and tracks are independent. So that the runs repeat with the
    patch, the velocity is raised to the next that gives a whole number of channel bits
    along y; the provenance states it.

    Parameters
    ----------
    key
        JAX random key.
    shape, pixel
        (ny, nx) and (dy, dx) in micrometres. nx dx must be a whole number of pitches.
    pitch
        Distance of tracks, micrometres.
    velocity
        Least scanning velocity, 1.2 to 1.4 m/s; a channel bit is velocity / 4.3218 MHz.
    depth
        Depth of the pits, micrometres; negative for bumps.
    width
        Width of the pits at half depth, micrometres; their ends are half circles.
    wall
        Horizontal width of the walls, micrometres; at most ``width``.

    Raises
    ------
    InputError
        If the tracks do not fit the patch, or pits do not fit their tracks.
    """
    (ny, nx), (dy, dx) = shape, pair(pixel, "pixel")
    tracks = _whole(shape, pixel, pitch, "tracks")
    if not (0 < wall <= width and width + wall <= pitch):
        raise InputError(
            f"width={width}, wall={wall}: expected 0 < wall <= width and width + wall <= pitch"
        )
    bits, bit = discs.whole_bits(ny * dy, velocity)
    # Uniform draws from the key; the constrained sequences are drawn on the host.
    draws = np.asarray(jax.random.uniform(key, (tracks, bits + 1)), dtype=np.float64)
    y, x = np.arange(ny) * dy, (np.arange(nx) + 0.5) * dx
    heights = np.zeros((ny, nx))
    for track in range(tracks):
        columns = np.flatnonzero(np.floor(x / pitch).astype(int) == track)
        heights[:, columns] = -depth * discs.pits(
            y,
            x[columns] - (track + 0.5) * pitch,
            discs.run_lengths(bits, draws[track, 1:]),
            bit=bit,
            start=draws[track, 0] * ny * dy,
            width=float(width),
            wall=float(wall),
        )
    step = f"{tracks} tracks of {bits} channel bits at {bit * discs.CHANNEL_BIT_RATE:.4f} m/s"
    return _heightfield(jnp.asarray(heights, _dtype()), pixel, "compact disc", step)


def random_bumps(
    key: Key,
    *,
    shape: tuple[int, int] = (512, 512),
    pixel: Pixel = 0.05,
    height: Number = 0.15,
    sigma: Number | tuple[Number, Number] = (0.5, 0.25),
    density: Number = 1.0,
) -> Heightfield:
    """Return Gaussian bumps at random places (Stam, Diffraction shaders, SIGGRAPH 1999).

    h = sum of height exp(-x^2 / (2 sx^2) - y^2 / (2 sy^2)) about points of a Poisson process.

    Parameters
    ----------
    key
        JAX random key.
    shape, pixel
        (ny, nx) and (dy, dx) in micrometres.
    height
        Of each bump, micrometres.
    sigma
        (sy, sx), or one number for both, micrometres.
    density
        Mean number of bumps on a square micrometre.

    Raises
    ------
    InputError
        If the density is negative or sigma is no pair of positive lengths.
    """
    sigma_y, sigma_x = pair(sigma, "sigma")
    if not 0 <= density < float("inf"):
        raise InputError(f"density={density}: expected bumps on a square micrometre, 0 or more")
    step = pair(pixel, "pixel")
    y, x = (jnp.arange(n, dtype=_dtype()) * d for n, d in zip(shape, step, strict=True))
    field, count = bumps(key, y, x, step, (sigma_y, sigma_x), float(density))
    return _heightfield(height * field, pixel, "random bumps", f"{count} bumps")


def gaussian_roughness(
    key: Key,
    *,
    shape: tuple[int, int] = (512, 512),
    pixel: Pixel = 0.05,
    rms: Number = 0.05,
    correlation_length: Number = 0.5,
) -> Heightfield:
    """Return a Gaussian random surface with autocorrelation rms^2 exp(-r^2 / ell^2).

    White noise filtered in the frequency domain by the root of the power spectrum
    pi ell^2 rms^2 exp(-pi^2 ell^2 f^2) (Garcia and Stoll, Phys. Rev. Lett. 52, 1798, 1984). rms
    is that of the ensemble; a patch differs from it at random.

    Parameters
    ----------
    key
        JAX random key.
    shape, pixel
        (ny, nx) and (dy, dx) in micrometres.
    rms
        Root mean square height, micrometres.
    correlation_length
        ell, micrometres: at least two pixels, at most a quarter of the shorter side.

    Raises
    ------
    InputError
        If the correlation length is out of range.
    """
    return _heightfield(
        rms * gaussian_field(key, shape, pair(pixel, "pixel"), correlation_length),
        pixel,
        "gaussian roughness",
        f"rms {rms:g} um, correlation length {correlation_length:g} um",
    )


def snake_skin(
    key: Key,
    *,
    shape: tuple[int, int] = (512, 512),
    pixel: Pixel = 0.05,
    finger_pitch: Number = 0.8,
    row_pitch: Number = 2.4,
    height: Number = 0.3,
    disorder: Number = 0.06,
) -> Heightfield:
    """Return a quasi-periodic surface like the nanostructure of a snake's scales.

    Ridges (fingers) along x, ``finger_pitch`` apart in y, that taper and leave wedge-shaped
    hollows at every ``row_pitch``; smooth random displacements wear the order down. The
    proportions follow published pictures of such scales (Dhillon et al., Interactive
    diffraction from biological nanostructures, 2014); it is no model of a species.

    Parameters
    ----------
    key
        JAX random key.
    shape, pixel
        (ny, nx) and (dy, dx) in micrometres; sides of at least two pitches.
    finger_pitch, row_pitch
        Micrometres; adjusted so that whole numbers of them fit the patch.
    height
        Depth of the hollows, micrometres.
    disorder
        Root mean square displacement, micrometres, over a correlation length of about one
        row.

    Raises
    ------
    InputError
        If the patch holds fewer than two pitches.
    """
    (ny, nx), (dy, dx) = shape, pair(pixel, "pixel")
    length_y, length_x = ny * dy, nx * dx
    fingers, rows = round(length_y / finger_pitch), round(length_x / row_pitch)
    if fingers < 2 or rows < 2:
        raise InputError(
            f"snake_skin: a patch of {length_y:.3g} x {length_x:.3g} um; expected two pitches or "
            f"more, {2 * finger_pitch:.3g} x {2 * row_pitch:.3g} um"
        )
    key_y, key_x = jax.random.split(key)
    reach = min(float(row_pitch), length_y / 4, length_x / 4)
    shift_y = disorder * gaussian_field(key_y, shape, (dy, dx), reach)
    shift_x = disorder * gaussian_field(key_x, shape, (dy, dx), reach)
    y = (jnp.arange(ny, dtype=_dtype()) * dy)[:, None]
    x = (jnp.arange(nx, dtype=_dtype()) * dx)[None, :]
    along = 2 * jnp.pi * (rows / length_x * x + shift_x / row_pitch)
    across = 2 * jnp.pi * (fingers / length_y * y + shift_y / finger_pitch)
    # Width of the ridges: a saw along x, its series cut after three terms with Lanczos
    # factors so that the hollow closes over about a fifth of the row instead of at once.
    saw = sum(np.sinc(n / 4) * jnp.sin(n * along) / n for n in (1, 2, 3))
    # Above the threshold a ridge, below it a hollow; the slope limits the walls.
    level = jax.nn.sigmoid(2.5 * (jnp.cos(across) + 0.3 + 0.9 * saw))
    return _heightfield(height * level, pixel, "snake skin", f"{fingers} fingers, {rows} rows")


_KEYED: dict[str, Callable[..., Heightfield]] = {
    "compact_disc": compact_disc,
    "gaussian_roughness": gaussian_roughness,
    "random_bumps": random_bumps,
    "snake_skin": snake_skin,
}
_PLAIN: dict[str, Callable[..., Heightfield]] = {
    "binary_grating": binary_grating,
    "blazed_grating": blazed_grating,
    "flat": flat,
    "sinusoidal_grating": sinusoidal_grating,
}
NAMES = tuple(sorted(_KEYED | _PLAIN))


def make(name: str, *, key: Key | None = None, **options: Any) -> Heightfield:
    """Build a sample by its name.

    Parameters
    ----------
    name
        One of `NAMES`.
    key
        JAX random key for the random ones (key 0 if left out); the others ignore it.
    options
        Passed to the function of that name.

    Raises
    ------
    InputError
        If there is no sample of that name.
    """
    if name in _KEYED:
        return _KEYED[name](jax.random.key(0) if key is None else key, **options)
    if name in _PLAIN:
        return _PLAIN[name](**options)
    raise InputError(f"no sample {name!r}; expected one of {', '.join(NAMES)}")


def _dtype() -> Any:
    return jnp.result_type(float)


def _heightfield(heights: Array, pixel: Pixel, name: str, *steps: str) -> Heightfield:
    return Heightfield(heights, pixel, provenance=Provenance(f"sample: {name}", steps=steps))


def _whole(shape: tuple[int, int], pixel: Pixel, period: Number, what: str) -> int:
    """Number of periods along x, refused where it is not whole."""
    if not 0 < period < float("inf"):
        raise InputError(f"period={period}: expected positive micrometres")
    extent = shape[1] * pair(pixel, "pixel")[1]
    count = round(extent / period)
    if count < 1 or abs(extent - count * period) > 1e-6 * period:
        fitting = max(count, 1) * period / shape[1]
        raise InputError(
            f"{extent:.6g} um along x hold {extent / period:.4g} {what} of {period:g} um; expected "
            f"a whole number: a pixel of {fitting:.8g} um would do"
        )
    return count


def _between_samples(pixel: Pixel, period: Number) -> float:
    """Shift that puts the jump at x = 0 half a pixel before it, where rounding cannot reach."""
    return -0.5 * pair(pixel, "pixel")[1] / float(period)
