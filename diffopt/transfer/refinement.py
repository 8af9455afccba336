"""Which triangles are split next.

An initial triangle is judged by half the difference of its corners: what linear interpolation
misses in the middle of an edge if all of the difference is a step (the glossy-transfer paper,
section 4.3, has the whole difference). Its descendants are judged by what was missed where their
parent was halved, if that is less: where transfer varies smoothly that falls to a quarter with
every split, and is not followed further.

Errors count by area: the squared error of a picture is an integral, so that a step is worth
a split where it is wide. Without it the edges of all reflections would be followed to the
finest triangles.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from diffopt.transfer import references, spatial, tessellation
from diffopt.transfer.references import Reference
from diffopt.transfer.settings import TransferSettings
from diffopt.transfer.spatial import Known
from diffopt.transfer.tessellation import Tessellation


@dataclasses.dataclass(frozen=True, eq=False)
class Measure:
    """What differences of a material are measured by.

    Attributes
    ----------
    unoccluded
        Its lobes over views, see `diffopt.transfer.references.pack`, [V, F].
    scale
        Mean squared norms of unoccluded slices of the views up to each level.
    matte
        Squared norm of the unoccluded diffuse slice.
    """

    unoccluded: Float[np.ndarray, "V F"]
    scale: Float[np.ndarray, " L"]
    matte: float


class Refinement:
    """Chooses triangles; keeps what it has measured.

    Parameters
    ----------
    settings
        Of the precomputation.
    """

    def __init__(self, settings: TransferSettings) -> None:
        self.settings = settings
        self._pairs: dict[int, float] = {}
        self._missed = np.zeros(0)

    def chosen(
        self,
        mesh: Tessellation,
        known: Callable[[], Known],
        reflector: Int[np.ndarray, " V"],
        measures: list[Measure],
    ) -> tuple[Int[np.ndarray, " n"], int]:
        """Leaves to split next, the worst first, and how many wait.

        Parameters
        ----------
        mesh
            With slices at all vertices.
        known
            Gives them.
        reflector
            Material of each vertex.
        measures
            Of the materials.
        """
        settings, count = self.settings, len(mesh.vertices)
        leaves = tessellation.leaves(mesh)
        open_ = leaves[mesh.level[leaves] < settings.splits]
        initial = tessellation.areas(mesh, np.flatnonzero(mesh.level == 0))
        area = tessellation.areas(mesh, open_)
        if settings.least_area > 0.0:
            wide = area > settings.least_area * initial.sum()
            open_, area = open_[wide], area[wide]
        if not len(open_) or count >= settings.most_vertices:
            return open_[:0], 0
        error = self._errors(mesh, open_, known, reflector, measures)
        error *= np.sqrt(np.minimum(area / initial.mean(), 1.0))
        over = np.flatnonzero(error > settings.tolerance)
        # A split brings two vertices, about: no more than are allowed.
        most = min(settings.round_faces, max(1, (settings.most_vertices - count) // 2))
        worst = over[np.argsort(-error[over], kind="stable")][:most]
        return open_[worst], len(over)

    def _errors(
        self,
        mesh: Tessellation,
        faces: np.ndarray,
        known: Callable[[], Known],
        reflector: np.ndarray,
        measures: list[Measure],
    ) -> Float[np.ndarray, " n"]:
        """What interpolation over faces is expected to miss, over the norm."""
        edges, sides = tessellation.pairs(mesh, faces)
        # Numbers of pairs that no later vertex changes.
        keys = (edges[:, 1].astype(np.int64) * 2**31 + edges[:, 0]).tolist()
        fresh = np.array([key not in self._pairs for key in keys], bool)
        new = np.arange(len(self._missed), len(mesh.vertices))
        if fresh.any() or len(new):
            held = known()
            lobes = self.settings.lobes
            over = references.reference([m.unoccluded for m in measures], lobes, references.LEVEL)
            found = self._differences(held, over, edges[fresh], reflector, measures)
            self._pairs.update(zip(np.array(keys)[fresh].tolist(), found.tolist(), strict=True))
            missed = self._surprises(held, over, mesh, new, reflector, measures)
            self._missed = np.concatenate([self._missed, missed])
        error = np.array([self._pairs[key] for key in keys])[sides].max(-1)
        below = mesh.level[faces] > 0
        middle = mesh.children[mesh.parent[faces[below]]] + 3
        halved = self._missed[mesh.faces[middle]].max(-1)
        error[below] = np.minimum(error[below], halved)
        return error

    def _differences(
        self,
        known: Known,
        over: Reference,
        pairs: np.ndarray,
        reflector: np.ndarray,
        measures: list[Measure],
    ) -> np.ndarray:
        out, most = np.zeros(len(pairs)), self.settings.compared
        number = reflector[pairs[:, 0]]
        for k in np.unique(number):
            rows, own = np.flatnonzero(number == k), measures[k]
            out[rows] = spatial.differences(
                known, over, int(k), pairs[rows], own.scale, own.matte, most
            )
        return out

    def _surprises(
        self,
        known: Known,
        over: Reference,
        mesh: Tessellation,
        new: np.ndarray,
        reflector: np.ndarray,
        measures: list[Measure],
    ) -> np.ndarray:
        out, most = np.zeros(len(new)), self.settings.compared
        for k in np.unique(reflector[new]):
            # Initial vertices lie between none.
            rows = np.flatnonzero((reflector[new] == k) & (new >= mesh.initial))
            if len(rows):
                mine, own = new[rows], measures[k]
                out[rows] = spatial.surprises(
                    known, over, int(k), mine, mesh.ends[mine], own.scale, own.matte, most
                )
        return out
