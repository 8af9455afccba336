"""Cards of studies and of their results: error against time, and the rows."""

from typing import Any

from diffopt.accuracy import output
from diffopt.accuracy.studies import Study, StudyResult
from diffopt.previews import markup
from diffopt.previews.bundles import NoCardError

#: Points of the front that are named in the plot, rows that are listed, bytes of the plot.
NAMED, LISTED, MOST = 24, 48, 60_000
# Rows listed unfolded.
_OPEN = 12


def card(result: StudyResult) -> markup.Markup:
    """HTML of a result: the plot, the rows of the front, and all rows folded.

    Raises
    ------
    NoCardError
        If there are no rows.
    """
    if not result.rows:
        raise NoCardError("it has no rows")
    study = result.study
    if study.against is None:
        figure, width = plot(result), None
        what = "Error against run time, both logarithmic"
    else:
        figure = result.plot()
        width = min(620.0, 88.0 * float(figure.get_figwidth()))
        what = f"Error against {study.against}"
    drawn = markup.picture(figure, f"{study.name}: {what}", width=width, most=MOST)
    front, problems = result.front(), len(result.problems())
    pairs = [
        ("error of", study.quantity),
        ("against", study.reference),
        ("rows", f"{len(result.rows)}, {len(front)} of them on the front"),
        ("smallest error", f"{min(row.error for row in result.rows):.1e}"),
        ("fastest", output.seconds(min(row.run_s for row in result.rows))),
    ]
    if problems > 1:
        pairs.insert(3, ("problems", f"{problems}, by {', '.join(study.conditions)}"))
    parts = [markup.key_figures(pairs)]
    shown = result.rows if len(result.rows) <= _OPEN else front[:_OPEN]
    parts.append(_table(result, shown))
    if len(front) > _OPEN and len(result.rows) > _OPEN:
        parts.append(markup.note(f"The first {_OPEN} of {len(front)} rows on the front."))
    if len(result.rows) > len(shown):
        some = result.rows[:LISTED]
        of = f"all {len(some)} rows" if len(some) == len(result.rows) else f"{len(some)} rows"
        parts.append(markup.folded(of, _table(result, some)))
    return markup.card(f"Study {study.name}", drawn, *parts)


def study_card(study: Study) -> markup.Markup:
    """HTML of a study that was not run."""
    pairs = [("error of", study.quantity), ("against", study.reference)]
    if study.conditions:
        pairs.append(("problems differ in", ", ".join(study.conditions)))
    pairs.append(("drawn against", study.against or "run time"))
    words = "Not run yet: .run() measures every case, .run(quick=True) fewer and smaller ones."
    return markup.card(f"Study {study.name}", None, markup.key_figures(pairs), markup.note(words))


def plot(result: StudyResult) -> Any:
    """Error against run time, with the settings written on the points of the front."""
    from matplotlib.figure import Figure

    problems = result.problems()
    names = [n for n in output._names(result.rows) if _varies(result, n)]
    said = [n for n in names if n not in result.study.conditions] or names
    floor = min((row.error for row in result.rows if row.error > 0.0), default=1e-17)
    figure = Figure(figsize=(5.6, 3.9), layout="constrained")
    axes = figure.subplots()
    few = len(result.front()) <= NAMED
    for k, problem in enumerate(problems):
        shade, front = f"C{k % 10}", problem.front()
        # An error of exactly 0 stands at the smallest of the others.
        points = [(1e3 * row.run_s, max(row.error, floor)) for row in problem.rows]
        axes.plot(*zip(*points, strict=True), ".", ms=4, color=shade, alpha=0.45)
        best = [(1e3 * row.run_s, max(row.error, floor)) for row in front]
        conditions = {
            n: problem.rows[0].settings[n]
            for n in result.study.conditions
            if n in names and n in problem.rows[0].settings
        }
        label = output.label(conditions) or None
        axes.plot(*zip(*best, strict=True), "o-", ms=4, lw=1.1, color=shade, label=label)
        # The first and the last are named where there is no room for all.
        for n, (row, place) in enumerate(zip(front, best, strict=True)):
            if few or (len(problems) <= 4 and n in (0, len(front) - 1)):
                words = " ".join(output._text(row.settings[s]) for s in said if s in row.settings)
                axes.annotate(
                    words,
                    place,
                    xytext=(4, 3),
                    textcoords="offset points",
                    fontsize=6.5,
                    color=shade,
                )
    axes.set(xscale="log", yscale="log")
    axes.margins(x=0.12, y=0.1)
    axes.tick_params(which="both", labelsize=7)
    axes.set_xlabel("run time / ms", fontsize=8)
    axes.set_ylabel("error", fontsize=8)
    if said:
        axes.set_title(f"on points: {', '.join(said)}", fontsize=7.5, loc="left")
    axes.grid(alpha=0.3)
    if 1 < len(problems) <= 12 and axes.get_legend_handles_labels()[1]:
        axes.legend(fontsize=6.5, frameon=False)
    return figure


def _varies(result: StudyResult, name: str) -> bool:
    return len({row.settings.get(name) for row in result.rows}) > 1


def _table(result: StudyResult, rows: Any) -> markup.Markup:
    """Settings that vary, errors and costs; rows of the front are bold if others are there."""
    front = set(map(id, result.front()))
    names = [n for n in output._names(result.rows) if _varies(result, n)]
    optional = [c for c in output._OPTIONAL if any(c[1](row) for row in rows)]
    columns = [*names, "error", "run", *(title for title, _ in optional)]
    cells = [
        [
            *(output._text(row.settings.get(n, "")) for n in names),
            f"{row.error:.1e}",
            output.seconds(row.run_s),
            *(show(row) for _, show in optional),
        ]
        for row in rows
    ]
    strong = [k for k, row in enumerate(rows) if id(row) in front]
    return markup.table(columns, cells, strong=strong if len(strong) < len(cells) else ())
