"""Precomputed transfer in a zarr folder: complete or absent, with its history.

While transfer is computed the folder holds `diffopt.transfer.working` batches, when it is finished
the group ``transfer``, chunked and compressed, see `diffopt.transfer.packing`.
"""

import contextlib
import dataclasses
import datetime
import os
from pathlib import Path
from typing import Any

from diffopt import __version__
from diffopt.errors import InputError
from diffopt.io import zarr_files
from diffopt.io.files import aside, one_line, remove, replaced, settle, standing, swap, sweep
from diffopt.locking import Lock
from diffopt.transfer import packing, zarrays
from diffopt.transfer.compression import CompressionSettings
from diffopt.transfer.result import Transfer
from diffopt.transfer.settings import KINDS
from diffopt.transfer.working import FOLDER, Working, discard

FORMAT = "diffopt transfer"
VERSION = 1
_GROUP = "transfer"
_LOCK = f".{_GROUP}.lock"
_UNITS = {
    "vertices": "of the scene",
    "alpha": "1: reflected radiance over the radiance of light that is the same from everywhere",
    "kappa": "1",
    "mu": "unit vectors in the local frames",
    "seconds": "s",
}


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
    return "finished" if (standing(path / _GROUP) / "zarr.json").is_file() else "begun"


def begin(path: str | os.PathLike) -> Path:
    """Make the folder of a store, if there is none; errors as for `state`."""
    import zarr

    path = Path(path)
    if state(path) == "absent":
        new = aside(path)
        try:
            zarr.open_group(new, mode="w").attrs.update({"format": FORMAT, "version": VERSION})
            os.rename(new, path)
        except BaseException as error:
            remove(new)
            # Another process may have made it meanwhile.
            if not isinstance(error, OSError) or state(path) == "absent":
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
    with Lock(path / _LOCK, path):
        target, new = path / _GROUP, aside(path / _GROUP)
        try:
            group = zarr.open_group(new, mode="w")
            layout, errors = packing.write(group, transfer, settings)
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
            group.attrs.update({"layout": layout, "record": content})
            swap(new, target)
        except BaseException:
            remove(new)
            raise
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
    settle(working.path / _GROUP)  # or a loss of power would take both
    working.discard()
    return content


def tidy(path: str | os.PathLike, identity: dict[str, Any]) -> None:
    """Remove from a finished store what a process killed at its very end left there.

    Parameters
    ----------
    path
        Of the store.
    identity
        What it was computed for: batches of something else stay, as those of a process at work.
    """
    path = Path(path)
    target = path / _GROUP
    # What cannot be removed, as on a disk that is read-only, harms nobody.
    with contextlib.suppress(InputError, OSError), Lock(path / _LOCK, path):
        if target.exists():
            remove(replaced(target))
        discard(path, identity)
        sweep(path)


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
        return packing.made(arrays, layout, record)
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
    files = standing(Path(path) / _GROUP).rglob("*")
    return sum(file.stat().st_size for file in files if file.is_file())


def _checked(path: Path) -> Any:
    """The zarr group of a store."""
    if not path.is_dir():
        what = "is a file" if path.exists() else "no such folder"
        raise InputError(f"{path}: {what}; expected the folder of a store of transfer")
    try:
        root = zarr_files.opened(path)
        attributes: dict[str, Any] = dict(root.attrs)
    except InputError:
        raise
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
    _checked(path)
    folder = standing(path / _GROUP)
    if not (folder / "zarr.json").is_file():
        begun = (path / FOLDER).is_dir()
        raise InputError(
            f"{path}: {'begun, but not finished' if begun else 'holds no transfer'}: precompute it "
            + ("to its end" if begun else "again")
        )
    try:
        return zarr_files.opened(folder)
    except Exception as error:
        raise InputError(f"{path}: damaged: {one_line(error)}; precompute it again") from error
