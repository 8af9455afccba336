"""``diffopt material``: what a material looks like, and whether it keeps its promises."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from diffopt.errors import InputError

if TYPE_CHECKING:
    from diffopt.materials.naming import Subject
    from diffopt.materials.report import Properties

#: Most angles of incidence that a plot can hold, and the largest, degrees.
MOST, STEEPEST = 9, 89.0
SIZES = (16, 4096)

_WORDS = {
    "reciprocal": "reciprocity",
    "conserves_energy": "energy",
    "pdf": "density",
    "delta": "delta lobes",
    "transmits": "transmission",
}


def command(
    material: Annotated[
        str,
        typer.Argument(
            metavar="NAME|FILE",
            help="lambert, oren-nayar, phong, blinn-phong, mirror, glass, rough-glass, gold, "
            "silver, aluminium, copper, plastic; or a file: .binary (MERL), .bsdf, .pbsdf, "
            ".csv, .npz.",
        ),
    ],
    alpha: Annotated[
        str | None,
        typer.Option(help="Width of the normals, or X,Y, 0.001 to 4. [default: 0.2]"),
    ] = None,
    roughness: Annotated[
        str | None, typer.Option(help="In place of alpha, its square root; one number or X,Y.")
    ] = None,
    normals: Annotated[str | None, typer.Option(help="ggx, beckmann or gaussian.")] = None,
    masking: Annotated[
        str | None, typer.Option(help="correlated, uncorrelated or v-cavity.")
    ] = None,
    compensation: Annotated[
        str | None, typer.Option(help="none or kulla-conty: light between facets.")
    ] = None,
    exponent: Annotated[
        float | None, typer.Option(help="Of phong and blinn-phong. [default: 32]")
    ] = None,
    colour: Annotated[
        str | None,
        typer.Option(help="Linear R,G,B or one number, 0 to 1. [default: 0.5, lobes 1]"),
    ] = None,
    sigma: Annotated[
        float | None,
        typer.Option(help="Spread of oren-nayar's facets in degrees. [default: 20]"),
    ] = None,
    eta: Annotated[float | None, typer.Option(help="Index of refraction. [default: 1.5]")] = None,
    angles: Annotated[
        str,
        typer.Option(help="Of the light, in degrees; the middle one is also that of the map."),
    ] = "0,30,60,80",
    size: Annotated[int, typer.Option(help="Pixels on a side of sphere and map.")] = 512,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the report as JSON and nothing else.")
    ] = False,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder. [default: out/NAME]")
    ] = None,
) -> None:
    """Lobes, a sphere, a map, albedo and colour of a material, and a test of its properties."""
    from diffopt.cli import options
    from diffopt.cli.errors import user_input

    if not SIZES[0] <= size <= SIZES[1]:
        raise InputError(
            f"--size must lie between {SIZES[0]} and {SIZES[1]} pixels; received {size}"
        )
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
    lights = options.angles("--angles", angles, MOST, STEEPEST)
    with user_input():
        found = subject(material, chosen)
    target = Path("out") / Path(material).stem if output is None else output
    run(found, lights, size, target, as_json=as_json)


def run(
    subject: "Subject", lights: tuple[float, ...], size: int, target: Path, *, as_json: bool
) -> None:
    """Measure and draw a material, leave the results in `target`, and print the report.

    Parameters
    ----------
    subject
        The material.
    lights
        Angles of incidence, degrees.
    size
        Pixels on a side of sphere and map.
    target
        Folder; the pictures and ``report.json``.
    as_json
        Whether JSON is printed in place of words.

    Raises
    ------
    InputError
        If the folder cannot be written to.
    """
    import json

    from diffopt.cli.output import folder
    from diffopt.cli.progress import stages
    from diffopt.drawing import lobes, pictures
    from diffopt.materials.report import properties

    notes = [*subject.notes]
    made = []
    with folder(target) as staging, stages(3) as progress:

        def save(figure: Any, name: str) -> None:
            pictures.save(figure, staging / name)
            made.append(name)

        with progress.stage("properties"):
            report = properties(subject.material)
        alone = subject.material.delta and report.reciprocity is None
        with progress.stage("lobes and map"):
            save(lobes.in_plane(subject, lights), "lobes.png")
            if alone:
                notes.append("f is 0 but in single directions: lobes are lines, there is no map")
            else:
                light = lights[(len(lights) - 1) // 2]
                save(lobes.hemisphere(subject, light, size=size), "hemisphere.png")
        if subject.material.delta:
            notes.append("the sphere reflects a simple sky; glass is a massive ball under it")
        with progress.stage("sphere and albedo"):
            save(lobes.sphere(subject, report, size=size), "sphere.png")
            save(lobes.albedo(subject, report), "albedo.png")
            save(lobes.swatch(subject, report), "swatch.png")
        content = {
            "name": subject.name,
            "channels": list(subject.material.channels),
            "wavelengths_um": _listed(subject.wavelengths),
            **report.as_json(),
            "broken": list(report.broken),
            "notes": notes,
        }
        text = json.dumps(content, indent=2)
        (staging / "report.json").write_text(text + "\n", encoding="utf-8")
    if as_json:
        print(text)
    else:
        tell(subject, report, notes, made, target)


def rows(subject: "Subject", report: "Properties") -> list[tuple[str, str, str, str]]:
    """The report in words: property, measurement, what is declared, and the verdict."""
    where = report.reciprocity_at
    texts = {
        "reciprocal": "f is 0 everywhere"
        if report.reciprocity is None or where is None
        else f"f(wi, wo) and f(wo, wi) differ by at most {report.reciprocity:.1e} of the larger"
        + (f", at {where[0]:.0f}° and {where[1]:.0f}°" if report.reciprocity > 1e-9 else "")
    }
    channel = subject.channel(report.energy_channel)
    angle, azimuth = report.energy_at
    even = abs(report.albedo[:, 0] - report.albedo[:, 1]).max() < 1e-3
    texts["conserves_energy"] = (
        f"largest albedo {report.energy:.4f}, at {angle:g}°"
        + ("" if even else f", azimuth {azimuth:g}°")
        + ("" if channel is None else f", {channel}")
    )
    integrals = ", ".join(
        f"{value:.4f} ({at:g}°)" for value, at in zip(report.pdf, report.pdf_angles, strict=True)
    )
    texts["pdf"] = f"integral over the sphere {integrals}"
    if report.declared["delta"] and not report.pdf.any():
        texts["pdf"] = "none: single directions have no density"
    for name, word in (("delta", "single directions"), ("transmits", "directions across")):
        seen = report.declared[name] == report.holds[name]
        texts[name] = f"samples have {word}" if seen else f"no samples have {word}"
    verdicts = {True: "holds", False: "DOES NOT HOLD", None: ""}
    table = []
    for name, word in _WORDS.items():
        declared = _declared(name, report)
        table.append((word, texts[name], declared, verdicts[report.holds[name]]))
    return table


def tell(
    subject: "Subject", report: "Properties", notes: list[str], made: list[str], target: Path
) -> None:
    """Print the report, with the names of the pictures that were made."""
    from rich.table import Table

    from diffopt.cli.progress import terminal

    console = terminal()
    summary = Table.grid(padding=(0, 2))
    channels = subject.material.channels
    kinds = {(): "one channel", (1,): "one channel", (3,): "linear RGB"}
    words = kinds.get(channels, f"{channels[0] if channels else 1} wavelengths")
    if subject.wavelengths is not None:
        low, high = 1000.0 * subject.wavelengths[0], 1000.0 * subject.wavelengths[-1]
        words = f"{len(subject.wavelengths)} wavelengths from {low:.0f} to {high:.0f} nm"
    summary.add_row("material", f"{subject.name}, {words}")
    summary.add_row("results", str(target))
    summary.add_row("pictures", ", ".join(made))
    console.print(summary)
    table = Table(box=None, padding=(0, 2, 0, 0))
    for title in ("property", "measured", "declared", ""):
        table.add_column(title)
    for row in rows(subject, report):
        table.add_row(*row, style="bold red" if row[3] == "DOES NOT HOLD" else None)
    console.print()
    console.print(table)
    for note in notes:
        console.print(f"note: {note}")


def _declared(name: str, report: "Properties") -> str:
    if name == "pdf":
        return "" if report.holds[name] is None else "integrates to 1"
    yes, no = {
        "reciprocal": ("reciprocal", "not reciprocal"),
        "conserves_energy": ("at most 1", "no promise"),
        "delta": ("delta lobes", "no delta lobes"),
        "transmits": ("transmits", "does not transmit"),
    }[name]
    return yes if report.declared[name] else no


def subject(word: str, chosen: dict[str, Any]) -> "Subject":
    """The material that is meant by a name or a file."""
    from diffopt.materials import naming

    path = Path(word)
    if word in naming.NAMES:
        return naming.named(word, **chosen)
    if path.suffix.lower() not in naming.SUFFIXES and not path.exists():
        raise InputError(naming.unknown(word))
    used = [name for name, value in chosen.items() if value is not None]
    if used:
        raise InputError(f"--{used[0]} is for named materials; {word} is a file")
    return naming.load(path)


def _listed(values: Any) -> list[float] | None:
    return None if values is None else values.tolist()
