"""Random functions and materials for ``lobes="auto"`` of `diffopt.fitting.lobe_targets`.

The relative L2 error of every slice is measured anew on a quadrature of the whole sphere that
has nothing in common with the nodes of the fit: Gauss-Legendre over the height in each half,
even over the azimuth.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import materials
from diffopt.accuracy.promises import Answer, Draw, Promise, refusal
from diffopt.errors import InputError
from diffopt.fitting.lobe_targets import fit_lobes
from diffopt.lobes import Lobes

# Heights in each half of the sphere, and azimuths: they resolve concentrations up to 3,000.
_HEIGHTS, _AZIMUTHS = 160, 640
_SHARPEST = 3000.0
#: Lobes of a function at most, and directions to the viewer of a material.
MOST, VIEWS = 6, 2


@functools.cache
def sphere() -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
    """Directions and solid angles of the quadrature."""
    t, weight = np.polynomial.legendre.leggauss(_HEIGHTS)
    z = np.concatenate([0.5 * (t + 1.0), 0.5 * (t - 1.0)])
    weight = np.tile(0.5 * weight, 2)
    phi = (np.arange(_AZIMUTHS) + 0.5) * 2.0 * np.pi / _AZIMUTHS
    sin = np.sqrt(1.0 - z * z)
    directions = np.stack(
        [
            sin[:, None] * np.cos(phi),
            sin[:, None] * np.sin(phi),
            np.broadcast_to(z[:, None], (len(z), _AZIMUTHS)),
        ],
        -1,
    )
    solid = np.repeat(weight * 2.0 * np.pi / _AZIMUTHS, _AZIMUTHS)
    return directions.reshape(-1, 3), solid


def relative_error(lobes: Lobes, right: Float[Array, " N"]) -> float:
    """L2 distance of lobes [K] from values on `sphere`, over the norm of these."""
    directions, solid = (jnp.asarray(a, right.dtype) for a in sphere())
    return float(_relative(lobes, directions, solid, right))


@jax.jit
def _relative(lobes: Lobes, directions: Array, solid: Array, right: Array) -> Array:
    off = lobes(directions) - right
    return jnp.sqrt((solid * off * off).sum() / (solid * right * right).sum())


def _mixture(rng: np.random.Generator) -> tuple[Callable[[Array], Array], str]:
    """Lobes over a constant floor."""
    count = int(rng.integers(1, MOST + 1))
    axes = rng.normal(size=(MOST, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    kappa = np.exp(rng.uniform(np.log(0.5), np.log(_SHARPEST), MOST))
    weight = rng.uniform(0.1, 1.0, MOST) * (np.arange(MOST) < count)
    floor = float(rng.choice([0.0, 0.02, 0.3]))
    lobes = Lobes(jnp.asarray(weight), jnp.asarray(axes), jnp.asarray(kappa))

    def value(s: Array) -> Array:
        return lobes(s) + floor

    return value, f"{count} lobes, the sharpest {kappa[:count].max():.3g}, floor {floor:g}"


def _material(rng: np.random.Generator) -> tuple[materials.Material, str]:
    kind = str(rng.choice(["ggx", "beckmann", "blinn-phong", "phong", "oren-nayar"]))
    if kind in ("ggx", "beckmann"):
        # Below this width a slice is sharper than the quadrature can hold.
        alpha = float(np.exp(rng.uniform(np.log(0.06), np.log(1.0))))
        return materials.Microfacet(alpha, normals=kind), f"{kind}, alpha {alpha:.2g}"
    if kind == "oren-nayar":
        sigma = float(rng.uniform(0.0, 1.0))
        return materials.OrenNayar(sigma=sigma), f"{kind}, sigma {sigma:.2g}"
    exponent = float(np.exp(rng.uniform(np.log(1.0), np.log(500.0))))
    model = materials.BlinnPhong if kind == "blinn-phong" else materials.Phong
    return model(exponent=exponent), f"{kind}, exponent {exponent:.3g}"


def _answer(draw: Draw) -> Answer:
    rng = draw.rng
    directions = jnp.asarray(sphere()[0])
    target: Any
    if rng.uniform() < 0.5:
        target, words = _mixture(rng)
        right = target(directions)[None]
        options: dict[str, Any] = {}
    else:
        target, words = _material(rng)
        angle = np.radians(rng.uniform(0.0, 85.0, VIEWS))
        wo = np.stack([np.sin(angle), np.zeros(VIEWS), np.cos(angle)], -1)
        words += f", viewers at {np.degrees(angle).round(1).tolist()} degrees"
        options = {"wo": jnp.asarray(wo)}
        right = _slices(target, directions, options["wo"])
    key = jax.random.key(int(rng.integers(2**31)))
    try:
        fit = fit_lobes(target, "auto", tolerance=draw.tolerance, key=key, **options)
    except InputError as error:
        return refusal(words, error)
    count = fit.lobes.count
    error = _worst(fit.lobes, right)
    price = None
    if draw.priced:
        fewest = count
        for fewer in range(1, count):
            less = fit_lobes(target, fewer, key=key, **options)
            if _worst(less.lobes, right) <= draw.tolerance:
                fewest = fewer
                break
        price = count / fewest
    return Answer(f"{words}: {count} lobes", error, price=price)


@jax.jit
def _slices(material: materials.Material, directions: Array, wo: Array) -> Array:
    """What is fitted, at the nodes of `sphere`, [V, N]."""

    def one(wo: Array) -> Array:
        values = material(directions, jnp.broadcast_to(wo, directions.shape))
        return values.reshape(len(directions), -1).mean(-1) * jnp.abs(directions[:, 2])

    return jax.vmap(one)(wo)


def _worst(lobes: Lobes, right: Array) -> float:
    parts = [jax.tree.map(lambda a, k=k: a[k], lobes) for k in range(len(right))]
    if len(right) == 1 and lobes.alpha.ndim == 1:
        parts = [lobes]
    return max(relative_error(part, row) for part, row in zip(parts, right, strict=True))


LOBES = Promise(
    name="lobes",
    entry="fitting.fit_lobes(lobes='auto', tolerance=)",
    quantity="relative L2 error over the sphere, the largest of the slices; cost in lobes",
    reference=f"the function itself on {2 * _HEIGHTS} x {_AZIMUTHS} other directions",
    answer=_answer,
)
