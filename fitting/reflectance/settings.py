"""How a parametric surface is fitted to reflectance."""

import dataclasses
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from diffopt import checks
from diffopt.errors import InputError
from diffopt.fitting.reflectance import solving

# Fall of chi-squared, where noise alone makes it 1 a value, that is not worth a step.
_CRAWL = 1e-3


@dataclasses.dataclass(frozen=True)
class FitSettings:
    """How a surface is fitted to reflectance.

    Attributes
    ----------
    lattices
        Grating vectors taken from the data. More cost time in proportion and find gratings
        whose first orders are dark.
    design
        Points of the other parameters for each lattice; doubled for each parameter beyond the
        first.
    starts
        Solves from the best of them. One is enough for a sinusoid; saws and steps have many
        minima.
    finalists
        Of these, finished on all data.
    retries
        Times that a fit from the data alone is done again, with three times the starts, where
        chi-squared says that it is none. Needs noise that is known.
    rows
        Pairs of directions of the comparison and of the first solves; fewer cost less and are
        noisier.
    stages
        Coarse stages from given starts: none make a fit faster and its basin narrower.
    coarsest
        Coherence window of the first of them, in periods of the starts.
    solver
        ``normal-lm`` (Levenberg-Marquardt on normal equations), or optimistix's own ``lm``,
        ``dogleg`` and ``bfgs``.
    tolerance
        Of the last solve, on y and on the squared loss; the root of the rounding unit if None.
    max_steps
        Of each solve.
    devices
        Local ones among which the starts of every solve are divided.

    Raises
    ------
    InputError
        If the solver is unknown or a number is too small.
    """

    lattices: int = 8
    design: int = 24
    starts: int = 12
    finalists: int = 3
    retries: int = 1
    rows: int = 400
    stages: int = 4
    coarsest: float = 0.2
    solver: solving.Solver = "normal-lm"
    tolerance: float | None = None
    max_steps: int = 64
    devices: int = 1

    def harder(self) -> "FitSettings":
        """With three times the points of the design and of the starts, and no retry."""
        more = {"design": 3 * self.design, "starts": 3 * self.starts}
        return dataclasses.replace(self, retries=0, **more)

    def last(self, values: Array) -> dict[str, Any]:
        """Options of `diffopt.fitting.reflectance.solving.solve` for a last solve on values."""
        return {
            "solver": self.solver,
            "tolerance": self.tolerance or float(jnp.finfo(values.dtype).eps) ** 0.5,
            "max_steps": self.max_steps,
            "flat": _CRAWL / values.size,
        }

    def __post_init__(self) -> None:
        checks.choice("solver", self.solver, solving.SOLVERS)
        for name, least in (
            ("lattices", 1),
            ("design", 1),
            ("starts", 1),
            ("finalists", 1),
            ("retries", 0),
            ("rows", 8),
            ("stages", 0),
            ("max_steps", 1),
            ("devices", 1),
        ):
            if getattr(self, name) < least:
                raise InputError(f"{name} must be {least} or more; received {getattr(self, name)}")
        for name, value in (("coarsest", self.coarsest), ("tolerance", self.tolerance)):
            if value is not None and not value > 0:
                raise InputError(f"{name} must be above 0; received {value}")
