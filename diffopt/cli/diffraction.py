"""``diffopt diffraction``: what a scan looks like, in pictures and numbers."""

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from diffopt.cli import meshes as mesh_options
from diffopt.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from diffopt.cli.options import Appearance, Job, Source
    from diffopt.cli.progress import Stages
    from diffopt.drawing import bands, views

#: Pictures of every scan, in the order in which they are made; a mesh adds ``mesh.png``.
PICTURES = ("scan.png", "in_plane.png", "hemisphere.png", "sphere.png", "sheet.png")
#: Stages of `produce`, one more with a mesh.
STAGES = 5
# Samples on each axis of a pixel of a lit object.
SUPERSAMPLING = 2

# Directions of the light on the two objects, towards the light: from the upper left, and for
# the sheet opposite the camera, so that its highlight is in the picture.
_LIGHTS = {"sphere": (-0.45, 0.50, 0.75), "sheet": (-0.50, 0.75, 0.85)}


def command(
    file: Annotated[str, typer.Argument(help="File of heights, or sample:NAME.")],
    pixel_size: Annotated[
        str | None, typer.Option(help="Pixel in um, or Y,X, where the file does not state it.")
    ] = None,
    height_range: Annotated[
        str | None, typer.Option(help="Heights of black and white, LOW,HIGH or HIGH, in um.")
    ] = None,
    height_unit: Annotated[
        str | None, typer.Option(help="Unit of the numbers, as nm, where the file has none.")
    ] = None,
    channel: Annotated[str | None, typer.Option(help="Channel, by number or name.")] = None,
    level: Annotated[
        str | None,
        typer.Option(help="plane, line, polynomial or none. [default: plane, samples none]"),
    ] = None,
    fill: Annotated[bool, typer.Option("--fill", help="Fill missing pixels.")] = False,
    key: Annotated[int, typer.Option(help="Random key of a sample.")] = 0,
    incidence: Annotated[float, typer.Option(help="Angle of the light to the normal.")] = 20.0,
    azimuth: Annotated[
        float | None,
        typer.Option(help="Azimuth of the light from x. [default: across the dominant period]"),
    ] = None,
    coherence: Annotated[
        float | None,
        typer.Option(
            help="sigma_s of the coherence window in um. [default: an eighth of the patch]"
        ),
    ] = None,
    material: Annotated[
        str, typer.Option(help="mirror, al, ag, au, cu, n=1.5, schlick=0.04, constant=0.8.")
    ] = "mirror",
    illuminant: Annotated[str, typer.Option(help="D65, A, E or another of the CIE.")] = "D65",
    source_angle: Annotated[float, typer.Option(help="Diameter of the light in degrees.")] = 0.53,
    balance: Annotated[
        str, typer.Option(help="White balance: radiometric or peak.")
    ] = "radiometric",
    average: Annotated[
        str, typer.Option(help="Over all positions of the window, or one window: speckle.")
    ] = "positions",
    tolerance: Annotated[float, typer.Option(help="Error of the spectra over the largest.")] = 1e-3,
    method: Annotated[
        str, typer.Option(help="auto, direct, separable, taylor, chebyshev, lowrank, table.")
    ] = "auto",
    dtype: Annotated[
        str,
        typer.Option(help="float32, float64, or auto: spectra in float64 where they need it."),
    ] = "auto",
    size: Annotated[int, typer.Option(help="Pixels on a side of the pictures.")] = 512,
    allow_coarse: Annotated[
        bool,
        typer.Option("--allow-coarse", help="Go on where the pixel is too coarse for wide angles."),
    ] = False,
    mesh: mesh_options.File = None,
    mesh_turn: mesh_options.Turn = None,
    mesh_direction: mesh_options.Direction = None,
    mesh_light: mesh_options.Light = None,
    mesh_eye: mesh_options.Eye = None,
    mesh_up: mesh_options.Up = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder. [default: out/NAME]")
    ] = None,
) -> None:
    """Colours of a scan: hemisphere map, in-plane spectra, a lit sphere, a bent sheet, a mesh."""
    from diffopt.cli.options import Appearance, Source, name

    source = Source(file, pixel_size, height_range, height_unit, channel, level, fill, key)
    options = Appearance(
        incidence=incidence,
        azimuth=azimuth,
        coherence=coherence,
        material=material,
        illuminant=illuminant,
        source_angle=source_angle,
        balance=balance,
        average=average,
        tolerance=tolerance,
        method=method,
        dtype=dtype,
        size=size,
        allow_coarse=allow_coarse,
    )
    words = mesh_options.Words(mesh, mesh_turn, mesh_direction, mesh_light, mesh_eye, mesh_up)
    run(source, options, Path("out") / name(file) if output is None else output, words)


def run(
    source: "Source",
    options: "Appearance",
    target: Path,
    words: mesh_options.Words | None = None,
) -> None:
    """Do it all for one scan, print the summary, and leave the results in `target`.

    Raises
    ------
    InputError
        If anything in the input cannot be used; then nothing is left in `target`.
    """
    from diffopt.cli import results
    from diffopt.cli.errors import user_input
    from diffopt.cli.options import job as prepare_job
    from diffopt.cli.output import folder
    from diffopt.cli.progress import stages

    words = mesh_options.Words() if words is None else words
    count = STAGES + (words.mesh is not None)
    with precision(options.dtype), folder(target) as staging, stages(count) as progress:
        with user_input():
            subject = mesh_options.prepare(words)
            job = prepare_job(source, options)
        content = produce(job, staging, progress, subject)
        results.write_summary(staging / "result.json", content)
    tell(content, target)


@contextlib.contextmanager
def precision(dtype: str) -> Iterator[None]:
    """Make float64 the default type inside, if asked for, and float32 otherwise."""
    import jax

    from diffopt import checks
    from diffopt.cli.options import DTYPES

    checks.choice("--dtype", dtype, DTYPES)
    with jax.enable_x64(dtype == "float64"):
        yield


def produce(
    job: "Job", folder: Path, stages: "Stages", subject: mesh_options.Subject | None = None
) -> dict[str, Any]:
    """Compute and draw everything into a folder; gives the summary of ``result.json``."""
    from diffopt.cli import results
    from diffopt.drawing import pictures, views

    options, light = job.options, job.illuminant
    samples = SUPERSAMPLING * options.size
    objects = _closed_shapes(samples, 0.0 if job.grating is None else job.grating[1])
    seen = None
    if subject is not None:
        with stages.stage("mesh"):
            seen = subject.shoot(samples)
        objects["mesh"] = seen.shot()
    with stages.stage("in-plane spectra"):
        cut = spectra(job)
    with stages.stage("hemisphere") as report:
        wi = views.incident(job.incidence, job.azimuth)
        dome = views.hemisphere(job.brdf, wi, size=options.size, illuminant=light, progress=report)
    with stages.stage("table for objects") as report:
        table = object_table(job, objects.values(), report)
    with stages.stage("objects"):
        for name, shot in objects.items():
            draw_object(job, table, shot, folder / f"{name}.png")
    with stages.stage("figures"):
        pictures.save(pictures.scan(job.scan, job.statistics), folder / "scan.png")
        figure = pictures.in_plane(cut, period=job.period_in_plane, illuminant=light)
        pictures.save(figure, folder / "in_plane.png")
        figure = pictures.hemisphere(dome, grating=job.grating, illuminant=light)
        pictures.save(figure, folder / "hemisphere.png")
        results.write_arrays(folder / "result.npz", job, cut, dome)
    content = results.summary(job, cut, stages)
    if seen is not None:
        content["mesh"] = seen.summary()
        content["notes"] += seen.notes()
    return content


def _closed_shapes(samples: int, turn: float) -> "dict[str, bands.Shot]":
    """Sphere and sheet under their lights, of so many samples on a side."""
    from diffopt.drawing import bands, shapes

    lights = {name: shapes.unit(_array(value)) for name, value in _LIGHTS.items()}

    def sphere(rows: slice) -> "bands.Part":
        return shapes.sphere(samples, rows=rows), lights["sphere"], None

    def sheet(rows: slice) -> "bands.Part":
        # The dominant period runs along the bend, so that its orders lie one above the other.
        return shapes.sheet(samples, rows=rows).turned(turn), lights["sheet"], None

    shape = (samples, samples)
    return {"sphere": bands.Shot(shape, sphere), "sheet": bands.Shot(shape, sheet)}


def spectra(job: "Job") -> "views.InPlane":
    """In-plane spectra within the tolerance, in float64 where ``auto`` finds float32 too coarse.

    Raises
    ------
    InputError
        If no method, or not the one asked for, meets the tolerance.
    """
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    from diffopt.drawing import views

    options = job.options

    def compute(brdf: Any) -> "views.InPlane":
        return views.in_plane(
            brdf,
            job.incidence,
            job.azimuth,
            count=min(321, 5 * options.size // 2 | 1),
            tolerance=options.tolerance,
            method=options.method,
            illuminant=job.illuminant,
        )

    try:
        return compute(job.brdf)
    except InputError as error:
        if options.dtype == "float32":
            words = str(error).replace("use float64 heights", "use --dtype float64")
            raise InputError(words) from error
        if options.dtype == "float64":
            raise
    with jax.enable_x64(True):
        leaves, rest = eqx.partition(job.brdf, eqx.is_inexact_array)
        wide = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), leaves)
        return compute(eqx.combine(wide, rest))


def object_table(job: "Job", shots: "Iterable[bands.Shot]", report: Any) -> Any:
    """One colour table for several objects under their lights."""
    from diffopt.drawing import bands, views

    return views.bake(
        job.brdf,
        bands.extremes(shots),
        size=job.options.size,
        illuminant=job.illuminant,
        progress=report,
    )


def draw_object(
    job: "Job", table: Any, shot: "bands.Shot", path: Path, *, percentile: float = 96.0
) -> None:
    """Light one object and write its picture."""
    from diffopt.drawing import bands, pictures

    image = bands.photograph(job.brdf, table, shot, illuminant=job.illuminant)
    rgb = pictures.photograph(
        image, supersampling=SUPERSAMPLING, percentile=percentile, illuminant=job.illuminant
    )
    pictures.save(rgb, path)


def tell(content: dict[str, Any], target: Path) -> None:
    """Print the summary of a finished job."""
    from rich.table import Table
    from rich.text import Text

    from diffopt.cli.progress import terminal

    console = terminal()
    table = Table.grid(padding=(0, 2))
    method, figures, times = content["method"], content["statistics"], content["times"]
    table.add_row("results", str(target))
    table.add_row("pictures", ", ".join(sorted(p.name for p in target.glob("*.png"))))
    period = figures["dominant_period"]
    if period is not None:
        share = f"{100 * figures['dominant_share']:.0f} % of the variance"
        table.add_row("dominant period", f"{period:.4g} um, {share}")
    table.add_row("method", method["choice"].splitlines()[0])
    table.add_row(
        "error",
        f"at most {method['error_bound']:.1e} of the largest value (asked "
        f"{method['tolerance']:.1e}); finite patch apart: about {method['patch_error']:.1e}",
    )
    compiling, running = (sum(t[k] for t in times.values()) for k in ("compile_s", "run_s"))
    table.add_row("time", f"{compiling:.1f} s to compile, {running:.1f} s to run")
    line = Text()
    for peak in content["brightest"]:
        line.append("██ ", style=peak["rgb"])
        line.append(f"{peak['angle_deg']:+.1f}° ({peak['wavelength_nm']:.0f} nm)  ")
    table.add_row("brightest", line)
    console.print(table)
    for note in content["notes"]:
        console.print(f"note: {note}")
    for warning in content["warnings"]:
        console.print(f"warning: {warning}", style="yellow")


def _array(values: tuple[float, ...]) -> "np.ndarray":
    import numpy as np

    if len(values) != 3:
        raise InputError(f"a direction has three numbers; received {values}")
    return np.array(values, np.float64)
