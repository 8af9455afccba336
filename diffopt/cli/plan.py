"""``diffopt plan``: which effects a picture of a scene calls for, and what they cost."""

import json
import re
import shlex
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from diffopt.errors import InputError

if TYPE_CHECKING:
    from diffopt.planning import Plan
    from diffopt.scenes import SceneFile

#: Paths of a pixel, at most, where none are typed.
MOST_SPP = 1024
# What texts of `diffopt.plan` start with or hold, and what was typed: options for its arguments.
_TYPED = (
    (r"^tolerance\b", "--tolerance"),
    (r"^seed\b", "--seed"),
    (r"\binclude(?= must| and| names)", "--with"),
    (r"\bexclude(?= must| both| names)", "--without"),
    (r"^(?=matte-light cannot be left out)", "--without: "),
    (r"^(?=[-a-z, ]+ cannot be in: the scene)", "--with: "),
)

#: Options that `diffopt plan` and `diffopt render` share.
With = Annotated[
    list[str] | None,
    typer.Option(
        "--with", metavar="EFFECT", help="An effect to keep whatever it brings; may be given again."
    ),
]
Without = Annotated[
    list[str] | None,
    typer.Option("--without", metavar="EFFECT", help="An effect to leave out; may be given again."),
]
MostSpp = Annotated[
    int | None,
    typer.Option("--most-spp", help=f"Paths of a pixel, at most. [default: {MOST_SPP}]"),
]


def command(
    scene: Annotated[
        Path,
        typer.Argument(
            metavar="SCENE",
            help="A scene, .toml; or, where there is no such file, the name of an example of "
            "diffopt scene example.",
        ),
    ],
    tolerance: Annotated[
        float,
        typer.Option(
            help="Mean difference of luminance from a picture of everything, over the mean."
        ),
    ] = 0.01,
    include: With = None,
    exclude: Without = None,
    most_spp: MostSpp = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Pixels, in place of the camera's.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of the random numbers.")] = None,
    output: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the plan to a file.")
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Render what is left out too; exit code 1 if it brings too much."
        ),
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Effects that a picture calls for within a tolerance, and why."""
    import dataclasses

    from diffopt.cli.progress import terminal
    from diffopt.cli.render import pixels
    from diffopt.io.files import replacing

    if output is not None:
        if not output.parent.is_dir():
            raise InputError(f"--json {output}: the folder {output.parent} does not exist")
        if output.is_dir():
            raise InputError(f"--json {output}: is a folder; expected a file")
    resolution = pixels(size)
    file = found(scene)
    camera = file.camera
    if resolution is not None:
        camera = dataclasses.replace(camera, resolution=resolution)
    plan = planned(
        file, camera, tolerance, include, exclude, most_spp=most_spp, seed=seed, quiet=quiet
    )
    told = plan.summary()
    if not quiet:
        console = terminal()
        console.print(plan.table())
        for note in [*file.notes, *shortfall(plan)]:
            console.print(f"note: {note}", markup=False, soft_wrap=True)
    checked = None
    if check:
        checked = _checked(file.scene, camera, plan, quiet=quiet)
        told["check"] = checked.summary()
        if not quiet:
            terminal().print(checked.table())
            held = "holds" if checked.passed else "does not hold"
            terminal().print(f"check: the plan {held} to its tolerance")
    if output is not None:
        with replacing(output) as stream:
            stream.write((json.dumps(told, indent=2) + "\n").encode())
    if not quiet:
        words = _options(tolerance, include, exclude, most_spp, size, seed)
        line = f"next: {_next(scene, words)}"
        terminal().print(line, markup=False, soft_wrap=True)
    if checked is not None and not checked.passed:
        raise typer.Exit(1)


def found(scene: Path) -> "SceneFile":
    """Read a scene file, or an example where there is no such file.

    Raises
    ------
    InputError
        For faults of the file, or if there is neither.
    """
    from diffopt.cli.errors import user_input
    from diffopt.cli.scene import one_line
    from diffopt.scenes import examples, load_scene

    if not scene.exists() and str(scene) in examples.EXAMPLES:
        with tempfile.TemporaryDirectory() as folder:
            written = Path(folder, f"{scene}.toml")
            written.write_text(examples.text(str(scene)), encoding="utf-8")
            return load_scene(written)
    if not scene.exists() and not scene.suffix:
        names = ", ".join(examples.EXAMPLES)
        raise InputError(f"{scene}: no such file, and no example, which are {names}")
    with one_line(scene), user_input():
        return load_scene(scene)


def planned(
    file: "SceneFile",
    camera: Any,
    tolerance: float,
    include: list[str] | None,
    exclude: list[str] | None,
    *,
    most_spp: int | None,
    seed: int | None,
    quiet: bool,
) -> "Plan":
    """Plan a picture of a scene file, with a bar on the error stream unless `quiet`.

    Parameters
    ----------
    file
        The scene; its options give the backend, and the seed where none is typed.
    camera
        From where, and at what resolution.
    tolerance, include, exclude, most_spp, seed
        As typed.

    Raises
    ------
    InputError
        Of `diffopt.plan`, with the options in place of its arguments.
    """
    from diffopt import planning
    from diffopt.cli.progress import stages

    most = MOST_SPP if most_spp is None else most_spp
    if not 1 <= most <= 2**20:
        raise InputError(f"--most-spp must be a whole number from 1 to {2**20}; received {most}")
    kept = {name: file.options[name] for name in ("seed", "backend") if name in file.options}
    if seed is not None:
        kept["seed"] = seed
    given: dict[str, Any] = {
        "include": include or (),
        "exclude": exclude or (),
        "most_spp": most,
        **kept,
    }
    try:
        if quiet:
            return planning.plan(file.scene, camera, tolerance, **given)
        with stages(1) as progress, progress.stage("plan"):
            return planning.plan(file.scene, camera, tolerance, **given)
    except InputError as error:
        raise InputError(_renamed(str(error))) from None


def shortfall(plan: "Plan") -> list[str]:
    """A note where a plan predicts more than its tolerance, and what to do; else none."""
    from diffopt.planning.choosing import NOISE

    whole = plan.bias + plan.noise
    if whole <= plan.tolerance:
        return []
    noisy = plan.noise > NOISE * plan.tolerance
    why = "noise needs more samples (--most-spp)" if noisy else "--without leaves out too much"
    return [f"{whole:.2%} predicted in all, above the tolerance: {why}"]


def _renamed(text: str) -> str:
    """The text of an error with options in place of arguments; what was received stays."""
    head, mark, received = text.partition("; received ")
    for pattern, option in _TYPED:
        head = re.sub(pattern, option, head)
    return head + mark + received


def _checked(scene: Any, camera: Any, plan: "Plan", *, quiet: bool) -> Any:
    """What `diffopt.planning.checking` finds."""
    from diffopt.cli.progress import stages
    from diffopt.planning.checking import check

    if quiet:
        return check(scene, camera, plan)
    with stages(1, left=True) as progress, progress.stage("check") as report:
        return check(scene, camera, plan, progress=report)


def _options(
    tolerance: float,
    include: list[str] | None,
    exclude: list[str] | None,
    most_spp: int | None,
    size: str | None,
    seed: int | None,
) -> list[str]:
    """Words that make `diffopt render` follow the same plan."""
    words = ["--tolerance", f"{tolerance:g}"]
    for option, names in (("--with", include), ("--without", exclude)):
        words += [word for name in names or () for word in (option, name)]
    rest = {"--most-spp": most_spp, "--size": size, "--seed": seed}
    for option, value in rest.items():
        words += [] if value is None else [option, str(value)]
    return words


def _next(scene: Path, words: list[str]) -> str:
    """The command that renders by the plan; an example is written first."""
    first, file = "", str(scene)
    if not scene.exists():
        first, file = f"diffopt scene example {scene} && ", f"{scene}.toml"
    return first + shlex.join(["diffopt", "render", file, *words])
