"""The diffraction BRDF of a heightfield, by Stam's scalar theory.

``f = R S C / lambda^2 * area * |P|^2`` with R the power reflectance at the half-vector
angle, S shadowing, C the geometric factor of the model (`diffopt.kernels.prefactor`),
``area`` the coherent area (4 pi sigma_s^2 for a Gaussian window, the patch without one) and
|P|^2 the windowed transform relative to a mirror's peak. Sources: J. Stam, Diffraction
Shaders, SIGGRAPH 1999; Dhillon et al., Interactive Diffraction from Biological
Nanostructures, 2014.

Differentiable in heights, directions, wavelengths, coherence, blur and reflectance, at
fixed visibility (the horizon is a mask).
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal, get_args

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from diffopt import checks, colour, devices, gathering, methods, spreading
from diffopt.checks import Values
from diffopt.errors import InputError
from diffopt.fresnel import Constant, Reflectance
from diffopt.heightfield import Heightfield
from diffopt.kernels import frames
from diffopt.kernels import prefactor as prefactors
from diffopt.scalar import Shadowing as Shadowing
from diffopt.scalar import geometry as geometry
from diffopt.scalar import model_factors as model_factors
from diffopt.settings import DirectSettings, GatherSettings, SeparableSettings, Settings

if TYPE_CHECKING:
    from diffopt.choice import PreparedBRDF

Balance = Literal["radiometric", "peak"]
Mirror = Literal["included", "apart"]
Output = Literal["spectral", "relative", "xyz"]


class DiffractionBRDF(eqx.Module):
    """BRDF of a measured heightfield, 1/sr without the cosine, zero below the horizon.

    Reciprocal (for ``prefactor`` stam, rohs, rghs and kirchhoff); conserves energy within
    the limits of scalar theory only; no delta part unless ``mirror="apart"``.

    Parameters
    ----------
    scan
        The heightfield, one period of a periodic surface as far as the transform goes.
    coherence
        sigma_s of the Gaussian coherence window exp(-r^2 / 2 sigma_s^2), micrometres, from
        one pixel to half the patch; None: the bare patch is coherent as a whole. A patch
        of 8 sigma_s or more keeps its own edges out of the result, see `patch_error`.
    fresnel
        Power reflectance (`diffopt.fresnel`); a perfect mirror by default.
    average
        ``positions``: |P|^2 averaged over all positions of the window, what a pixel much
        larger than the coherence area sees; ``window``: one window at `position`, what a
        coherent spot sees (speckle, glints).
    position
        Centre (y, x) of the single window, micrometres from the middle of the patch.
    prefactor
        ``stam`` or a related model, see `diffopt.kernels.prefactor.geometric_factor`.
    shadowing
        ``none``, or ``v-cavity`` (Torrance and Sparrow).
    balance
        White balance of `xyz`: ``radiometric`` weights spectra of f, so that an extended
        white source seen in a mirror is white; ``peak`` (the thesis) weights the relative
        reflectance, so that the peak of a mirror is white.
    blur
        Standard deviation, in u and in v (direction sines), of the light source and the
        pixel together; only with ``average="positions"``. The sun's disc is 0.0023.
    repeats
        Copies (y, x) of the bare patch side by side; only with ``coherence=None``.
    mirror
        ``apart`` leaves the mean of exp(i k w h), which reflects like a mirror, out of f
        and gives it as `mirror_reflectance`; only with ``average="positions"``.

    Raises
    ------
    InputError
        If an argument is out of its range; the message names it.
    """

    surface: methods.Surface
    fresnel: Reflectance
    shadowing: Shadowing = eqx.field(static=True)
    balance: Balance = eqx.field(static=True)

    def __init__(
        self,
        scan: Heightfield,
        coherence: Values | None,
        *,
        fresnel: Reflectance | None = None,
        average: Literal["positions", "window"] | str = "positions",
        position: Values = (0.0, 0.0),
        prefactor: prefactors.Prefactor | str = "stam",
        shadowing: Shadowing | str = "none",
        balance: Balance | str = "radiometric",
        blur: Values = 0.0,
        repeats: tuple[int, int] = (1, 1),
        mirror: Mirror | str = "included",
    ):
        window = checks.choice("average", average, ("positions", "window"))
        model = checks.choice("prefactor", prefactor, prefactors.NAMES)
        checks.choice("mirror", mirror, get_args(Mirror))
        coverage: methods.Coverage = window if coherence is not None else "patch"
        checks.coherence(coherence, scan.pixel, scan.extent)
        checks.window_options(coverage, blur, repeats, mirror)
        dtype = scan.heights.dtype
        self.surface = methods.Surface(
            heights=scan.heights,
            sigma=jnp.asarray(1.0 if coherence is None else coherence, dtype),
            center=jnp.asarray(position, dtype),
            blur=jnp.asarray(blur, dtype),
            pixel=scan.pixel,
            coverage=coverage,
            repeats=repeats,
            prefactor=model,
            drop_mean=mirror == "apart",
        )
        self.fresnel = Constant() if fresnel is None else fresnel
        self.shadowing = checks.choice("shadowing", shadowing, get_args(Shadowing))
        self.balance = checks.choice("balance", balance, get_args(Balance))

    def __call__(self, wi: Values, wo: Values, wavelengths: Values) -> Float[Array, "*batch L"]:
        """Absolute BRDF by the direct sum, the reference for every other method.

        Parameters
        ----------
        wi, wo
            Unit vectors to the light and to the viewer, [..., 3], broadcast together;
            converted to the dtype of the heights.
        wavelengths
            Micrometres, [L].

        Returns
        -------
        Array
            f in 1/sr, [..., L]; 0 where either direction is at or below the horizon.

        Raises
        ------
        InputError
            If a direction is not of unit length or a wavelength not positive and below
            100 micrometres (checked unless traced by a caller's own jit).
        """
        return evaluate(self, wi, wo, wavelengths, DirectSettings())

    def relative(self, wi: Values, wo: Values, wavelengths: Values) -> Float[Array, "*batch L"]:
        """The thesis's relative reflectance rho = R/R0 S C cos_i |P|^2 (its eq. 16-18).

        A mirror at its specular direction gives R/R0 cos_i. Arguments as for a call.
        """
        return evaluate(self, wi, wo, wavelengths, DirectSettings(), output="relative")

    def xyz(
        self,
        wi: Values,
        wo: Values,
        *,
        illuminant: colour.IlluminantLike = "D65",
        step_nm: float = 5.0,
    ) -> Float[Array, "*batch 3"]:
        """CIE 1931 XYZ by the direct sum, under the balance of this object.

        ``radiometric``: XYZ of f in 1/sr (a Lambertian white has Y = 1/pi); ``peak``: XYZ
        of the relative reflectance (a mirror's peak at normal incidence has Y = 1).

        Parameters
        ----------
        wi, wo
            Unit vectors, [..., 3].
        illuminant
            Name or spectrum, see `diffopt.colour.spectral_weights`.
        step_nm
            Step of the trapezoid rule over 380-780 nm. A line seen at a fixed direction is
            lambda^2 / (2 pi |u| sigma_s) wide: keep the step below an eighth of
            lambda^2 / (|u| sigma_s).
        """
        wavelengths = colour.wavelengths(step_nm)
        weights = colour.spectral_weights(wavelengths, illuminant=illuminant)
        return evaluate(self, wi, wo, wavelengths, DirectSettings(), output="xyz", weights=weights)

    def prepare(
        self,
        *,
        pairs: "int | tuple[Values, Values]",
        wavelengths: Values | None = None,
        output: Output | str = "spectral",
        tolerance: float = 1e-3,
        gradient: str = "none",
        method: str = "auto",
        settings: Settings | None = None,
        illuminant: colour.IlluminantLike = "D65",
        progress: Callable[[int, int], None] | None = None,
    ) -> "PreparedBRDF":
        """Choose the cheapest method for a job; see `diffopt.choice.prepare`."""
        from diffopt.choice import prepare

        return prepare(
            self,
            pairs=pairs,
            wavelengths=wavelengths,
            output=output,
            tolerance=tolerance,
            gradient=gradient,
            method=method,
            settings=settings,
            illuminant=illuminant,
            progress=progress,
        )

    def mirror_reflectance(self, cos_i: Values, wavelengths: Values) -> Float[Array, "*batch L"]:
        """Reflectance of the mirror part: R |mean of exp(i k w h)|^2 at w = -2 cos_i.

        Parameters
        ----------
        cos_i
            Cosine of the angle of incidence, (0, 1], [...].
        wavelengths
            Micrometres, [L].
        """
        dtype = self.surface.heights.dtype
        cos_i = jnp.asarray(cos_i, dtype)
        wavelengths = jnp.asarray(wavelengths, dtype)
        wave = jnp.stack(jnp.broadcast_arrays(jnp.zeros_like(cos_i), 0.0 * cos_i, -2.0 * cos_i), -1)
        s = self.surface.height_phase(wave)[..., None] / wavelengths
        share = jnp.vectorize(
            lambda s: methods.mean_reflectance(self.surface.heights, s), signature="()->()"
        )(s)
        return self.fresnel(cos_i, wavelengths) * share

    @property
    def coherent_area(self) -> Float[Array, ""]:
        """Area whose waves add coherently, square micrometres: 4 pi sigma_s^2 or the patch."""
        if self.surface.coverage == "patch":
            (ey, ex), (ry, rx) = self.surface.extent, self.surface.repeats
            return jnp.asarray(ey * ex * ry * rx, self.surface.heights.dtype)
        return 4.0 * math.pi * self.surface.sigma**2

    def patch_error(self) -> float:
        """Estimated relative error of |P|^2 from the finite patch, apart from all others.

        The share of the window's weight outside the patch, 2 erfc(L / (2 sqrt(2) sigma_s)):
        9 % at L = 4 sigma_s, 0.5 % at 6, 1.3e-4 at 8; the study ``diffraction.patch``
        measures 8 %, 0.6 % and 1.5e-4 on a rough surface. An estimate, not a bound; it is
        beside the point for a surface that really repeats.
        """
        if self.surface.coverage == "patch":
            return 0.0
        ratio = min(self.surface.extent) / float(self.surface.sigma)
        return 2.0 * math.erfc(ratio / (2.0 * math.sqrt(2.0)))


def factors(
    brdf: DiffractionBRDF,
    wi: Float[Array, "M 3"],
    wo: Float[Array, "M 3"],
    wavelengths: Float[Array, " L"],
    output: Output,
) -> Float[Array, "M L"]:
    """Everything before |P|^2 in an output of a diffraction BRDF."""
    relative = output == "relative" or (output == "xyz" and brdf.balance == "peak")
    value = model_factors(
        brdf.fresnel,
        wi,
        wo,
        wavelengths,
        prefactor=brdf.surface.prefactor,
        shadowing=brdf.shadowing,
        relative=relative,
    )
    return value if relative else value * brdf.coherent_area


def intensity(
    brdf: DiffractionBRDF,
    wave: Float[Array, "M 3"],
    wavelengths: Float[Array, " L"],
    settings: Settings,
    tables: gathering.GatherTables | None = None,
    valid: Bool[Array, " M"] | None = None,
) -> Float[Array, "M L"]:
    """|P|^2 relative to a mirror's peak by the method that `settings` belong to.

    Parameters
    ----------
    brdf, wave, wavelengths, settings
        The model, wave vectors, micrometres, and settings of a method that has no bake.
    tables
        Of a method that gathers; made for these pairs and wavelengths if not given.
    valid
        Which pairs count for the range of the tables; all if not given.
    """
    if isinstance(settings, DirectSettings):
        return methods.direct(brdf.surface, wave, wavelengths, settings)
    if isinstance(settings, SeparableSettings):
        return methods.separable_pairs(brdf.surface, wave, wavelengths, settings)
    if not isinstance(settings, GatherSettings):
        raise TypeError(f"no |P|^2 by settings {settings!r}")
    if tables is None:
        reached = gathering.s_range(brdf.surface, wave, wavelengths, valid)
        tables = gathering.gather_tables(brdf.surface, settings, reached)
    return gathering.gathered(brdf.surface, wave, wavelengths, settings, tables)


@eqx.filter_jit
def _evaluate(brdf, wi, wo, wavelengths, weights, tables, *, settings, output):
    batch = wi.shape[:-1]
    valid, wi, wo = frames.above_horizon(wi.reshape(-1, 3), wo.reshape(-1, 3))
    wave = frames.valid_wave_vector(valid, wi, wo)
    before = factors(brdf, wi, wo, wavelengths, output)
    value = before * intensity(brdf, wave, wavelengths, settings, tables, valid)
    value = jnp.where(valid[:, None], value, 0.0)
    if output == "xyz":
        value = jnp.matmul(value, weights, precision="highest")
    return value.reshape(*batch, value.shape[-1])


def evaluate(
    brdf: DiffractionBRDF,
    wi: Values,
    wo: Values,
    wavelengths: Values,
    settings: Settings,
    *,
    output: Output = "spectral",
    weights: Values | None = None,
    tables: gathering.GatherTables | None = None,
) -> Float[Array, "*batch L"]:
    """Check, convert and evaluate: the one entry point that is compiled.

    Parameters are those of `DiffractionBRDF.__call__`, with the method's settings, the
    output, for ``output="xyz"`` the spectral weights [L, 3], and tables made before for a
    method that gathers (`diffopt.gathering.gather_tables`).
    """
    dtype = brdf.surface.heights.dtype
    checks.directions("wi", wi)
    checks.directions("wo", wo)
    checks.wavelengths(wavelengths)
    over, axis = spreading.pairs(wi, wo)
    over = devices.common(wavelengths) if over is None else over
    wi, wo = jnp.broadcast_arrays(jnp.asarray(wi, dtype), jnp.asarray(wo, dtype))
    wavelengths = jnp.atleast_1d(jnp.asarray(wavelengths, dtype))
    if weights is not None:
        weights = jnp.asarray(weights, dtype)
    refuse(brdf, settings)
    given = brdf, wi, wo, wavelengths, weights, tables
    if over is not None:
        return spreading.evaluated(_evaluate, over, axis, given, settings, output)
    return _evaluate(*given, settings=settings, output=output)


def refuse(brdf: DiffractionBRDF, settings: Settings) -> None:
    """Raise InputError for a method that cannot evaluate this model."""
    surface = brdf.surface
    if surface.prefactor == "kirchhoff" and not isinstance(settings, DirectSettings):
        raise InputError(
            f"prefactor 'kirchhoff' weights every facet by the directions: method "
            f"{settings.name!r} cannot do that, use method 'direct'"
        )
    if isinstance(settings, GatherSettings) and surface.coverage == "patch":
        raise InputError(
            f"method {settings.name!r} gathers with a coherence window: received coherence=None, "
            "give coherence in micrometres or use method 'direct' or 'separable'"
        )
