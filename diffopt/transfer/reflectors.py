"""Materials as transfer sees them: a diffuse colour, and a glossy rest that depends on the view.

The split of the glossy-transfer paper, eq. 3 and 9, exact in place of fitted: Lambert's share is
taken out of sums, everything else is glossy.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.errors import InputError
from diffopt.materials.base import Material, Sample, directions, unit_square
from diffopt.materials.combined import Scaled, Sum
from diffopt.materials.diffuse import Lambert
from diffopt.scenes.channels import wavelengths_of
from diffopt.scenes.scene import Object, Scene
from diffopt.scenes.textures import Textured

#: Lobes sharper than this are not told from mirrors in float32.
SHARPEST = 2e4


class Reflector(eqx.Module):
    """A material in the channels of its scene.

    Attributes
    ----------
    diffuse
        Albedo of its Lambertian share, [C].
    glossy
        The rest; None where there is none.
    matrix
        From the channels of the rest to those of the scene, None where they are the same.
    channels
        C; 1 where a scene is grey.
    """

    diffuse: Float[Array, " C"]
    glossy: Material | None
    matrix: Float[Array, "c C"] | None
    channels: int = eqx.field(static=True)

    def value(self, wi: Float[Array, "*batch 3"], wo: Float[Array, "*batch 3"]) -> Array:
        """BRDF of the glossy rest in 1/sr, [..., C]; both directions in the local frame."""
        if self.glossy is None:
            return jnp.zeros((*wi.shape[:-1], self.channels), wi.dtype)
        return self._own(self.glossy._reflected(wi, wo), wi.ndim - 1)

    def scatter(
        self, u: Float[Array, "*batch 3"], wo: Float[Array, "*batch 3"]
    ) -> tuple[Array, Array]:
        """Directions drawn by the glossy rest, and their weights f cos / density, [..., C]."""
        assert self.glossy is not None
        sample: Sample = self.glossy.scatter(u, wo)
        return sample.wi, self._own(sample.weight, wo.ndim - 1)

    def _own(self, values: Array, batch: int) -> Array:
        values = values[..., None] if values.ndim == batch else values
        if self.matrix is None:
            return jnp.broadcast_to(values, (*values.shape[:-1], self.channels))
        return jnp.matmul(values, self.matrix, precision="highest")


def reflectors(scene: Scene, dtype: Any = np.float32) -> tuple[tuple[Reflector, ...], np.ndarray]:
    """The reflectors of a scene, each once, and that of each object [O].

    Raises
    ------
    InputError
        For perfect mirrors, glass, textures and lights among the objects, and for lobes that
        are too sharp: what transfer slices cannot hold. Names the object.
    """
    found: list[Reflector] = []
    keys: dict[int, int] = {}
    number = []
    grey = all(_is_grey(one.material) for one in scene.objects)
    for k, one in enumerate(scene.objects):
        key = id(one.material)
        if key not in keys:
            try:
                found.append(reflector(one, scene, grey, dtype))
            except InputError as error:
                raise InputError(f"object {one.name or k}: {error}") from None
            keys[key] = len(found) - 1
        number.append(keys[key])
    return tuple(found), np.array(number, np.int32)


def _is_grey(material: Material | Textured) -> bool:
    return material.channels in ((), (1,))


def reflector(one: Object, scene: Scene, grey: bool, dtype: Any) -> Reflector:
    """The reflector of one object."""
    material = one.material
    if isinstance(material, Textured):
        raise InputError("transfer takes one material for an object, not a texture")
    if one.emission is not None:
        raise InputError("transfer is for light from infinity; this object emits light")
    if material.transmits or material.delta:
        raise InputError(
            "transfer takes matte and glossy materials; received a perfect mirror or one that "
            "light passes"
        )
    channels = 1 if grey else scene.channels.count
    diffuse, rest = _split(material)
    colour = np.zeros(channels)
    for factor, part in diffuse:
        both = np.asarray(factor * np.asarray(part.colour, np.float64))
        lam = wavelengths_of(material)
        own = scene.channels.converted(jnp.asarray(both), lam) if not grey else both.reshape(-1)[:1]
        colour = colour + np.asarray(own)
    glossy = None
    if rest:
        glossy = rest[0] if len(rest) == 1 else Sum(tuple(rest))
        glossy = glossy.typed(dtype)
    matrix = None
    if glossy is not None and not grey and glossy.channels:
        matrix = scene.channels.matrix(glossy.channels[0], wavelengths_of(glossy))
    made = Reflector(
        jnp.asarray(colour, dtype),
        glossy,
        None if matrix is None else jnp.asarray(matrix, dtype),
        channels,
    )
    if sharpness(made) > SHARPEST:
        raise InputError(
            f"its lobe has a concentration of {sharpness(made):.3g}, hardly told from a mirror; "
            f"transfer takes up to {SHARPEST:g}"
        )
    return made


def _split(
    material: Material, factor: Any = 1.0
) -> tuple[list[tuple[Any, Lambert]], list[Material]]:
    """Lambertian parts with their factors, and the rest."""
    if isinstance(material, Lambert):
        return [(factor, material)], []
    if isinstance(material, Sum):
        pairs = [_split(part, factor) for part in material.parts]
        return [x for d, _ in pairs for x in d], [x for _, g in pairs for x in g]
    if isinstance(material, Scaled):
        return _split(material.material, factor * np.asarray(material.factor, np.float64))
    scaled = material if np.ndim(factor) == 0 and factor == 1.0 else Scaled(material, factor)
    return [], [scaled]


def sharpness(made: Reflector) -> float:
    """Concentration of the lobe of its glossy rest at normal incidence; 0 without one."""
    if made.glossy is None:
        return 0.0
    points, weights = unit_square(48, np.float32, made.glossy.choices)
    wo = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0], points.dtype), points.shape)
    (wo,) = directions(wo)
    wi, weight = eqx.filter_jit(Reflector.scatter)(_typed(made, points.dtype), points, wo)
    share = np.asarray(weight, np.float64).mean(-1) * np.asarray(weights)
    total = share.sum()
    if total <= 0.0:
        return 0.0
    # One minus the mean cosine, of directions about the normal.
    rest = float((share * (1.0 - np.asarray(wi, np.float64)[:, 2])).sum() / total)
    return 1.0 / max(rest, 1e-12)


def _typed(made: Reflector, dtype: Any) -> Reflector:
    import jax

    return jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, made)
