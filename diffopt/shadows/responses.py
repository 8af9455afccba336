"""What receivers make of light: the clamped cosine, or a BRDF times it, in harmonics."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.kernels import harmonic_rotation, harmonics
from diffopt.kernels.tabulated import root


def cosine(normals: Float[Array, "3 N"], bands: int) -> Float[Array, "L2 N"]:
    """Coefficients of max(n . w, 0)."""
    return cosine_rows(normals, np.arange(bands**2))


def cosine_rows(normals: Float[Array, "3 N"], rows: np.ndarray) -> Float[Array, "R N"]:
    """Coefficients of max(n . w, 0) in some places; odd degrees above 1 have none."""
    bands = int(np.sqrt(rows[-1])) + 1
    factor = harmonics.clamped_cosine(bands) * np.sqrt(4.0 * np.pi / (2.0 * np.arange(bands) + 1.0))
    factor = factor[harmonics.degrees(bands)]
    values = harmonics.basis(normals.T, bands)
    return jnp.stack([values[int(row)] * float(factor[row]) for row in rows])


def cosine_places(bands: int) -> np.ndarray:
    """Places of the coefficients of a clamped cosine that are not 0."""
    degree = harmonics.degrees(bands)
    return np.flatnonzero((degree < 2) | (degree % 2 == 0))


class ProjectedBRDF(eqx.Module):
    """f(wi, wo) (n . wi) in harmonics of wi, by the viewer's angle: isotropic BRDFs.

    Attributes
    ----------
    table
        Coefficients in the frame of the normal, wo in the plane of x and z, at equal steps of
        cos t_o from 0 to 1, [steps, L^2].
    """

    table: Float[Array, "M L2"]

    def response(
        self, normals: Float[Array, "3 N"], views: Float[Array, "3 N"], bands: int
    ) -> Float[Array, "L2 N"]:
        """Coefficients in the world's frame; 0 for a viewer below the surface."""
        steps = self.table.shape[0]
        upright = jnp.sum(normals * views, 0)
        value = jnp.clip(upright, 0.0, 1.0) * (steps - 1)
        low = jnp.clip(value.astype(jnp.int32), 0, steps - 2)
        share = (value - low.astype(value.dtype))[:, None]
        table = self.table[:, : bands**2]
        local = ((1.0 - share) * table[low] + share * table[low + 1]).T
        local = jnp.where(upright[None] > 0.0, local, 0.0)
        return _to_normal(local, normals, views - upright[None] * normals)


def _to_normal(local: Array, normals: Array, across: Array) -> Array:
    """From the frame of a normal, x towards `across`, to the world's."""
    x, y, z = normals
    flat = root(x * x + y * y)
    off_axis = flat > 0.0
    safe = jnp.where(off_axis, flat, 1.0)
    cos_phi, sin_phi = jnp.where(off_axis, x / safe, 1.0), jnp.where(off_axis, y / safe, 0.0)
    # Components of `across` along e_theta and e_phi of the normal.
    along = z * (cos_phi * across[0] + sin_phi * across[1]) - flat * across[2]
    beside = cos_phi * across[1] - sin_phi * across[0]
    length = root(along * along + beside * beside)
    turned = length > 0.0
    length = jnp.where(turned, length, 1.0)
    cos_twist = jnp.where(turned, along / length, 1.0)
    sin_twist = jnp.where(turned, beside / length, 0.0)
    found = harmonic_rotation.about_z(local, cos_twist, sin_twist)
    found = harmonic_rotation.about_y(found, z, flat)
    return harmonic_rotation.about_z(found, cos_phi, sin_phi)


def project_brdf(brdf: Any, bands: int, *, steps: int = 33, nodes: int = 48) -> ProjectedBRDF:
    """An isotropic BRDF for receivers.

    Parameters
    ----------
    brdf
        A function of (wi, wo), unit vectors [..., 3] in the frame of the normal, to 1/sr, [...];
        a material of `diffopt.materials` with one channel.
    bands
        Of the result. What is sharper than 180 / bands degrees rings.
    steps
        Viewing angles, equally spaced in cosine.
    nodes
        Of quadrature over the polar angle of wi; twice as many over the azimuth.
    """
    wi, weights = harmonics.hemisphere_rule(nodes, 2 * nodes)
    cosines = np.linspace(0.0, 1.0, steps)
    cosines[0] = 1e-3
    views = np.stack([np.sqrt(1.0 - cosines**2), np.zeros(steps), cosines], -1)
    dtype = jnp.result_type(float)
    wi_, views_ = jnp.asarray(wi, dtype), jnp.asarray(views, dtype)

    def one(view: Array) -> Array:
        return jnp.asarray(brdf(wi_, jnp.broadcast_to(view, wi_.shape))).reshape(len(wi))

    values = jax.lax.map(one, views_)
    projection = harmonics.numpy_basis(wi, bands) * (weights * wi[:, 2])
    return ProjectedBRDF(values @ jnp.asarray(projection.T, dtype))
