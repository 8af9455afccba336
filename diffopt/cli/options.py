"""From the words of options to a scan, a model and a job."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diffopt import checks, fresnel
from diffopt.choice import METHODS
from diffopt.cli.limits import refuse_enormous
from diffopt.diffraction import DiffractionBRDF
from diffopt.errors import InputError
from diffopt.heightfield import Heightfield
from diffopt.statistics import SurfaceStatistics

if TYPE_CHECKING:
    from diffopt.colour import Illuminant

SAMPLE = "sample:"
LEVELS = ("plane", "line", "polynomial", "none")
DTYPES = ("auto", "float32", "float64")
SIZES = (16, 4096)
#: Below this share of the variance the dominant period says nothing about the pattern.
LEAST_SHARE = 0.15

_LOADING = ("pixel_size", "height_range", "height_unit", "lateral_unit", "channel", "format")


@dataclasses.dataclass(frozen=True)
class Source:
    """Where heights come from and how to read them; names as in `Heightfield.load`."""

    file: str
    pixel_size: str | None = None
    height_range: str | None = None
    height_unit: str | None = None
    channel: str | None = None
    level: str | None = None
    fill: bool = False
    key: int = 0


@dataclasses.dataclass(frozen=True)
class Appearance:
    """Options of the model and of its evaluation; angles in degrees, lengths in micrometres."""

    incidence: float = 20.0
    azimuth: float | None = None
    coherence: float | None = None
    material: str = "mirror"
    illuminant: str = "D65"
    source_angle: float = 0.53
    balance: str = "radiometric"
    average: str = "positions"
    tolerance: float = 1e-3
    method: str = "auto"
    dtype: str = "auto"
    size: int = 512
    allow_coarse: bool = False


@dataclasses.dataclass(frozen=True)
class Job:
    """Everything that the pictures of one scan need.

    Attributes
    ----------
    scan, statistics
        The heights, levelled and complete, and their figures.
    periodic
        Whether the patch is known to repeat.
    brdf
        The model.
    options
        What was asked.
    incidence, azimuth
        Of the light, radians.
    grating
        Dominant period (micrometres) and direction (radians), None if there is none.
    illuminant
        The light.
    notes
        What was assumed.
    warnings
        What limits the result.
    """

    scan: Heightfield
    statistics: SurfaceStatistics
    periodic: bool
    brdf: DiffractionBRDF
    options: Appearance
    incidence: float
    azimuth: float
    grating: tuple[float, float] | None
    illuminant: "Illuminant"
    notes: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def sigma(self) -> float:
        """Coherence sigma_s, micrometres."""
        return float(self.brdf.surface.sigma)

    @property
    def period_in_plane(self) -> float | None:
        """Dominant period along the plane of incidence, None where its orders miss the plane."""
        if self.grating is None:
            return None
        period, direction = self.grating
        apart = direction - self.azimuth
        # An order leaves the plane by lambda / d sin(apart); its line is lambda / (2 pi sigma)
        # wide.
        if abs(math.sin(apart)) > period / (2.0 * math.pi * self.sigma):
            return None
        return period / abs(math.cos(apart))


def name(file: str) -> str:
    """Short name of a scan, for its folder of results."""
    return file.removeprefix(SAMPLE) if file.startswith(SAMPLE) else Path(file).stem


def floats(text: str) -> tuple[float, ...]:
    """Numbers separated by commas; none at all where one of them is no number."""
    try:
        return tuple(float(word) for word in text.split(","))
    except ValueError:
        return ()


def numbers(
    option: str, text: str | None, counts: Sequence[int] = (1, 2), *, unit: str = ""
) -> Any:
    """One number, or a tuple of several separated by commas; None for None.

    Raises
    ------
    InputError
        If there is another number of them than `counts` allows.
    """
    if text is None:
        return None
    values = floats(text)
    if len(values) not in counts:
        most = f"up to {max(counts)}" if len(counts) > 2 else str(max(counts))
        raise InputError(
            f"{option} must be one number or {most} separated by commas{unit}; received {text!r}"
        )
    return values[0] if len(values) == 1 else values


def of_material(words: dict[str, Any]) -> dict[str, Any]:
    """What `diffopt.materials.naming.named` takes, from options as they are typed.

    Raises
    ------
    InputError
        If a number is mistyped or the angle is out of range.
    """
    sigma = words["sigma"]
    if sigma is not None and not 0.0 <= sigma <= 90.0:
        raise InputError(f"--sigma must lie between 0 and 90 degrees; received {sigma:g}")
    counts = {"alpha": (1, 2), "roughness": (1, 2), "colour": (1, 3)}
    read = {name: numbers(f"--{name}", words[name], many) for name, many in counts.items()}
    return words | read | {"sigma": None if sigma is None else math.radians(sigma)}


def angles(option: str, text: str, most: int, steepest: float) -> tuple[float, ...]:
    """Different angles to the normal in degrees, at most so many, up to the steepest.

    Raises
    ------
    InputError
        If there are more, one is mistyped or out of range.
    """
    found = numbers(option, text, range(1, most + 1))
    values = (found,) if isinstance(found, float) else tuple(found)
    for angle in values:
        if not 0.0 <= angle <= steepest:
            raise InputError(
                f"{option} must lie between 0 and {steepest:g} degrees; received {angle:g}"
            )
    return tuple(dict.fromkeys(values))


def read(source: Source) -> Heightfield:
    """Read or make the heights, as they are: neither levelled nor complete.

    Raises
    ------
    InputError
        For anything that cannot be used; the text names options as they are typed.
    """
    if source.level is not None:
        checks.choice("--level", source.level, LEVELS)
    if source.file.startswith(SAMPLE):
        return _sample(source)
    refuse_enormous(Path(source.file))
    um = ", in micrometres"
    try:
        return Heightfield.load(
            source.file,
            pixel_size=numbers("--pixel-size", source.pixel_size, unit=um),
            height_range=numbers("--height-range", source.height_range, unit=um),
            height_unit=source.height_unit,
            channel=_channel(source.channel),
            missing="keep",
        )
    except InputError as error:
        raise InputError(_as_typed(str(error))) from error


def load(source: Source) -> Heightfield:
    """Read or make the heights, level them and see that they are complete.

    Raises
    ------
    InputError
        As `read`, and if pixels are missing and are not to be filled.
    """
    scan, level = read(source), source.level
    if level is None:
        level = "none" if source.file.startswith(SAMPLE) else "plane"
    missing = scan.missing
    if missing and not source.fill:
        raise InputError(
            f"{source.file}: {missing} of {scan.heights.size} pixels are missing; add --fill to "
            "fill them from their surroundings"
        )
    if level != "none":
        scan = scan.levelled(by=level)
    return scan.filled() if missing else scan


def job(source: Source, options: Appearance) -> Job:
    """Check all options, load the scan and set up the model.

    Raises
    ------
    InputError
        For the first option or file that cannot be used.
    """
    _check(options)
    fresnel.parse(options.material)
    _illuminant(options.illuminant)
    return job_of(load(source), options, periodic=source.file.startswith(SAMPLE))


def job_of(scan: Heightfield, options: Appearance, *, periodic: bool) -> Job:
    """Set up the model of a complete scan; `periodic` if the patch is known to repeat.

    Raises
    ------
    InputError
        For the first option that cannot be used.
    """
    _check(options)
    material = fresnel.parse(options.material)
    light = _illuminant(options.illuminant)
    statistics = scan.statistics(periodic=periodic)
    notes, warnings = [], []
    coherence = options.coherence
    if coherence is None:
        coherence = min(max(min(scan.extent) / 8.0, max(scan.pixel)), min(scan.extent) / 2.0)
        notes.append(f"coherence {coherence:.3g} um: an eighth of the patch, as none was given")
    blur = 0.5 * math.sin(math.radians(0.5 * options.source_angle))
    if options.average == "window" and blur > 0.0:
        blur = 0.0
        notes.append("a single coherent window: the angle of the source is left out")
    brdf = DiffractionBRDF(
        scan,
        coherence,
        fresnel=material,
        average=options.average,  # type: ignore[arg-type]
        balance=options.balance,  # type: ignore[arg-type]
        blur=blur,
    )
    grating = _grating(statistics)
    azimuth = options.azimuth
    if azimuth is None:
        azimuth = 0.0 if grating is None else math.degrees(grating[1])
        if grating is not None:
            notes.append(f"azimuth {azimuth:.1f} degrees: across the dominant period")
    if not periodic and brdf.patch_error() > 1e-3:
        warnings.append(
            f"the patch is {min(scan.extent) / coherence:.2g} coherence lengths wide: its edges "
            f"change the result by about {100 * brdf.patch_error():.1g} %, from 8 on they do not"
        )
    warnings.extend(_sampling(scan, options))
    return Job(
        scan=scan,
        statistics=statistics,
        periodic=periodic,
        brdf=brdf,
        options=options,
        incidence=math.radians(options.incidence),
        azimuth=math.radians(azimuth),
        grating=grating,
        illuminant=light,
        notes=tuple(notes),
        warnings=tuple(warnings),
    )


def _check(options: Appearance) -> None:
    if not abs(options.incidence) < 90.0:
        raise InputError(
            f"--incidence must lie between -90 and 90 degrees; received {options.incidence:g}"
        )
    if options.azimuth is not None and not math.isfinite(options.azimuth):
        raise InputError(f"--azimuth must be a number of degrees; received {options.azimuth}")
    if not 0.0 <= options.source_angle <= 60.0:
        raise InputError(
            f"--source-angle must lie between 0 and 60 degrees; received {options.source_angle:g}"
        )
    if not SIZES[0] <= options.size <= SIZES[1]:
        raise InputError(
            f"--size must lie between {SIZES[0]} and {SIZES[1]} pixels; received {options.size}"
        )
    checks.choice("--method", options.method, ("auto", *METHODS))
    checks.choice("--dtype", options.dtype, DTYPES)
    checks.choice("--average", options.average, ("positions", "window"))
    checks.choice("--balance", options.balance, ("radiometric", "peak"))
    checks.tolerance(options.tolerance)


def _sample(source: Source) -> Heightfield:
    import jax

    from diffopt import samples

    for option in _LOADING:
        if getattr(source, option, None) is not None:
            raise InputError(
                f"--{option.replace('_', '-')} is for files; {source.file} is made by code"
            )
    return samples.make(source.file.removeprefix(SAMPLE), key=jax.random.key(source.key))


def _channel(text: str | None) -> int | str | None:
    return int(text) if text is not None and text.isdecimal() else text


def _as_typed(text: str) -> str:
    """Names of arguments in an error text as the options that set them."""
    for option in _LOADING:
        text = text.replace(f"{option}=", f"--{option.replace('_', '-')} ")
    return " ".join(text.split())


def _illuminant(word: str) -> "Illuminant":
    from diffopt import colour

    try:
        found = colour.illuminant(word)
    except ValueError as error:
        raise InputError(f"--{error}") from error
    # Fails here, and not after minutes, where the table is too short.
    colour.spectral_weights(colour.wavelengths(10.0), illuminant=found)
    return found


def _grating(statistics: SurfaceStatistics) -> tuple[float, float] | None:
    period, direction = statistics.dominant_period, statistics.dominant_direction
    if period is None or direction is None or statistics.dominant_share < LEAST_SHARE:
        return None
    return period, direction


def _sampling(scan: Heightfield, options: Appearance) -> list[str]:
    """What the pixel is too coarse for, as warnings; directions that alias are refused."""
    shortest = 0.38
    reach = min(abs(math.sin(math.radians(options.incidence))) + 1.0, 2.0)
    try:
        scan.check_sampling(shortest, u_max=reach, jumps=True)
    except InputError as error:
        if not options.allow_coarse:
            raise InputError(f"{error}; --allow-coarse goes on all the same") from error
        return [str(error)]
    try:
        scan.check_sampling(shortest, u_max=reach)
    except InputError as error:
        return [str(error).replace(", real jumps need jumps=True", " unless they are real jumps")]
    return []
