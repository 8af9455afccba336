"""Colours of a heightfield as a table over (u, v, w), for drawing.

The spectral integral is done once: at Chebyshev points in w and on a grid in u and v, each
wavelength is one set of matrix products. A lookup is bilinear in u and v and polynomial in
w. The grid is as fine as a picture needs: light is blurred to at least one grid step, as a
pixel would blur it.
"""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import bounds, colour, methods
from diffopt.diffraction import DiffractionBRDF, geometry
from diffopt.errors import InputError
from diffopt.kernels import frames, phase
from diffopt.settings import SeparableSettings

Range = tuple[float, float]

# Wavelengths between two reports of progress.
GROUP = 4


class ColourTable(eqx.Module):
    """XYZ of everything but geometry: R area / lambda^2 |P|^2 integrated over the spectrum.

    Attributes
    ----------
    values
        XYZ at Chebyshev points in w and grid points in v and u, [nodes, V, U, 3].
    u, v, w
        Ends of the table on each axis.
    """

    values: Float[Array, "nodes V U 3"]
    u: Range = eqx.field(static=True)
    v: Range = eqx.field(static=True)
    w: Range = eqx.field(static=True)

    def __call__(self, wave: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """XYZ at wave vectors (u, v, w); outside the table the nearest edge."""
        flat = wave.reshape(-1, 3)
        out = jax.lax.map(self._one, flat, batch_size=min(16384, flat.shape[0]))
        return out.reshape(wave.shape)

    def _one(self, wave: Array) -> Array:
        nodes, rows, columns, _ = self.values.shape
        x, i = _place(wave[0], self.u, columns)
        y, j = _place(wave[1], self.v, rows)
        t = (2.0 * wave[2] - self.w[0] - self.w[1]) / (self.w[1] - self.w[0])
        weights = phase.chebyshev_weights(jnp.clip(t, -1.0, 1.0), nodes)
        corner = jax.lax.dynamic_slice(
            self.values, (jnp.zeros_like(i), j, i, jnp.zeros_like(i)), (nodes, 2, 2, 3)
        )
        wx, wy = jnp.stack([1.0 - x, x]), jnp.stack([1.0 - y, y])
        return jnp.einsum("nyxc,n,y,x->c", corner, weights, wy, wx, precision="highest")


def _place(value: Array, ends: Range, count: int) -> tuple[Array, Array]:
    """Fraction within a cell and the cell's index."""
    at = jnp.clip((value - ends[0]) / (ends[1] - ends[0]), 0.0, 1.0) * (count - 1)
    index = jnp.minimum(at.astype(jnp.int32), count - 2)
    return at - index.astype(value.dtype), index


@eqx.filter_jit
def _bake_group(brdf, u, v, w_nodes, wavelengths, weights):
    """XYZ that a group of wavelengths adds to the table, [nodes, V, U, 3]."""
    surface = brdf.surface
    grid_v, grid_u = jnp.meshgrid(v, u, indexing="ij")

    def at_wavelength(total, z):
        wavelength, weight = z
        before = 1.0 if brdf.balance == "peak" else brdf.coherent_area / wavelength**2
        lam = wavelength[None]
        normal = brdf.fresnel.normal(lam)[0] if brdf.balance == "peak" else 1.0

        def at_node(w):
            wave = jnp.stack([grid_u, grid_v, jnp.full_like(grid_u, w)], -1)
            # Corners of the table lie outside all pairs of directions.
            cos_h = jnp.minimum(frames.half_cosine(wave), 1.0)
            reflectance = brdf.fresnel(cos_h.reshape(-1), lam).reshape(cos_h.shape) / normal
            square = methods.separable_grid(
                surface, u, v, jnp.full_like(grid_u, w), wavelength, SeparableSettings(nodes=1)
            )
            return reflectance * square * before

        values = jax.lax.map(at_node, w_nodes)
        return total + values[..., None] * weight[None, None, None, :], None

    zero = jnp.zeros((w_nodes.shape[0], v.shape[0], u.shape[0], 3), u.dtype)
    total, _ = jax.lax.scan(at_wavelength, zero, (wavelengths, weights))
    return total


def bake(
    brdf: DiffractionBRDF,
    *,
    u: Range,
    v: Range,
    w: Range,
    size: int = 385,
    wavelengths: Float[np.ndarray, " L"] | None = None,
    illuminant: colour.IlluminantLike = "D65",
    error: float = 1e-6,
    progress: Callable[[int, int], None] | None = None,
) -> ColourTable:
    """Integrate the spectrum over a grid of wave vectors.

    Parameters
    ----------
    brdf
        The model; its `blur` is widened to one grid step.
    u, v, w
        Ends of the table; w within [-2, 0].
    size
        Grid points on the longer of the u and v axes: memory and time grow with its square.
    wavelengths
        Micrometres; 380 to 780 nm by 10 nm if not given.
    illuminant
        See `diffopt.colour.spectral_weights`.
    error
        Interpolation error in w of |P|^2 relative to a mirror's peak.
    progress
        Called with (wavelengths done, wavelengths in all).

    Raises
    ------
    InputError
        If the model weights facets by the directions (``prefactor="kirchhoff"``), or a
        range is empty.
    """
    if brdf.surface.prefactor == "kirchhoff":
        raise InputError("prefactor 'kirchhoff' cannot be tabulated: use 'stam' or another")
    for name, ends in (("u", u), ("v", v), ("w", w)):
        if not ends[0] < ends[1]:
            raise InputError(f"{name} must be a range (low, high) with low < high; received {ends}")
    lam = colour.wavelengths(10.0) if wavelengths is None else np.asarray(wavelengths)
    weights = np.asarray(colour.spectral_weights(lam, illuminant=illuminant))
    step = max(u[1] - u[0], v[1] - v[0]) / (size - 1)
    columns, rows = (max(2, math.ceil((r[1] - r[0]) / step - 1e-9) + 1) for r in (u, v))
    if brdf.surface.coverage == "positions":
        wider = jnp.maximum(brdf.surface.blur, jnp.asarray(step, brdf.surface.blur.dtype))
        brdf = eqx.tree_at(lambda b: b.surface.blur, brdf, wider)
    ends = np.array([[0.0, 0.0, w[0]], [0.0, 0.0, w[1]]])
    nodes = phase.chebyshev_nodes(bounds.separable_sweep(brdf.surface, ends, lam), error)
    dtype = brdf.surface.heights.dtype
    w_nodes = phase.chebyshev_points(nodes, dtype) * (0.5 * (w[1] - w[0])) + 0.5 * (w[0] + w[1])
    lines = jnp.linspace(*u, columns, dtype=dtype), jnp.linspace(*v, rows, dtype=dtype)
    total = jnp.zeros((nodes, rows, columns, 3), dtype)
    for first in range(0, len(lam), GROUP):
        # The last group is filled up with weightless wavelengths: one shape, one compilation.
        part = slice(first, first + GROUP)
        short = GROUP - len(lam[part])
        group = np.append(lam[part], np.full(short, lam[-1]))
        weight = np.append(weights[part], np.zeros((short, 3)), axis=0)
        total = total + _bake_group(
            brdf, *lines, w_nodes, jnp.asarray(group, dtype), jnp.asarray(weight, dtype)
        )
        if progress is not None:
            total.block_until_ready()
            progress(min(first + GROUP, len(lam)), len(lam))
    return ColourTable(values=total, u=u, v=v, w=w)


@eqx.filter_jit
def shade(
    brdf: DiffractionBRDF,
    table: ColourTable,
    wi: Float[Array, "*batch 3"],
    wo: Float[Array, "*batch 3"],
) -> Float[Array, "*batch 3"]:
    """XYZ of the light that leaves towards `wo`, per irradiance across the beam: f cos_i.

    Parameters
    ----------
    brdf, table
        The model and its table.
    wi, wo
        Unit vectors in the local frame, [..., 3]; 0 where either is below the horizon.
    """
    valid, wi, wo = frames.above_horizon(wi, wo)
    factor = geometry(wi, wo, prefactor=brdf.surface.prefactor, shadowing=brdf.shadowing)
    value = table(frames.wave_vector(wi, wo)) * (factor * wi[..., 2])[..., None]
    return jnp.where(valid[..., None], value, 0.0)
