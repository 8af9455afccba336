"""``diffopt demo``: all pictures of an embedded compact disc, as a page."""

import html
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from diffopt.cli.options import Job

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


def command(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for the pictures and index.html.")
    ] = Path("out/demo"),
    size: Annotated[int, typer.Option(help="Pixels on a side of the pictures.")] = 512,
    key: Annotated[int, typer.Option(help="Random key of the pits.")] = 0,
) -> None:
    """Make every picture of an embedded compact disc, and a page that shows them."""
    from diffopt.cli import diffraction, results
    from diffopt.cli.errors import user_input
    from diffopt.cli.output import folder
    from diffopt.cli.progress import stages

    with (
        diffraction.precision("auto"),
        folder(output) as staging,
        stages(diffraction.STAGES + 1) as progress,
    ):
        with user_input():
            job = _job(size, key)
        with progress.stage("disc") as report:
            draw_disc(job, staging / "disc.png", report)
        content = diffraction.produce(job, staging, progress)
        results.write_summary(staging / "result.json", content)
        (staging / "index.html").write_text(page(content), encoding="utf-8")
    diffraction.tell(content, output)
    print(f"open {output / 'index.html'}")


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
    from diffopt.drawing import shapes

    view = shapes.disc(diffraction.SUPERSAMPLING * job.options.size, eye=CAMERA)
    light = view.towards(np.array(LAMP))
    table = diffraction.object_table(job, {"disc": view}, {"disc": light}, report)
    diffraction.draw_object(job, table, view, light, path, percentile=90.0)


def page(content: dict[str, Any]) -> str:
    """The page that shows the pictures, as HTML that refers to nothing outside its folder."""
    method, times = content["method"], content["times"]
    compiling, running = (sum(t[k] for t in times.values()) for k in ("compile_s", "run_s"))
    blocks = "\n".join(
        f'<figure><img src="{name}" alt="{html.escape(title)}"><figcaption><b>'
        f"{html.escape(title)}.</b> {html.escape(text)}</figcaption></figure>"
        for name, (title, text) in CAPTIONS.items()
    )
    settings = content["settings"]
    about = (
        f"Pits by code after IEC 60908 ({content['provenance']['source']}), aluminium, coherence "
        f"{settings['coherence']:.3g} um, light at {settings['incidence']:g} degrees (hemisphere "
        f"and plane of incidence). Spectra by the method {method['name']}, error at most "
        f"{method['error_bound']:.1e} of the largest value. {compiling:.0f} s to compile, "
        f"{running:.0f} s to run. Objects are exposed so that 96 % of the lit samples stay below "
        "white (the disc 90 %), with compressed highlights and dim white surroundings."
    )
    return f"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>Diffraction colours of a compact disc</title>
<style>
body {{ margin: 2rem auto; max-width: 72rem; padding: 0 1rem; background: #1d1d1f; color: #ddd;
  font: 16px/1.5 system-ui, sans-serif; }}
main {{ display: grid; grid-template-columns: repeat(auto-fit, minmax(26rem, 1fr)); gap: 2rem; }}
figure {{ margin: 0; }}
img {{ width: 100%; background: white; border-radius: 4px; }}
figcaption {{ font-size: 0.9rem; }}
a {{ color: #9cf; }}
</style>
<h1>Diffraction colours of a compact disc</h1>
<p>{html.escape(about)}</p>
<main>
{blocks}
</main>
<p>Numbers: <a href="result.json">result.json</a>, <a href="result.npz">result.npz</a>.</p>
</html>
"""
