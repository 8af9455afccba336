"""Baked tables in files: a zarr folder that is complete or absent, with its history."""

import dataclasses
import math
import os
import shutil
import uuid
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.checks import Values
from diffopt.errors import InputError
from diffopt.io.files import one_line
from diffopt.kernels import frames, prefactor
from diffopt.lookup import Table, reflect

FORMAT = "diffopt table"
VERSION = 1
_ARRAYS = ("coefficients", "first", "step", "low", "high")
# A chunk of a few megabytes: read and written at the speed of the disc.
_CHUNK_ELEMENTS = 2**20


@dataclasses.dataclass(frozen=True)
class BakedBRDF:
    """A table read back from a file, ready to be evaluated.

    Attributes
    ----------
    table
        For use inside a caller's own jit: `diffopt.lookup.reflect`.
    record
        What was written beside it: output, wavelengths, settings, error bound, the surface.
    """

    table: Table
    record: dict[str, Any]

    def __call__(self, wi: Values, wo: Values) -> Float[Array, "*batch K"]:
        """Evaluate pairs of directions, as the `PreparedBRDF` that was saved.

        Parameters
        ----------
        wi, wo
            Unit vectors, [..., 3], broadcast together.

        Raises
        ------
        InputError
            If a direction is not of unit length or a pair lies outside the table.
        """
        return evaluate_pairs(self.table, wi, wo)


def evaluate_pairs(table: Table, wi: Values, wo: Values) -> Float[Array, "*batch K"]:
    """Check, convert and look up; outside the table an error, NaN where traced."""
    dtype = table.coefficients.dtype
    for name, value in (("wi", wi), ("wo", wo)):
        if np.shape(value)[-1:] != (3,):
            checks.directions(name, value)
    a, b = jnp.broadcast_arrays(jnp.asarray(wi, dtype), jnp.asarray(wo, dtype))
    value, wrong = _evaluate(table, a, b)
    # Checked in the same pass as the lookup: the test alone would take as long on the host.
    if np.any(checks.concrete(wrong)):
        checks.directions("wi", wi)
        checks.directions("wo", wo)
        low, high = np.asarray(table.low), np.asarray(table.high)
        ranges = ", ".join(
            f"{name} in [{a:.3g}, {b:.3g}]" for name, a, b in zip("uvw", low, high, strict=True)
        )
        raise InputError(
            f"wi, wo: pairs outside the table, which covers {ranges} of (u, v, w) = -(wi + wo); "
            "prepare with pairs= of the whole job, or with their number"
        )
    return value


@jax.jit
def _evaluate(table, wi, wo):
    """Values, and whether a direction is not of unit length or a pair outside the table."""
    value = reflect(table, wi, wo, irradiance=table.relative)
    length = jnp.stack([(v * v).sum(-1) for v in (wi, wo)])
    bent = ~jnp.all(jnp.abs(length - 1.0) <= 2e-3)
    # Not by looking for NaN in the values: that would compute them twice.
    above = (wi[..., 2] > 0) & (wo[..., 2] > 0)
    return value, bent | jnp.any(above & ~table.holds(frames.wave_vector(wi, wo)))


def save(path: str | os.PathLike, table: Table, record: dict[str, Any]) -> None:
    """Write a table as a zarr folder; an old table of that name is replaced when all is there.

    Parameters
    ----------
    path
        Folder to write; by custom it ends in ``.zarr``.
    table
        The table.
    record
        What to keep beside it; must be serialisable as JSON.

    Raises
    ------
    InputError
        If the folder around it does not exist, or something that is not a table is there.
    """
    import zarr

    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")
    if path.exists() and not (path / "zarr.json").is_file():
        raise InputError(f"{path}: exists and is not a saved table; choose another name")
    aside = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        store = zarr.open_group(aside, mode="w")
        for name in _ARRAYS:
            values = np.asarray(getattr(table, name))
            store.create_array(name, data=values, chunks=_chunks(values.shape))
        store.attrs.update(
            {
                "format": FORMAT,
                "version": VERSION,
                "axes": "coefficients over v, u, w, channel; B-splines, cubic in w",
                "order": table.order,
                "prefactor": table.prefactor,
                "shadowing": table.shadowing,
                "relative": table.relative,
                "record": record,
            }
        )
        if path.exists():
            old = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
            os.rename(path, old)
            os.rename(aside, path)
            shutil.rmtree(old, ignore_errors=True)
        else:
            os.rename(aside, path)
    except BaseException:
        shutil.rmtree(aside, ignore_errors=True)
        raise


def load_table(path: str | os.PathLike) -> BakedBRDF:
    """Read a table that `PreparedBRDF.save` wrote.

    Parameters
    ----------
    path
        The zarr folder.

    Raises
    ------
    InputError
        If there is none, it is not such a table or of a newer version, or parts of it are
        missing or damaged; float64 tables also if 64-bit types are off.
    """
    import zarr

    path = Path(path)
    if not path.is_dir():
        what = "is a file" if path.exists() else "no such folder"
        raise InputError(f"{path}: {what}; expected the folder of a saved table")
    try:
        store = zarr.open_group(path, mode="r")
        attributes: dict[str, Any] = dict(store.attrs)
    except Exception as error:
        raise InputError(f"{path}: not a saved table: {one_line(error)}") from error
    if attributes.get("format") != FORMAT:
        raise InputError(f"{path}: expected a {FORMAT}, found {attributes.get('format')!r}")
    if attributes.get("version") != VERSION:
        raise InputError(
            f"{path}: written as version {attributes.get('version')}; this program reads {VERSION}"
        )
    try:
        arrays = {}
        for name in _ARRAYS:
            item = store[name]
            if not isinstance(item, zarr.Array):
                raise InputError(f"{path}: {name} is not an array")
            if item.nchunks_initialized < item.nchunks:
                raise InputError(
                    f"{path}: {item.nchunks - item.nchunks_initialized} of {item.nchunks} chunks "
                    f"of {name} are missing: bake the table again"
                )
            arrays[name] = np.asarray(item[...])
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path}: damaged: {one_line(error)}; bake the table again") from error
    if arrays["coefficients"].dtype == np.float64 and jnp.ones(()).dtype != jnp.float64:
        raise InputError(
            f"{path}: a float64 table; enable 64-bit types (jax_enable_x64) to read it"
        )
    checks.choice(f"{path}: prefactor", attributes["prefactor"], prefactor.NAMES)
    table = Table(
        **{name: jnp.asarray(values) for name, values in arrays.items()},
        order=int(attributes["order"]),
        prefactor=attributes["prefactor"],
        shadowing=attributes["shadowing"],
        relative=bool(attributes["relative"]),
    )
    return BakedBRDF(table, attributes["record"])


def _chunks(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Whole rows, as many as make a chunk."""
    if len(shape) == 1:
        return shape
    row = math.prod(shape[1:])
    return (max(1, min(shape[0], _CHUNK_ELEMENTS // row)), *shape[1:])
