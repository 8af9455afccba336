"""Precomputed transfer of a scene."""

import dataclasses
import functools

import numpy as np
from jaxtyping import Float, Int

from diffopt.transfer import tessellation
from diffopt.transfer.settings import TransferSettings
from diffopt.transfer.slices import Slices
from diffopt.transfer.tessellation import Tessellation


@dataclasses.dataclass(frozen=True)
class Round:
    """A step of refinement.

    Attributes
    ----------
    vertices
        After it.
    faces
        Leaves after it.
    waiting
        Faces whose corners differ by more than the tolerance, when it began; 0 for the first.
    seconds
        It took.
    """

    vertices: int
    faces: int
    waiting: int
    seconds: float


@dataclasses.dataclass(frozen=True, eq=False)
class Transfer:
    """Precomputed transfer of a scene.

    Attributes
    ----------
    mesh
        With all that was split.
    axes
        Local frames of the vertices as rows (tangent, across, normal), [V, 3, 3].
    reflector
        Number of the material of each vertex, [V].
    level
        Of the views of each vertex, -1 where the material is matte, [V].
    first
        Row of the first view of each vertex, [V].
    views
        Slices of all views of all vertices over those of the unoccluded material, see
        `diffopt.transfer.references`, [S, 3, K, ...].
    diffuse
        Slices of the view-independent share, in the local frames, [V, 3, K, ...].
    unoccluded
        Unoccluded lobes of the materials over views, as `diffopt.transfer.references.pack` has
        them, [materials, V', K (4 + C)].
    error
        How far the last level of views computed was from its prediction, [V].
    settings
        Used.
    rounds
        Of refinement.
    """

    mesh: Tessellation
    axes: Float[np.ndarray, "V 3 3"]
    reflector: Int[np.ndarray, " V"]
    level: Int[np.ndarray, " V"]
    first: Int[np.ndarray, " V"]
    views: Slices
    diffuse: Slices
    unoccluded: Float[np.ndarray, "m v F"]
    error: Float[np.ndarray, " V"]
    settings: TransferSettings
    rounds: tuple[Round, ...]

    @property
    def lobes(self) -> int:
        """Lobes of each kind of path, K."""
        return self.diffuse.kappa.shape[-1]

    @property
    def channels(self) -> int:
        """Channels, C: 1 for a grey scene."""
        return self.diffuse.alpha.shape[-1]

    @functools.cached_property
    def triangles(self) -> Int[np.ndarray, "G 3"]:
        """Triangles without T-vertices, to be drawn."""
        return tessellation.closed(self.mesh)[0]

    @property
    def slices(self) -> int:
        """Number of slices, view-independent ones too."""
        return len(self.views.kappa) + len(self.diffuse.kappa)
