"""Slices over those of the same material that sees nothing but light.

What a vertex sees differs from the unoccluded material by little, or slowly: stored and
interpolated is how it differs. Of direct light the axes are held in the frame of the unoccluded
lobe's axis and concentrations over the lobe's own; of all kinds weights are held over those of
the unoccluded lobe. A vertex without occluders is then exact with the fewest views, and its
slices are all the same.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt.transfer.slices import Slices
from diffopt.transfer.views import Locator, locator

Axis = tuple[Array, Array, Array]

# Weights below this are none.
_NOTHING = 1e-12


class Reference(eqx.Module):
    """Unoccluded lobes of materials over views.

    Attributes
    ----------
    rows
        Of every material and view, K lobes of axis (3), logarithm of the concentration and
        weights (C), [materials * V, K (4 + C)].
    views
        V.
    find
        Triangles of views.
    """

    rows: Float[Array, "M F"]
    lobes: int = eqx.field(static=True)
    views: int = eqx.field(static=True)
    find: Locator

    def places(
        self, material: Int[Array, "*#batch"], wo: Float[Array, "*batch 3"]
    ) -> tuple[Array, Array]:
        """Rows and shares [..., 3] of directions in the local frame."""
        place = self.find(wo, jnp.full(wo.shape[:-1], self.find.level, jnp.int32))
        first = jnp.broadcast_to(material * self.views, wo.shape[:-1])
        return place.corners + first[..., None], place.shares

    def at(self, material: Int[Array, "*#batch"], wo: Float[Array, "*batch 3"]) -> "Unoccluded":
        """Unoccluded lobes for directions in the local frame."""
        rows, shares = self.places(material, wo)
        found = self.rows[rows] * shares[..., None]
        found = found[..., 0, :] + found[..., 1, :] + found[..., 2, :]
        return unpacked(found, self.lobes)


class Unoccluded(eqx.Module):
    """Unoccluded lobes: alpha [..., K, C], mu [..., K, 3], log_kappa [..., K]."""

    alpha: Array
    mu: Array
    log_kappa: Array


def unpacked(rows: Float[Array, "... F"], lobes: int) -> Unoccluded:
    """Lobes of rows; axes of any length are normalised."""
    each = rows.reshape(*rows.shape[:-1], lobes, -1)
    mu = each[..., :3]
    square = (mu * mu).sum(-1, keepdims=True)
    return Unoccluded(each[..., 4:], mu / jnp.sqrt(jnp.maximum(square, 1e-30)), each[..., 3])


def reference(packed: list[np.ndarray], lobes: int, level: int) -> Reference:
    """Tables of materials [V, K (4 + C)] for the views of a level."""
    rows = np.concatenate(packed).astype(np.float32)
    return Reference(jnp.asarray(rows), lobes, len(packed[0]), locator(level))


def pack(alpha: np.ndarray, mu: np.ndarray, kappa: np.ndarray) -> np.ndarray:
    """Rows of lobes [V, K, ...]."""
    log = np.log(np.maximum(kappa, 1e-6))[..., None]
    return np.concatenate([mu, log, alpha], -1).reshape(len(kappa), -1)


def into(axis: Axis, mu: Axis) -> Axis:
    """Components of directions in the frame of an axis above the horizon (Duff et al. 2017)."""
    x, y, z = axis
    a = -1.0 / (1.0 + jnp.maximum(z, -0.5))
    u, v, w = mu
    along = x * u + y * v
    p = u + x * (a * along - w)
    q = v + y * (a * along - w)
    return p, q, along + z * w


def out_of(axis: Axis, mu: Axis) -> Axis:
    """The inverse of `into`."""
    x, y, z = axis
    a = -1.0 / (1.0 + jnp.maximum(z, -0.5))
    p, q, r = mu
    along = x * p + y * q
    shift = a * along + r
    return p + x * shift, q + y * shift, z * r - along


def _components(mu: Array) -> Axis:
    return mu[..., 0], mu[..., 1], mu[..., 2]


def _kinds(array: Array) -> Array:
    return array[..., None, :, :]


def relative(found: Slices, over: Unoccluded) -> Slices:
    """Slices [..., 3, K, ...] as they differ from unoccluded lobes [..., K, ...]."""
    whole = _kinds(over.alpha)
    some = whole > _NOTHING
    alpha = jnp.where(some, found.alpha / jnp.where(some, whole, 1.0), 0.0)
    direct = jnp.stack(into(_components(over.mu), _components(found.mu[..., 0, :, :])), -1)
    mu = jnp.concatenate([direct[..., None, :, :], found.mu[..., 1:, :, :]], -3)
    ratio = found.kappa[..., :1, :] * jnp.exp(-over.log_kappa)[..., None, :]
    return Slices(alpha, mu, jnp.concatenate([ratio, found.kappa[..., 1:, :]], -2))


def absolute(held: Slices, over: Unoccluded) -> Slices:
    """The inverse of `relative`."""
    alpha = held.alpha * _kinds(over.alpha)
    direct = jnp.stack(out_of(_components(over.mu), _components(held.mu[..., 0, :, :])), -1)
    mu = jnp.concatenate([direct[..., None, :, :], held.mu[..., 1:, :, :]], -3)
    kappa = held.kappa[..., :1, :] * jnp.exp(over.log_kappa)[..., None, :]
    return Slices(alpha, mu, jnp.concatenate([kappa, held.kappa[..., 1:, :]], -2))


#: Level of the views of references: at 5 degrees weights are interpolated to 0.2 %.
LEVEL = 4
