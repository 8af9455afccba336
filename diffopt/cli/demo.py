"""``diffopt demo``: some of everything, computed here and now, as one page."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from diffopt.cli.options import Job
    from diffopt.report.page import Section

#: Of the page, in order.
SECTIONS = (
    "diffraction",
    "scene",
    "shadows",
    "transfer",
    "lobes",
    "surface",
    "accuracy",
    "stability",
)
# Bytes of a picture on the page.
_MOST = 250_000

# Positions in mm, disc in the plane z = 0: the mirror image of the lamp falls on the hub, so
# that the first orders are seen on both sides of it.
CAMERA = (0.0, -130.0, 190.0)
LAMP = (4.0, 114.0, 190.0)
# Of the disc itself, micrometres: a patch of 16 tracks and a window of two.
PIXEL, COHERENCE = 0.05, 3.2

CAPTIONS = {
    "disc.png": (
        "The disc",
        "A compact disc of 120 mm under a small lamp, both lamp and camera about 23 cm away. "
        "Tracks are circles, so the local frame turns with the azimuth; where the tangential "
        "part of the two directions cancels, each radius sends its own wavelength to the camera: "
        "violet inside, red outside. Hub and rim are drawn neutral.",
    ),
    "hemisphere.png": (
        "Colour over the hemisphere",
        "Where the light goes for one direction of incidence. Circles mark the orders of the "
        "track pitch at 450, 550 and 650 nm; the haze above and below comes from the pits along "
        "the tracks.",
    ),
    "in_plane.png": (
        "Spectra in the plane of incidence",
        "BRDF against viewing angle and wavelength, with the grating equation d (sin ti + sin to) "
        "= m lambda drawn over it; beneath it the colours that an eye sees.",
    ),
    "sphere.png": (
        "A sphere",
        "The same surface wrapped round a sphere, tracks along the meridians, light from the upper "
        "left.",
    ),
    "sheet.png": (
        "A bent sheet",
        "The same surface on a bent sheet, tracks along its axis.",
    ),
    "scan.png": ("The heights", "The patch of pits from which everything above follows."),
}


# Width of the pictures of scenes over `--size`.
_WIDE = 0.75


def command(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for index.html and the pictures.")
    ] = Path("out/demo"),
    size: Annotated[int, typer.Option(help="Pixels on a side of the pictures.")] = 512,
    key: Annotated[int, typer.Option(help="Random key of the pits.")] = 0,
    only: Annotated[
        str | None,
        typer.Option(help=f"Some sections, with commas between: {', '.join(SECTIONS)}."),
    ] = None,
) -> None:
    """Compute some of everything here and now, and show it on one page without links to others."""
    from diffopt.cli import diffraction
    from diffopt.cli.errors import user_input
    from diffopt.cli.output import folder
    from diffopt.cli.progress import stages

    names = _chosen(only)
    count = len(names) + (diffraction.STAGES if "diffraction" in names else 0)
    with (
        diffraction.precision("auto"),
        folder(output) as staging,
        stages(count) as progress,
    ):
        with user_input():
            job = _job(size, key)
        found = [_section(name, job, staging, progress, round(_WIDE * size)) for name in names]
        text = _page(found, progress)
        (staging / "index.html").write_text(text, encoding="utf-8")
    for one in found:
        spent = sum(progress.times[name].total_s for name in _stages(one.name, progress))
        print(f"{one.name:<12} {spent:6.1f} s  {one.title}")
    print(f"open {output / 'index.html'} ({len(text.encode()) / 2**20:.1f} MB, nothing outside it)")


def _chosen(only: str | None) -> list[str]:
    from diffopt import checks

    if only is None:
        return list(SECTIONS)
    names = [name.strip() for name in only.split(",") if name.strip()]
    for name in names:
        checks.choice("--only", name, SECTIONS)
    return [name for name in SECTIONS if name in names] or list(SECTIONS)


def _section(name: str, job: "Job", staging: Path, progress: Any, width: int) -> "Section":
    from diffopt.report import numbers, pictures

    if name == "diffraction":
        return _diffraction(job, staging, progress)
    made = {
        "scene": lambda: pictures.planned(width),
        "shadows": lambda: pictures.shadows(width),
        "transfer": lambda: pictures.glossy(width),
        "lobes": numbers.lobes,
        "surface": numbers.surface,
        "accuracy": numbers.accuracy,
        "stability": numbers.stability,
    }
    with progress.stage(name):
        return made[name]()


def _stages(section: str, progress: Any) -> list[str]:
    """Stages that a section took."""
    own = set(SECTIONS[1:])
    return [name for name in progress.times if (name if name in own else "diffraction") == section]


def _diffraction(job: "Job", staging: Path, progress: Any) -> "Section":
    """The disc, with its files beside the page."""
    import numpy as np
    import PIL.Image

    from diffopt.cli import diffraction, results
    from diffopt.previews import markup
    from diffopt.report.page import Section, figure, grid

    with progress.stage("disc") as report:
        draw_disc(job, staging / "disc.png", report)
    content = diffraction.produce(job, staging, progress)
    results.write_summary(staging / "result.json", content)
    figures = []
    for name, (title, text) in CAPTIONS.items():
        with PIL.Image.open(staging / name) as image:
            pixels = np.asarray(image.convert("RGB"))
        figures.append(figure(markup.picture(pixels, title, most=_MOST), title, text))
    method, settings = content["method"], content["settings"]
    pairs = [
        ("surface", f"pits by code after IEC 60908 ({content['provenance']['source']}), aluminium"),
        ("coherence σ", f"{settings['coherence']:.3g} µm"),
        ("light", f"{settings['incidence']:g}° (hemisphere and plane of incidence)"),
        ("spectra by", method["name"]),
        ("error", f"at most {method['error_bound']:.1e} of the largest value"),
    ]
    return Section(
        "diffraction",
        "The colours of a compact disc",
        "From the heights of its pits, by scalar wave optics. Objects are exposed so that 96 % of "
        "the lit samples stay below white (the disc 90 %), with compressed highlights and dim "
        "white surroundings.",
        (grid(figures), markup.key_figures(pairs)),
        "diffopt diffraction sample:compact_disc -o out/disc\ndiffopt view",
    )


def _page(found: "list[Section]", progress: Any) -> str:
    from diffopt.previews import markup
    from diffopt.report import machine, page

    rows = [
        (name, f"{t.total_s:.2f} s", f"{t.compile_s:.2f} s", f"{t.run_s:.2f} s")
        for name, t in progress.times.items()
    ]
    total = progress.sum
    facts = dict(machine.figures())
    lead = (
        f"All that follows was computed by diffopt {facts['diffopt']} on this machine, on "
        f"{facts['date']}, in {total.total_s:.0f} s, {total.compile_s:.0f} s of them compilation. "
        "Heads of tables sort their rows. The page holds everything that it shows."
    )
    foot = (
        markup.Markup("<h2>Times and versions</h2>"),
        markup.table(("stage", "in all", "compiling", "the rest"), rows),
        markup.key_figures(machine.figures()),
    )
    return page.page("diffopt: what it does, computed here and now", lead, found, foot)


def _job(size: int, key: int) -> "Job":
    """The disc as the job of `diffopt diffraction`."""
    import jax

    from diffopt import samples
    from diffopt.cli import options

    scan = samples.compact_disc(jax.random.key(key), pixel=PIXEL)
    asked = options.Appearance(coherence=COHERENCE, material="al", size=size)
    return options.job_of(scan, asked, periodic=True)


def draw_disc(job: "Job", path: Path, report: Any) -> None:
    """Picture of the disc under a near lamp."""
    import numpy as np

    from diffopt.cli import diffraction
    from diffopt.drawing import bands, shapes

    size = diffraction.SUPERSAMPLING * job.options.size

    def part(rows: slice) -> bands.Part:
        view = shapes.disc(size, eye=CAMERA, rows=rows)
        return view, view.towards(np.array(LAMP)), None

    shot = bands.Shot((size, size), part)
    table = diffraction.object_table(job, [shot], report)
    diffraction.draw_object(job, table, shot, path, percentile=90.0)
