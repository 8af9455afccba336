"""``diffopt promises``: whether every tolerance is kept."""

import contextlib
from pathlib import Path
from typing import Annotated

import typer

#: Exit code if a promise was broken.
BROKEN = 1


def command(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="Promises; all if left out.")
    ] = None,
    jobs: Annotated[int, typer.Option(help="Random jobs of each.")] = 50,
    seed: Annotated[int, typer.Option(help="Of the jobs.")] = 0,
    first: Annotated[
        int, typer.Option(help="Number of the first job, to repeat one: --first 317 --jobs 1.")
    ] = 0,
    priced: Annotated[
        int, typer.Option(help="Look for cheaper settings in every so-many-th job; 0 for none.")
    ] = 10,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for the trials (CSV).")
    ] = None,
) -> None:
    """Random jobs at random tolerances, answered and then measured against the reference.

    With -o trials are kept as they are made: after a kill the same command goes on. The exit
    code is 1 if a tolerance was not kept.
    """
    from diffopt.accuracy import promise_output, promises
    from diffopt.accuracy.keeping import Rows
    from diffopt.cli.output import beside, folder
    from diffopt.cli.progress import stages, terminal

    chosen = [promises.promise(name) for name in names or sorted(promises.NAMES)]
    console = terminal()
    results, kept = [], []
    with contextlib.ExitStack() as stack:
        staging = None if output is None else stack.enter_context(folder(output))
        progress = stack.enter_context(stages(len(chosen)))
        for promise in chosen:
            rows = None
            if output is not None:
                told = f"{promise.name}, seed {seed} from {first}, priced {priced}"
                rows = Rows(beside(output, f"{promise.name}.rows"), told, False)
                kept.append(stack.enter_context(rows))
            with progress.stage(promise.name) as report:
                result = promise.test(
                    jobs,
                    seed=seed,
                    first=first,
                    priced=priced,
                    progress=lambda done, of, _, to=report: to(done, of),
                    keep=rows,
                )
            if staging is not None:
                result.save_csv(staging / f"{promise.name}.csv")
            results.append(result)
        if staging is not None:
            (staging / "promises.md").write_text(promise_output.markdown(results))
    for rows in kept:
        rows.discard()
    console.print(promise_output.table(results))
    for result in results:
        for line in promise_output.above(result):
            console.print(line, markup=False, soft_wrap=True)
    if output is not None:
        console.print(f"trials: {output}", markup=False, soft_wrap=True)
    if not all(result.kept for result in results):
        raise typer.Exit(BROKEN)
