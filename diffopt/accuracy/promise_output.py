"""Promises in words, as a table and as a file, see `diffopt.accuracy.promises.PromiseResult`."""

import csv
import io
import os
from collections.abc import Iterable
from typing import Any

import numpy as np

from diffopt.accuracy.output import as_text
from diffopt.io.files import replacing

_COLUMNS = (
    "seed",
    "job",
    "tolerance",
    "error",
    "doubt",
    "price",
    "seconds",
    "words",
    "refused",
)


def table(results: Iterable[Any]) -> Any:
    """A `rich.table.Table`: a row for each decade of each promise, then one for all of it."""
    from rich.table import Table

    found = Table()
    found.add_column("promise")
    found.add_column("tolerance")
    for title in ("jobs", "refused", "above", "95 % interval", "error / tolerance", "cost"):
        found.add_column(title, justify="right")
    for result in results:
        for words, part in result.decades():
            found.add_row(result.promise.name, words, *_cells(part))
        found.add_row(result.promise.name, "all", *_cells(result), end_section=True)
    return found


def markdown(results: Iterable[Any]) -> str:
    """The rows over all tolerances, as a table for a page."""
    lines = [
        "| promise | jobs | refused | above the tolerance | 95 % interval | error / tolerance: "
        "median, worst | cost over the cheapest that would have done: median, 90 % |",
        "|---|---|---|---|---|---|---|",
    ]
    for result in results:
        jobs, refused, above, interval, ratio, price = _cells(result)
        name = result.promise.entry
        lines.append(
            f"| `{name}` | {jobs} | {refused} | {above} | {interval} | {ratio} | {price} |"
        )
    return "\n".join(lines) + "\n"


def text(result: Any) -> str:
    """A table of one promise, then each job above its tolerance."""
    promise = result.promise
    lines = [
        f"{promise.entry}: {promise.quantity}",
        f"against {promise.reference}",
        as_text(table([result])).rstrip(),
    ]
    return "\n".join([*lines, *above(result)])


def above(result: Any) -> list[str]:
    """A line for each job whose error is above its tolerance."""
    return [
        f"{result.promise.name}, job {trial.settings['job']}: asked {trial.tolerance:g}, error "
        f"{trial.answer.error:.3g}: {trial.answer.job}"
        for trial in result.broken
    ]


def save_csv(result: Any, path: str | os.PathLike) -> None:
    """Write all trials, empty where there is no figure."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for trial in result.trials:
        answer = trial.answer
        values = [
            trial.settings["seed"],
            trial.settings["job"],
            trial.tolerance,
            answer.error,
            answer.doubt,
            answer.price,
            trial.seconds,
            answer.job,
            answer.refused,
        ]
        writer.writerow(["" if value is None else value for value in values])
    with replacing(path) as file:
        file.write(stream.getvalue().encode())


def _cells(result: Any) -> tuple[str, ...]:
    low, high = result.interval
    prices = result.prices
    # Without chance an interval of the share would say less than the count.
    interval = f"{100 * low:.1f} to {100 * high:.1f} %"
    return (
        str(len(result.trials)),
        f"{100 * result.refused:.0f} %",
        str(len(result.broken)),
        interval if result.answered else "",
        f"{result.usual:.2g}, {result.worst:.2g}" if result.answered else "",
        f"{np.median(prices):.2g}, {np.quantile(prices, 0.9):.2g}" if prices else "",
    )
