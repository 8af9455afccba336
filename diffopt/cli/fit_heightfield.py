"""``diffopt fit heightfield``: from a scan or from measured reflectance back to the surface."""

import dataclasses
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from diffopt.cli.options import Source
from diffopt.errors import InputError

if TYPE_CHECKING:
    from diffopt.cli.progress import Stages
    from diffopt.fitting import Measured
    from diffopt.heightfield import Heightfield

#: Exit code where there is a result, but no answer: the reason is printed and written.
NO_ANSWER = 1

#: Trial steps of a fit of every height.
MOST_STEPS = 500


@dataclasses.dataclass(frozen=True)
class Asked:
    """Options of a fit; None stands for the default."""

    file: str
    model: tuple[str, ...]
    start: str | None
    free: tuple[str, ...] | None
    coherence: float | None
    quantity: str | None
    solver: str | None
    drift: bool
    dtype: str


@dataclasses.dataclass(frozen=True)
class Subject:
    """What is fitted, and what was said while it was read.

    Attributes
    ----------
    kind
        ``scan``, ``reflectance`` or ``heights`` (every height, from reflectance).
    data
        A `Heightfield` or a `Measured`.
    start
        Heights to start from, for ``heights``.
    notes
        In full sentences.
    """

    kind: str
    data: Any
    start: Any = None
    notes: tuple[str, ...] = ()


def command(
    file: Annotated[
        str,
        typer.Argument(
            help="A scan (any file of heights, or sample:NAME), or measured reflectance (.npz, "
            ".csv with named columns): told apart by what it holds."
        ),
    ],
    model: Annotated[
        str | None,
        typer.Option(help="sinusoidal, binary, blazed, ..., several with commas, or auto."),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(help="Of reflectance: a scan from which every height is fitted."),
    ] = None,
    free: Annotated[
        str | None, typer.Option(help="Of reflectance: NAME,NAME of the parameters to fit.")
    ] = None,
    coherence: Annotated[
        float | None,
        typer.Option(help="Of reflectance: sigma_s in um, where the file does not state it."),
    ] = None,
    quantity: Annotated[
        str | None,
        typer.Option(
            help="Of reflectance: spectral, relative, power, xyz, rgb or srgb, where the file does "
            "not state it."
        ),
    ] = None,
    solver: Annotated[
        str | None,
        typer.Option(
            help="Of reflectance: normal-lm, lm, dogleg or bfgs; with --start lbfgs or cg."
        ),
    ] = None,
    drift: Annotated[
        bool, typer.Option("--drift/--no-drift", help="Of a scan: offsets of its lines.")
    ] = True,
    dtype: Annotated[str, typer.Option(help="float32 or float64.")] = "float64",
    pixel_size: Annotated[
        str | None, typer.Option(help="Of scans, as for diffopt diffraction, and so on:")
    ] = None,
    height_range: Annotated[str | None, typer.Option(help="LOW,HIGH or HIGH, in um.")] = None,
    height_unit: Annotated[str | None, typer.Option(help="As nm.")] = None,
    channel: Annotated[str | None, typer.Option(help="By number or name.")] = None,
    level: Annotated[
        str | None,
        typer.Option(
            help="plane, line, polynomial or none. [default: none, tilt and drift are fitted; of "
            "--start plane]"
        ),
    ] = None,
    fill: Annotated[bool, typer.Option("--fill", help="Fill missing pixels of --start.")] = False,
    key: Annotated[int, typer.Option(help="Random key of a sample.")] = 0,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for numbers and pictures.")
    ] = None,
) -> None:
    """Parameters of a surface, with their errors, from its scan or its reflectance.

    Exit code 1 where there is no answer (the reason is printed): models that do not explain the
    data, fits that did not settle or were interrupted.
    """
    from diffopt import checks
    from diffopt.cli.diffraction import precision
    from diffopt.cli.errors import user_input

    checks.choice("--dtype", dtype, ("float32", "float64"))
    if start is not None and model is not None:
        raise InputError("--start fits every height and goes without --model; received both")
    asked = Asked(
        file,
        _words("--model", model) or ("auto",),
        start,
        _words("--free", free),
        coherence,
        quantity,
        solver,
        drift,
        dtype,
    )
    source = Source(file, pixel_size, height_range, height_unit, channel, level, fill, key)
    with precision(dtype):
        with user_input():
            subject = read(asked, source)
        if not run(subject, asked, output):
            raise typer.Exit(NO_ANSWER)


def read(asked: Asked, source: Source) -> Subject:
    """The data, and options that go with them.

    Raises
    ------
    InputError
        For what cannot be read, and for options that are for other data.
    """
    from diffopt.fitting import measured_files
    from diffopt.fitting.freeform import steps
    from diffopt.fitting.reflectance.solving import SOLVERS

    refused = {
        "--start": asked.start is not None,
        "--free": asked.free is not None,
        "--coherence": asked.coherence is not None,
        "--quantity": asked.quantity is not None,
        "--solver": asked.solver is not None,
    }
    sample = asked.file.startswith("sample:")
    if sample or not measured_files.is_measured(asked.file):
        for option, given in refused.items():
            if given:
                raise InputError(f"{option} is for reflectance; {asked.file} holds heights")
        if source.fill:
            raise InputError(
                "--fill is for --start: missing pixels of a scan have no weight in its fit"
            )
        return Subject("scan", _scan(source))
    if not asked.drift:
        raise InputError(f"--no-drift is for scans; {asked.file} holds reflectance")
    data, notes = _measured(asked)
    solvers = SOLVERS if asked.start is None else get_args(steps.Solver)
    if asked.solver is not None and asked.solver not in solvers:
        where = "" if asked.start is None else " with --start"
        raise InputError(
            f"--solver must be one of {', '.join(solvers)}{where}; received {asked.solver!r}"
        )
    if asked.start is None:
        for option in ("pixel_size", "height_range", "height_unit", "channel", "level"):
            if getattr(source, option) is not None:
                raise InputError(
                    f"--{option.replace('_', '-')} is for scans; {asked.file} holds reflectance"
                )
        return Subject("reflectance", data, notes=notes)
    if asked.free is not None:
        raise InputError("--free names parameters; with --start every height is fitted")
    from diffopt.cli import options

    start = options.load(dataclasses.replace(source, file=asked.start))
    return Subject("heights", data, start, notes)


def run(subject: Subject, asked: Asked, output: Path | None) -> bool:
    """Fit, leave the results in a folder if there is one, print them; whether it is an answer.

    Raises
    ------
    InputError
        If the data cannot be fitted or the folder cannot be written to.
    """
    import contextlib

    from diffopt.cli import fit_heightfield_output as results
    from diffopt.cli import fit_heightfield_table
    from diffopt.cli.output import folder
    from diffopt.cli.progress import stages

    with contextlib.ExitStack() as stack:
        staging = None if output is None else stack.enter_context(folder(output))
        progress = stack.enter_context(stages(1 + (staging is not None)))
        began = time.perf_counter()
        fit = fitted(subject, asked, progress)
        content = results.document(subject, asked, fit, time.perf_counter() - began)
        if staging is not None:
            with progress.stage("pictures"):
                results.write(staging, subject, asked, fit, content)
    fit_heightfield_table.tell(content, output)
    return bool(fit.converged)


def fitted(subject: Subject, asked: Asked, stages: "Stages") -> Any:
    """The fit, with its stage, its loss and the best model on the bar."""
    from diffopt.fitting import FitSettings, fit_heightfield

    options: dict[str, Any] = {}
    model: Any = asked.model[0] if len(asked.model) == 1 else list(asked.model)
    with stages.stage("fit") as report:

        def of_models(name: str, number: int, count: int) -> None:
            report(number, count)
            stages.tell(f"fit: {name}, model {number + 1} of {count}")

        def of_starts(what: str, share: float, loss: float) -> None:
            report(share, 1.0)
            best = f", best misfit {loss:.2e}" if math.isfinite(loss) else ""
            stages.tell(f"fit: {what}{best}")

        def of_steps(steps: int, loss: float) -> None:
            report(min(steps, MOST_STEPS), MOST_STEPS)
            stages.tell(f"fit: step {steps}, loss {loss:.4g}")

        if subject.kind == "scan":
            options |= {"drift": asked.drift, "progress": of_models}
        elif subject.kind == "reflectance":
            options["progress"] = of_starts
            if asked.free is not None:
                options["free"] = asked.free
            if asked.solver is not None:
                options["settings"] = FitSettings(solver=asked.solver)  # type: ignore
        else:
            model = subject.start
            options |= {"max_steps": MOST_STEPS, "progress": of_steps}
            if asked.solver is not None:
                options["solver"] = asked.solver
        return fit_heightfield(subject.data, model, **options)


def _words(option: str, text: str | None) -> tuple[str, ...] | None:
    if text is None:
        return None
    words = tuple(word.strip() for word in text.split(","))
    if not all(words):
        raise InputError(f"{option} must be names separated by commas; received {text!r}")
    if "auto" in words and len(words) > 1:
        raise InputError(f"{option}: auto stands alone; received {text!r}")
    return words


def _measured(asked: Asked) -> "tuple[Measured, tuple[str, ...]]":
    import warnings

    import jax.numpy as jnp

    from diffopt.cli.limits import refuse_enormous
    from diffopt.fitting import Measured

    refuse_enormous(Path(asked.file))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", UserWarning)
        data = Measured.load(asked.file, coherence=asked.coherence, quantity=asked.quantity)
    return data.astype(jnp.dtype(asked.dtype)), tuple(str(one.message) for one in said)


def _scan(source: Source) -> "Heightfield":
    """The heights as they are: what is missing has no weight, tilt and drift are fitted."""
    from diffopt.cli import options

    scan, level = options.read(source), source.level
    return scan if level in (None, "none") else scan.levelled(by=level)
