"""``diffopt fit``: lobes of materials, maps and samples; `fit_heightfield`: surfaces."""

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from diffopt.cli import fit_heightfield
from diffopt.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from diffopt.cli.fit_targets import Target
    from diffopt.fitting import LobeFit
    from diffopt.lobes import Lobes

#: Most angles of one fit, and the largest, degrees.
MOST, STEEPEST = 9, 89.0
#: Numbers of lobes if none is given.
COUNTS = {"material": 3, "map": 16, "samples": 3}

_METHODS = ("em+lm", "lm", "em", "moments")

app = typer.Typer(help="Fit lobes, or surfaces, to what was measured.", rich_markup_mode=None)
app.command("heightfield")(fit_heightfield.command)


@app.callback()
def _root() -> None:
    """Fit lobes to materials, maps and samples; surfaces to scans and reflectance."""


@dataclasses.dataclass(frozen=True)
class Asked:
    """Options of a fit that were checked; None stands for the default."""

    lobes: int | Literal["auto"] | None
    tolerance: float | None
    angles: tuple[float, ...] | None
    method: str | None
    energy: str | None
    start: str | None
    rounds: int | None
    key: int
    dtype: str


@app.command("lobes")
def lobes(
    target: Annotated[
        str,
        typer.Argument(
            metavar="NAME|FILE",
            help="A material as for `diffopt material`; a map in longitude and latitude (.exr, "
            ".hdr, .png, .npy [H, W, C]); or samples (.npy [N, 3] or [N, 4] with weights, .npz "
            "with directions, .csv with x, y, z).",
        ),
    ],
    count: Annotated[
        str | None,
        typer.Option("--lobes", help="1 to 64, or auto. [default: 3, maps 16]"),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(help="Of auto: the largest relative error of any slice. [default: 0.05]"),
    ] = None,
    angle: Annotated[
        str | None,
        typer.Option(help="Of the viewer of a material, degrees. [default: 0,30,60,80]"),
    ] = None,
    method: Annotated[
        str | None, typer.Option(help="em+lm, lm, em or moments. [default: em+lm]")
    ] = None,
    energy: Annotated[
        str | None, typer.Option(help="restored (exactly) or fitted. [default: restored]")
    ] = None,
    start: Annotated[
        str | None, typer.Option(help="scattered (by the key) or split. [default: scattered]")
    ] = None,
    rounds: Annotated[
        int | None, typer.Option(help="Most rounds of least squares. [default: 1]")
    ] = None,
    key: Annotated[int, typer.Option(help="Random key of the start.")] = 0,
    dtype: Annotated[str, typer.Option(help="float32 or float64.")] = "float32",
    alpha: Annotated[str | None, typer.Option(help="As for diffopt material, and so on:")] = None,
    roughness: Annotated[str | None, typer.Option(help="Square root of alpha.")] = None,
    normals: Annotated[str | None, typer.Option(help="ggx, beckmann or gaussian.")] = None,
    masking: Annotated[
        str | None, typer.Option(help="correlated, uncorrelated or v-cavity.")
    ] = None,
    compensation: Annotated[str | None, typer.Option(help="none or kulla-conty.")] = None,
    exponent: Annotated[float | None, typer.Option(help="Of phong and blinn-phong.")] = None,
    colour: Annotated[str | None, typer.Option(help="Linear R,G,B or one number.")] = None,
    sigma: Annotated[float | None, typer.Option(help="Of oren-nayar, degrees.")] = None,
    eta: Annotated[float | None, typer.Option(help="Index of refraction.")] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for lobes, errors and pictures.")
    ] = None,
) -> None:
    """Von Mises-Fisher lobes of a material's slices, an environment map, or samples."""
    from diffopt import checks
    from diffopt.cli import fit_targets, options
    from diffopt.cli.diffraction import precision
    from diffopt.cli.errors import user_input

    checks.choice("--dtype", dtype, ("float32", "float64"))
    asked = Asked(
        _count(count, method),
        tolerance,
        None if angle is None else options.angles("--angle", angle, MOST, STEEPEST),
        _chosen("--method", method, _METHODS),
        _chosen("--energy", energy, ("restored", "fitted")),
        _chosen("--start", start, ("scattered", "split")),
        rounds,
        key,
        dtype,
    )
    if tolerance is not None:
        if asked.lobes != "auto":
            raise InputError("--tolerance is for --lobes auto")
        if not 0.0 < tolerance < 1.0:
            raise InputError(f"--tolerance must lie between 0 and 1; received {tolerance:g}")
    if rounds is not None and rounds < 1:
        raise InputError(f"--rounds must be at least 1; received {rounds}")
    if key < 0:
        raise InputError(f"--key must be at least 0; received {key}")
    chosen = options.of_material(
        {
            "alpha": alpha,
            "roughness": roughness,
            "normals": normals,
            "masking": masking,
            "compensation": compensation,
            "exponent": exponent,
            "colour": colour,
            "sigma": sigma,
            "eta": eta,
        }
    )
    with precision(dtype):
        with user_input():
            found = fit_targets.read(target, chosen)
            _suits(found, asked)
        run(found, asked, output)


def run(target: "Target", asked: Asked, output: Path | None) -> None:
    """Fit, leave the results in a folder if there is one, and print them.

    Raises
    ------
    InputError
        If the target cannot be fitted or the folder cannot be written to.
    """
    from diffopt.cli.output import folder
    from diffopt.cli.progress import stages
    from diffopt.drawing import pictures

    angles = asked.angles or (0.0, 30.0, 60.0, 80.0)
    made: list[str] = []
    with contextlib.ExitStack() as stack:
        staging = None if output is None else stack.enter_context(folder(output))
        progress = stack.enter_context(stages(1 + (staging is not None)))
        with progress.stage("fit"), _naming(f"{target.name}: "):
            fit, lobes = fitted(target, asked, angles)
        if staging is not None:
            with progress.stage("pictures"):
                lobes.save(staging / "lobes.json")
                lobes.save(staging / "lobes.npz")
                if fit is not None:
                    _write_errors(staging / "errors.csv", target, angles, fit)
                for name, figure in figures(target, angles, lobes):
                    pictures.save(figure, staging / name)
                    made.append(name)
    tell(target, asked, angles, fit, lobes, output, made)


def fitted(
    target: "Target", asked: Asked, angles: tuple[float, ...]
) -> "tuple[LobeFit | None, Lobes]":
    """The fit and its lobes; of samples there are only lobes."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from diffopt.fitting import LobeSettings, fit_environment, fit_lobes, fit_samples
    from diffopt.materials.report import direction

    count = asked.lobes or (1 if asked.method == "moments" else COUNTS[target.kind])
    key = jax.random.key(asked.key)
    if target.kind == "samples":
        directions, weights = target.content
        directions = jnp.asarray(directions, asked.dtype)
        return None, fit_samples(directions, count, weights=weights, key=key)
    given = {"energy": asked.energy, "start": asked.start, "rounds": asked.rounds}
    options: dict[str, Any] = {
        "method": asked.method or "em+lm",
        "settings": LobeSettings(**{k: v for k, v in given.items() if v is not None}),
        "key": key,
    }
    if asked.tolerance is not None:
        options["tolerance"] = asked.tolerance
    if target.kind == "map":
        fit = fit_environment(jnp.asarray(target.content, asked.dtype), count, **options)
    else:
        wo = jnp.asarray(np.stack([direction(angle) for angle in angles]), asked.dtype)
        fit = fit_lobes(target.content.material, count, wo=wo, **options)
    return fit, fit.lobes


def figures(target: "Target", angles: tuple[float, ...], lobes: "Lobes") -> Any:
    """Names of pictures and the pictures, one after the other."""
    import numpy as np

    from diffopt.cli.fit_targets import reflected
    from diffopt.drawing import lobe_fits
    from diffopt.materials.report import direction

    if target.kind == "map":
        yield "map.png", lobe_fits.over_map(target.name, target.content.mean(-1), lobes)
    elif target.kind == "samples":
        yield "samples.png", lobe_fits.over_samples(target.name, target.content[0], lobes)
    else:
        material = target.content.material
        for k, angle in enumerate(angles):
            given = reflected(material, np.asarray(direction(angle)))
            head = (target.name, angle, given, lobes[k])
            yield f"plane_{angle:g}.png", lobe_fits.in_plane(*head)
            yield (
                f"residual_{angle:g}.png",
                lobe_fits.over_hemisphere(*head, below=material.transmits),
            )


def tell(
    target: "Target",
    asked: Asked,
    angles: tuple[float, ...],
    fit: "LobeFit | None",
    lobes: "Lobes",
    output: Path | None,
    made: list[str],
) -> None:
    """Print errors and lobes."""
    from rich.table import Table

    from diffopt.cli.progress import terminal

    console: Console = terminal()
    summary = Table.grid(padding=(0, 2))
    method = "expectation maximisation on samples" if fit is None else fit.method
    word = "lobe" if lobes.count == 1 else "lobes"
    summary.add_row("fit", f"{target.name}: {lobes.count} {word} by {method}, {asked.dtype}")
    if output is not None:
        summary.add_row("results", str(output))
        kept = ["lobes.json", "lobes.npz", *(["errors.csv"] if fit is not None else []), *made]
        summary.add_row("files", ", ".join(kept))
    console.print(summary)
    labels = [f"{angle:g}°" for angle in angles] if target.kind == "material" else [target.kind]
    if fit is not None:
        table = Table(box=None, padding=(0, 2, 0, 0))
        for title in (_head(target), "relative error", "energy error", "settled", "steps"):
            table.add_column(title, justify="left" if title == "settled" else "right")
        for label, row in zip(labels, _errors(fit), strict=True):
            error, energy, settled, steps = row
            done = "yes" if settled else "not yet"
            table.add_row(label, f"{error:.3g}", f"{energy:.2g}", done, f"{steps}")
        console.print()
        console.print(table)
    table = Table(box=None, padding=(0, 2, 0, 0))
    alpha = "alpha" if not lobes.channels else f"alpha (mean of {lobes.channels[0]})"
    for title in (_head(target), "lobe", alpha, "kappa", "theta", "phi"):
        table.add_column(title, justify="right")
    for label, rows in zip(labels, _lobe_rows(lobes), strict=True):
        for j, row in enumerate(rows):
            table.add_row("" if j else label, f"{j + 1}", *row)
    console.print()
    console.print(table)
    for note in _notes(target, asked, fit):
        console.print(f"note: {note}")


def _notes(target: "Target", asked: Asked, fit: "LobeFit | None") -> list[str]:
    import numpy as np

    notes = [*target.notes]
    if fit is None:
        return notes
    if fit.settings.energy == "restored":
        notes.append("the energy error is that of least squares; it was then restored exactly")
    if not np.all(fit.settled):
        notes.append(f"not settled: more --rounds than {fit.settings.rounds} go on")
    return notes


def _head(target: "Target") -> str:
    return "viewer" if target.kind == "material" else ""


def _errors(fit: "LobeFit") -> list[tuple[float, float, bool, int]]:
    """Relative error, energy error, settled, steps of each function."""
    import numpy as np

    parts = (fit.error, fit.energy_error, fit.settled, fit.steps)
    columns = [np.atleast_1d(np.asarray(part)).tolist() for part in parts]
    return list(zip(*columns, strict=True))


def _lobe_rows(lobes: "Lobes") -> list[list[tuple[str, ...]]]:
    """Alpha, kappa, theta and phi in words, of every lobe of every function."""
    import numpy as np

    count = lobes.count
    mu = np.asarray(lobes.mu, np.float64).reshape(-1, count, 3)
    kappa = np.asarray(lobes.kappa, np.float64).reshape(-1, count)
    alpha = np.asarray(lobes.alpha, np.float64).reshape(*kappa.shape, -1).mean(-1)
    theta = np.degrees(np.arctan2(np.hypot(mu[..., 0], mu[..., 1]), mu[..., 2]))
    # -180 is written as 180, and -0 as 0.
    phi = 180.0 - (180.0 - np.degrees(np.arctan2(mu[..., 1], mu[..., 0])).round(2)) % 360.0
    return [
        [
            (f"{a:.4g}", f"{k:.4g}", f"{t:.2f}°", f"{p:.2f}°" if 0.005 < t < 179.995 else "")
            for a, k, t, p in zip(*row, strict=True)
        ]
        for row in zip(alpha, kappa, theta, phi, strict=True)
    ]


def _write_errors(path: Path, target: "Target", angles: tuple[float, ...], fit: "LobeFit") -> None:
    from diffopt.accuracy.output import write_csv

    seen = target.kind == "material"
    names = ["relative_error", "energy_error", "settled", "steps"]
    rows = [[*angles[k : k + seen], *row] for k, row in enumerate(_errors(fit))]
    write_csv(["angle_deg"] * seen + names, rows, path)


def _count(text: str | None, method: str | None) -> int | Literal["auto"] | None:
    """Number of lobes; None if none was asked for."""
    if method == "moments" and text not in (None, "1"):
        raise InputError(f"--lobes must be 1 for --method moments; received {text}")
    if text is None or text == "auto":
        return text  # type: ignore[return-value]
    if not text.isdecimal() or not 1 <= int(text) <= 64:
        raise InputError(f"--lobes must be 1 to 64, or auto; received {text!r}")
    return int(text)


def _chosen(option: str, value: str | None, options: tuple[str, ...]) -> str | None:
    from diffopt import checks

    return None if value is None else checks.choice(option, value, options)


def _suits(target: "Target", asked: Asked) -> None:
    """Refuse options that the kind of target does not have."""
    if target.kind == "material":
        return
    refused = {"angle": asked.angles}
    if target.kind == "samples":
        names = ("tolerance", "method", "energy", "start", "rounds")
        refused |= {name: getattr(asked, name) for name in names}
    for name, value in refused.items():
        if value is not None:
            kind = (
                "a map has no viewer" if target.kind == "map" else "of samples only EM makes lobes"
            )
            raise InputError(f"--{name} does not go with {target.name}: {kind}")


@contextlib.contextmanager
def _naming(prefix: str) -> Iterator[None]:
    """Put a prefix before what is said about bad input."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{prefix}{error}") from error
