"""``diffopt compare``: every method on one job, in one run."""

import contextlib
from pathlib import Path
from typing import Annotated

import typer

from diffopt.cli.comparing_levels import rendering
from diffopt.cli.comparing_plans import plans
from diffopt.cli.comparing_shadows import shadows
from diffopt.cli.comparing_transfer import transfer

app = typer.Typer(
    help="Compare all ways to compute the same: set-up, run time, memory, measured error.",
    rich_markup_mode=None,
)


@app.callback()
def _root() -> None:
    """Compare all ways to compute the same: set-up, run time, memory, measured error."""


app.command("plans")(plans)
app.command("rendering")(rendering)
app.command("shadows")(shadows)
app.command("transfer")(transfer)


@app.command("diffraction")
def diffraction(
    file: Annotated[str, typer.Argument(help="File of heights, or sample:NAME.")],
    pixel_size: Annotated[str | None, typer.Option(help="Pixel in um, or Y,X.")] = None,
    height_range: Annotated[
        str | None, typer.Option(help="Heights of black and white, LOW,HIGH or HIGH, in um.")
    ] = None,
    height_unit: Annotated[str | None, typer.Option(help="Unit of the numbers, as nm.")] = None,
    channel: Annotated[str | None, typer.Option(help="Channel, by number or name.")] = None,
    level: Annotated[
        str | None,
        typer.Option(help="plane, line, polynomial or none. [default: plane, samples none]"),
    ] = None,
    fill: Annotated[bool, typer.Option("--fill", help="Fill missing pixels.")] = False,
    key: Annotated[int, typer.Option(help="Random key of a sample.")] = 0,
    coherence: Annotated[
        float | None,
        typer.Option(
            help="sigma_s of the coherence window in um. [default: an eighth of the patch]"
        ),
    ] = None,
    material: Annotated[
        str, typer.Option(help="mirror, al, ag, au, cu, n=1.5, schlick=0.04, constant=0.8.")
    ] = "mirror",
    source_angle: Annotated[float, typer.Option(help="Diameter of the light in degrees.")] = 0.0,
    pairs: Annotated[int, typer.Option(help="Random pairs of directions.")] = 100_000,
    angle: Annotated[float, typer.Option(help="Largest angle to the normal, degrees.")] = 75.0,
    seed: Annotated[int, typer.Option(help="Same seed, same pairs.")] = 0,
    tolerance: Annotated[
        list[float] | None,
        typer.Option(help="Largest error over the largest value; may be repeated. [default: 0.01]"),
    ] = None,
    result: Annotated[
        str, typer.Option("--output", help="What is computed: xyz, spectral or relative.")
    ] = "xyz",
    method: Annotated[
        list[str] | None, typer.Option(help="A method; may be repeated. [default: all]")
    ] = None,
    budget: Annotated[float, typer.Option(help="Seconds that one method may run.")] = 10.0,
    checked: Annotated[int, typer.Option(help="Pairs on which errors are measured.")] = 200,
    dtype: Annotated[str, typer.Option(help="float32 or float64.")] = "float32",
    allow_coarse: Annotated[
        bool,
        typer.Option("--allow-coarse", help="Go on where the pixel is too coarse for wide angles."),
    ] = False,
    output: Annotated[
        Path | None, typer.Option("-o", help="Folder for comparison.csv and comparison.json.")
    ] = None,
) -> None:
    """Set-up, run time, memory and measured error of every method of diffraction on a scan."""
    import numpy as np

    from diffopt import checks
    from diffopt.accuracy import comparison
    from diffopt.cli import options
    from diffopt.cli.diffraction import precision
    from diffopt.cli.errors import user_input
    from diffopt.cli.output import folder
    from diffopt.cli.progress import stages, terminal
    from diffopt.colour import spectral_weights, wavelengths
    from diffopt.errors import InputError

    checks.choice("--dtype", dtype, ("float32", "float64"))
    kind = checks.choice("--output", result, ("xyz", "spectral", "relative"))
    if checked < 1:
        raise InputError(f"--checked must be at least 1; received {checked}")
    if not budget > 0.0:
        raise InputError(f"--budget must be above 0 seconds; received {budget:g}")
    tolerances = tolerance or [1e-2]
    for each in tolerances:
        checks.tolerance(each)
    chosen = method or list(comparison.METHODS)
    for name in chosen:
        checks.choice("--method", name, comparison.METHODS)
    source = options.Source(file, pixel_size, height_range, height_unit, channel, level, fill, key)
    appearance = options.Appearance(
        coherence=coherence,
        material=material,
        source_angle=source_angle,
        dtype=dtype,
        allow_coarse=allow_coarse,
    )
    with contextlib.ExitStack() as stack:
        staging = None if output is None else stack.enter_context(folder(output))
        stack.enter_context(precision(dtype))
        progress = stack.enter_context(stages(1 + len(tolerances)))
        with user_input():
            job = options.job(source, appearance)
            wi, wo = comparison.random_pairs(pairs, angle, seed)
        with progress.stage("truth in float64"):
            lam = wavelengths()
            weights = np.asarray(spectral_weights(lam)) if kind == "xyz" else None
            check = comparison.truth(job.brdf, wi, wo, lam, weights, kind, checked)
        found = []
        for each in tolerances:
            with progress.stage(f"tolerance {each:g}") as report:
                found.append(
                    comparison.compare(
                        job.brdf,
                        pairs=(wi, wo),
                        tolerance=each,
                        output=kind,
                        methods=chosen,
                        budget_s=budget,
                        check=check,
                        progress=lambda done, of, _, to=report: to(done, of),
                    )
                )
        if staging is not None:
            for each in found:
                stem = "comparison" if len(found) == 1 else f"comparison_{each.tolerance:g}"
                each.save_csv(staging / f"{stem}.csv")
                each.save_json(staging / f"{stem}.json")
    console = terminal()
    for each in found:
        console.print(each.table())
    for note in job.notes:
        console.print(f"note: {note}")
    for warning in job.warnings:
        console.print(f"warning: {warning}", style="yellow")
    if output is not None:
        console.print(f"tables: {output}")


@app.command("materials")
def materials(
    count: Annotated[int, typer.Option(help="Pairs, and samples, of one run.")] = 1_000_000,
    repeats: Annotated[int, typer.Option(help="Runs of which the median counts.")] = 5,
    output: Annotated[Path | None, typer.Option("-o", help="Folder for materials.csv.")] = None,
) -> None:
    """Evaluations and samples per second of every material, beside Mitsuba's if installed.

    Mitsuba's vectorised variant runs where DRJIT_LIBLLVM_PATH names an LLVM library above 15.
    """
    from diffopt.accuracy import material_throughput
    from diffopt.cli.output import folder
    from diffopt.cli.progress import terminal

    with contextlib.ExitStack() as stack:
        staging = None if output is None else stack.enter_context(folder(output))
        rows = material_throughput.compare(count, repeats)
        if staging is not None:
            material_throughput.save_csv(rows, staging / "materials.csv")
    terminal().print(material_throughput.table(rows))
    if output is not None:
        terminal().print(f"table: {output}")


@app.command("lobes")
def lobes(
    names: Annotated[
        list[str] | None,
        typer.Argument(help="Materials, by name or file. [default: Blinn-Phong 4 to 128]"),
    ] = None,
    lobes: Annotated[str, typer.Option(help="Numbers of lobes.")] = "1,2,4,8",
    angle: Annotated[str, typer.Option(help="Angles of view to the normal, degrees.")] = (
        "0,30,60,80"
    ),
    views: Annotated[
        int | None, typer.Option(help="In place of angles: icosahedral views of a level, 0 to 6.")
    ] = None,
    method: Annotated[
        list[str] | None, typer.Option(help="A method; may be repeated. [default: all]")
    ] = None,
    samples: Annotated[int, typer.Option(help="Samples of a slice, for EM on samples.")] = 10_000,
    repeats: Annotated[int, typer.Option(help="Runs of which the median counts.")] = 7,
    seed: Annotated[int, typer.Option(help="Of starts and samples.")] = 0,
    output: Annotated[
        Path | None, typer.Option("-o", help="Folder for lobes.csv and lobes.png.")
    ] = None,
) -> None:
    """EM, least squares, optimistix and SciPy on the same slices: error, time, success."""
    import numpy as np

    from diffopt import checks
    from diffopt.brdf_lobes import icosahedral_views
    from diffopt.cli.errors import user_input
    from diffopt.cli.material import subject
    from diffopt.cli.options import floats
    from diffopt.cli.output import folder
    from diffopt.cli.progress import stages, terminal
    from diffopt.errors import InputError
    from diffopt.fitting import comparison
    from diffopt.materials.report import direction

    for each in method or ():
        checks.choice("--method", each, comparison.METHODS)
    counts = [int(count) for count in floats(lobes)]
    if not counts or not all(1 <= count <= 64 for count in counts):
        raise InputError(f"--lobes must be numbers from 1 to 64, as 1,2,4; received {lobes!r}")
    degrees = floats(angle)
    if not degrees or not all(0.0 <= each < 90.0 for each in degrees):
        raise InputError(f"--angle must be 0 to below 90 degrees, as 0,60; received {angle!r}")
    if min(samples, repeats) < 1:
        raise InputError("--samples and --repeats must be at least 1")
    with user_input():
        subjects = [subject(name, {}) for name in names or ()]
        if views is not None:
            wo = icosahedral_views(views)[0]
        else:
            wo = np.stack([direction(each) for each in degrees])
    with contextlib.ExitStack() as stack:
        staging = None if output is None else stack.enter_context(folder(output))
        progress = stack.enter_context(stages(1))
        with progress.stage("every method"), user_input():
            found = comparison.compare(
                [each.material for each in subjects] or None,
                counts,
                wo=wo,
                methods=method or comparison.METHODS,
                samples=samples,
                repeats=repeats,
                seed=seed,
            )
        if staging is not None:
            found.save_csv(staging / "lobes.csv")
            found.plot(staging / "lobes.png")
    terminal().print(found.table())
    if output is not None:
        terminal().print(f"table and picture: {output}")
