"""The table that ``diffopt fit heightfield`` prints and keeps."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console, RenderableType


def tell(content: dict[str, Any], output: Path | None) -> None:
    """Print the result, and where it went."""
    from diffopt.cli.progress import terminal

    console = terminal()
    show(console, content)
    if output is not None:
        console.print(f"results: {output}", soft_wrap=True, markup=False)


def show(console: "Console", content: dict[str, Any]) -> None:
    """Print `fit_heightfield_output.document`."""
    for part in _parts(content):
        console.print(part)


def _parts(content: dict[str, Any]) -> "list[RenderableType]":
    # Sentences may hold brackets, which are not to be taken for styles.
    from rich.markup import escape
    from rich.table import Table

    out: list[RenderableType] = []
    head = Table.grid(padding=(0, 2))
    model = f"{content['model']}, from " if "model" in content else ""
    head.add_row("fit", f"{model}{content['what']}")
    head.add_row("answer" if content["converged"] else "no answer", escape(content["reason"]))
    head.add_row("misfit", f"{content['misfit']:.3g} ({content['units']['misfit']})")
    if content.get("chi2") is not None:
        head.add_row("chi-squared", f"{content['chi2']:.3g} per value")
    if content["provenance"].get("gain") == "free":
        head.add_row("gain", f"{content['gain']:.5g}")
    if "heights" in content:
        found = content["heights"]
        ny, nx = found["shape"]
        head.add_row(
            "heights",
            f"{nx} x {ny}, {1000 * found['rms']:.4g} nm rms, "
            f"{1000 * found['peak_to_valley']:.4g} nm peak to valley",
        )
    head.add_row("time", f"{content['seconds']:.1f} s")
    out.append(head)
    if "parameters" in content:
        out += ["", _table(content)]
        loose = [
            escape(row["identifiable"])
            for row in content["parameters"].values()
            if row["identifiable"] != "determined"
        ]
        out += ["", *(f"- {text}" for text in loose)] if loose else []
    if len(content.get("ranking", ())) > 1:
        out += ["", _ranking(content["ranking"], scan="goodness" in content)]
    out += [f"note: {escape(note)}" for note in content["notes"]]
    return out


def _table(content: dict[str, Any]) -> Any:
    from rich.table import Table

    table = Table(box=None, padding=(0, 2, 0, 0))
    for title in ("parameter", "value", "standard error", "unit", "determined"):
        table.add_column(title, justify="right" if title in ("value", "standard error") else "left")
    for name, row in content["parameters"].items():
        turn = math.degrees(1.0) if row["unit"] == "rad" else 1.0
        value, error = row["value"], row["error"]
        if error:
            shown = f"{error * turn:.2g}"
            # As many decimals as the error has.
            size = math.floor(math.log10(error * turn))
            digits = max(1 - size, 0)
            text = f"{value * turn:.{min(digits, 12)}f}"
        else:
            shown, text = "", f"{value * turn:.6g}"
        unit = "deg" if row["unit"] == "rad" else row["unit"]
        sure = "yes" if row["identifiable"] == "determined" else "no"
        table.add_row(name, text, shown, unit, sure)
    return table


def _ranking(rows: list[dict[str, Any]], *, scan: bool) -> Any:
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, padding=(0, 2, 0, 0))
    for title in ("model", "criterion", "free", "rms nm" if scan else "misfit", "answer"):
        table.add_column(title, justify="left" if title in ("model", "answer") else "right")
    for row in rows:
        size = row["misfit"]
        shown = "" if size is None else (f"{1000 * size:.3g}" if scan else f"{size:.2e}")
        gap = "" if row["difference"] is None else f"+{row['difference']:.1f}"
        sure = "yes" if row["converged"] else f"no: {escape(row['reason'])}"
        table.add_row(row["name"], gap, str(row["parameters"]), shown, sure)
    return table
