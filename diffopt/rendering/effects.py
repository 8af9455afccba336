"""Effects of light in a picture, and which of them it is composed of.

A path of light needs some effects: one that leaves a lamp, is scattered by two matte walls and
seen in a mirror needs diffuse interreflection and the mirror. Its code is the set of them, a bit
for each, and above them how often it was reflected coherently and scattered. What is left out
with an effect is what all paths bring whose codes hold its bit; light that a shadow takes away
counts with the shadow's bit, and less than nothing.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Int

from diffopt.errors import InputError

#: Effects that paths need, in the order of their bits.
PATHS = (
    "emission",
    "surroundings",
    "ambient",
    "matte-light",
    "glossy-light",
    "mirror",
    "refraction",
    "diffuse-interreflection",
    "glossy-interreflection",
    "caustics",
    "hard-shadows",
    "soft-shadows",
    "self-shadows",
)
BITS = {name: 1 << k for k, name in enumerate(PATHS)}
#: Shadows, which take light away.
SHADOWS = ("hard-shadows", "soft-shadows", "self-shadows")
#: The layer of a path is the first of these that it needs.
LAYERS = (
    "self-shadows",
    "hard-shadows",
    "soft-shadows",
    "caustics",
    "glossy-interreflection",
    "diffuse-interreflection",
    "refraction",
    "mirror",
    "ambient",
    "glossy-light",
    "matte-light",
    "emission",
    "surroundings",
)

#: What happens to light at a surface: it is scattered by its matte or its glossy part,
#: reflected or transmitted as by a perfect mirror or smooth glass.
MATTE, GLOSSY, REFLECTED, TRANSMITTED = range(4)

#: Bit of a shadow in the light of surfaces or surroundings, beside that of the shadow itself.
OF_SOFT = 1 << 15
# Where the counts of a code are.
_COHERENT, _SCATTERED = 16, 32
_COUNT = 0xFFFF

_DIFFUSE, _RICH = BITS["diffuse-interreflection"], BITS["glossy-interreflection"]
_SHINY, _DULL = BITS["glossy-light"], BITS["matte-light"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Composition:
    """What a picture is composed of; equal ones are the same program.

    Attributes
    ----------
    excluded
        Effects that are left out, of `PATHS`; ``matte-light`` cannot be.
    coherent
        Coherent reflections and refractions in a row, at most.
    bounces
        Times that light is scattered by matte and glossy surfaces, at most; 1 is direct light.
    hard, soft
        Numbers of the objects on which shadows fall of abstract lights, and of surfaces that
        emit and surroundings; None for all.

    Raises
    ------
    InputError
        For another effect, or effects that need one which is left out.
    """

    excluded: frozenset[str] = frozenset()
    coherent: int = 64
    bounces: int = 64
    hard: frozenset[int] | None = None
    soft: frozenset[int] | None = None

    def __post_init__(self) -> None:
        """Check the effects."""
        unknown = self.excluded - set(PATHS)
        if unknown:
            raise InputError(
                f"effects are {', '.join(PATHS)}; received {', '.join(sorted(unknown))}"
            )
        if "matte-light" in self.excluded:
            raise InputError("matte-light cannot be left out: nothing would be lit")

    @property
    def mask(self) -> int:
        """Bits of what is left out."""
        return sum(BITS[name] for name in self.excluded)

    def holds(self, name: str) -> bool:
        """Whether an effect is in."""
        return name not in self.excluded

    @property
    def scattered(self) -> int:
        """Times that light is scattered, at most: 1 without interreflections."""
        none = {"diffuse-interreflection", "glossy-interreflection"} <= self.excluded
        return 1 if none else self.bounces

    @property
    def mirrors(self) -> int:
        """Coherent reflections and refractions in a row, at most: 0 without any."""
        none = {"mirror", "refraction", "caustics"} <= self.excluded
        return 0 if none else self.coherent

    def allows(self, code: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Whether paths need nothing that is left out."""
        return (code & self.mask) == 0

    def receivers(self, soft: bool, owner: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Whether shadows fall on objects."""
        which = self.soft if soft else self.hard
        names = "soft-shadows" if soft else "hard-shadows", "self-shadows"
        if which is None:
            return np.full(len(owner), any(self.holds(name) for name in names))
        return np.isin(owner, sorted(which))

    def may_scatter(self, code: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Whether light that went through something may be scattered once more."""
        times = scattered(code)
        plain = ((code & _DULL) != 0) & ((code & _RICH) == 0)
        diffuse, rich = (self.holds(f"{name}-interreflection") for name in ("diffuse", "glossy"))
        return ((times == 0) | (plain & diffuse) | rich) & (times < self.scattered)

    def may_mirror(self, code: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Whether light may be reflected or refracted coherently."""
        seen = self.holds("mirror") or self.holds("refraction")
        allowed = np.where(scattered(code) == 0, seen, self.holds("caustics"))
        return allowed & (coherent(code) < self.mirrors)


#: All effects.
EVERYTHING = Composition()


def scattered(code: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """How often paths were scattered."""
    return code >> _SCATTERED


def coherent(code: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """How often paths were reflected or refracted coherently."""
    return (code >> _COHERENT) & _COUNT


def after(code: Int[np.ndarray, " n"], kind: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Codes of paths after something happened to their light.

    Parameters
    ----------
    code
        Before it.
    kind
        `MATTE`, `GLOSSY`, `REFLECTED` or `TRANSMITTED`.

    The first scattering is direct light, by the part that scatters; further ones are
    interreflection, diffuse while all parts are matte. Coherent reflection counts as a caustic
    where it follows scattering (as seen from the camera).
    """
    first, smooth = scattered(code) == 0, kind <= GLOSSY
    seen = np.where(kind == REFLECTED, BITS["mirror"], BITS["refraction"])
    single = np.where(first, seen, BITS["caustics"])
    plain = (kind == MATTE) & ((code & (_SHINY | _RICH)) == 0)
    once = np.where(kind == MATTE, _DULL, _SHINY)
    more = np.where(first, once, np.where(plain, _DIFFUSE, _RICH))
    kept = np.where(smooth & ~first & ~plain, code & ~_DIFFUSE, code)
    counted = kept + np.where(smooth, 1 << _SCATTERED, 1 << _COHERENT)
    return counted | np.where(smooth, more, single)


def layer(code: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Number in `LAYERS` of the layer of paths."""
    bits = np.array([BITS[name] for name in LAYERS])
    return np.argmax((code[:, None] & bits) != 0, axis=1)
