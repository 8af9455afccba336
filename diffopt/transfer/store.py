"""Precomputed transfer in a zarr folder: complete or absent, with its history.

While transfer is computed the folder holds `diffopt.transfer.working` batches, when it is finished
the group ``transfer``, chunked and compressed. Integers that count up are stored as differences.
"""

import dataclasses
import datetime
import os
import shutil
import uuid
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from diffopt import __version__
from diffopt.errors import InputError
from diffopt.io.files import one_line
from diffopt.transfer import compression, zarrays
from diffopt.transfer.compression import CompressionError, CompressionSettings, Over, Packed
from diffopt.transfer.precompute import Round, Transfer, frames
from diffopt.transfer.settings import KINDS, TransferSettings
from diffopt.transfer.slices import Slices
from diffopt.transfer.tessellation import Tessellation
from diffopt.transfer.views import hemisphere
from diffopt.transfer.working import FOLDER, Working

FORMAT = "diffopt transfer"
VERSION = 1
_GROUP = "transfer"
_MESH = ("vertices", "normals", "tangents", "ends", "faces", "label", "level", "parent", "children")
_OWN = ("reflector", "level", "first", "error")
_SLICES = ("alpha", "mu", "kappa")
_UNITS = {
    "vertices": "of the scene",
    "alpha": "1: reflected radiance over the radiance of light that is the same from everywhere",
    "kappa": "1",
    "mu": "unit vectors in the local frames",
    "seconds": "s",
}
# Frames are made of the mesh again if that gives them to this, in radians.
_SAME_FRAME = 1e-5
# Frames that are kept to tell whether they still are made in the same way.
_WITNESSES = 16


def state(path: str | os.PathLike) -> str:
    """What a path is: "absent", "begun" or "finished".

    Raises
    ------
    InputError
        If it is something else than a store of transfer, of a newer version, or its folder
        does not exist.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")
    if not path.exists():
        return "absent"
    if not (path / "zarr.json").is_file():
        raise InputError(f"{path}: exists and is not a store of transfer; choose another name")
    _checked(path)
    return "finished" if (path / _GROUP / "zarr.json").is_file() else "begun"


def begin(path: str | os.PathLike) -> Path:
    """Make the folder of a store, if there is none; errors as for `state`."""
    import zarr

    path = Path(path)
    if state(path) == "absent":
        aside = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
        try:
            zarr.open_group(aside, mode="w").attrs.update({"format": FORMAT, "version": VERSION})
            os.rename(aside, path)
        except BaseException:
            shutil.rmtree(aside, ignore_errors=True)
            raise
    return path


def save(
    path: str | os.PathLike,
    transfer: Transfer,
    record: dict[str, Any] | None = None,
    settings: CompressionSettings | None = None,
) -> dict[str, Any]:
    """Write finished transfer; an older one there is replaced when all is written.

    Parameters
    ----------
    path
        Folder; by custom it ends in ``.zarr``.
    transfer
        Computed.
    record
        To be kept beside it, of what JSON has.
    settings
        Of the compression; by default those of `CompressionSettings`. With a tolerance the
        normals and tangents of the mesh are kept in float32.

    Returns
    -------
    dict
        All that is recorded, as `record_of` gives it.

    Raises
    ------
    InputError
        As for `state`, or if the slices do not belong to the vertices.
    """
    import zarr

    settings = settings or CompressionSettings()
    path = begin(path)
    for old in path.glob(f".{_GROUP}.*"):  # of a process that was killed in writing
        shutil.rmtree(old, ignore_errors=True)
    aside = path / f".{_GROUP}.{uuid.uuid4().hex}"
    try:
        group = zarr.open_group(aside, mode="w")
        scales, errors = _write_slices(group, transfer, settings)
        alone = _write_rest(group, transfer, bool(settings.tolerance))
        content = {
            "diffopt": __version__,
            "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "units": _UNITS,
            "paths": list(KINDS),
            "vertices": {"initial": transfer.rounds[0].vertices, "final": len(transfer.axes)},
            "slices": transfer.slices,
            "settings": dataclasses.asdict(transfer.settings),
            "rounds": [dataclasses.asdict(one) for one in transfer.rounds],
            "compression": dataclasses.asdict(settings) | {"errors": errors},
            **(record or {}),
        }
        layout = {
            "lobes": transfer.lobes,
            "channels": transfer.channels,
            "initial": transfer.mesh.initial,
            "frames": "stored" if alone else "of the mesh",
            "scales": scales,
            "slices": len(transfer.views.kappa),
        }
        group.attrs.update({"layout": layout, "record": content})
        target = path / _GROUP
        if target.exists():
            os.rename(target, path / f".{_GROUP}.{uuid.uuid4().hex}")
        os.rename(aside, target)
    except BaseException:
        shutil.rmtree(aside, ignore_errors=True)
        raise
    for old in path.glob(f".{_GROUP}.*"):
        shutil.rmtree(old, ignore_errors=True)
    return content


def finish(
    working: Working,
    transfer: Transfer,
    record: dict[str, Any] | None = None,
    settings: CompressionSettings | None = None,
) -> dict[str, Any]:
    """Write what a run computed, as `save` does, and remove its batches."""
    clock, cpu = working.spent
    whole = {"identity": working.identity, "seconds": clock, "core_seconds": cpu, **(record or {})}
    content = save(working.path, transfer, whole, settings)
    working.discard()
    return content


def load(path: str | os.PathLike) -> Transfer:
    """Read finished transfer.

    Raises
    ------
    InputError
        If there is none, it is not finished, something else or of a newer version, or parts of
        it are missing or damaged.
    """
    path = Path(path)
    group = _finished(path)
    try:
        layout, record = group.attrs["layout"], group.attrs["record"]
        arrays = zarrays.read(group, path)
        return _made(arrays, layout, record)
    except InputError as error:
        text = str(error)
        named = text if text.startswith(str(path)) else f"{path}: damaged: {text}"
        raise InputError(f"{named}; precompute it again") from error
    except Exception as error:
        raise InputError(f"{path}: damaged: {one_line(error)}; precompute it again") from error


def record_of(path: str | os.PathLike) -> dict[str, Any]:
    """What is recorded beside finished transfer: history, settings, times, error; see `load`."""
    path = Path(path)
    record = _finished(path).attrs.get("record")
    if not isinstance(record, dict):
        raise InputError(f"{path}: damaged: no record; precompute it again")
    return record


def size(path: str | os.PathLike) -> int:
    """Bytes of finished transfer with all that belongs to it."""
    files = (Path(path) / _GROUP).rglob("*")
    return sum(file.stat().st_size for file in files if file.is_file())


def _checked(path: Path) -> Any:
    """The zarr group of a store."""
    import zarr

    if not path.is_dir():
        what = "is a file" if path.exists() else "no such folder"
        raise InputError(f"{path}: {what}; expected the folder of a store of transfer")
    try:
        root = zarr.open_group(path, mode="r")
        attributes: dict[str, Any] = dict(root.attrs)
    except Exception as error:
        raise InputError(f"{path}: not a store of transfer: {one_line(error)}") from error
    if attributes.get("format") != FORMAT:
        raise InputError(
            f"{path}: expected a store of {FORMAT}, found {attributes.get('format')!r}"
        )
    if attributes.get("version") != VERSION:
        raise InputError(
            f"{path}: written as version {attributes.get('version')}; this program reads {VERSION}"
        )
    return root


def _finished(path: Path) -> Any:
    root = _checked(path)
    if not (path / _GROUP / "zarr.json").is_file():
        begun = (path / FOLDER).is_dir()
        raise InputError(
            f"{path}: {'begun, but not finished' if begun else 'holds no transfer'}: precompute it "
            + ("to its end" if begun else "again")
        )
    try:
        return root[_GROUP]
    except Exception as error:
        raise InputError(f"{path}: damaged: {one_line(error)}; precompute it again") from error


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
    return Over(flat[..., 4:], flat[..., 3], np.ones(len(flat)), place)


def _scaled(over: Over, scales: list[float]) -> Over:
    return over._replace(scale=np.repeat(scales, len(over.alpha) // len(scales)))


def _write_slices(
    group: Any, transfer: Transfer, settings: CompressionSettings
) -> tuple[dict[str, list[float]], dict[str, Any]]:
    """Slices; gives the norms of mean ones by material, and the errors."""
    finest, material = transfer.settings.finest, transfer.reflector
    views = _order(transfer.level, transfer.first, finest, len(transfer.views.kappa))
    scales: dict[str, list[float]] = {}
    errors: dict[str, Any] = {}
    zarrays.write(group, "unoccluded", transfer.unoccluded)
    for name, found, order, table in (
        ("views", transfer.views, views, transfer.unoccluded),
        ("diffuse", transfer.diffuse, _flat(transfer.level), None),
    ):
        if not settings.tolerance:
            for part, values in zip(_SLICES, found, strict=True):
                zarrays.write(group, f"{name}_{part}", np.asarray(values))
            errors[name] = dataclasses.asdict(CompressionError(0.0, 0.0, 0.0))
            continue
        sorted_ = Slices(*(np.asarray(a)[order.rows] for a in found))
        over = _over(table, transfer.lobes, transfer.channels, finest, order, material)
        own = material[order.vertex]
        number = len(over.alpha) // (1 if table is None else hemisphere(finest).counts[finest])
        scales[name] = [compression.mean_norm(sorted_, over, own == k) for k in range(number)]
        stored, error = compression.packed(
            sorted_, _scaled(over, scales[name]), order.groups, settings
        )
        zarrays.write(group, f"{name}_rows", stored.rows, attributes={"step": stored.step})
        if stored.index is not None:
            zarrays.write(group, f"{name}_index", stored.index)
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


def _made(arrays: dict[str, np.ndarray], layout: dict[str, Any], record: Any) -> Transfer:
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
            return Slices(*(arrays[f"{name}_{part}"] for part in _SLICES))
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
        return Slices(*(a[place] for a in found))

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
