"""All shapes of a scene in arrays, and the surface where a ray meets one.

Primitives are numbered through: triangles first, then spheres, then discs.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from diffopt.kernels import frames
from diffopt.kernels.frames import dot
from diffopt.scenes.shapes import Disc, Round, Sphere, Triangles

Either = Array | np.ndarray

# Cosine to the viewer below which an interpolated normal is bent towards him.
_LEAST = 1e-3
# Square of the shortest projection of a tangent that still says a direction.
_WEAK = 1e-6


class World(eqx.Module):
    """Shapes in their places.

    Attributes
    ----------
    vertices, normals, tangents, uv
        Of triangles, [V, 3], [V, 2].
    faces
        Vertices of triangles, [T, 3].
    centres, radii, axes
        Of S spheres, then D discs: [S + D, 3], [S + D], [S + D, 3, 3].
    element
        Number of each primitive within its object, [P].
    triangles, spheres
        T and S. The arrays may be longer, so that scenes of other sizes share a program.
    """

    vertices: Float[Either, "V 3"]
    normals: Float[Either, "V 3"]
    tangents: Float[Either, "V 3"]
    uv: Float[Either, "V 2"]
    faces: Int[Either, "T 3"]
    centres: Float[Either, "R 3"]
    radii: Float[Either, " R"]
    axes: Float[Either, "R 3 3"]
    element: Int[Either, " P"]
    triangles: Int[Either, ""]
    spheres: Int[Either, ""]

    @property
    def counts(self) -> tuple[int, int, int]:
        """Numbers of triangles, spheres and discs; of a world that is not padded."""
        spheres = int(self.spheres)
        return int(self.triangles), spheres, self.radii.shape[0] - spheres


class Surface(eqx.Module):
    """Points on surfaces.

    Attributes
    ----------
    position
        [n, 3].
    geometric
        Unit normals of the shape itself, on its front, [n, 3].
    tangent, across, normal
        The material's axes, [n, 3]; on the front.
    uv
        Texture coordinates, [n, 2].
    element
        Numbers of the primitives within their objects, [n].
    """

    position: Float[Array, "n 3"]
    geometric: Float[Array, "n 3"]
    tangent: Float[Array, "n 3"]
    across: Float[Array, "n 3"]
    normal: Float[Array, "n 3"]
    uv: Float[Array, "n 2"]
    element: Int[Array, " n"]

    def local(self, world: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Directions in the material's frame from those in the world, [n, 3] or [n, k, 3]."""
        between = (slice(None), *(None,) * (world.ndim - 2))
        axes = (self.tangent[between], self.across[between], self.normal[between])
        return frames.direction(*(dot(world, axis) for axis in axes))

    def outwards(self, local: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Directions in the world from those in the material's frame."""
        x, y, z = local[:, :1], local[:, 1:2], local[:, 2:]
        return x * self.tangent + y * self.across + z * self.normal


def build(patches: Sequence[Triangles | Round]) -> World:
    """Arrays of the shapes of objects, one after the other, in float64 on the host."""
    meshes = [(k, p) for k, p in enumerate(patches) if isinstance(p, Triangles)]
    rounds = [
        (k, p)
        for kind in (Sphere, Disc)
        for k, p in enumerate(patches)
        if isinstance(p, Round) and p.kind is kind
    ]
    first = np.cumsum([0] + [len(p.vertices) for _, p in meshes])

    def joined(arrays: list[np.ndarray], shape: tuple[int, ...], dtype: type) -> np.ndarray:
        return np.concatenate([np.zeros((0, *shape), dtype), *arrays]).astype(dtype)

    element = [np.arange(len(p.faces)) for _, p in meshes] + [np.array([0]) for _ in rounds]
    return World(
        vertices=joined([p.vertices for _, p in meshes], (3,), np.float64),
        normals=joined([p.normals for _, p in meshes], (3,), np.float64),
        tangents=joined([p.tangents for _, p in meshes], (3,), np.float64),
        uv=joined([p.uv for _, p in meshes], (2,), np.float64),
        faces=joined(
            [p.faces + at for (_, p), at in zip(meshes, first, strict=False)], (3,), np.int32
        ),
        centres=joined([p.centre[None] for _, p in rounds], (3,), np.float64),
        radii=joined([np.array([p.radius]) for _, p in rounds], (), np.float64),
        axes=joined([p.axes[None] for _, p in rounds], (3, 3), np.float64),
        element=joined(element, (), np.int32),
        triangles=np.asarray(sum(len(p.faces) for _, p in meshes), np.int32),
        spheres=np.asarray(sum(p.kind is Sphere for _, p in rounds), np.int32),
    )


def owners(patches: Sequence[Triangles | Round]) -> Int[np.ndarray, " P"]:
    """The patch that each primitive of their world belongs to."""
    order = [(k, len(p.faces)) for k, p in enumerate(patches) if isinstance(p, Triangles)]
    for kind in (Sphere, Disc):
        order += [(k, 1) for k, p in enumerate(patches) if isinstance(p, Round) and p.kind is kind]
    found = [np.full(count, k, np.int32) for k, count in order]
    return np.concatenate([np.zeros(0, np.int32), *found])


def padded(world: World) -> World:
    """A world whose arrays have a power of two of rows, or none: the last one is repeated."""
    return jax.tree.map(lengthened, world)


def lengthened(array: np.ndarray) -> np.ndarray:
    """An array with rows up to a power of two, the last one repeated; numbers as they are."""
    if array.ndim == 0 or len(array) == 0:
        return array
    spare = (1 << (len(array) - 1).bit_length()) - len(array)
    return np.concatenate([array, np.repeat(array[-1:], spare, axis=0)])


def surface(
    world: World,
    primitive: Int[Array, " n"],
    u: Float[Array, " n"],
    v: Float[Array, " n"],
    reached: Float[Array, "n 3"],
) -> Surface:
    """The surface of primitives.

    Parameters
    ----------
    world
        The shapes.
    primitive
        Which of them, [n].
    u, v
        Shares of the second and third corner of triangles, [n].
    reached
        Where the rays meet them by distance and direction, [n, 3]: used for spheres and discs,
        and put onto their surface.
    """
    found = None
    if world.faces.shape[0]:
        found = _on_triangles(world, jnp.minimum(primitive, world.faces.shape[0] - 1), u, v)
    if world.radii.shape[0]:
        which = jnp.clip(primitive - world.triangles, 0, world.radii.shape[0] - 1)
        other = _on_rounds(world, which, reached)
        found = other if found is None else _either(primitive < world.triangles, found, other)
    assert found is not None, "a ray met nothing"
    position, geometric, normal, tangent, uv = found
    # The shading normal on the side of the geometric one.
    normal = jnp.where(dot(normal, geometric)[:, None] < 0.0, -normal, normal)
    tangent, across = _axes(tangent, normal)
    element = jnp.asarray(world.element)[primitive]
    return Surface(position, geometric, tangent, across, normal, uv, element)


def facing(
    found: Surface, eye: Float[Array, "n 3"], *, both: bool
) -> tuple[Surface, Bool[Array, " n"]]:
    """The surface as the viewer sees it, and whether he sees its front.

    Parameters
    ----------
    found
        The surface.
    eye
        Unit vectors to the viewer, [n, 3].
    both
        Whether its back is the material's back, as of glass; otherwise the material covers
        both sides alike and its axes are turned to the viewer.

    Normals interpolated over a mesh may face away from a viewer who does see the face: they
    are bent until they are square to the line of sight.
    """
    front = dot(found.geometric, eye) > 0.0
    side = jnp.where(front, 1.0, -1.0).astype(eye.dtype)[:, None]
    bent = found.normal
    lack = jnp.maximum(_LEAST - dot(side * bent, eye), 0.0)[:, None]
    bent = bent + side * lack * eye
    bent = bent * inverse_root(dot(bent, bent))[:, None]
    kept = bent if both else side * bent
    tangent, across = _axes(found.tangent, kept)
    turned = eqx.tree_at(lambda s: (s.normal, s.tangent, s.across), found, (kept, tangent, across))
    return turned, front


def inverse_root(square: Array) -> Array:
    """One over a root, finite at 0."""
    return 1.0 / jnp.sqrt(jnp.maximum(square, jnp.finfo(square.dtype).tiny))


def _on_triangles(world: World, index: Array, u: Array, v: Array) -> tuple[Array, ...]:
    corners = world.faces[index]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    u, v = u[:, None], v[:, None]
    rest = 1.0 - u - v

    def mixed(field: Either) -> Array:
        return jnp.asarray(rest * field[a] + u * field[b] + v * field[c])

    origin = world.vertices[a]
    one, two = world.vertices[b] - origin, world.vertices[c] - origin
    geometric = cross(one, two)
    geometric = geometric * inverse_root(dot(geometric, geometric))[:, None]
    normal = mixed(world.normals)
    normal = normal * inverse_root(dot(normal, normal))[:, None]
    # From one corner along the edges: the sum of three places would round more.
    position = origin + u * one + v * two
    return position, geometric, normal, mixed(world.tangents), mixed(world.uv)


def _on_rounds(world: World, index: Array, reached: Array) -> tuple[Array, ...]:
    centre, radius, axes = world.centres[index], world.radii[index][:, None], world.axes[index]
    x, y, z = axes[:, :, 0], axes[:, :, 1], axes[:, :, 2]
    offset = reached - centre
    ball = (index < world.spheres)[:, None]
    # Where it is a disc, a direction that is no 0.
    outward = jnp.where(ball, offset, z)
    outward = outward * inverse_root(dot(outward, outward))[:, None]
    flat = offset - dot(offset, z)[:, None] * z
    position = centre + jnp.where(ball, radius * outward, flat)
    p, q, r = (dot(outward, axis) for axis in (x, y, z))
    turn = _turn(q, p)
    height = jnp.arccos(jnp.clip(-r, -1.0, 1.0)) / np.pi
    s, t = (0.5 + 0.5 * dot(flat, axis) / radius[:, 0] for axis in (x, y))
    ball = ball[:, 0]
    uv = jnp.stack([jnp.where(ball, turn, s), jnp.where(ball, height, t)], -1)
    return position, outward, outward, jnp.where(ball[:, None], cross(z, outward), x), uv


def _turn(y: Array, x: Array) -> Array:
    """Azimuth as a share of the circle, [0, 1); with a slope also on the axis."""
    pole = (x == 0.0) & (y == 0.0)
    share = jnp.arctan2(jnp.where(pole, 0.0, y), jnp.where(pole, 1.0, x)) / (2.0 * np.pi)
    return jnp.where(share < 0.0, share + 1.0, share)


def _either(first: Array, one: tuple[Array, ...], other: tuple[Array, ...]) -> tuple[Array, ...]:
    return tuple(jnp.where(first[:, None], a, b) for a, b in zip(one, other, strict=True))


def _axes(tangent: Array, normal: Array) -> tuple[Array, Array]:
    """Unit tangent nearest to a direction, and the third axis; any where there is none."""
    flat = tangent - dot(tangent, normal)[:, None] * normal
    square = dot(flat, flat)
    weak = (square < _WEAK * dot(tangent, tangent)) | (square == 0.0)
    instead, _ = frames.tangents(normal)
    flat = jnp.where(weak[:, None], instead, flat)
    flat = flat * inverse_root(dot(flat, flat))[:, None]
    return flat, cross(normal, flat)


def cross(a: Float[Array, "n 3"], b: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Vector product, written out; see `diffopt.kernels.frames.direction` for why."""
    return frames.direction(
        a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
        a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
        a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
    )
