"""Textures, maps, lobes and measured materials from files, which remember where they are from."""

import os
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffopt.errors import InputError
from diffopt.io import environments
from diffopt.lobes import Lobes
from diffopt.materials import naming
from diffopt.materials.base import Material
from diffopt.scenes.lights import Environment, LobeEnvironment
from diffopt.scenes.origins import remember
from diffopt.scenes.textures import Texture

#: How the values of a picture are stored.
SPACES = ("srgb", "linear")

# Pixels of one square of a pattern of checks: between pixels the texture is interpolated.
_SQUARE = 128


def load_texture(
    path: str | os.PathLike, *, repeat: tuple[float, float] = (1.0, 1.0), space: str = "srgb"
) -> Texture:
    """Read a picture as a texture.

    Parameters
    ----------
    path
        ``.png``; ``.exr``, ``.hdr`` and ``.npy`` [H, W] or [H, W, C] hold linear values.
    repeat
        How often it lies along u and v.
    space
        ``"srgb"`` or ``"linear"``: what the values of a ``.png`` are.

    Raises
    ------
    InputError
        If the file cannot be read or a value is not finite.
    """
    path = Path(path)
    if space not in SPACES:
        raise InputError(f"space must be one of {', '.join(SPACES)}; received {space!r}")
    if path.suffix.lower() == ".png" and space == "linear" and path.is_file():
        pixels = environments.codes(path)
    else:
        pixels = environments.read(path)
    if not np.isfinite(pixels).all():
        raise InputError(f"{path}: pixels of a texture must be finite")
    texture = Texture(jnp.asarray(pixels, jnp.result_type(float)), repeat)
    remember(texture.pixels, file=os.path.abspath(path), space=space)
    return texture


def load_material(path: str | os.PathLike) -> Material:
    """Read a measured material, see `diffopt.materials.naming.load`.

    Raises
    ------
    InputError
        For a file that is not there, or whose suffix or content is not known.
    """
    return remember(naming.load(Path(path)).material, file=os.path.abspath(path))


def load_lobes(path: str | os.PathLike) -> LobeEnvironment:
    """Read the light of lobes that ``diffopt fit lobes`` wrote (``.json``, ``.npz``).

    Raises
    ------
    InputError
        If the file cannot be read, or its lobes are several sums or negative.
    """
    light = LobeEnvironment(Lobes.load(path))
    remember(light.lobes, file=os.path.abspath(path))
    return light


def checkerboard(
    first: Any = 0.8, second: Any = 0.2, *, repeat: tuple[float, float] = (1.0, 1.0)
) -> Texture:
    """Pattern of checks: two by two squares in two colours, repeated.

    Parameters
    ----------
    first, second
        Numbers, or channels [C].
    repeat
        How often the pattern lies along u and v.
    """
    one, other = np.broadcast_arrays(np.asarray(first, float), np.asarray(second, float))
    side = np.arange(2 * _SQUARE) // _SQUARE
    board = side[:, None] + side[None, :]
    even = (board % 2 == 0).reshape(board.shape + (1,) * one.ndim)
    texture = Texture(jnp.asarray(np.where(even, one, other), jnp.result_type(float)), repeat)
    remember(texture.pixels, checks=[one.tolist(), other.tolist()])
    return texture


def load_environment(
    path: str | os.PathLike, *, scale: Any = 1.0, turn: float = 0.0, up: str = "z"
) -> tuple[Environment, tuple[str, ...]]:
    """Read an environment map.

    Parameters
    ----------
    path
        ``.exr``, ``.hdr``, ``.png`` or ``.npy``, see `diffopt.io.environments`.
    scale, turn, up
        As of `Environment`.

    Returns
    -------
    tuple
        The light, and what was assumed about the file.

    Raises
    ------
    InputError
        If the file cannot be read or used.
    """
    path = Path(path)
    image, notes = environments.checked(path, environments.read(path))
    radiance = jnp.asarray(image, jnp.result_type(float))
    light = Environment(radiance, scale, turn, up)
    remember(light.radiance, file=os.path.abspath(path))
    return light, notes
