"""Transfer as the arrays of a zarr group, and back.

Slices stand view after view, in the order of the vertices, whether compressed or not as
`diffopt.transfer.compression` has them; local frames are made of the mesh again, and a few are kept
to tell whether they still are what they were.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from diffopt.errors import InputError
from diffopt.transfer import compression, quantisation, zarrays
from diffopt.transfer.beginning import frames
from diffopt.transfer.compression import CompressionError, CompressionSettings, Packed
from diffopt.transfer.quantisation import Over, host
from diffopt.transfer.result import Round, Transfer
from diffopt.transfer.settings import TransferSettings
from diffopt.transfer.slices import Slices
from diffopt.transfer.tessellation import Tessellation
from diffopt.transfer.views import hemisphere

_MESH = ("vertices", "normals", "tangents", "ends", "faces", "label", "level", "parent", "children")
_OWN = ("reflector", "level", "first", "error")
_SLICES = ("alpha", "mu", "kappa")
# Frames are made of the mesh again if that gives them to this, in radians.
_SAME_FRAME = 1e-5
# Frames that are kept to tell whether they still are made in the same way.
_WITNESSES = 16


def write(
    group: Any, transfer: Transfer, settings: CompressionSettings
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Write all arrays; gives what `made` needs besides, and the errors of the slices.

    Raises
    ------
    InputError
        If the slices do not belong to the vertices.
    """
    scales, errors = _write_slices(group, transfer, settings)
    alone = _write_rest(group, transfer, bool(settings.tolerance))
    layout = {
        "lobes": transfer.lobes,
        "channels": transfer.channels,
        "slices": len(transfer.views.kappa),
        "initial": transfer.mesh.initial,
        "frames": "stored" if alone else "of the mesh",
        "scales": scales,
    }
    return layout, errors


class _Order(NamedTuple):
    """Slices from view to view.

    Attributes
    ----------
    rows
        Of the slices of the transfer, [S].
    vertex, view
        Whose they are, [S].
    groups
        How many each view has.
    """

    rows: Int[np.ndarray, " S"]
    vertex: Int[np.ndarray, " S"]
    view: Int[np.ndarray, " S"]
    groups: Int[np.ndarray, " n"]


def _order(
    level: Int[np.ndarray, " V"], first: Int[np.ndarray, " V"], finest: int, count: int
) -> _Order:
    counts = np.array((*hemisphere(finest).counts, 0))
    if level.min(initial=0) < -1 or level.max(initial=0) > finest:
        raise InputError(f"levels must be -1 to {finest}")
    length = counts[level]
    if length.sum() != count:
        raise InputError(f"expected {length.sum()} slices; received {count}")
    owner = np.repeat(np.arange(len(level)), length)
    view = np.arange(count) - np.repeat(np.cumsum(length) - length, length)
    order = np.argsort(view, kind="stable")
    rows = (first[owner] + view)[order]
    used = np.zeros(count, bool)
    if count and (rows.min() < 0 or rows.max() >= count):
        raise InputError("first rows of vertices lie outside of the slices")
    used[rows] = True
    if not used.all():
        raise InputError("vertices do not have the slices between them, each once")
    return _Order(rows, owner[order], view[order], np.bincount(view))


def _flat(level: Int[np.ndarray, " V"]) -> _Order:
    """Of slices that serve all views."""
    every = np.arange(len(level))
    return _Order(every, every, np.zeros(len(level), np.int64), np.array([len(level)]))


def _over(
    unoccluded: Float[np.ndarray, "m v F"] | None,
    lobes: int,
    channels: int,
    finest: int,
    order: _Order,
    material: Int[np.ndarray, " V"],
) -> Over:
    """What slices are relative to; None: to nothing, as view-independent ones."""
    number = int(material.max(initial=0)) + 1
    if unoccluded is None:
        rows, views = np.zeros((number, 1, lobes, 4 + channels), np.float32), 1
        rows[..., 4:] = 1.0
    else:
        views = hemisphere(finest).counts[finest]
        # Beyond the level of the references only steps depend on them: the nearest will do.
        last = hemisphere(finest).ends
        near = np.arange(views)
        while (near >= unoccluded.shape[1]).any():
            near = np.where(near >= unoccluded.shape[1], last[near, 0], near)
        rows = unoccluded[:, near].reshape(len(unoccluded), views, lobes, 4 + channels)
    flat = rows.reshape(-1, *rows.shape[2:])
    place = material[order.vertex].astype(np.int64) * views + order.view
    return Over(flat[..., 4:], flat[..., 3], np.ones((len(flat), 2)), place)


def _scaled(over: Over, scales: Any) -> Over:
    return over._replace(scale=np.repeat(np.array(scales), len(over.alpha) // len(scales), axis=0))


def _write_slices(
    group: Any, transfer: Transfer, settings: CompressionSettings
) -> tuple[dict[str, list[tuple[float, float]]], dict[str, Any]]:
    """Slices; gives norms and weights of mean ones by material, and the errors."""
    finest, material = transfer.settings.finest, transfer.reflector
    views = _order(transfer.level, transfer.first, finest, len(transfer.views.kappa))
    scales: dict[str, list[tuple[float, float]]] = {}
    errors: dict[str, Any] = {}
    zarrays.write(group, "unoccluded", transfer.unoccluded)
    for name, found, order, table in (
        ("views", transfer.views, views, transfer.unoccluded),
        ("diffuse", transfer.diffuse, _flat(transfer.level), None),
    ):
        if not settings.tolerance:
            for part, values in zip(_SLICES, found, strict=True):
                zarrays.write(group, f"{name}_{part}", np.asarray(values))
            errors[name] = dataclasses.asdict(CompressionError(0.0, 0.0, 0.0, 0.0))
            continue
        sorted_ = host(*(np.asarray(a)[order.rows] for a in found))
        over = _over(table, transfer.lobes, transfer.channels, finest, order, material)
        own = material[order.vertex]
        number = len(over.alpha) // (1 if table is None else hemisphere(finest).counts[finest])
        scales[name] = [quantisation.means(sorted_, over, own == k) for k in range(number)]
        stored, error = compression.packed(
            sorted_, _scaled(over, scales[name]), order.groups, settings
        )
        zarrays.write(group, f"{name}_rows", stored.rows, attributes={"step": stored.step})
        if stored.places is not None:
            zarrays.write(group, f"{name}_index", stored.places)
        errors[name] = dataclasses.asdict(error)
    return scales, errors


def _write_rest(group: Any, transfer: Transfer, narrow: bool) -> bool:
    """Mesh and what each vertex has; whether frames had to be stored."""
    mesh = {name: getattr(transfer.mesh, name) for name in _MESH}
    own = {name: getattr(transfer, name) for name in _OWN}
    if narrow:
        mesh |= {name: mesh[name].astype(np.float32) for name in ("normals", "tangents")}
        own["error"] = own["error"].astype(np.float32)
    for prefix, arrays in (("mesh", mesh), ("vertex", own)):
        for name, values in arrays.items():
            zarrays.write(group, f"{prefix}_{name}", values, differences=values.dtype.kind == "i")
    again = frames(_widened(Tessellation(**mesh, initial=transfer.mesh.initial)))
    close = _SAME_FRAME if narrow else 0.0
    alone = not np.abs(again - transfer.axes).max(initial=0.0) <= close
    some = slice(None) if alone else slice(None, _WITNESSES)
    zarrays.write(group, "axes", transfer.axes[some])
    return alone


def _widened(mesh: Tessellation) -> Tessellation:
    wide = {name: getattr(mesh, name).astype(np.float64) for name in ("normals", "tangents")}
    return dataclasses.replace(mesh, **wide)


def made(arrays: dict[str, np.ndarray], layout: dict[str, Any], record: dict[str, Any]) -> Transfer:
    """Transfer of what `write` wrote.

    Raises
    ------
    InputError
        If arrays do not fit together.
    """
    mesh = _widened(
        Tessellation(
            **{name: arrays[f"mesh_{name}"] for name in _MESH}, initial=int(layout["initial"])
        )
    )
    own = {name: arrays[f"vertex_{name}"] for name in _OWN}
    count = len(mesh.vertices)
    if any(len(values) != count for values in own.values()):
        raise InputError(f"numbers of vertices differ from {count}")
    if mesh.faces.size and not 0 <= mesh.faces.min() <= mesh.faces.max() < count:
        raise InputError("faces name vertices that do not exist")
    axes = arrays["axes"]
    if layout["frames"] != "stored":
        kept, axes = axes, frames(mesh)
        if not np.abs(axes[: len(kept)] - kept).max(initial=0.0) <= 10.0 * _SAME_FRAME:
            raise InputError("its local frames are not made as this version makes them")
    settings = TransferSettings(**record["settings"])
    lobes, channels = int(layout["lobes"]), int(layout["channels"])
    material, unoccluded = own["reflector"], arrays["unoccluded"]
    if unoccluded.shape[2:] != (lobes * (4 + channels),):
        raise InputError(f"unoccluded lobes have another shape: {unoccluded.shape}")
    if material.min(initial=0) < 0 or material.max(initial=0) >= len(unoccluded):
        raise InputError("vertices have materials that do not exist")

    def slices(name: str, table: np.ndarray | None) -> Slices:
        if name not in layout["scales"]:
            return host(*(arrays[f"{name}_{part}"] for part in _SLICES))
        size = int(layout["slices"])
        finest = settings.finest
        order = (
            _flat(own["level"])
            if table is None
            else _order(own["level"], own["first"], finest, size)
        )
        over = _over(table, lobes, channels, finest, order, material)
        rows, step = arrays[f"{name}_rows"], arrays[f"{name}_rows.step"].item()
        stored = Packed(rows, arrays.get(f"{name}_index"), step)
        found = compression.unpacked(stored, _scaled(over, layout["scales"][name]), order.groups)
        place = np.empty(len(order.rows), np.int64)
        place[order.rows] = np.arange(len(place))
        return host(*(a[place] for a in found))

    views, diffuse = slices("views", unoccluded), slices("diffuse", None)
    _order(own["level"], own["first"], settings.finest, len(views.kappa))
    for found, size in ((views, len(views.kappa)), (diffuse, count)):
        shapes = ((size, 3, lobes, channels), (size, 3, lobes, 3), (size, 3, lobes))
        if tuple(a.shape for a in found) != shapes:
            raise InputError("slices have other shapes than vertices and views ask for")
    return Transfer(
        mesh=mesh,
        axes=axes,
        reflector=material,
        level=own["level"],
        first=own["first"],
        views=views,
        diffuse=diffuse,
        unoccluded=unoccluded,
        error=own["error"].astype(np.float64),
        settings=settings,
        rounds=tuple(Round(**one) for one in record["rounds"]),
    )
