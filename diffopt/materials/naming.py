"""Materials from a name and a few numbers, or from a file, and their colours.

A `Subject` is a material with what pictures need beside it: the wavelengths of its channels
and what was assumed. Metals keep a channel for each wavelength, so that what is said about
their energy holds at every wavelength; colours come last, spectral -> XYZ -> linear RGB.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from diffopt import checks, colour, fresnel
from diffopt.errors import InputError
from diffopt.materials.base import Material
from diffopt.materials.combined import Sum
from diffopt.materials.diffuse import Lambert, OrenNayar
from diffopt.materials.interfaces import Dielectric, Mirror, RoughDielectric
from diffopt.materials.microfacet import Microfacet, alpha_from_roughness
from diffopt.materials.phong import BlinnPhong, Phong

#: Step of the wavelengths of spectral materials and of the white of all colours, nanometres.
#: Rough gold and copper differ from their colour at a step of 1 by a delta E 2000 below 0.005.
STEP_NM = 10.0

_METALS = {"gold": "Au", "silver": "Ag", "aluminium": "Al", "copper": "Cu"}
_FACETS = ("alpha", "roughness", "normals", "masking", "compensation")
_METAL_NOTE = {
    "gold": "gold is a fit of oscillators: paler than measured gold by a delta E of 2.8",
    "copper": "copper is a fit of oscillators: off measured copper by a delta E of 13.6",
}
_ROUGH_GLASS_NOTES = (
    "radiance that crosses is scaled by the square of the index: f over it is reciprocal",
    "the sphere is a surface alone: what would shine through a ball is left out",
)
# Narrower lobes are mirrors to every picture, and overflow in float32 in the end.
_RANGES = {"alpha": (1e-3, 4.0), "roughness": (0.03, 1.0), "exponent": (0.0, 1e6)}

#: Names, and the options that each of them takes.
NAMES: dict[str, tuple[str, ...]] = {
    "lambert": ("colour",),
    "oren-nayar": ("colour", "sigma"),
    "phong": ("colour", "exponent"),
    "blinn-phong": ("colour", "exponent"),
    "mirror": (),
    "glass": ("eta",),
    "rough-glass": ("eta", "alpha", "roughness", "normals"),
    **dict.fromkeys(_METALS, _FACETS),
    "plastic": ("colour", "eta", *_FACETS),
}
#: Suffixes of files of measured materials, and what they hold.
SUFFIXES = {
    ".binary": "MERL",
    ".bsdf": "RGL",
    ".pbsdf": "polarised",
    ".csv": "table",
    ".npz": "table",
}


@dataclasses.dataclass(frozen=True)
class Subject:
    """A material and what its colours need.

    Attributes
    ----------
    name
        As it was asked for; of a file without folders.
    material
        Scalar, RGB, or with a channel for each wavelength.
    wavelengths
        Of the channels, micrometres, ascending, [L]; None for a scalar material and RGB.
    notes
        What was assumed or is not exact, one sentence each.
    """

    name: str
    material: Material
    wavelengths: Float[np.ndarray, " L"] | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check that the channels are colours."""
        channels = self.material.channels
        if self.wavelengths is not None:
            if channels != self.wavelengths.shape or len(self.wavelengths) < 2:
                raise InputError(
                    f"{self.name}: {len(self.wavelengths)} wavelengths for channels {channels}; "
                    "expected at least two, and one for each channel"
                )
        elif channels not in ((), (1,), (3,)):
            raise InputError(
                f"{self.name}: {channels[0]} channels of unknown wavelength; expected one, RGB, "
                "or a wavelength for each"
            )

    def xyz(self, values: Any) -> Float[np.ndarray, "*batch 3"]:
        """XYZ under D65 of values or albedos; 1 in every channel is white, with Y = 1.

        Parameters
        ----------
        values
            [..., *C], C the channels of the material. RGB is linear, with the primaries of
            sRGB. Outside the material's wavelengths its first and last channel are continued.
        """
        values = np.asarray(values, np.float64)
        grid = colour.wavelengths(STEP_NM)
        white = colour.white_point("D65", grid)
        if self.wavelengths is None:
            if self.material.channels == ():
                return values[..., None] * white
            if self.material.channels == (1,):
                return values * white
            return values @ np.linalg.inv(colour.rgb_matrix(white)).T
        # Linear between the channels: each takes its share of the weights around it.
        unit = np.eye(len(self.wavelengths))
        shares = np.stack([np.interp(grid, self.wavelengths, row) for row in unit])
        return values @ (shares @ colour.spectral_weights(grid))

    def rgb(self, values: Any) -> Float[np.ndarray, "*batch 3"]:
        """Linear RGB of `xyz`; outside [0, 1] for what a display cannot show."""
        white = colour.white_point("D65", colour.wavelengths(STEP_NM))
        return self.xyz(values) @ colour.rgb_matrix(white).T

    def channel(self, index: int) -> str | None:
        """A channel in words: its wavelength or its colour; None for a scalar material."""
        if self.wavelengths is not None:
            return f"{1000.0 * self.wavelengths[index]:.0f} nm"
        return ("red", "green", "blue")[index] if self.material.channels == (3,) else None


def named(name: str, **options: Any) -> Subject:
    """A material by name.

    Parameters
    ----------
    name
        One of `NAMES`.
    **options
        Those that the name takes; None is the same as left out. ``alpha``: width of the
        normals, one or two, in [0.001, 4] [0.2], or ``roughness`` in [0.03, 1], its square root,
        one or two; ``normals``, ``masking``, ``compensation``: see `Microfacet` (Gaussian normals
        bring V-cavities); ``colour``: one number or RGB in [0, 1] [0.5, for Phong's and
        Blinn's lobes 1]; ``exponent`` in [0, 1e6] [32]; ``sigma``: radians [0.35]; ``eta`` [1.5].

    Raises
    ------
    InputError
        For another name, with all names; for an option that the name does not take, or a
        value out of range.
    """
    if name not in NAMES:
        raise InputError(unknown(name))
    given = {key: value for key, value in options.items() if value is not None}
    for key in given:
        if key not in NAMES[name]:
            takes = ", ".join(NAMES[name]) or "no options"
            raise InputError(f"{name} has no {key}; it takes {takes}")
    for key, (low, high) in _RANGES.items():
        values = np.asarray(given.get(key, low), float)
        if not ((values >= low) & (values <= high)).all():
            shown = ", ".join(f"{value:g}" for value in np.atleast_1d(values))
            raise InputError(f"{key} must be from {low:g} to {high:g}; received {shown}")
    if "colour" in given and np.shape(given["colour"]) not in ((), (3,)):
        raise InputError(f"colour must be one number or R,G,B; received {given['colour']}")
    if name in _METALS:
        return _metal(name, given)
    if name == "plastic":
        diffuse = Lambert(given.pop("colour", 0.5))
        eta = given.pop("eta", 1.5)
        if not 1.0 < eta <= 100.0:
            raise InputError(f"eta of plastic must be above 1 to 100; received {eta:g}")
        coat = _coat(given, fresnel=fresnel.Dielectric(eta))
        note = "plastic adds a diffuse base and a coat; the base does not lose what the coat takes"
        return Subject(name, Sum((diffuse, coat)), notes=(note,))
    if name == "rough-glass":
        if given.get("eta") == 1.0:
            raise InputError("eta of rough-glass must not be 1: nothing is bent; received 1")
        return Subject(name, RoughDielectric(**_facets(given)), notes=_ROUGH_GLASS_NOTES)
    makers: dict[str, Callable[..., Material]] = {
        "lambert": Lambert,
        "oren-nayar": OrenNayar,
        "phong": Phong,
        "blinn-phong": BlinnPhong,
        "mirror": Mirror,
        "glass": Dielectric,
    }
    return Subject(name, makers[name](**given))


def load(path: str | Path) -> Subject:
    """A measured material from a file, by its suffix (`SUFFIXES`).

    Raises
    ------
    InputError
        For a file that is not there, or whose suffix or content is not known.
    """
    path = Path(path)
    kind = SUFFIXES.get(path.suffix.lower())
    if kind is None:
        raise InputError(f"{path}: unknown kind of file; expected {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if kind == "MERL":
        from diffopt.materials.merl import load_merl as read
    elif kind == "RGL":
        from diffopt.materials.rgl import load_rgl as read
    elif kind == "polarised":
        from diffopt.materials.pbsdf import load_pbsdf as read
    else:
        from diffopt.materials.scattered import load_table as read
    material = read(path)
    wavelengths = getattr(material, "wavelengths", None)
    if wavelengths is not None:
        # One wavelength is a scalar material.
        wavelengths = None if np.size(wavelengths) < 2 else np.asarray(wavelengths, np.float64)
    return Subject(path.name, material, wavelengths)


def unknown(name: str) -> str:
    """What to say about a name that is none, with the nearest one and all of them."""
    near = checks.nearest(name, NAMES)
    hint = f" (did you mean {near}?)" if near else ""
    return (
        f"{name!r} is no material{hint}: expected {', '.join(NAMES)}, or a file "
        f"({', '.join(SUFFIXES)})"
    )


def _metal(name: str, given: dict[str, Any]) -> Subject:
    lam = colour.wavelengths(STEP_NM)
    material = _coat(given, fresnel=fresnel.metal(_METALS[name]), wavelengths=lam)
    notes = (_METAL_NOTE[name],) if name in _METAL_NOTE else ()
    return Subject(name, material, lam, notes)


def _facets(given: dict[str, Any]) -> dict[str, Any]:
    """Arguments of a microfacet material."""
    arguments = dict(given)
    if "roughness" in arguments:
        if "alpha" in arguments:
            raise InputError("give alpha or roughness, not both: alpha is the roughness squared")
        roughness = np.asarray(arguments.pop("roughness"), float)
        arguments["alpha"] = alpha_from_roughness(roughness)
    return arguments


def _coat(given: dict[str, Any], **more: Any) -> Microfacet:
    """A microfacet material; Gaussian normals bring the only masking that they have."""
    arguments = _facets(given)
    if arguments.get("normals") == "gaussian":
        masking = arguments.setdefault("masking", "v-cavity")
        if masking != "v-cavity":
            raise InputError(f"gaussian normals need the masking v-cavity; received {masking!r}")
    return Microfacet(**arguments, **more)
