"""What every material offers: value, sampling, density, albedo, declared properties.

Directions are unit vectors [..., 3] in the local frame, z the surface normal, both pointing
away from the surface: ``wi`` to the light, ``wo`` to the viewer. Values are in 1/sr without
the cosine, [..., *C], with the material's colour channels C last: none for a scalar
material, RGB, or one for each wavelength. They follow the type of the directions.

A material is sampled through `scatter`, a map from the unit cube to directions: random numbers
make `sample`, a quadrature rule makes `albedo`, a low-discrepancy sequence makes a renderer.
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from diffopt.chunks import in_chunks
from diffopt.errors import InputError
from diffopt.fresnel import floating as floating
from diffopt.kernels import frames, warps

# Nodes of the albedo's quadrature on each axis of the unit square.
ALBEDO_NODES = 48
# Directions whose albedo is computed at a time.
ALBEDO_CHUNK = 64


class Sample(eqx.Module):
    """Directions drawn by a material.

    Attributes
    ----------
    wi
        Directions to the light, [..., 3].
    weight
        f cos / density, [..., *C]: what a path is multiplied with. 0 for a direction that no
        light comes from, as one that left a reflecting lobe below the horizon.
    pdf
        Density per steradian, [...]; that of the choice alone where `delta` holds.
    delta
        Whether the direction comes from a perfect mirror or refraction, [...].
    """

    wi: Float[Array, "*batch 3"]
    weight: Float[Array, "..."]
    pdf: Float[Array, "*batch"]
    delta: Bool[Array, "*batch"]


class Material(eqx.Module):
    """A bidirectional scattering distribution function.

    What a subclass declares, and is tested for: `reciprocal`, f(wi, wo) = f(wo, wi);
    `conserves_energy`, an albedo of at most 1 in every direction; `delta`, lobes that `f` and
    `pdf` leave out; `transmits`, values for directions on opposite sides.
    """

    #: Third coordinates of the unit cube over which `integrate` averages: one in the middle of
    #: each equal share that `warp` tells apart.
    choices: ClassVar[tuple[float, ...]] = (0.5,)

    @property
    def reciprocal(self) -> bool:
        """Whether f(wi, wo) = f(wo, wi)."""
        return True

    @property
    def conserves_energy(self) -> bool:
        """Whether no direction reflects more than it receives."""
        return True

    @property
    def delta(self) -> bool:
        """Whether there are lobes in single directions, which `f` and `pdf` leave out."""
        return False

    @property
    def smooth(self) -> bool:
        """Whether `f` is more than 0: there is more than lobes in single directions."""
        return True

    @property
    def transmits(self) -> bool:
        """Whether light passes; directions below the horizon have values then."""
        return False

    @property
    @abc.abstractmethod
    def channels(self) -> tuple[int, ...]:
        """Shape of a value: () for a scalar material, (3,) for RGB, (L,) for a spectrum."""

    @abc.abstractmethod
    def value(
        self, wi: Float[Array, "*batch 3"], wo: Float[Array, "*batch 3"]
    ) -> Float[Array, "..."]:
        """Value of pairs of one floating type; both above the horizon unless it transmits."""

    def warp(
        self, u: Float[Array, "*batch 3"], wo: Float[Array, "*batch 3"]
    ) -> Float[Array, "*batch 3"]:
        """Directions to the light from points of the unit cube, with density `density`."""
        return warps.cosine_hemisphere(u[..., :2])

    def density(
        self, wi: Float[Array, "*batch 3"], wo: Float[Array, "*batch 3"]
    ) -> Float[Array, "*batch"]:
        """Density of `warp` per steradian over the whole sphere, for wo above the horizon."""
        return jnp.maximum(wi[..., 2], 0.0) / np.pi

    def scatter(self, u: Float[Array, "*batch 3"], wo: Float[Array, "*batch 3"]) -> Sample:
        """Sample from points of the unit cube; wo above the horizon unless it transmits."""
        wi = self.warp(u, wo)
        pdf = self.density(wi, wo)
        seen = pdf > 0.0
        ratio = jnp.where(seen, jnp.abs(wi[..., 2]) / jnp.where(seen, pdf, 1.0), 0.0)
        weight = times(ratio, self._reflected(wi, wo))
        return Sample(wi, weight, pdf, jnp.zeros(pdf.shape, bool))

    def coherent(self, wo: Float[Array, "*batch 3"]) -> tuple[Sample, ...]:
        """All lobes in single directions, each with its whole weight and a density of 1.

        What perfect mirrors and smooth glass do: coherent reflection and refraction. None by
        default; wo above the horizon unless the material transmits.
        """
        return ()

    def f(self, wi: Any, wo: Any) -> Float[Array, "..."]:
        """Value in 1/sr without the cosine, [..., *C].

        Parameters
        ----------
        wi, wo
            Unit vectors to the light and to the viewer, [..., 3]; they broadcast against
            each other. 0 where one of them is below the horizon (unless the material
            `transmits`).

        Raises
        ------
        InputError
            For arrays whose last axis is not 3.
        """
        wi, wo = directions(wi, wo)
        return _value(self.typed(wi.dtype), wi, wo)

    def __call__(self, wi: Any, wo: Any) -> Float[Array, "..."]:
        """The same as `f`."""
        return self.f(wi, wo)

    def pdf(self, wi: Any, wo: Any) -> Float[Array, "*batch"]:
        """Density of `sample` per steradian, [...]; its integral over the sphere is 1.

        Parameters
        ----------
        wi, wo
            As for `f`. 0 where wo is below the horizon. A reflecting lobe can reach below
            the horizon: the density is positive there, though `f` and the weight are 0.
        """
        wi, wo = directions(wi, wo)
        return _density(self.typed(wi.dtype), wi, wo)

    def sample(self, key: Array, wo: Any) -> Sample:
        """Draw directions to the light.

        Parameters
        ----------
        key
            Of `jax.random.key`; the same key gives the same directions.
        wo
            Unit vectors to the viewer, [..., 3]; one direction is drawn for each.
        """
        (wo,) = directions(wo)
        return _sample(self.typed(wo.dtype), key, wo)

    def albedo(self, wo: Any, nodes: int = ALBEDO_NODES) -> Float[Array, "..."]:
        """Share of the light from wo that is scattered (or of a white sky that is seen).

        Parameters
        ----------
        wo
            Unit vectors, [..., 3].
        nodes
            Of Gauss's rule on each axis of the material's own sampling; smooth lobes are
            integrated to 1e-4 by the default.

        Returns
        -------
        Array
            The integral of f cos over the sphere, delta lobes included, [..., *C].
        """
        (wo,) = directions(wo)
        return _albedo(self.typed(wo.dtype), wo, nodes)

    def typed(self, dtype: Any) -> "Material":
        """Copy with its parameters in a floating type."""
        return jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, self)

    def integrate(self, wo: Float[Array, "3"], nodes: int) -> Float[Array, "..."]:
        """The integral of f cos over the sphere for one wo, by Gauss's rule."""
        points, weights = unit_square(nodes, wo.dtype, self.choices)
        sample = self.scatter(points, jnp.broadcast_to(wo, points.shape))
        return jnp.tensordot(weights, sample.weight, 1, precision="highest")

    def __add__(self, other: "Material") -> "Material":
        """Both materials at once; see `Sum`."""
        from diffopt.materials.combined import Sum

        return Sum((self, other))

    def __rmul__(self, factor: Any) -> "Material":
        """The material with its values times a factor; see `Scaled`."""
        from diffopt.materials.combined import Scaled

        return Scaled(self, factor)

    def _reflected(self, wi: Array, wo: Array) -> Array:
        """`value`, with 0 below the horizon unless the material transmits."""
        if self.transmits:
            return self.value(wi, wo)
        above, wi, wo = frames.above_horizon(wi, wo)
        return mask(above, self.value(wi, wo))

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.previews import bundles, materials

        return bundles.bundle(self, materials.card)


def directions(*arrays: Any) -> tuple[Array, ...]:
    """Arrays of directions of one floating type and one shape."""
    found = []
    for array in arrays:
        array = jnp.asarray(array)
        if not jnp.issubdtype(array.dtype, jnp.floating):
            array = array.astype(float)
        if array.ndim == 0 or array.shape[-1] != 3:
            raise InputError(
                f"directions must be unit vectors on a last axis of 3; received shape {array.shape}"
            )
        found.append(array)
    kind = jnp.result_type(*found)
    try:
        shape = np.broadcast_shapes(*(a.shape for a in found))
    except ValueError:
        shapes = " and ".join(str(a.shape) for a in found)
        raise InputError(f"wi and wo must broadcast; received shapes {shapes}") from None
    return tuple(jnp.broadcast_to(a.astype(kind), shape) for a in found)


def mask(valid: Bool[Array, "*batch"], value: Float[Array, "..."]) -> Float[Array, "..."]:
    """Values where valid, 0 elsewhere; channels last."""
    extra = value.ndim - valid.ndim
    return jnp.where(valid.reshape(valid.shape + (1,) * extra), value, 0.0)


def times(shape: Float[Array, "*batch"], values: Float[Array, "..."]) -> Float[Array, "..."]:
    """Product of a number for each pair and the values [*batch, *C] of the pairs."""
    return shape.reshape(shape.shape + (1,) * (values.ndim - shape.ndim)) * values


def tint(shape: Float[Array, "*batch"], colour: Float[Array, "..."]) -> Float[Array, "..."]:
    """Outer product of a number for each pair and one colour [*C] for all."""
    return times(shape, colour.reshape((1,) * shape.ndim + colour.shape))


def unit_square(
    nodes: int, dtype: Any, choices: tuple[float, ...] = (0.5,)
) -> tuple[Float[Array, "M 3"], Float[Array, " M"]]:
    """Points of Gauss's rule on the square at each third coordinate, and their weights."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    x, w = 0.5 * (x + 1.0), 0.5 * w
    choice, *across = np.meshgrid(choices, x, x, indexing="ij")
    points = np.stack([*across, choice], -1).reshape(-1, 3)
    weights = np.tile(np.outer(w, w).ravel(), len(choices)) / len(choices)
    return jnp.asarray(points, dtype), jnp.asarray(weights, dtype)


@eqx.filter_jit
def _value(material: Material, wi: Array, wo: Array) -> Array:
    return material._reflected(wi, wo)


@eqx.filter_jit
def _density(material: Material, wi: Array, wo: Array) -> Array:
    if material.transmits:
        return material.density(wi, wo)
    seen = wo[..., 2] > 0.0
    return jnp.where(seen, material.density(wi, _upright(seen, wo)), 0.0)


@eqx.filter_jit
def _sample(material: Material, key: Array, wo: Array) -> Sample:
    u = jax.random.uniform(key, wo.shape, wo.dtype)
    if material.transmits:
        return material.scatter(u, wo)
    seen = wo[..., 2] > 0.0
    sample = material.scatter(u, _upright(seen, wo))
    return Sample(
        sample.wi,
        mask(seen, sample.weight),
        jnp.where(seen, sample.pdf, 0.0),
        sample.delta,
    )


@eqx.filter_jit
def _albedo(material: Material, wo: Array, nodes: int) -> Array:
    flat = wo.reshape(-1, 3)
    seen = jnp.full(flat.shape[:1], True) if material.transmits else flat[:, 2] > 0.0
    one = lambda w: material.integrate(w, nodes)  # noqa: E731
    found = in_chunks(one, _upright(seen, flat), ALBEDO_CHUNK)
    found = mask(seen, found)
    return found.reshape(*wo.shape[:-1], *found.shape[1:])


def _upright(seen: Array, wo: Array) -> Array:
    """The normal in place of directions that are not seen."""
    normal = jnp.zeros_like(wo).at[..., 2].set(1.0)
    return jnp.where(seen[..., None], wo, normal)
