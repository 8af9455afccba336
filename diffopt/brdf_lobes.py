"""A BRDF as lobes over viewing directions, interpolated between them.

At every view of an icosahedral set stands a `Lobes` with the same number of lobes; between
three neighbours the parameters are interpolated (the glossy-transfer paper, eq. 6), which makes
sense where lobe j of one is lobe j of the next: `diffopt.fitting.fit_brdf` sees to it.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt import checks
from diffopt.errors import InputError
from diffopt.kernels import vmf_pairs
from diffopt.lobes import Lobes

# Views on the horizon, where a BRDF has no value, are raised to this elevation, radians.
_LOWEST = 0.02


def icosahedral_views(level: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions over the upper hemisphere with the triangles between them.

    Parameters
    ----------
    level
        Subdivisions of the icosahedron, 0 to 6: 8, 25, 89, 337, 1313, ... views, 32, 16, 8, 4, 2
        degrees apart.

    Returns
    -------
    tuple
        ``(views, faces)``: unit vectors [V, 3], those on the horizon raised by 0.02 radians,
        and indices [F, 3].
    """
    if not 0 <= level <= 6:
        raise InputError(f"level must be 0 to 6; received {level}")
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=level, radius=1.0)
    views = np.asarray(sphere.vertices, np.float64)
    kept = views[:, 2] > -1e-6
    number = np.cumsum(kept) - 1
    faces = number[np.asarray(sphere.faces)[kept[sphere.faces].all(1)]]
    views = views[kept]
    low = views[:, 2] < np.sin(_LOWEST)
    flat = views[low] / np.linalg.norm(views[low, :2], axis=1, keepdims=True)
    views[low] = np.concatenate(
        [flat[:, :2] * np.cos(_LOWEST), np.full((low.sum(), 1), np.sin(_LOWEST))], 1
    )
    return views / np.linalg.norm(views, axis=1, keepdims=True), faces


class BRDFLobes(eqx.Module):
    """Lobes of f cos at the views of a triangulated hemisphere.

    Attributes
    ----------
    views
        Unit vectors, [V, 3].
    faces
        Triangles of views, [F, 3].
    lobes
        V sums of K lobes; lobe j of neighbours belong together.
    """

    views: Float[Array, "V 3"]
    faces: Int[Array, "F 3"]
    lobes: Lobes
    _inverse: Float[Array, "F 3 3"]

    def __init__(self, views: Any, faces: Any, lobes: Lobes) -> None:
        checks.directions("views", views)
        self.views = jnp.asarray(views, lobes.mu.dtype)
        self.faces = jnp.asarray(faces)
        self.lobes = lobes
        if lobes.kappa.shape[:-1] != self.views.shape[:1] or self.faces.shape[1:] != (3,):
            raise InputError(
                "expected views [V, 3], faces [F, 3] and V sums of lobes; received "
                f"{self.views.shape}, {self.faces.shape} and {lobes.kappa.shape}"
            )
        corners = np.asarray(self.views, np.float64)[np.asarray(faces)]
        self._inverse = jnp.asarray(np.linalg.inv(corners.transpose(0, 2, 1)), lobes.mu.dtype)

    def at(self, wo: Any) -> Lobes:
        """Lobes for viewing directions [..., 3], interpolated; below the views, the nearest."""
        checks.directions("wo", wo)
        return self._at(jnp.asarray(wo, self.views.dtype))

    @eqx.filter_jit
    def _at(self, wo: Float[Array, "*batch 3"]) -> Lobes:
        shares = jnp.einsum("fij,...j->...fi", self._inverse, wo)
        # The triangle that holds a direction has no negative share.
        face = jnp.argmax(shares.min(-1), -1)
        weights = jnp.take_along_axis(shares, face[..., None, None], -2)[..., 0, :]
        weights = jnp.maximum(weights, 0.0)
        weights = weights / weights.sum(-1, keepdims=True)
        corners = self.faces[face]
        mu = jnp.moveaxis(self.lobes.mu[corners], -3, -2)
        kappa = jnp.moveaxis(self.lobes.kappa[corners], -2, -1)
        flat = self.lobes.alpha.reshape(*self.lobes.kappa.shape, -1)
        shared = weights[..., None, :]
        _, mu, kappa = vmf_pairs.interpolated(shared, jnp.ones_like(kappa), mu, kappa)
        alpha = jnp.einsum("...i,...ikc->...kc", weights, flat[corners])
        return Lobes(alpha.reshape(*kappa.shape, *self.lobes.channels), mu, kappa)

    def __call__(self, wi: Any, wo: Any) -> Float[Array, "..."]:
        """F cos theta_i of pairs of directions of one shape, [..., 3]."""
        return self.at(wo)(wi)

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.previews import bundles, lobes

        return bundles.bundle(self, lobes.brdf_card)
