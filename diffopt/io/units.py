"""Length units as they appear in files, to micrometres."""

from diffopt.errors import InputError

# "A" is left out: it is the angstrom in some formats and the ampere in others.
MICROMETRES = {
    "m": 1e6,
    "cm": 1e4,
    "mm": 1e3,
    "um": 1.0,
    "nm": 1e-3,
    "angstrom": 1e-4,
    "pm": 1e-6,
}
_ALIASES = {
    "µm": "um",  # micro sign, U+00B5
    "μm": "um",  # Greek letter mu, U+03BC
    "~m": "um",  # Nanoscope headers
    "micron": "um",
    "microns": "um",
    "micrometre": "um",
    "micrometer": "um",
    "metre": "m",
    "meter": "m",
    "millimetre": "mm",
    "millimeter": "mm",
    "nanometre": "nm",
    "nanometer": "nm",
    "Å": "angstrom",  # letter A with ring, U+00C5
    "\u212b": "angstrom",  # angstrom sign
}


def is_length(unit: object) -> bool:
    """Whether ``unit`` is the name of a length unit known here."""
    return isinstance(unit, str) and _ALIASES.get(unit.strip(), unit.strip()) in MICROMETRES


def to_micrometres(unit: object, what: str) -> float:
    """Micrometres in one ``unit``.

    Parameters
    ----------
    unit
        Name of a length unit, as ``"nm"`` or ``"µm"``.
    what
        What has this unit, for the error text (file name and quantity).

    Raises
    ------
    InputError
        If the unit is not a length.
    """
    if not is_length(unit):
        known = ", ".join(MICROMETRES)
        raise InputError(f"{what} has the unit {unit!r}; expected a length: {known}")
    name = str(unit).strip()
    return MICROMETRES[_ALIASES.get(name, name)]
