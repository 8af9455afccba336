"""``--mesh`` and the options that go with it: a mesh under a camera and a light."""

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from diffopt.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from diffopt.drawing import bands, meshes, shapes

File = Annotated[
    str | None, typer.Option(help="Mesh to lay the scan on: ply, obj, stl, off, glb or gltf.")
]
Turn = Annotated[
    float | None,
    typer.Option(help="Direction in the scan that lies along the mesh's tangents, from x."),
]
Direction = Annotated[
    str | None,
    typer.Option(help="X,Y,Z of the tangents. [default: along the texture, or around the mesh]"),
]
Light = Annotated[
    str | None,
    typer.Option(help="X,Y,Z towards the light on the mesh. [default: upper left of the camera]"),
]
Eye = Annotated[
    str | None,
    typer.Option(help="X,Y,Z from the mesh to the camera. [default: a three-quarter view]"),
]
Up = Annotated[str | None, typer.Option(help="X,Y,Z that is upwards. [default: 0,1,0]")]

#: Towards the light in the camera's axes: right, up, back.
UPPER_LEFT = (-0.45, 0.50, 0.75)
# Share of the mesh's picture that may show backs of faces without a note.
_BACKS = 0.01


@dataclasses.dataclass(frozen=True)
class Words:
    """The options as they were typed."""

    mesh: str | None = None
    mesh_turn: float | None = None
    mesh_direction: str | None = None
    mesh_light: str | None = None
    mesh_eye: str | None = None
    mesh_up: str | None = None


@dataclasses.dataclass(frozen=True)
class Subject:
    """A mesh that is to be drawn.

    Attributes
    ----------
    name, mesh
        Of the file, and what it holds.
    eye, up
        Of the camera, in the mesh's coordinates; it looks at the middle of the mesh.
    light
        Unit vector to the light.
    turn
        Of the material about the normal, degrees.
    field, tangents
        Vectors along the material's x axis, and what they follow.
    """

    name: str
    mesh: "meshes.Mesh"
    eye: "np.ndarray"
    up: tuple[float, float, float]
    light: "np.ndarray"
    turn: float
    field: "np.ndarray"
    tangents: str

    def shoot(self, size: int) -> "Shot":
        """Cast the rays of a camera of `size` samples on a side, and those to the light."""
        from diffopt.drawing import meshes

        seen = meshes.view(self.mesh, size, eye=self.eye, up=self.up, field=self.field)
        lit = meshes.lit(seen, self.light)
        return Shot(self, seen.turned(math.radians(self.turn)), lit)


@dataclasses.dataclass(frozen=True)
class Shot:
    """A mesh before its camera, and which samples its light reaches, [h, w]."""

    subject: Subject
    view: "shapes.View"
    lit: "np.ndarray"

    def shot(self) -> "bands.Shot":
        """For a picture."""
        from diffopt.drawing import bands

        return bands.Shot(
            self.lit.shape, lambda rows: (self.view.rows(rows), self.subject.light, self.lit[rows])
        )

    def notes(self) -> list[str]:
        """What was assumed, and what the picture lacks."""
        name, turn = self.subject.name, self.subject.turn
        notes = [f"{name}: the scan's x axis, turned by {turn:g} degrees, {self.subject.tangents}"]
        backs = self.view.neutral.sum() / (self.view.neutral | self.view.covered).sum()
        if backs > _BACKS:
            notes.append(
                f"{name}: {100 * backs:.0f} % of what is seen are backs of faces, drawn grey"
            )
        if not self.lit.any():
            notes.append(f"{name}: the light reaches nothing that is seen")
        return notes

    def summary(self) -> dict[str, Any]:
        """Entry of ``result.json``; lengths in the unit of the file."""
        import numpy as np

        from diffopt.drawing import meshes

        subject, covered = self.subject, int(self.view.covered.sum())
        return {
            "file": subject.name,
            "vertices": len(np.unique(subject.mesh.vertices, axis=0)),
            "faces": len(subject.mesh.faces),
            "tangents": subject.tangents,
            "turn": subject.turn,
            "camera": {
                "eye": subject.eye.tolist(),
                "target": subject.mesh.centre.tolist(),
                "up": list(subject.up),
                "field_of_view": meshes.FIELD_OF_VIEW_DEG,
            },
            "light": subject.light.tolist(),
            "lit_share": round(int(self.lit.sum()) / max(covered, 1), 4),
        }


def prepare(words: Words) -> Subject | None:
    """Read the mesh and place camera and light; None without a mesh.

    Raises
    ------
    InputError
        For a file or an option that cannot be used, or options without a mesh.
    """
    if words.mesh is None:
        for field in dataclasses.fields(words):
            if getattr(words, field.name) is not None:
                raise InputError(f"--{field.name.replace('_', '-')} needs --mesh FILE")
        return None
    import numpy as np

    from diffopt.drawing import meshes, shapes
    from diffopt.scenes import tangents

    up = _vector("--mesh-up", words.mesh_up) or (0.0, 1.0, 0.0)
    direction = _vector("--mesh-direction", words.mesh_direction)
    light = _vector("--mesh-light", words.mesh_light)
    side = _vector("--mesh-eye", words.mesh_eye)
    turn = 0.0 if words.mesh_turn is None else words.mesh_turn
    if not math.isfinite(turn):
        raise InputError(f"--mesh-turn must be a number of degrees; received {turn}")
    mesh = meshes.load(words.mesh)
    try:
        eye = meshes.viewpoint(mesh, side, up=up)
    except InputError as error:
        raise InputError(
            f"--mesh-eye {words.mesh_eye} lies along the upward direction "
            f"{words.mesh_up or '0,1,0'}; expected another, or another --mesh-up"
        ) from error
    if direction is not None:
        field = tangents.from_direction(mesh, np.array(direction))
        kind = f"follows the direction {words.mesh_direction}"
    else:
        field, kind = tangents.own(mesh, np.array(up))
    camera = shapes.axes(eye, mesh.centre, np.array(up))
    towards = camera.T @ np.array(UPPER_LEFT) if light is None else np.array(light)
    return Subject(
        name=Path(words.mesh).name,
        mesh=mesh,
        eye=eye,
        up=up,
        light=shapes.unit(towards),
        turn=turn,
        field=field,
        tangents=kind,
    )


def _vector(option: str, text: str | None) -> tuple[float, float, float] | None:
    from diffopt.cli.options import floats

    if text is None:
        return None
    values = floats(text)
    if len(values) != 3 or not all(map(math.isfinite, values)) or not any(values):
        raise InputError(
            f"{option} must be a direction X,Y,Z, three numbers that are not all 0; "
            f"received {text!r}"
        )
    return values
