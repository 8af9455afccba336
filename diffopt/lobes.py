"""Functions on the sphere as sums of von Mises-Fisher lobes: what a fit returns.

    T(s) = sum_j alpha_j gamma(s; mu_j, kappa_j),    integral of gamma over the sphere = 1

The domain is the whole sphere: of a lobe of concentration 3 along the normal, 4.7 % lie below
the horizon.
"""

import json
import os
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from diffopt import checks
from diffopt.errors import InputError
from diffopt.io import limits, numpy_files
from diffopt.io.files import existing_file, replacing
from diffopt.kernels import vmf, vmf_pairs, vmf_sampling

_FIELDS = ("alpha", "mu", "kappa")


class Lobes(eqx.Module):
    """A sum of lobes, or a batch of them.

    Parameters
    ----------
    alpha
        Integral of each lobe over the sphere, in the unit of the function times steradian,
        [..., K] or with colour channels [..., K, C].
    mu
        Axes, unit vectors, [..., K, 3].
    kappa
        Concentrations, 0 (even) to 1e8 in float32 and 1e12 in float64, [..., K].

    Raises
    ------
    InputError
        If shapes do not match, an axis is not a unit vector, a number is not finite or a
        concentration is negative.
    """

    alpha: Float[Array, "..."]
    mu: Float[Array, "*batch K 3"]
    kappa: Float[Array, "*batch K"]

    def __init__(self, alpha: Any, mu: Any, kappa: Any) -> None:
        self.mu, self.kappa = jnp.asarray(mu), jnp.asarray(kappa)
        self.alpha = jnp.asarray(alpha)
        shape = self.kappa.shape
        if not shape or self.mu.shape != (*shape, 3) or self.alpha.shape[: len(shape)] != shape:
            raise InputError(
                "alpha, mu and kappa must be [..., K], [..., K, 3] and [..., K]; received "
                f"{self.alpha.shape}, {self.mu.shape} and {shape}"
            )
        checks.directions("mu", self.mu)
        for name in ("alpha", "kappa"):
            array = checks.concrete(getattr(self, name))
            if array is not None and not np.isfinite(array).all():
                raise InputError(f"{name} must be finite; received {array[~np.isfinite(array)][0]}")
        array = checks.concrete(self.kappa)
        if array is not None and (array < 0.0).any():
            raise InputError(f"kappa must be >= 0; received {array.min():g}")

    @property
    def arrays(self) -> tuple[Array, Array, Array]:
        """Alpha, mu and kappa."""
        return self.alpha, self.mu, self.kappa

    @property
    def count(self) -> int:
        """Number of lobes K."""
        return self.kappa.shape[-1]

    @property
    def channels(self) -> tuple[int, ...]:
        """Shape of a value: () or (C,)."""
        return self.alpha.shape[self.kappa.ndim :]

    def __getitem__(self, index: Any) -> "Lobes":
        """Members of a batch."""
        if self.kappa.ndim == 1:
            raise InputError("these lobes are not a batch; take alpha, mu, kappa apart instead")
        return Lobes(self.alpha[index], self.mu[index], self.kappa[index])

    def __call__(self, directions: Any) -> Float[Array, "..."]:
        """Value at directions.

        Parameters
        ----------
        directions
            Unit vectors: [..., 3] for one function, and for a batch [*batch, ..., 3].

        Returns
        -------
        Array
            The directions' shape without the 3, with the channels last.
        """
        checks.directions("directions", directions)
        return self._values(jnp.asarray(directions, self.mu.dtype))

    @eqx.filter_jit
    def _values(self, s: Float[Array, "... 3"]) -> Float[Array, "..."]:
        batch = self.kappa.shape[:-1]
        inner = s.ndim - 1 - len(batch)
        if inner < 0 or s.shape[: len(batch)] != batch:
            raise InputError(f"directions must be [*{batch}, ..., 3]; received {s.shape}")
        channels = len(self.channels)

        def spread(array: Array, rest: int) -> Array:
            """Axes for the directions between the batch and the lobes."""
            return array.reshape(*batch, *(1,) * inner, *array.shape[array.ndim - rest :])

        density = vmf.pdf(s[..., None, :], spread(self.mu, 2), spread(self.kappa, 1))
        density = density.reshape(*density.shape, *(1,) * channels)
        return (spread(self.alpha, 1 + channels) * density).sum(-1 - channels)

    def integral(self) -> Float[Array, "..."]:
        """Integral over the sphere, [..., *C]: the sum of alpha."""
        return self.alpha.sum(self.kappa.ndim - 1)

    def pdf(self, directions: Any) -> Float[Array, "..."]:
        """Density per steradian of `sample`: lobes by the share of their mean over channels."""
        checks.directions("directions", directions)
        return Lobes(self._share(), self.mu, self.kappa)(directions)

    def sample(self, key: PRNGKeyArray, count: int) -> Float[Array, "... count 3"]:
        """Directions with density `pdf`, [..., count, 3].

        Negative lobes have no part in it.
        """
        choice, place = jax.random.split(key)
        batch = self.kappa.shape[:-1]
        share = jnp.cumsum(self._share(), -1)[..., None, :]
        drawn = jax.random.uniform(choice, (*batch, count, 1), self.kappa.dtype)
        which = jnp.minimum((drawn >= share).sum(-1), self.count - 1)
        mu = jnp.take_along_axis(self.mu, which[..., None], -2)
        kappa = jnp.take_along_axis(self.kappa, which, -1)
        u = jax.random.uniform(place, (*batch, count, 2), self.kappa.dtype)
        return vmf_sampling.warp(u, mu, kappa)

    def _share(self) -> Float[Array, "*batch K"]:
        weight = self.alpha.mean(tuple(range(self.kappa.ndim, self.alpha.ndim)))
        weight = jnp.maximum(weight, 0.0)
        whole = weight.sum(-1, keepdims=True)
        return weight / jnp.where(whole > 0.0, whole, 1.0)

    def inner(self, other: "Lobes") -> Float[Array, "..."]:
        """Integral of the product with other lobes over the sphere, in closed form.

        Both without a batch; the result has the channels of this one, then the other's.
        """
        for lobes in (self, other):
            if lobes.kappa.ndim != 1:
                raise InputError("inner takes lobes without a batch: use jax.vmap over batches")
        pairs = vmf_pairs.log_inner(
            self.mu[:, None], self.kappa[:, None], other.mu[None], other.kappa[None]
        )
        own, others = (lobes.alpha.reshape(lobes.count, -1) for lobes in (self, other))
        return (own.T @ jnp.exp(pairs) @ others).reshape(*self.channels, *other.channels)

    def scaled(self, factor: Any) -> "Lobes":
        """The function times a factor, [] or one for each member of the batch."""
        factor = jnp.asarray(factor, self.alpha.dtype)
        return Lobes(
            self.alpha * factor.reshape(*factor.shape, *(1,) * (self.alpha.ndim - factor.ndim)),
            self.mu,
            self.kappa,
        )

    def save(self, path: str | os.PathLike) -> None:
        """Write to .npz or .json, aside first and then renamed."""
        path = Path(path)
        arrays = {name: np.asarray(getattr(self, name)) for name in _FIELDS}
        if path.suffix == ".npz":
            with replacing(path) as file:
                np.savez(file, alpha=arrays["alpha"], mu=arrays["mu"], kappa=arrays["kappa"])
        elif path.suffix == ".json":
            text = json.dumps({"lobes": {n: a.tolist() for n, a in arrays.items()}}, indent=1)
            with replacing(path) as file:
                file.write(text.encode())
        else:
            raise InputError(f"{path}: lobes are written to .npz or .json")

    @staticmethod
    def load(path: str | os.PathLike) -> "Lobes":
        """Read what `save` wrote.

        Raises
        ------
        InputError
            If there is no such file, or it holds no lobes; names the file.
        """
        path = existing_file(path)
        try:
            if path.suffix == ".npz":
                content = numpy_files.archive(path)
                arrays = {name: content[name] for name in _FIELDS}
            else:
                found = json.loads(limits.text(path, limits.MOST_JSON))["lobes"]
                arrays = {name: np.asarray(found[name], np.float64) for name in _FIELDS}
            for name, array in arrays.items():
                if array.dtype.kind not in "fiu":
                    raise InputError(f"{name} must be real numbers; found {array.dtype}")
            kept = {n: jnp.asarray(a, jnp.result_type(float)) for n, a in arrays.items()}
            return Lobes(**kept)
        except InputError as error:
            text = str(error).removeprefix(f"{path}: ")
            raise InputError(f"{path}: {text}") from None
        except (KeyError, TypeError, ValueError, OSError, OverflowError, RecursionError) as error:
            raise InputError(
                f"{path}: expected lobes ({', '.join(_FIELDS)}) as Lobes.save writes them; {error}"
            ) from None

    def __str__(self) -> str:
        if self.kappa.ndim > 1:
            return f"{self.kappa.shape[:-1]} sums of {self.count} lobes"
        rows = ["  alpha        kappa      theta   phi (degrees)"]
        alpha = np.asarray(self.alpha).reshape(self.count, -1).mean(-1)
        for a, (x, y, z), k in zip(alpha, np.asarray(self.mu), np.asarray(self.kappa), strict=True):
            theta = np.degrees(np.arctan2(np.hypot(x, y), z))
            rows.append(f"{a:8.4g} {k:12.5g} {theta:10.2f} {np.degrees(np.arctan2(y, x)):8.2f}")
        return "\n".join(rows)

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.previews import bundles, lobes

        return bundles.bundle(self, lobes.card)
