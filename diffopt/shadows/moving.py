"""An object that deforms and moves: its fields are made anew only where its shape changed."""

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from diffopt.errors import InputError
from diffopt.shadows import parts as splitting
from diffopt.shadows import sampling
from diffopt.shadows.fields import Field, field_of
from diffopt.shadows.settings import ShadowSettings

# A pose is a rotation to this.
_ROUNDING = 1e-4


class Times(NamedTuple):
    """Seconds that a frame took.

    Attributes
    ----------
    sampling
        Spheres, rays, and their projection to coefficients.
    conversion
        From coefficients on the shells to the tables that receivers read.
    sampled
        Parts that were sampled; 0 for a frame without rays.
    """

    sampling: float = 0.0
    conversion: float = 0.0
    sampled: int = 0


class Occluder:
    """An object whose shape and place change from frame to frame.

    Shapes are given in the object's own frame, by `update`; its place in the world by `move`. A
    shape that is that of the frame before casts no ray, and neither does a rigid motion, which is
    recognised by nothing but a call of `move`.

    Parameters
    ----------
    faces
        Corners of triangles, [F, 3], the same in all frames.
    settings
        Of the fields.
    parts
        Of an articulated object: a number, then the first shape is split into as many; or the
        faces of each, [n, 3]. Every part has a field of its own, sampled again only where that
        part changed.
    backend
        Of the rays: "embree" or "jax".

    Attributes
    ----------
    times
        Of the last `update`.
    """

    def __init__(
        self,
        faces: Int[np.ndarray, "F 3"],
        settings: ShadowSettings | None = None,
        *,
        parts: int | Sequence[Int[np.ndarray, "_ 3"]] = 1,
        backend: str = "embree",
    ) -> None:
        self.faces = np.asarray(faces)
        self.settings = settings or ShadowSettings()
        self.backend = backend
        self.times = Times()
        self._parts: list[_Part] | None = None
        self._count = parts if isinstance(parts, int) else len(parts)
        if not isinstance(parts, int):
            if not len(parts):
                raise InputError("parts must hold the faces of one part at least")
            self._parts = [_Part(np.asarray(part)) for part in parts]
        elif parts < 1:
            raise InputError(f"parts must be at least 1; received {parts}")
        self._shape: np.ndarray | None = None
        self._pose: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def fields(self) -> tuple[Field, ...]:
        """Fields of all parts in the world.

        Raises
        ------
        InputError
            Before the first `update`.
        """
        fields = [part.field for part in self._parts or ()]
        if self._shape is None or not fields:
            raise InputError("the occluder has no shape yet: call update(vertices) first")
        found = tuple(field for field in fields if field is not None)
        if self._pose is None:
            return found
        return tuple(field.moved(*self._pose) for field in found)

    @property
    def vertices(self) -> Float[np.ndarray, "V 3"]:
        """Of the last shape, in the world."""
        if self._shape is None:
            raise InputError("the occluder has no shape yet: call update(vertices) first")
        if self._pose is None:
            return self._shape
        rotation, translation = self._pose
        return self._shape @ rotation.T + translation

    def move(self, rotation: Any = None, translation: Any = None) -> None:
        """Put the object's frame to a place in the world: no ray is cast.

        Places are not added up: each call says where the object is, not how far it went.

        Parameters
        ----------
        rotation
            Orthogonal [3, 3] of determinant 1, from the object's frame to the world's.
        translation
            [3], after it.
        """
        turn = np.eye(3) if rotation is None else np.asarray(rotation, np.float64)
        step = np.zeros(3) if translation is None else np.asarray(translation, np.float64)
        if turn.shape != (3, 3):
            raise InputError(f"rotation must be [3, 3]; received {turn.shape}")
        if step.shape != (3,) or not np.isfinite(step).all():
            raise InputError(f"translation must be three finite numbers; received {step}")
        error = np.abs(turn @ turn.T - np.eye(3)).max()
        if not error <= _ROUNDING or np.linalg.det(turn) < 0.0:
            raise InputError(
                "rotation must be orthogonal with determinant 1: other motions change the shape, "
                "which update(vertices) samples again"
            )
        self._pose = turn, step

    def update(self, vertices: Any, receivers: Any = None) -> bool:
        """Take the shape of a frame; cast rays if it is another one.

        Parameters
        ----------
        vertices
            [V, 3], in the object's frame.
        receivers
            Points [..., 3] of the world, which must be shaded where the object now is: where some
            lie within a part's sphere, nearer than any before, that part is sampled there too.

        Returns
        -------
        bool
            Whether anything was sampled.

        Raises
        ------
        InputError
            For arrays that are no mesh, or receivers that are no points.
        """
        shape = np.array(vertices, np.float64)
        parts, points = self._split(shape), self._local(receivers)
        self._shape = shape
        spent = [part.update(shape, points, self.settings, self.backend) for part in parts]
        self.times = Times(*(sum(column) for column in zip(*spent, strict=True)))
        return self.times.sampled > 0

    def foresee(self, vertices: Any, receivers: Any) -> None:
        """Allow for a shape to come, where the object now is: no ray is cast.

        Shells inside the spheres will go down to what it needs from the first sampling on, so
        that tables have one shape in all frames, and nothing is compiled on the way.

        Parameters
        ----------
        vertices, receivers
            As for `update`.
        """
        shape = np.asarray(vertices, np.float64)
        parts, points = self._split(shape), self._local(receivers)
        for part in parts:
            part.foresee(shape, points, self.settings)

    def _split(self, shape: np.ndarray) -> "list[_Part]":
        sampling.check_mesh(shape, self.faces)
        if self._parts is None:
            split = splitting.split(shape, self.faces, self._count) if self._count > 1 else None
            self._parts = [_Part(part) for part in split or [self.faces]]
        return self._parts

    def _local(self, receivers: Any) -> np.ndarray | None:
        if receivers is None:
            return None
        points = np.asarray(receivers, np.float64)
        if points.shape[-1:] != (3,):
            raise InputError(f"receivers must be points [..., 3]; received {points.shape}")
        points = points.reshape(-1, 3)
        if self._pose is None:
            return points
        rotation, translation = self._pose
        return (points - translation) @ rotation


class _Part:
    """Faces with one sphere and one field, in the object's frame."""

    def __init__(self, faces: np.ndarray) -> None:
        self.used, self.faces = splitting.compact(faces)
        self.field: Field | None = None
        self._shape = np.zeros((0, 3))
        # Shells inside go down to this, in radii: it never rises, so that tables keep their shape
        # and programs that read them are not compiled anew.
        self._nearest = self._sampled = 1.0

    def foresee(
        self, vertices: np.ndarray, receivers: np.ndarray | None, settings: ShadowSettings
    ) -> None:
        centre, radius = sampling.bounding_sphere(vertices[self.used])
        self._nearest = min(self._nearest, _reached(receivers, centre, radius, settings))

    def update(
        self,
        vertices: np.ndarray,
        receivers: np.ndarray | None,
        settings: ShadowSettings,
        backend: str,
    ) -> Times:
        begun = time.perf_counter()
        shape = vertices[self.used]
        same = self.field is not None and np.array_equal(shape, self._shape)
        if same and self.field is not None:
            centre = np.asarray(self.field.centre, np.float64)
            radius = float(self.field.radius)
        else:
            centre, radius = sampling.bounding_sphere(shape)
        nearest = _reached(receivers, centre, radius, settings)
        if same and nearest >= self._sampled:
            return Times(time.perf_counter() - begun)
        self._nearest = min(nearest, self._nearest)
        samples = sampling.sample(
            shape,
            self.faces,
            settings,
            centre=centre,
            radius=radius,
            nearest=self._nearest,
            backend=backend,
        )
        sampled = time.perf_counter()
        self.field = field_of(samples, settings, centre, radius)
        jax.block_until_ready(self.field.table)
        self._shape, self._sampled = shape, self._nearest
        return Times(sampled - begun, time.perf_counter() - sampled, 1)


def _reached(
    receivers: np.ndarray | None, centre: np.ndarray, radius: float, settings: ShadowSettings
) -> float:
    """Distance of the nearest receiver in radii, down to a whole step of the shells inside."""
    step = settings.inner_step
    if receivers is None or not len(receivers) or step == 0.0:
        return 1.0
    distance = np.sqrt(((receivers - centre) ** 2).sum(1).min()) / radius
    steps = np.ceil((1.0 - distance) / step - 1e-9)
    return float(np.clip(1.0 - steps * step, 0.0, 1.0))
