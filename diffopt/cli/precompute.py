"""``diffopt precompute``: transfer of a scene into a store, in as many sittings as it takes."""

from pathlib import Path
from typing import Annotated

import typer

from diffopt.errors import InputError


def command(
    scene: Annotated[
        str,
        typer.Argument(metavar="SCENE", help="A scene file, .toml, or teapot, rabbit or knots."),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="STORE.zarr", help="Folder for the result.")
    ],
    tolerance: Annotated[
        float | None,
        typer.Option(help="Difference of neighbours that is not refined. [default: 0.1]"),
    ] = None,
    lobes: Annotated[
        int | None, typer.Option(help="For each kind of light path. [default: 1]")
    ] = None,
    rays: Annotated[int | None, typer.Option(help="From each vertex. [default: 4096]")] = None,
    depth: Annotated[
        int | None, typer.Option(help="Surfaces that a path meets at most. [default: 2]")
    ] = None,
    finest: Annotated[
        int | None, typer.Option(help="Level of viewing directions at most. [default: 4]")
    ] = None,
    splits: Annotated[
        int | None, typer.Option(help="Of a triangle in four, at most. [default: 5]")
    ] = None,
    threads: Annotated[
        int | None, typer.Option(help="Of each process. [default: as many as pay]")
    ] = None,
    processes: Annotated[
        int | None, typer.Option(help="On this machine, or with --coordinator in all. [default: 1]")
    ] = None,
    distributed: Annotated[
        bool, typer.Option("--distributed", help="One of the processes that srun or mpirun starts.")
    ] = False,
    coordinator: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Where process 0 of several listens.")
    ] = None,
    process: Annotated[
        int | None, typer.Option(metavar="I", help="Number of this one, from 0.")
    ] = None,
    joined: Annotated[bool, typer.Option("--joined", hidden=True)] = False,
    compression: Annotated[
        float | None,
        typer.Option(metavar="TOL", help="RMS error of what is stored; 0: exact. [default: 0.01]"),
    ] = None,
    table: Annotated[Path | None, typer.Option(help="Also write the table, as .csv.")] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace a finished store, or batches of another scene.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Precompute transfer; Ctrl-C keeps what is finished, and the same command goes on."""
    from diffopt.cli import precompute_children, precompute_jobs, precompute_processes

    words = {"tolerance": tolerance, "lobes": lobes, "rays": rays, "depth": depth}
    words |= {"finest": finest, "splits": splits}
    place = precompute_processes.Place(processes, distributed, coordinator, process, joined)
    if threads is not None and not 1 <= threads <= 256:
        raise InputError(f"--threads must lie between 1 and 256; received {threads}")
    if table is not None and (table.suffix.lower() != ".csv" or not table.parent.is_dir()):
        raise InputError(f"--table {table}: expected a .csv file in a folder that exists")

    def look() -> precompute_jobs.Job:
        return precompute_jobs.checked(scene, output, words, compression, force=force)

    if place.member:
        with precompute_processes.member(place) as company:
            job = company.alike(look)
            quiet = quiet or company.index > 0
            precompute_processes.work(job, company, threads, joined=joined, quiet=quiet)
            if joined or company.index > 0:
                return
    else:
        job = look()
        if place.count > 1:
            run = precompute_children.children(job, place.count, threads)
        else:
            run = precompute_jobs.alone(job, threads)
        precompute_jobs.compute(job, run, quiet=quiet)
    if quiet and table is None:
        return
    from diffopt.cli import precompute_tables
    from diffopt.cli.output import written

    rows = precompute_tables.rows(output, job.found)
    if not quiet:
        precompute_tables.tell(rows, output)
    if table is not None:
        with written(table):
            precompute_tables.write(rows, table)
