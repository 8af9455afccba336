"""Baked tables in files: a zarr folder that is complete or absent, with its history."""

import dataclasses
import math
import os
from pathlib import Path
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.checks import Values
from diffopt.errors import InputError
from diffopt.io import zarr_files
from diffopt.io.files import aside, one_line, remove, standing, swap
from diffopt.kernels import frames, prefactor
from diffopt.lookup import Table, reflect
from diffopt.scalar import Shadowing

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
    new = aside(path)
    try:
        store = zarr.open_group(new, mode="w")
        for name in _ARRAYS:
            values = np.asarray(getattr(table, name))
            # Zeros as well: a chunk that is not there is one that was lost.
            store.create_array(
                name,
                data=values,
                chunks=_chunks(values.shape),
                config={"write_empty_chunks": True},
            )
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
        swap(new, path)
    except BaseException:
        remove(new)
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

    path = standing(Path(path))
    if not path.is_dir():
        what = "is a file" if path.exists() else "no such folder"
        raise InputError(f"{path}: {what}; expected the folder of a saved table")
    try:
        store = zarr_files.opened(path)
        attributes: dict[str, Any] = dict(store.attrs)
    except InputError:
        raise
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
            arrays[name] = zarr_files.read(path, item)
        settings = _settings(attributes)
        record = attributes["record"]
        _fitting(arrays, settings)
    except InputError as error:
        text = str(error).removeprefix(f"{path}: ")
        raise InputError(f"{path}: {text}: bake the table again") from error
    except Exception as error:
        raise InputError(f"{path}: damaged: {one_line(error)}; bake the table again") from error
    if arrays["coefficients"].dtype == np.float64 and jnp.ones(()).dtype != jnp.float64:
        raise InputError(
            f"{path}: a float64 table; enable 64-bit types (jax_enable_x64) to read it"
        )
    table = Table(**{name: jnp.asarray(values) for name, values in arrays.items()}, **settings)
    return BakedBRDF(table, record)


def _settings(attributes: dict[str, Any]) -> dict[str, Any]:
    """Static fields of a table, each of its kind."""
    found = {name: attributes[name] for name in ("order", "prefactor", "shadowing", "relative")}
    checks.choice("prefactor", found["prefactor"], prefactor.NAMES)
    checks.choice("shadowing", found["shadowing"], get_args(Shadowing))
    if type(found["order"]) is not int or not 1 <= found["order"] <= 3:
        raise InputError(f"order must be 1, 2 or 3; received {found['order']!r}")
    if type(found["relative"]) is not bool:
        raise InputError(f"relative must be true or false; received {found['relative']!r}")
    return found


def _fitting(arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> None:
    """Refuse arrays that are no table of B-splines."""
    kind = arrays["coefficients"].dtype
    if any(values.dtype != kind for values in arrays.values()) or kind.kind != "f":
        raise InputError("its arrays are of different types; expected one of real numbers")
    shape = arrays["coefficients"].shape
    if len(shape) != 4 or 0 in shape:
        raise InputError(f"coefficients have the shape {shape}; expected [V, U, W, K]")
    for name in _ARRAYS[1:]:
        if arrays[name].shape != (3,) or not np.isfinite(arrays[name]).all():
            raise InputError(f"{name} must be three finite numbers")
    if not (arrays["step"] > 0.0).all():
        raise InputError(f"step must be above 0; received {arrays['step'].min():g}")


def _chunks(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Whole rows, as many as make a chunk."""
    if len(shape) == 1:
        return shape
    row = math.prod(shape[1:])
    return (max(1, min(shape[0], _CHUNK_ELEMENTS // row)), *shape[1:])
