"""The methods of evaluating |P|^2 of a heightfield.

Each takes a `Surface` (what is transformed), wave vectors [M, 3] and wavelengths [L], and
returns |P|^2 relative to a mirror's peak, [M, L]. Their settings are in
`diffopt.settings`, their error bounds in `diffopt.bounds`; those that gather from tables are
in `diffopt.gathering`.
"""

from functools import partial
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.chunks import in_chunks
from diffopt.kernels import dtft, phase, separable
from diffopt.kernels import prefactor as prefactors
from diffopt.settings import DirectSettings, SeparableSettings

Coverage = Literal["positions", "window", "patch"]


class Surface(eqx.Module):
    """What the transform sees: heights under a window.

    Attributes
    ----------
    heights
        Micrometres, [ny, nx].
    sigma
        sigma_s of the coherence window, micrometres (unused for the bare patch).
    center
        Position (y, x) of a single window, micrometres from the middle.
    blur
        Standard deviation of source and pixel together in u and in v (direction sines).
    """

    heights: Float[Array, "ny nx"]
    sigma: Float[Array, ""]
    center: Float[Array, "2"]
    blur: Float[Array, ""]
    pixel: tuple[float, float] = eqx.field(static=True)
    coverage: Coverage = eqx.field(static=True)
    repeats: tuple[int, int] = eqx.field(static=True)
    prefactor: prefactors.Prefactor = eqx.field(static=True)
    drop_mean: bool = eqx.field(static=True)

    @property
    def extent(self) -> tuple[float, float]:
        """Size (y, x) of the patch in micrometres."""
        ny, nx = self.heights.shape
        return ny * self.pixel[0], nx * self.pixel[1]

    @property
    def follows_w(self) -> bool:
        """Whether the phase of the heights depends on w at all; it is that of w = -2 if not."""
        return self.prefactor not in ("ohs", "rohs")

    def height_phase(self, wave: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Factor of the height in the phase, in wavelengths."""
        return prefactors.height_factor(self.prefactor, wave)

    def spread(self, wavelength: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Width of the averaged Gaussian in cycles per micrometre, with the blur.

        The window alone gives sigma_f; blurring |P|^2 over directions by a Gaussian adds
        2 (blur / wavelength)^2 to its square: the van Cittert-Zernike theorem for a
        Gaussian source.
        """
        sigma_f = 1.0 / (phase.TWO_PI * self.sigma)
        return jnp.sqrt(sigma_f**2 + 2.0 * (self.blur / wavelength) ** 2)

    def peak_loss(self, wavelength: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Factor by which the blur lowers a mirror's peak (its energy is kept)."""
        return (1.0 / (phase.TWO_PI * self.sigma) / self.spread(wavelength)) ** 2


def _axis_x(surface: Surface, fx: Array) -> Array:
    nx, dx = surface.heights.shape[1], surface.pixel[1]
    if surface.coverage == "patch":
        return dtft.finite_axis(nx, dx, fx, surface.repeats[1])
    return dtft.gaussian_axis(nx, dx, fx, surface.sigma, surface.center[1])


def _axis_y(surface: Surface, fy: Array) -> Array:
    ny, dy = surface.heights.shape[0], surface.pixel[0]
    if surface.coverage == "patch":
        return dtft.finite_axis(ny, dy, fy, surface.repeats[0])
    return dtft.gaussian_axis(ny, dy, fy, surface.sigma, surface.center[0])


def _bin_axes(surface: Surface, fx: Array, fy: Array, wavelength: Array) -> tuple[Array, Array]:
    ny, nx = surface.heights.shape
    dy, dx = surface.pixel
    spread = surface.spread(wavelength)
    wx = dtft.bin_weights(nx, dx, fx, jnp.broadcast_to(spread, fx.shape))
    wy = dtft.bin_weights(ny, dy, fy, jnp.broadcast_to(spread, fy.shape))
    return wx, wy * surface.peak_loss(wavelength)


def _one(surface: Surface, wave: Array, wavelength: Array) -> Array:
    """|P|^2 of one pair at one wavelength by the direct sum."""
    q = wave / wavelength
    s = surface.height_phase(wave) / wavelength
    if surface.prefactor == "kirchhoff":
        return _kirchhoff(surface, wave, wavelength)
    if surface.coverage == "positions":
        wx, wy = _bin_axes(surface, q[0], q[1], wavelength)
        return dtft.averaged_intensity(surface.heights, s, wx, wy, surface.drop_mean)
    return dtft.coherent_intensity(
        surface.heights, s, _axis_x(surface, q[0]), _axis_y(surface, q[1])
    )


def mean_reflectance(heights: Float[Array, "ny nx"], s: Float[Array, ""]) -> Float[Array, ""]:
    """|mean of exp(2 pi i s h)|^2: the share of the light that stays in the mirror."""
    ny, nx = heights.shape
    flat_x = jnp.zeros((2, nx), heights.dtype).at[0].set(1.0 / nx)
    flat_y = jnp.zeros((2, ny), heights.dtype).at[0].set(1.0 / ny)
    return dtft.coherent_intensity(heights, s, flat_x, flat_y)


def _kirchhoff(surface: Surface, wave: Array, wavelength: Array) -> Array:
    """The direct sum with Kirchhoff's weight per facet (slopes by central differences)."""
    h = surface.heights
    dy, dx = surface.pixel
    weight = prefactors.kirchhoff_weight(
        wave,
        (jnp.roll(h, -1, 1) - jnp.roll(h, 1, 1)) / (2.0 * dx),
        (jnp.roll(h, -1, 0) - jnp.roll(h, 1, 0)) / (2.0 * dy),
    )
    cos, sin = phase.cis_turns(wave[2] / wavelength * h)
    cos, sin = cos * weight, sin * weight
    q = wave / wavelength
    if surface.coverage == "positions":
        c = jnp.fft.ifft2(jax.lax.complex(cos, sin))
        wx, wy = _bin_axes(surface, q[0], q[1], wavelength)
        power = c.real**2 + c.imag**2
        if surface.drop_mean:
            power = power.at[0, 0].set(0.0)
        return jnp.vdot(wy, jnp.matmul(power, wx, precision="highest"))
    ax, ay = _axis_x(surface, q[0]), _axis_y(surface, q[1])
    re, im = separable.contract(ay[:, None], (cos, sin), ax[:, None], grid=False)
    return re[0] ** 2 + im[0] ** 2


def direct(
    surface: Surface,
    wave: Float[Array, "M 3"],
    wavelengths: Float[Array, " L"],
    settings: DirectSettings,
) -> Float[Array, "M L"]:
    """|P|^2 by the direct sum: one pass over the heights for each pair and wavelength."""
    pairs, count = wave.shape[0], wavelengths.shape[0]
    chunk = settings.chunk or max(1, 65536 // surface.heights.size)
    waves = jnp.repeat(wave, count, axis=0)
    colours = jnp.tile(wavelengths, pairs)
    body = jax.checkpoint(lambda z: _one(surface, *z), prevent_cse=False)
    batch = (waves, colours)
    found = jax.lax.map(body, batch) if chunk == 1 else in_chunks(body, batch, chunk)
    return found.reshape(pairs, count)


def separable_pairs(
    surface: Surface,
    wave: Float[Array, "M 3"],
    wavelengths: Float[Array, " L"],
    settings: SeparableSettings,
) -> Float[Array, "M L"]:
    """|P|^2 by matrix products over chunks of pairs, see `diffopt.kernels.separable`."""
    pairs = wave.shape[0]
    chunk = min(settings.chunk, pairs)
    blocks = -(-pairs // chunk)
    # Repeat the last pair to fill the last block: its s stays inside the job's interval.
    padded = jnp.concatenate([wave, jnp.repeat(wave[-1:], blocks * chunk - pairs, axis=0)])

    def evaluate(block, wavelength):
        fx, fy = block[:, 0] / wavelength, block[:, 1] / wavelength
        s = surface.height_phase(block) / wavelength
        return _at_wavelength(surface, fx, fy, s, wavelength, settings.nodes, grid=False)

    def over_wavelengths(block):
        body = jax.checkpoint(lambda lam: evaluate(block, lam), prevent_cse=False)
        return jax.lax.map(body, wavelengths)

    out = jax.lax.map(over_wavelengths, padded.reshape(blocks, chunk, 3))
    return jnp.moveaxis(out, 1, 2).reshape(blocks * chunk, -1)[:pairs]


def _at_wavelength(
    surface: Surface, fx: Array, fy: Array, s: Array, wavelength: Array, nodes: int, *, grid: bool
) -> Array:
    """|P|^2 at one wavelength for lines fx [U], fy [V] (grid) or pairs [M] of frequencies."""
    if surface.coverage == "positions":
        wx, wy = _bin_axes(surface, fx, fy, wavelength)
        return separable.averaged(
            surface.heights, s, wx, wy, nodes=nodes, grid=grid, drop_mean=surface.drop_mean
        )
    ax = jax.vmap(partial(_axis_x, surface), out_axes=1)(fx)
    ay = jax.vmap(partial(_axis_y, surface), out_axes=1)(fy)
    return separable.coherent(surface.heights, s, ax, ay, nodes=nodes, grid=grid)


def separable_grid(
    surface: Surface,
    u: Float[Array, " U"],
    v: Float[Array, " V"],
    w: Float[Array, "V U"],
    wavelength: Float[Array, ""],
    settings: SeparableSettings,
) -> Float[Array, "V U"]:
    """|P|^2 at one wavelength on a grid of wave vectors: (u, v) lines with a w at each node."""
    wave = jnp.stack(jnp.broadcast_arrays(u[None, :], v[:, None], w), -1)
    s = surface.height_phase(wave) / wavelength
    return _at_wavelength(
        surface, u / wavelength, v / wavelength, s, wavelength, settings.nodes, grid=True
    )
