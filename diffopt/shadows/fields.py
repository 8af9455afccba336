"""A shadow field in its place, and what it hides from receivers.

A receiver at distance d, polar angle theta and azimuth phi from the centre reads its field's table
at (d, theta, phi), trilinearly, and turns what it finds from the local frame to the world's.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.errors import InputError
from diffopt.kernels import harmonic_rotation
from diffopt.kernels.tabulated import root
from diffopt.shadows import sampling, tables
from diffopt.shadows.settings import ShadowSettings


class Field(eqx.Module):
    """What one object hides (or emits) as seen from anywhere, in spherical harmonics.

    Differentiable in the receiver, in `centre`, `radius`, `rotation` and `table`.

    Attributes
    ----------
    table
        Coefficients in local frames, [rows, polar + 2, azimuthal + 1, L^2 x channels].
    centre
        Of the sphere in the world, [3].
    radius
        Of the sphere.
    rotation
        From the object's frame to the world's, [3, 3], or None for none.
    nearest
        Distance, in radii, of the first row; receivers nearer than that see what is seen there.
    inner
        Rows inside the sphere.
    bands
        L.
    channels
        Of what is emitted; 0 for what is hidden.
    """

    table: Float[Array, "r p a C"]
    centre: Float[Array, "3"]
    radius: Float[Array, ""]
    rotation: Float[Array, "3 3"] | None
    nearest: Float[Array, ""]
    inner: int = eqx.field(static=True)
    bands: int = eqx.field(static=True)
    channels: int = eqx.field(static=True, default=0)

    def moved(self, rotation: Any = None, translation: Any = None) -> "Field":
        """The field of the object after a rigid motion: no ray is cast.

        Parameters
        ----------
        rotation
            Orthogonal [3, 3] of determinant 1, about the world's origin.
        translation
            [3], after it.
        """
        centre, turned = self.centre, self.rotation
        if rotation is not None:
            rotation = jnp.asarray(rotation, self.table.dtype)
            if rotation.shape != (3, 3):
                raise InputError(f"rotation must be [3, 3]; received {rotation.shape}")
            centre = rotation @ centre
            turned = rotation if turned is None else rotation @ turned
        if translation is not None:
            centre = centre + jnp.asarray(translation, self.table.dtype)
        return eqx.tree_at(
            lambda f: (f.centre, f.rotation), self, (centre, turned), is_leaf=lambda x: x is None
        )

    def coefficients(self, points: Float[Array, "N 3"]) -> Float[Array, "L2 N ..."]:
        """What is hidden (or emitted) at points, in the world's frame, [L^2, N] (or [.., C])."""
        return self.seen(points.T)

    def distance(self, x: Float[Array, "3 N"]) -> Float[Array, " N"]:
        """From points [3, N] to the centre."""
        away = x - self.centre[:, None]
        return root(jnp.sum(away * away, 0))

    def seen(self, x: Float[Array, "3 N"]) -> Float[Array, "L2 N ..."]:
        """As `coefficients`, points as [3, N]."""
        away = (x - self.centre[:, None]) / self.radius
        if self.rotation is not None:
            away = self.rotation.T @ away
        place = _place(away, self)
        read = _read(self.table, place)
        square = self.bands**2
        count = max(self.channels, 1)
        # A product with the unit matrix: the reading ends in it and is done once. Left open to
        # fusion, it would be repeated for every coefficient that the rotation makes.
        unit = jnp.eye(square * count, dtype=read.dtype)
        read = jnp.einsum("ij,nj->in", unit, read)
        if self.channels:
            read = jnp.moveaxis(read.reshape(square, count, -1), 1, 0)
            turned = jax.vmap(lambda c: self._turned(c, place))(read)
            return jnp.moveaxis(turned, 0, 2)
        return self._turned(read, place)

    def _turned(self, read: Array, place: "_Place") -> Array:
        turned = harmonic_rotation.to_frame(
            read, place.cos_polar, place.sin_polar, place.cos_azimuth, place.sin_azimuth
        )
        return turned if self.rotation is None else harmonic_rotation.rotate(turned, self.rotation)


class _Place(NamedTuple):
    """Rows and shares in the table, the fall with distance, the direction from the centre."""

    corner: Array
    fall: Array
    shares: tuple[Array, Array, Array]
    cos_polar: Array
    sin_polar: Array
    cos_azimuth: Array
    sin_azimuth: Array


def _place(away: Array, field: Field) -> _Place:
    """Where points about the centre, [3, N] in radii, lie in the table."""
    rows, polar, azimuthal, _ = field.table.shape
    x, y, z = away
    across = root(x * x + y * y)
    distance = root(across * across + z * z)
    off_centre, off_axis = distance > 0.0, across > 0.0
    inverse = 1.0 / jnp.where(off_centre, distance, 1.0)
    sideways = 1.0 / jnp.where(off_axis, across, 1.0)
    cos_polar = jnp.where(off_centre, z * inverse, 1.0)
    cos_azimuth = jnp.where(off_axis, x * sideways, 1.0)
    sin_azimuth = y * sideways
    theta = jnp.arctan2(across, jnp.where(off_centre, z, 1.0))
    phi = jnp.arctan2(y, jnp.where(off_axis, x, 1.0))
    k = jnp.where(distance > 1.0, inverse, 1.0)
    k = jnp.minimum(k, tables.NEAREST)
    steps = (rows - 1 - field.inner) / (tables.LAST - tables.FIRST)
    outside = field.inner + jnp.maximum(jnp.sqrt(jnp.arccos(k)) - tables.FIRST, 0.0) * steps
    radial = outside
    if field.inner:
        span = field.inner / jnp.maximum(1.0 - field.nearest, 1e-6)
        within = jnp.clip((distance - field.nearest) * span, 0.0, float(field.inner))
        radial = jnp.where(distance < 1.0, within, outside)
    shares, corners = [], []
    scale = (azimuthal - 1) / (2.0 * math.pi)
    for value, count in (
        (radial, rows),
        (theta * ((polar - 2) / math.pi) + 0.5, polar),
        (jnp.where(phi < 0.0, phi + 2.0 * math.pi, phi) * scale, azimuthal),
    ):
        corner = jnp.clip(value.astype(jnp.int32), 0, count - 2)
        corners.append(corner)
        shares.append(value - corner.astype(value.dtype))
    corner = (corners[0] * polar + corners[1]) * azimuthal + corners[2]
    return _Place(
        corner,
        jnp.where(distance > 1.0, inverse * inverse, 1.0),
        (shares[0], shares[1], shares[2]),
        cos_polar,
        across * inverse,
        cos_azimuth,
        sin_azimuth,
    )


def _read(table: Array, place: _Place) -> Array:
    """Trilinear reading, [N, C]."""
    _, polar, azimuthal, width = table.shape
    flat = table.reshape(-1, width)
    total: Any = 0.0
    for row in (0, 1):
        for up in (0, 1):
            for right in (0, 1):
                share = place.fall
                for part, upper in zip(place.shares, (row, up, right), strict=True):
                    share = share * (part if upper else 1.0 - part)
                step = (row * polar + up) * azimuthal + right
                total = total + flat[place.corner + step] * share[:, None]
    return total


def field_of(
    samples: sampling.Samples,
    settings: ShadowSettings,
    centre: Any,
    radius: Any,
) -> Field:
    """The field of samples: its table, in its place."""
    table = tables.build(samples, settings)
    channels = samples.outer.shape[4] if samples.outer.ndim == 5 else 0
    dtype = table.dtype
    sampled = samples.nearest < 1.0
    return Field(
        table,
        jnp.asarray(centre, dtype),
        jnp.asarray(radius, dtype),
        None,
        jnp.asarray(samples.nearest if sampled else 0.0, dtype),
        table.shape[0] - settings.radial - 1,
        settings.bands,
        channels,
    )


def shadow_field(
    vertices: Any,
    faces: Any,
    settings: ShadowSettings | None = None,
    *,
    receivers: Any = None,
    centre: Any = None,
    radius: float | None = None,
    emission: Any = None,
    backend: str = "embree",
) -> Field:
    """The shadow field of a mesh.

    Parameters
    ----------
    vertices
        [V, 3].
    faces
        Corners of triangles, [F, 3].
    settings
        Of sampling and extrapolation.
    receivers
        Points [..., 3] that will be shaded: where some lie within the sphere, the field is sampled
        there too, down to the nearest.
    centre, radius
        Of the sphere that holds the mesh. [default: a small one]
    emission
        Radiance of the faces, [F] or [F, C]: the field of a light. Both sides emit.
    backend
        Of the rays: "embree" or "jax".

    Raises
    ------
    InputError
        For arrays that are no mesh, a mesh that leaves the sphere, or receivers of another shape.
    """
    settings = settings or ShadowSettings()
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    sampling.check_mesh(vertices, faces)
    if centre is None:
        centre, found = sampling.bounding_sphere(vertices)
    else:
        centre = np.asarray(centre, np.float64)
        found = float(np.sqrt(((vertices - centre) ** 2).sum(1).max()))
    radius = found if radius is None else radius
    nearest = np.inf
    if receivers is not None:
        points = np.asarray(receivers, np.float64)
        if points.shape[-1:] != (3,):
            raise InputError(f"receivers must be points [..., 3]; received {points.shape}")
        if points.size:
            away = points.reshape(-1, 3) - centre
            nearest = float(np.sqrt((away**2).sum(1).min())) / radius
    if emission is not None:
        emission = np.asarray(emission, np.float32)
        if emission.ndim not in (1, 2) or len(emission) != len(faces):
            raise InputError(
                f"emission must be [{len(faces)}] or [{len(faces)}, C]; received {emission.shape}"
            )
        emission = emission.reshape(len(faces), -1)
    samples = sampling.sample(
        vertices,
        faces,
        settings,
        centre=centre,
        radius=radius,
        nearest=nearest,
        emission=emission,
        backend=backend,
    )
    return field_of(samples, settings, centre, radius)
