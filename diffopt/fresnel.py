"""Reflectance of the surface material, as a function of angle and wavelength.

Every object is called as ``material(cos_h, wavelengths)`` with the cosine at the facet (the
half-vector cosine wi.h = wo.h) and wavelengths in micrometres, and returns the unpolarised
power reflectance with the wavelengths on a new last axis. Results follow the type of `cos_h`.
Parameters are array leaves: objects pass through `jit`, `vmap` and `grad`.
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.errors import InputError
from diffopt.kernels import fresnel

#: Planck's constant times the speed of light, in eV micrometres (exact in the SI, to ten digits).
HC_EV_UM = 1.239841984

# Lorentz-Drude parameters in eV of Rakic, Djurisic, Elazar and Majewski, Applied Optics 37,
# 5271 (1998), tables 1 and 2: plasma energy, then (strength, width, resonance) of each
# term, the first being the free electrons (resonance 0).
_LORENTZ_DRUDE = {
    "Al": (
        14.98,
        (
            (0.523, 0.047, 0.0),
            (0.227, 0.333, 0.162),
            (0.050, 0.312, 1.544),
            (0.166, 1.351, 1.808),
            (0.030, 3.382, 3.473),
        ),
    ),
    "Ag": (
        9.01,
        (
            (0.845, 0.048, 0.0),
            (0.065, 3.886, 0.816),
            (0.124, 0.452, 4.481),
            (0.011, 0.065, 8.185),
            (0.840, 0.916, 9.083),
            (5.646, 2.419, 20.29),
        ),
    ),
    "Au": (
        9.03,
        (
            (0.760, 0.053, 0.0),
            (0.024, 0.241, 0.415),
            (0.010, 0.345, 0.830),
            (0.071, 0.870, 2.969),
            (0.601, 2.494, 4.304),
            (4.384, 2.214, 13.32),
        ),
    ),
    "Cu": (
        10.83,
        (
            (0.575, 0.030, 0.0),
            (0.061, 0.378, 0.291),
            (0.104, 1.056, 2.957),
            (0.723, 3.213, 5.300),
            (0.638, 4.305, 11.18),
        ),
    ),
}
METALS = tuple(_LORENTZ_DRUDE)
# Where a metal's index comes from, see `metal`.
SOURCES = ("lorentz-drude", "measured")


def floating(x: Any) -> Array:
    """Array of the caller's floating type; Python and integer numbers in the default type."""
    x = jnp.asarray(x)
    kind = x.dtype if jnp.issubdtype(x.dtype, jnp.floating) else jnp.result_type(float)
    return jax.lax.convert_element_type(x, kind)  # Python numbers lose their weak type


class Reflectance(eqx.Module):
    """What every material offers."""

    @abc.abstractmethod
    def __call__(
        self, cos_h: Float[Array, "*batch"], wavelengths: Float[Array, " L"]
    ) -> Float[Array, "*batch L"]:
        """Unpolarised power reflectance.

        Parameters
        ----------
        cos_h
            Cosine of the angle of incidence on the facet, in [0, 1].
        wavelengths
            In micrometres.
        """

    def normal(self, wavelengths: Float[Array, " L"]) -> Float[Array, " L"]:
        """Reflectance at normal incidence, R0, by which relative reflectance is divided."""
        return self(jnp.ones((), wavelengths.dtype), wavelengths)


class Constant(Reflectance):
    """The same reflectance at all angles and wavelengths; 1 is the perfect mirror."""

    value: Float[Array, ""] = eqx.field(converter=floating, default=1.0)

    def __check_init__(self) -> None:
        """Check the value, where it is known."""
        _check("value", self.value, lambda v: (v > 0) & (v <= 1), "above 0 and at most 1")

    def __call__(
        self, cos_h: Float[Array, "*batch"], wavelengths: Float[Array, " L"]
    ) -> Float[Array, "*batch L"]:
        """See `Reflectance`."""
        return jnp.broadcast_to(
            self.value.astype(cos_h.dtype), (*cos_h.shape, wavelengths.shape[0])
        )


class Schlick(Reflectance):
    """Schlick's approximation from the reflectance at normal incidence; see `kernels.fresnel`.

    Parameters
    ----------
    r0
        Above 0 and at most 1: a number, or one for each wavelength, [L].
    """

    r0: Float[Array, "..."] = eqx.field(converter=floating)

    def __check_init__(self) -> None:
        """Check the value, where it is known."""
        if self.r0.ndim > 1:
            raise InputError(f"r0 must be a number or [L]; received shape {self.r0.shape}")
        _check("r0", self.r0, lambda v: (v > 0) & (v <= 1), "above 0 and at most 1")

    def __call__(
        self, cos_h: Float[Array, "*batch"], wavelengths: Float[Array, " L"]
    ) -> Float[Array, "*batch L"]:
        """See `Reflectance`."""
        r0 = jnp.broadcast_to(self.r0.astype(cos_h.dtype), wavelengths.shape)
        return fresnel.schlick(*jnp.broadcast_arrays(cos_h[..., None], _last_axis(r0, cos_h)))


class Dielectric(Reflectance):
    """Transparent material, by the exact formula.

    Parameters
    ----------
    coefficients
        The index, or Cauchy's coefficients (A, B, C, ...) of
        n = A + B / lambda^2 + C / lambda^4 + ..., lambda in micrometres.
    """

    coefficients: Float[Array, " K"] = eqx.field(converter=lambda n: jnp.atleast_1d(floating(n)))

    def __check_init__(self) -> None:
        """Check the values, where they are known."""
        _check("n", self.coefficients[0], lambda v: v > 0, "a refractive index above 0")
        _check("n", self.coefficients, np.isfinite, "a finite index")

    def index(self, wavelengths: Float[Array, " L"]) -> Float[Array, " L"]:
        """Refractive index at wavelengths in micrometres."""
        coefficients = self.coefficients.astype(wavelengths.dtype)
        return jnp.polyval(coefficients[::-1], wavelengths**-2)

    def __call__(
        self, cos_h: Float[Array, "*batch"], wavelengths: Float[Array, " L"]
    ) -> Float[Array, "*batch L"]:
        """See `Reflectance`."""
        n = _last_axis(self.index(wavelengths), cos_h)
        return fresnel.dielectric(*jnp.broadcast_arrays(cos_h[..., None], n))


class Conductor(Reflectance):
    """Absorbing material from a table of its complex index, linear between the samples.

    Parameters
    ----------
    wavelengths
        At least two, ascending, in micrometres.
    eta, k
        Real part and extinction coefficient at each, at least 0.

    Raises
    ------
    InputError
        For a table out of order or out of range. Wavelengths outside the table raise when
        they are known while tracing, and as an error of the compiled program otherwise.
    """

    wavelengths: Float[Array, " K"] = eqx.field(converter=floating)
    eta: Float[Array, " K"] = eqx.field(converter=floating)
    k: Float[Array, " K"] = eqx.field(converter=floating)

    def __check_init__(self) -> None:
        """Check the table, where it is known."""
        if self.wavelengths.shape[0] < 2:
            raise InputError(
                f"wavelengths: a table of {self.wavelengths.shape[0]} given, expected at least 2"
            )
        _check("wavelengths", self.wavelengths, lambda v: np.diff(v) > 0, "an ascending table")
        _check("eta", self.eta, lambda v: v >= 0, "values of at least 0")
        _check("k", self.k, lambda v: v >= 0, "values of at least 0")

    def index(
        self, wavelengths: Float[Array, " L"]
    ) -> tuple[Float[Array, " L"], Float[Array, " L"]]:
        """Real part and extinction coefficient at wavelengths in micrometres."""
        kind = wavelengths.dtype
        table = self.wavelengths.astype(kind)
        # The table may be in float64 and the request in float32, or the other way round.
        slack = 4 * float(jnp.finfo(jnp.float32).eps)
        known, asked = checks.concrete(self.wavelengths), checks.concrete(wavelengths)
        if known is None or asked is None:
            outside = (wavelengths < table[0] * (1 - slack)) | (
                wavelengths > table[-1] * (1 + slack)
            )
            wavelengths = eqx.error_if(
                wavelengths, outside, "wavelengths: outside the table of the conductor"
            )
        elif not (asked.min() >= known[0] * (1 - slack) and asked.max() <= known[-1] * (1 + slack)):
            raise InputError(
                f"wavelengths: {asked.min():g} to {asked.max():g} um given, the table of the "
                f"conductor has {known[0]:g} to {known[-1]:g} um"
            )
        eta, k = (jnp.interp(wavelengths, table, x.astype(kind)) for x in (self.eta, self.k))
        return eta, k

    def __call__(
        self, cos_h: Float[Array, "*batch"], wavelengths: Float[Array, " L"]
    ) -> Float[Array, "*batch L"]:
        """See `Reflectance`."""
        return _conductor(cos_h, *self.index(wavelengths))


class LorentzDrude(Reflectance):
    """Metal from free and bound oscillators, a formula at every wavelength.

    eps = 1 + sum over j of f_j wp^2 / (w_j^2 - w^2 - i w G_j), w = hc / lambda in eV. See
    `metal` for the published parameters.

    Parameters
    ----------
    plasma
        Plasma energy wp, in eV.
    strength, width, resonance
        f_j (without unit), G_j and w_j (eV); w_j = 0 for the free electrons.
    """

    plasma: Float[Array, ""] = eqx.field(converter=floating)
    strength: Float[Array, " J"] = eqx.field(converter=floating)
    width: Float[Array, " J"] = eqx.field(converter=floating)
    resonance: Float[Array, " J"] = eqx.field(converter=floating)

    def __check_init__(self) -> None:
        """Check the values, where they are known."""
        _check("plasma", self.plasma, lambda v: v > 0, "an energy above 0 eV")
        _check("strength", self.strength, lambda v: v >= 0, "values of at least 0")
        _check("width", self.width, lambda v: v > 0, "values above 0 eV")
        _check("resonance", self.resonance, lambda v: v >= 0, "values of at least 0 eV")

    def index(
        self, wavelengths: Float[Array, " L"]
    ) -> tuple[Float[Array, " L"], Float[Array, " L"]]:
        """Real part and extinction coefficient at wavelengths in micrometres."""
        kind = wavelengths.dtype
        plasma = self.plasma.astype(kind)
        strength, width, resonance = (
            x.astype(kind)[:, None] for x in (self.strength, self.width, self.resonance)
        )
        energy = (HC_EV_UM / wavelengths)[None, :]
        detuning = (resonance - energy) * (resonance + energy)
        damping = energy * width
        weight = strength * plasma**2 / (detuning**2 + damping**2)
        return fresnel.index_from_permittivity(
            1.0 + (weight * detuning).sum(axis=0), (weight * damping).sum(axis=0)
        )

    def __call__(
        self, cos_h: Float[Array, "*batch"], wavelengths: Float[Array, " L"]
    ) -> Float[Array, "*batch L"]:
        """See `Reflectance`."""
        return _conductor(cos_h, *self.index(wavelengths))


def metal(name: str, source: str = "lorentz-drude") -> LorentzDrude | Conductor:
    """Aluminium, silver, gold or copper: the Lorentz-Drude fit of Rakic et al. (1998), or a table.

    The fit covers wavelengths from 0.2 to 12 micrometres. Against measured tables, over 0.38
    to 0.78 micrometres at normal incidence, the largest difference in reflectance is 0.006
    (Al), 0.009 (Ag), 0.10 (Au, near 0.55) and 0.15 (Cu, near 0.55): the oscillators blur the
    edge that colours gold and copper. As a colour under D65 that is a delta E 2000 of 0.3,
    0.4, 2.8 and 13.6. For a true copper take the table. (Silver was fitted to older films: the
    table reflects 0.02 more above 0.6, 0.1 more at 0.4.)

    Parameters
    ----------
    name
        "Al", "Ag", "Au" or "Cu", in any case.
    source
        ``lorentz-drude``, or ``measured``: the tables of `diffopt.metals`, from 0.207 (Al) or
        0.188 to 1.94 micrometres, their sources and how far they agree with other films.

    Raises
    ------
    InputError
        For another name or source.
    """
    key = name.capitalize()
    if key not in _LORENTZ_DRUDE:
        raise InputError(f"metal: {name!r} given, expected one of {', '.join(METALS)}")
    if source == "measured":
        from diffopt.metals import measured

        return measured(key)
    if source != "lorentz-drude":
        raise InputError(
            f"source of a metal must be one of {', '.join(SOURCES)}; received {source!r}"
        )
    plasma, terms = _LORENTZ_DRUDE[key]
    return LorentzDrude(plasma, *np.array(terms).T)


def parse(text: str) -> Reflectance:
    """Material from the short text of the command line.

    Parameters
    ----------
    text
        "mirror", "al", "ag", "au", "cu" (the fit; "al-measured" and so on the table), "n=1.5",
        "schlick=0.04" or "constant=0.8".

    Raises
    ------
    InputError
        For anything else.
    """
    word = text.strip().lower()
    if word == "mirror":
        return Constant()
    symbol, table, _ = word.partition("-measured")
    if symbol.capitalize() in METALS and word == symbol + table:
        return metal(symbol, "measured" if table else "lorentz-drude")
    makers: dict[str, Callable[[Any], Reflectance]] = {
        "n": Dielectric,
        "schlick": Schlick,
        "constant": Constant,
    }
    name, equals, number = (part.strip() for part in word.partition("="))
    if not equals or name not in makers:
        raise InputError(
            f"material: {text!r} given, expected mirror, {', '.join(METALS).lower()}, n=NUMBER, "
            "schlick=NUMBER or constant=NUMBER; al-measured and so on for a metal's table"
        )
    try:
        value = float(number)
    except ValueError:
        raise InputError(
            f"material {text!r}: {number!r} given for {name}, expected a number"
        ) from None
    if name == "n" and value == 1.0:
        raise InputError(f"material {text!r}: an index of 1 reflects nothing, expected another")
    try:
        return makers[name](value)
    except ValueError as error:
        raise InputError(f"material {text!r}: {error}") from None


def _conductor(cos_h: Array, eta: Array, k: Array) -> Array:
    return fresnel.conductor(
        *jnp.broadcast_arrays(cos_h[..., None], _last_axis(eta, cos_h), _last_axis(k, cos_h))
    )


def _last_axis(spectrum: Array, cos_h: Array) -> Array:
    """Spectrum [L] reshaped to broadcast behind the axes of `cos_h`, in its type."""
    return spectrum.astype(cos_h.dtype).reshape((1,) * cos_h.ndim + spectrum.shape)


def _check(name: str, x: Array, holds: Callable[[np.ndarray], Any], expected: str) -> None:
    """Raise unless a condition holds for all values, where they are known."""
    values = checks.concrete(x)
    if values is not None and not np.all(holds(values)):
        low, high = values.min(), values.max()
        shown = f"{low:g}" if values.size == 1 else f"{low:g} to {high:g}"
        raise InputError(f"{name}: {shown} given, expected {expected}")
