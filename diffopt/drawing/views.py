"""What the pictures show, as numbers: hemisphere maps, in-plane cuts, lit objects.

Radiances are those of a surface under a beam of unit irradiance across it: f cos_i, as XYZ
with the illuminant's Y normalised to 1. Light and camera are directions or positions. Shadows
of one part of an object on another are the caller's to compute: the closed shapes are convex,
for meshes see `diffopt.drawing.meshes.lit`.
"""

import dataclasses
import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from diffopt import baking, colour, lookup, table_bounds
from diffopt.choice import Choice
from diffopt.diffraction import DiffractionBRDF
from diffopt.drawing import shapes, tones
from diffopt.errors import InputError

Progress = Callable[[int, int], None]

#: Scalar theory diverges as 1 / cos for a grazing viewer; pictures leave out what lies beyond.
GRAZING = math.radians(85.0)
#: The in-plane cut ends here, where the scalar theory is off by percents.
STEEPEST = math.radians(80.0)

#: Largest error of the colour tables behind pictures, relative to a mirror's peak.
TABLE_ERROR = 1e-3

#: Reflectance of the parts of an object that are not of the material.
NEUTRAL = 0.6


@dataclasses.dataclass(frozen=True)
class Hemisphere:
    """Colour of the reflected light over the viewing directions, at one direction of light.

    Attributes
    ----------
    xyz
        f cos_i as XYZ, in 1/sr, [n, n, 3], 0 beyond `GRAZING`; row j is wo.y = line[j],
        column i is wo.x = line[i].
    line
        Direction cosines of rows and columns, [n], ascending.
    wi
        Unit vector to the light.
    """

    xyz: Float[np.ndarray, "n n 3"]
    line: Float[np.ndarray, " n"]
    wi: Float[np.ndarray, "3"]


@dataclasses.dataclass(frozen=True)
class InPlane:
    """Spectra in the plane of incidence.

    Attributes
    ----------
    wi, wo
        Unit vectors to the light [3] and to the viewer [A, 3].
    angles
        Signed viewing angles, radians, [A]: positive on the side of the light; the mirror
        direction is at minus the angle of incidence.
    wavelengths
        Micrometres, [L].
    spectra
        f in 1/sr, [A, L].
    xyz
        Colour of the radiance f cos_i (balance peak: of the relative reflectance), [A, 3].
    choice
        The method, its settings and its error bound.
    """

    wi: Float[np.ndarray, "3"]
    wo: Float[np.ndarray, "A 3"]
    angles: Float[np.ndarray, " A"]
    wavelengths: Float[np.ndarray, " L"]
    spectra: Float[np.ndarray, "A L"]
    xyz: Float[np.ndarray, "A 3"]
    choice: Choice


@dataclasses.dataclass(frozen=True)
class Image:
    """A lit object.

    Attributes
    ----------
    xyz
        Radiance by the light, f cos_i as XYZ, [h, w, 3]; 0 but on the lit material.
    albedo
        Share of uniform surroundings that is sent back, relative to white in X, Y and Z,
        [h, w, 3]: for the material R at normal incidence (scalar theory gives all of R to
        the orders, whatever the surface), `NEUTRAL` elsewhere on the object.
    covered
        Whether a sample shows the material, [h, w].
    neutral
        Whether it shows a neutral part of the object, [h, w].
    """

    xyz: Float[np.ndarray, "h w 3"]
    albedo: Float[np.ndarray, "h w 3"]
    covered: Bool[np.ndarray, "h w"]
    neutral: Bool[np.ndarray, "h w"]


def incident(angle: float, azimuth: float) -> Float[np.ndarray, "3"]:
    """Unit vector to a light at an angle to the normal and an azimuth from x, radians."""
    if not (math.isfinite(angle) and abs(angle) < 0.5 * math.pi):
        raise InputError(
            f"incidence must lie between -90 and 90 degrees; received {math.degrees(angle):g}"
        )
    if not math.isfinite(azimuth):
        raise InputError(f"azimuth must be a finite angle; received {azimuth}")
    sin = math.sin(angle)
    return np.array([sin * math.cos(azimuth), sin * math.sin(azimuth), math.cos(angle)])


def order_direction(
    wi: Float[np.ndarray, "3"], period: float, direction: float, order: int, wavelength: float
) -> Float[np.ndarray, "3"] | None:
    """Viewing direction of a grating order, None where it is evanescent.

    (u, v) = -(wi + wo) = -m lambda / d k with the unit vector k across the lines; in the plane
    of incidence along k this is d (sin ti + sin to) = m lambda.

    Parameters
    ----------
    wi
        Unit vector to the light.
    period
        d, micrometres.
    direction
        Azimuth of k, radians.
    order
        m; 0 is the mirror direction.
    wavelength
        Micrometres.
    """
    step = order * wavelength / period
    x = -wi[0] + step * math.cos(direction)
    y = -wi[1] + step * math.sin(direction)
    rest = 1.0 - x * x - y * y
    return np.array([x, y, math.sqrt(rest)]) if rest > 0.0 else None


def hemisphere(
    brdf: DiffractionBRDF,
    wi: Float[np.ndarray, "3"],
    *,
    size: int = 512,
    illuminant: colour.IlluminantLike = "D65",
    progress: Progress | None = None,
) -> Hemisphere:
    """Map of the reflected colour over the hemisphere.

    Parameters
    ----------
    brdf
        The model.
    wi
        Unit vector to the light.
    size
        Pixels on a side, at least 8.
    illuminant
        See `diffopt.colour.spectral_weights`.
    progress
        Called with (wavelengths done, wavelengths in all).
    """
    if size < 8:
        raise InputError(f"size must be at least 8 pixels; received {size}")
    line = (np.arange(size) + 0.5) / size * 2.0 - 1.0
    x, y = np.meshgrid(line, line)
    shown = x * x + y * y < math.sin(GRAZING) ** 2
    wo = np.stack([x, y, np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))], axis=-1)[shown]
    table = bake(brdf, -(wi + wo), size=size, illuminant=illuminant, progress=progress)
    xyz = np.zeros((size, size, 3))
    xyz[shown] = radiance(table, np.broadcast_to(wi, wo.shape), wo)
    return Hemisphere(xyz=xyz, line=line, wi=wi)


def in_plane(
    brdf: DiffractionBRDF,
    angle: float,
    azimuth: float,
    *,
    count: int = 321,
    step_nm: float = 5.0,
    tolerance: float = 1e-3,
    method: str = "auto",
    illuminant: colour.IlluminantLike = "D65",
) -> InPlane:
    """Spectra against the viewing angle, in the plane of incidence up to `STEEPEST`.

    Parameters
    ----------
    brdf
        The model.
    angle, azimuth
        Of the light, radians.
    count
        Viewing angles.
    step_nm
        Wavelength step, nanometres.
    tolerance, method
        See `diffopt.choice.prepare`.
    illuminant
        See `diffopt.colour.spectral_weights`.
    """
    wi = incident(angle, azimuth)
    angles = np.linspace(-STEEPEST, STEEPEST, count)
    wo = np.stack([incident(a, azimuth) for a in angles])
    wavelengths = colour.wavelengths(step_nm)
    weights = np.asarray(colour.spectral_weights(wavelengths, illuminant=illuminant))
    fast = brdf.prepare(pairs=(wi, wo), wavelengths=wavelengths, tolerance=tolerance, method=method)
    spectra = np.asarray(fast(wi, wo), np.float64)
    value = spectra * wi[2]
    if brdf.balance == "peak":
        # f over that of a mirror's peak at normal incidence: rho of `relative`.
        normal = brdf.fresnel.normal(jnp.asarray(wavelengths, brdf.surface.heights.dtype))
        value = value * wavelengths**2 / (float(brdf.coherent_area) * np.asarray(normal))
    return InPlane(wi, wo, angles, wavelengths, spectra, value @ weights, fast.choice)


def bake(
    brdf: DiffractionBRDF,
    waves: Float[np.ndarray, "n 3"],
    *,
    size: int,
    illuminant: colour.IlluminantLike = "D65",
    error: float = TABLE_ERROR,
    progress: Progress | None = None,
) -> lookup.Table:
    """Colour table over the wave vectors that a picture of `size` pixels needs.

    Its error stays below `error` of a mirror's peak. Lines finer than two pixels of
    the box are blurred to that (a single coherent window is sampled as it is), as a pixel
    would blur them.

    Parameters
    ----------
    brdf
        The model.
    waves
        Wave vectors of the picture.
    size
        Pixels on a side.
    illuminant
        See `diffopt.colour.spectral_weights`.
    error
        Largest difference from the direct sum, relative to a mirror's peak.
    progress
        Called with (parts done, parts in all).
    """
    low, high = waves.min(axis=0), waves.max(axis=0)
    # A range of its own for every picture would mean a compilation for each; steps of 0.05
    # also keep the ends inside the table after rounding to float32.
    low, high = np.floor(low / 0.05) * 0.05, np.ceil(high / 0.05) * 0.05
    u, v, w = ((float(a), float(max(b, a + 0.05))) for a, b in zip(low, high, strict=True))
    box = baking.Box(u, v, (max(w[0], -2.0), min(w[1], 0.0)))
    lam = np.asarray(colour.wavelengths(tones.STEP_NM))
    weights = np.asarray(colour.spectral_weights(lam, illuminant=illuminant))
    finest = 2.0 * max(u[1] - u[0], v[1] - v[0]) / min(size, 512)
    width = float(baking.line_width(brdf.surface, lam).min())
    coarser = 1.0
    if brdf.surface.coverage != "positions":
        coarser = max(1.0, finest / width)
    elif width < finest:
        blur = math.sqrt(float(brdf.surface.blur) ** 2 + finest**2 - width**2)
        wider = jnp.asarray(blur, brdf.surface.blur.dtype)
        brdf = eqx.tree_at(lambda b: b.surface.blur, brdf, wider)
    settings = table_bounds.table_settings(
        brdf.surface, box, lam, lambda found: float(found.max()), error, order=3
    )
    settings = dataclasses.replace(settings, step=settings.step * coarser)
    return baking.bake(
        brdf, box, lam, weights, settings, relative=brdf.balance == "peak", progress=progress
    )


def radiance(
    table: lookup.Table,
    wi: Float[np.ndarray, "n 3"],
    wo: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n 3"]:
    """F cos_i as XYZ for many pairs in the local frame, 0 beyond `GRAZING` for the viewer."""
    dtype = table.coefficients.dtype
    out = np.zeros((len(wi), 3))
    for first in range(0, len(wi), tones.BLOCK):
        part = slice(first, first + tones.BLOCK)
        count = len(wi[part])
        # The last block is filled up: one shape, one compilation.
        pairs = np.zeros((2, tones.BLOCK, 3))
        pairs[..., 2] = 1.0
        pairs[0, :count], pairs[1, :count] = wi[part], wo[part]
        pairs = jnp.asarray(pairs, dtype)
        out[part] = np.asarray(lookup.shade(table, pairs[0], pairs[1]))[:count]
    out[wo[:, 2] <= math.cos(GRAZING)] = 0.0
    return out


def wave_vectors(
    view: shapes.View, light: Float[np.ndarray, "... 3"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which samples of a view are lit and seen, and their local wi and wo, [n, 3] each."""
    wi, wo = view.local(light), view.local(view.eye)
    lit = view.covered & (wi[..., 2] > 0.0) & (wo[..., 2] > math.cos(GRAZING))
    return lit, wi[lit], wo[lit]


def photograph(
    brdf: DiffractionBRDF,
    table: lookup.Table,
    view: shapes.View,
    light: Float[np.ndarray, "... 3"],
    *,
    lit: Bool[np.ndarray, "h w"] | None = None,
    illuminant: colour.IlluminantLike = "D65",
) -> Image:
    """Light that a lit object sends to the samples of a picture.

    Parameters
    ----------
    brdf, table
        The model and its table over the view's wave vectors, see `bake`.
    view
        The object under its camera.
    light
        Unit vectors to the light, in the world: [3] or [h, w, 3]. Unit irradiance across the
        beam.
    lit
        Which samples the light reaches, [h, w]; all whose front it faces if left out.
    illuminant
        As for `bake`.
    """
    shown, wi, wo = wave_vectors(view, light)
    if lit is not None:
        kept, shown = lit[shown], shown & lit
        wi, wo = wi[kept], wo[kept]
    xyz = np.zeros((*view.covered.shape, 3))
    xyz[shown] = radiance(table, wi, wo)
    albedo = np.where(view.neutral, NEUTRAL, 0.0)[..., None] * np.ones(3)
    albedo[view.covered] = normal_colour(brdf, illuminant)
    return Image(xyz, albedo, view.covered, view.neutral)


def normal_colour(
    brdf: DiffractionBRDF, illuminant: colour.IlluminantLike
) -> Float[np.ndarray, "3"]:
    """XYZ of R at normal incidence over that of white."""
    wavelengths = colour.wavelengths(tones.STEP_NM)
    weights = np.asarray(colour.spectral_weights(wavelengths, illuminant=illuminant))
    normal = brdf.fresnel.normal(jnp.asarray(wavelengths, brdf.surface.heights.dtype))
    return np.asarray(normal, np.float64) @ weights / weights.sum(axis=0)
