"""Batches over several devices: the same code on one of them.

`spread` puts a batch on the devices, each a share of its members. What the toolkit evaluates for
such a batch runs on all of them, each device the program of its share: loops over chunks stay
within a device, and nothing of the batch is sent to another one. Left to itself the compiler
gathers the whole batch on every device before such a loop.

Inside a caller's own jit the placement of a value is not known: there `each` is put around what
is to run on every device.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

from diffopt.errors import InputError

#: Name of the axis of devices.
AXIS = "batch"


def mesh(devices: Sequence[Any] | None = None) -> Mesh:
    """Devices in a row, all local ones if not given."""
    found = jax.local_devices() if devices is None else list(devices)
    if not found:
        raise InputError("devices: expected at least one; received none")
    return Mesh(np.array(found), (AXIS,))


def some(count: int) -> Mesh:
    """The first local devices.

    Raises
    ------
    InputError
        If there are fewer.
    """
    found = jax.local_devices()
    if not 1 <= count <= len(found):
        raise InputError(f"devices must be 1 to {len(found)}, as there are here; received {count}")
    return mesh(found[:count])


def spread(batch: PyTree, axis: int = 0, devices: Sequence[Any] | None = None) -> PyTree:
    """Put a batch on devices, each the same number of its members.

    Parameters
    ----------
    batch
        Array, or several of the same length along the axis (a tree); numbers of JAX or NumPy.
    axis
        Of the members: that of pairs of directions, wavelengths, vertices, functions, starts.
    devices
        All local ones by default; with one, everything is as without `spread`.

    Returns
    -------
    PyTree
        The same arrays, sharded.

    Raises
    ------
    InputError
        If a length is no multiple of the number of devices: see `in_batches`, which fills up.
    """
    over = mesh(devices)

    def placed(array: Any) -> Any:
        array = array if isinstance(array, jax.Array) else np.asarray(array)
        if not -array.ndim <= axis < array.ndim:
            raise InputError(f"axis {axis}: the array has the shape {array.shape}")
        length = array.shape[axis]
        if length % over.size:
            raise InputError(
                f"axis {axis} has {length} members: expected a multiple of {over.size}, the number "
                f"of devices, as {max(1, length // over.size) * over.size} or "
                f"{-(-length // over.size) * over.size}; diffopt.in_batches takes any number"
            )
        return jax.device_put(array, NamedSharding(over, _spec(axis % array.ndim, AXIS)))

    return jax.tree.map(placed, batch)


def in_batches(
    function: Callable[..., PyTree],
    *batches: PyTree,
    size: int,
    devices: Sequence[Any] | None = None,
) -> PyTree:
    """Evaluate a function over a long batch, part by part on the devices; the result on the host.

    All parts have one shape, so that one program serves them: the last is filled up with its
    last member, and what comes of that is left out.

    Parameters
    ----------
    function
        Of parts of the batches, whose first axis its results have too. Members do not depend on
        each other.
    batches
        Arrays (or trees of them) with one length of their first axes.
    size
        Members on each device at a time.
    devices
        All local ones by default.

    Returns
    -------
    PyTree
        NumPy arrays.

    Raises
    ------
    InputError
        If the lengths differ, there are no members, or the size is below 1.
    """
    lengths = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(batches)}
    if len(lengths) != 1 or lengths & {(), (0,)}:
        shown = ", ".join(str(one) for one in sorted(lengths)) or "none"
        raise InputError(f"batches must have one length of their first axes; received {shown}")
    if size < 1:
        raise InputError(f"size must be 1 or more; received {size}")
    ((count,),) = lengths
    step = size * mesh(devices).size
    found = []
    for start in range(0, count, step):
        some = jax.tree.map(lambda a, k=start: _filled(np.asarray(a[k : k + step]), step), batches)
        value = function(*spread(some, 0, devices))
        found.append(jax.tree.map(np.asarray, value))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *found)


def each(
    function: Callable[..., PyTree],
    *,
    axes: Sequence[int | None],
    out: int = 0,
    devices: Sequence[Any] | None = None,
) -> Callable[..., PyTree]:
    """A function that every device evaluates for its share; for use inside a caller's own jit.

    Parameters
    ----------
    function
        Its members do not depend on each other.
    axes
        Of the members in each argument; None for what all devices need.
    out
        Of the members in the results.
    devices
        All local ones by default.

    Returns
    -------
    Callable
        Of the same arguments; lengths must be multiples of the number of devices.
    """
    over = mesh(devices)

    def whole(*arguments: Any) -> PyTree:
        return run(function, arguments, axes, out, over)

    return functools.wraps(function)(whole) if hasattr(function, "__name__") else whole


def placement(value: Any) -> tuple[Mesh, int] | None:
    """Devices of an array and the axis that is spread over them; None if it is on one device.

    None for values that are traced, and for placements of another kind: those are left to JAX.
    """
    if not isinstance(value, jax.Array) or isinstance(value, jax.core.Tracer):
        return None
    sharding = value.sharding
    if not isinstance(sharding, NamedSharding) or sharding.mesh.size == 1:
        return None
    found = [k for k, name in enumerate(sharding.spec) if name is not None]
    if len(found) != 1 or len(sharding.mesh.axis_names) != 1:
        return None
    over = sharding.mesh
    return (over, found[0]) if isinstance(over, Mesh) else None


def like(given: Any, array: jax.Array) -> jax.Array:
    """An array where one of its shape that was given is spread, if that is."""
    if placement(given) is None or np.shape(given) != array.shape:
        return array
    return jax.device_put(array, given.sharding)


def common(*values: Any) -> Mesh | None:
    """Devices over which some of the arrays are spread; None for none.

    Raises
    ------
    InputError
        If they are spread over different ones.
    """
    found = {place[0] for value in values if (place := placement(value)) is not None}
    if len(found) > 1:
        raise InputError("arrays spread over different devices: spread them over the same")
    return found.pop() if found else None


def run(
    function: Callable[..., PyTree],
    arguments: Sequence[PyTree],
    axes: Sequence[int | None],
    out: int | None,
    over: Mesh,
) -> PyTree:
    """Evaluate a function, every device its share; arguments as for `each`.

    Parameters
    ----------
    function
        It is compiled once for each identity: a function of a module.
    arguments
        Arrays, modules, or anything static.
    axes, out
        As for `each`; `out` None for results that are the same on all devices.
    over
        Devices.
    """
    return _run(function, tuple(arguments), tuple(axes), out, over)


def _spec(axis: int | None, name: str) -> PartitionSpec:
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, name)


@eqx.filter_jit
def _run(function: Any, arguments: Any, axes: Any, out: int | None, over: Mesh) -> Any:
    arrays, static = eqx.partition(arguments, eqx.is_array)
    (name,) = over.axis_names
    places = tuple(_spec(axis, name) for axis in axes)

    def local(*arrays: Any) -> Any:
        return function(*eqx.combine(arrays, static))

    # Loops begin with constants, which the check of what varies takes for another type.
    return jax.shard_map(
        local, mesh=over, in_specs=places, out_specs=_spec(out, name), check_vma=False
    )(*arrays)


def _filled(array: np.ndarray, length: int) -> np.ndarray:
    short = length - len(array)
    return np.concatenate([array, np.repeat(array[-1:], short, axis=0)]) if short else array


def filled(batch: PyTree, count: int) -> PyTree:
    """A batch with its last member repeated up to so many."""

    def one(array: Any) -> Any:
        spare = count - array.shape[0]
        if not spare:
            return array
        return jnp.concatenate([array, jnp.broadcast_to(array[-1:], (spare, *array.shape[1:]))])

    return jax.tree.map(one, batch)
