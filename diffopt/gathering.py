"""The methods that gather from tables of Fourier bins: Taylor, Chebyshev, low rank.

The diffraction thesis's method (`diffopt.kernels.gather`) on the tables of three expansions
(`diffopt.kernels.expansions`). Tables are made once for a heightfield and a range of
s = w / wavelength; an evaluation then costs the same however large the heightfield is.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.kernels import expansions, gather, phase
from diffopt.methods import Surface
from diffopt.settings import ChebyshevSettings, GatherSettings, TaylorSettings

# Numbers that a block of evaluations may hold at once, and the fewest evaluations of one.
CACHED = 2**14
SMALLEST = 64


class GatherTables(eqx.Module):
    """What `gathered` reads; made by `gather_tables`.

    Attributes
    ----------
    values
        Coefficients of the expansion in each Fourier bin, zero frequency in the middle:
        (real, imaginary) of its amplitude, or its power alone.
    series
        Chebyshev series of the functions of the expansion (low rank only).
    middle, half
        The interval of s in cycles per micrometre; for Taylor terms zero, and the s at
        which the argument is one.
    """

    values: Float[Array, "nyp nxp parts terms"]
    series: Float[Array, "terms nodes"] | None
    middle: Float[Array, ""]
    half: Float[Array, ""]


def s_range(
    surface: Surface,
    wave: Float[Array, "M 3"],
    wavelengths: Float[Array, " L"],
    valid: Array | None = None,
) -> Float[Array, "2"]:
    """Smallest and largest s = w / wavelength of a job, cycles per micrometre.

    Parameters
    ----------
    surface, wave, wavelengths
        As for `gathered`.
    valid
        Which pairs count, [M]; all if not given. Without any, the range is [0, 0].
    """
    w = surface.height_phase(wave)
    if valid is None:
        valid = jnp.ones(w.shape, bool)
    s = w[:, None] / wavelengths[None, :]
    mask = jnp.broadcast_to(valid[:, None], s.shape)
    low = jnp.min(s, where=mask, initial=jnp.inf)
    high = jnp.max(s, where=mask, initial=-jnp.inf)
    found = jnp.stack([low, high])
    return jax.lax.stop_gradient(jnp.where(valid.any(), found, jnp.zeros_like(found)))


def gather_tables(
    surface: Surface, settings: GatherSettings, s_range: Float[Array, "2"]
) -> GatherTables:
    """The tables that `gathered` reads; build once for a heightfield and a range of s.

    Parameters
    ----------
    surface
        Under a coherence window (the bare patch has none to gather with).
    settings
        Which expansion, with its terms and its reach.
    s_range
        Smallest and largest w / wavelength, cycles per micrometre (`s_range`); Taylor terms
        hold for any.
    """
    heights, parts = surface.heights, 1
    ny, nx = heights.shape
    rest = jnp.zeros_like(surface.center)
    if surface.coverage != "positions":
        # The window comes to the middle: whole pixels here, the rest in `move_origin`.
        whole, rest = gather.whole_pixels(surface.center, surface.pixel)
        heights, parts = jnp.roll(heights, -whole, (0, 1)), 2
    series = None
    if isinstance(settings, TaylorSettings):
        middle = jnp.zeros((), heights.dtype)
        _, scale = gather.height_scale(heights, centred=settings.centred)
        half = 1.0 / (phase.TWO_PI * scale)
        coefficients = gather.taylor_spectra(heights, settings.terms, centred=settings.centred)
        if surface.drop_mean:
            coefficients = coefficients.at[:, :, 0, 0].set(0.0)
    else:
        # Where the expansion has its digits: values do not depend on it, and it has no slope.
        held = jax.lax.stop_gradient(heights)
        span = held.max() - held.min()
        middle, half = expansions.interval(s_range[0], s_range[1], span)
        if isinstance(settings, ChebyshevSettings):
            matrix = expansions.chebyshev_projection(settings.terms, heights.dtype)
        else:
            # |c|^2 is a product of two functions of s: twice the phase.
            swept = 0.5 * phase.TWO_PI * half * span
            series = expansions.lowrank_series(swept * (3 - parts), settings.terms)
            back = expansions.chebyshev_projection(series.shape[1], heights.dtype)
            matrix = jnp.matmul(series, back, precision="highest")
        at = phase.chebyshev_points(matrix.shape[1], heights.dtype) * half + middle
        if parts == 1:
            spectra = gather.node_powers(heights, at, drop_mean=surface.drop_mean)
        else:
            spectra = gather.node_spectra(heights, at)
        coefficients = gather.project(matrix, spectra)
    values = gather.table(coefficients, settings.reach)
    if surface.coverage != "positions":
        size = jnp.asarray([ny, nx], rest.dtype) * jnp.asarray(surface.pixel, rest.dtype)
        values = gather.move_origin(values, rest / size, settings.reach)
    return GatherTables(values=values, series=series, middle=middle, half=half)


def gathered(
    surface: Surface,
    wave: Float[Array, "M 3"],
    wavelengths: Float[Array, " L"],
    settings: GatherSettings,
    tables: GatherTables,
) -> Float[Array, "M L"]:
    """|P|^2 by the Gaussian gather from tables, see `diffopt.kernels.gather`.

    Parameters
    ----------
    surface
        What the tables were made of. Its window's width and blur may have changed since;
        its heights and the position of its window are in the tables.
    wave, wavelengths
        Wave vectors and micrometres; s = w / wavelength within the range of the tables
        (beyond it, the value at its end).
    settings
        Those of the tables.
    tables
        From `gather_tables`.
    """
    pairs, count = wave.shape[0], wavelengths.shape[0]
    ny, nx = surface.heights.shape
    dy, dx = surface.pixel
    terms = tables.values.shape[3]

    def block(z):
        wave, wavelength = z
        x = gather.axis_bins(nx, dx, wave[:, 0] / wavelength, settings.reach)
        y = gather.axis_bins(ny, dy, wave[:, 1] / wavelength, settings.reach)
        t = (surface.height_phase(wave) / wavelength - tables.middle) / tables.half
        if isinstance(settings, TaylorSettings):
            a = expansions.taylor_coefficients(t, terms)
        else:
            a = expansions.coefficients(t, terms, tables.series)
        if surface.coverage == "positions":
            spread = surface.spread(wavelength)
            over = jax.vmap(gather.averaged, in_axes=(None, 0, (0, 1), (0, 1), 0))
            return over(tables.values, a, x, y, spread) * surface.peak_loss(wavelength)
        over = jax.vmap(gather.coherent, in_axes=(None, 0, (0, 1), (0, 1), None))
        return over(tables.values, a, x, y, surface.sigma)

    waves = jnp.repeat(wave, count, axis=0)
    colours = jnp.tile(wavelengths, pairs)
    # What a block holds at once stays within the caches.
    held = (2 * settings.reach + 1) * terms
    if surface.coverage == "positions" and tables.values.shape[2] == 2:
        held *= 2 * settings.reach + 1
    batch = max(1, min(settings.chunk, waves.shape[0], max(SMALLEST, CACHED // held)))
    blocks = -(-waves.shape[0] // batch)
    fill = ((0, blocks * batch - waves.shape[0]),)
    waves = jnp.pad(waves, (*fill, (0, 0)), mode="edge").reshape(blocks, batch, 3)
    colours = jnp.pad(colours, fill, mode="edge").reshape(blocks, batch)
    out = jax.lax.map(jax.checkpoint(block, prevent_cse=False), (waves, colours))
    return out.reshape(-1)[: pairs * count].reshape(pairs, count)
