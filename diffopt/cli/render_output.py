"""What ``diffopt render`` tells of a picture, and the pictures of its effects."""

import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from diffopt.planning import Plan
    from diffopt.rendering import Image


def effects(plan: "Plan") -> list[str]:
    """Lines of what a plan holds and predicts."""
    inside = ", ".join(row.effect for row in plan.rows if row.included)
    return [
        f"effects: {inside}",
        f"plan for {plan.tolerance:g}: level {plan.settings.level}, "
        f"{plan.settings.spp} samples a pixel; bias at most {100.0 * plan.bias:.2g} %, "
        f"noise {100.0 * plan.noise:.2g} % predicted",
    ]


def layer_path(target: Path, effect: str) -> Path:
    """The file of an effect beside that of the whole picture: NAME.EFFECT.png."""
    return target.with_name(f"{target.stem}.{effect}{target.suffix}")


def save_layers(image: "Image", target: Path, exposure: float | None) -> None:
    """Write one PNG for each layer beside a PNG of the whole picture, at its exposure.

    Parameters
    ----------
    image
        With layers.
    target
        File of the whole picture.
    exposure
        As of that; by its brightest pixels for None.

    What shadows take away is below 0; its magnitude is shown.
    """
    factor = image.exposure() if exposure is None else exposure
    for effect, part in image.layers.items():
        alone = dataclasses.replace(image, radiance=abs(part), layers={})
        alone.save(layer_path(target, effect), exposure=factor)


def tell(image: "Image", targets: list[Path], notes: list[str]) -> None:
    """Print level, time, noise, layers and files."""
    import numpy as np
    from rich.table import Table

    from diffopt.cli.progress import terminal

    console = terminal()
    settings, (rows, columns) = image.settings, image.done.shape
    table = Table.grid(padding=(0, 2))
    table.add_row("level", f"{settings.level}, {settings.spp} samples a pixel")
    table.add_row("picture", f"{columns} x {rows} pixels, {image.channels.count} channels")
    table.add_row("time", _duration(image.seconds))
    if image.restored:
        share = f"{100.0 * image.restored:.0f} % of the pixels were done by an earlier run"
        table.add_row("goes on", share)
    if np.isfinite(image.noise):
        kind = "standard error" if settings.level == "path" else "bound of the error"
        table.add_row("noise", f"{100.0 * image.noise:.2g} % of the mean luminance ({kind})")
    if image.interrupted:
        share = f"{100.0 * image.done.mean():.0f} % of the pixels are done; the others are black"
        table.add_row("interrupted", share)
    if image.layers:
        table.add_row("layers", f"{_shares(image)} of the mean luminance")
    table.add_row("files", ", ".join(map(str, targets)))
    beside = [str(layer_path(target, "LAYER")) for target in pictures(image, targets)]
    if beside:
        table.add_row("", ", ".join(beside) + " for each layer; of shadows the magnitude")
    console.print(table, markup=False)
    for note in notes:
        console.print(f"note: {note}", markup=False)


def pictures(image: "Image", targets: list[Path]) -> list[Path]:
    """Files beside which there are those of layers."""
    return [t for t in targets if image.layers and t.suffix.lower() == ".png"]


def _shares(image: "Image") -> str:
    """Share of each layer, the largest first."""
    weights = image.channels.luminance()
    whole = max(float((image.radiance @ weights).sum()), 1e-30)
    shares = {name: float((a @ weights).sum()) / whole for name, a in image.layers.items()}
    names = sorted(shares, key=lambda name: -abs(shares[name]))
    return ", ".join(f"{name} {100.0 * shares[name]:.2g} %" for name in names)


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.3g} s"
    return time.strftime("%H:%M:%S", time.gmtime(seconds))
