"""Profile of the loss over one parameter: the least misfit when that is held."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffopt.errors import InputError
from diffopt.fitting.measured import Measured
from diffopt.fitting.reflectance import forward, solving
from diffopt.fitting.reflectance.answers import ReflectanceFit
from diffopt.fitting.reflectance.maps import bounds_for
from diffopt.fitting.reflectance.settings import FitSettings
from diffopt.fresnel import Reflectance
from diffopt.gratings.parametric import kinds
from diffopt.scalar import Shadowing

# Of the range about a single minimum, standard errors.
_WIDTH = 6.0
_COUNT = 61


@dataclasses.dataclass(frozen=True)
class Profile:
    """The least misfit for each value of a parameter.

    Attributes
    ----------
    name
        Of the parameter.
    values
        Held values, in its unit.
    loss
        Norm of the residuals over that of the data, both over the noise, with all other free
        parameters fitted.
    chi2
        Squared residuals over the noise less those of the fit: 1 at a standard error, in a
        parabola. None if the noise is not known.
    others
        The other parameters there, by name.
    """

    name: str
    values: Float[np.ndarray, " N"]
    loss: Float[np.ndarray, " N"]
    chi2: Float[np.ndarray, " N"] | None
    others: dict[str, Float[np.ndarray, " N"]]

    @property
    def minima(self) -> Float[np.ndarray, " K"]:
        """Values where the loss is less than at both neighbours."""
        padded = np.concatenate([[np.inf], self.loss, [np.inf]])
        return self.values[(self.loss < padded[:-2]) & (self.loss < padded[2:])]

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.fitting import previews
        from diffopt.previews import bundles

        return bundles.bundle(self, previews.profile_card)


def profile(
    measured: Measured,
    fit: ReflectanceFit,
    name: str,
    values: Any = None,
    *,
    fresnel: Reflectance | None = None,
    shadowing: Shadowing = "none",
    settings: FitSettings | None = None,
) -> Profile:
    """Least misfit over one parameter, the others fitted anew at each of its values.

    Where starts ended in different minima it shows how deep each is and what lies between
    (profile likelihood: Murphy and van der Vaart 2000).

    Parameters
    ----------
    measured, fresnel, shadowing
        As they were for the fit.
    fit
        The fit; its model and all its minima are the starts of the others.
    name
        A free parameter.
    values
        Where to hold it, [N]; by default over all minima of the fit, and six standard errors
        beyond.
    settings
        Solver, tolerance and steps.

    Raises
    ------
    InputError
        If the parameter was not free, or alone, or a value is not possible.
    """
    settings = FitSettings() if settings is None else settings
    if name not in fit.names:
        raise InputError(f"name must be one of {', '.join(fit.names)}; received {name!r}")
    if len(fit.names) < 2:
        raise InputError(f"name: expected other free parameters beside {name}, the fit has none")
    held = _range(fit, name) if values is None else np.asarray(values, np.float64)
    if held.ndim != 1 or not len(held) or not np.isfinite(held).all():
        raise InputError(f"values must be finite numbers [N]; received {values!r}")
    job = forward.job(measured.astype(fit.model.dtype), fresnel, shadowing)
    frequency, _ = forward.largest(job)
    names = tuple(other for other in fit.names if other != name)
    box = bounds_for(fit.model, names, measured, frequency)
    sets = [{n: float(fit.model.get(n)) for n in names}]
    sets += [{n: one.parameters[n] for n in names} for one in fit.minima if len(fit.minima) > 1]
    # Every value from every minimum: [N S, P].
    start = box.unbounded(np.array([[s[n] for n in names] for s in sets]))
    y = jnp.asarray(np.tile(start, (len(held), 1)), jnp.result_type(float))
    each = jnp.asarray(np.repeat(held, len(sets)), fit.model.dtype)
    like = jax.vmap(lambda value: fit.model.replaced({name: value}))(each)
    found = solving.solve_on(
        settings.devices,
        job,
        like,
        box,
        y,
        None,
        reach=fit.reach,
        **settings.last(job.values),
    )
    loss = np.nan_to_num(np.asarray(found.loss, np.float64), nan=np.inf).reshape(len(held), -1)
    best = loss.argmin(1)
    ends = np.asarray(jax.vmap(box.values)(found.y), np.float64).reshape(len(held), -1, len(names))
    ends = ends[np.arange(len(held)), best]
    loss = loss[np.arange(len(held)), best]
    norm = float(forward.norm(measured))
    return Profile(
        name,
        held,
        loss,
        (loss**2 - fit.loss**2) * norm**2 if measured.noise_known else None,
        {n: _sign(fit, n) * ends[:, k] for k, n in enumerate(names)},
    )


def _sign(fit: ReflectanceFit, name: str) -> float:
    """Of a height, whose bounds are those of its size."""
    return -1.0 if kinds(fit.model)[name] == "height" and float(fit.model.get(name)) < 0 else 1.0


def _range(fit: ReflectanceFit, name: str) -> np.ndarray:
    at, error = float(fit.model.get(name)), fit.errors[name]
    points = [at, *(_sign(fit, name) * one.parameters[name] for one in fit.minima)]
    width = _WIDTH * error if np.isfinite(error) else 0.2 * max(abs(at), 0.1)
    low, high = min(points) - width, max(points) + width
    kind = kinds(fit.model)[name]
    if kind in ("length", "density", "spread", "share"):
        low = max(low, 1e-3 * at)
    if kind == "share":
        high = min(high, 1.0 - 1e-3)
    near = np.linspace(max(at - width, low), min(at + width, high), _COUNT // 3)
    return np.unique(np.concatenate([np.linspace(low, high, _COUNT), near, points]))
