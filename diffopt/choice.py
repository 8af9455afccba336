"""Which method, at which settings, for a job and a tolerance.

The tolerance bounds the largest error of the output over its largest value in the job, for
the patch as given. Every method's settings are chosen so that its error bound meets it
(`diffopt.candidates`); the cheapest by a model calibrated with the benchmarks
(`diffopt.costs`) is taken.
"""

import dataclasses
import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import baking, bounds, candidates, checks, colour, devices, few, spreading, stores
from diffopt.baking import Box
from diffopt.candidates import METHODS as METHODS
from diffopt.candidates import Candidate as Candidate
from diffopt.candidates import Gradient, Job
from diffopt.checks import Values
from diffopt.diffraction import DiffractionBRDF, Output, evaluate, refuse
from diffopt.errors import InputError
from diffopt.gathering import GatherTables, gather_tables
from diffopt.lookup import Table
from diffopt.settings import FewSettings, GatherSettings, Settings, TableSettings

Tables = GatherTables | Table | few.FewWavelengths | None


@dataclass(frozen=True)
class Choice:
    """What was chosen for a job, what it costs, and what else was considered.

    Attributes
    ----------
    method, settings
        The chosen method and its settings.
    tolerance
        What was asked: largest error over largest value of the output.
    error_bound
        What the settings guarantee in the same terms (truncation rigorous but for a table's
        interpolation in w, rounding estimated); NaN for ``few``, which has no bound.
    patch_error
        Estimated error of the finite patch, apart from the above.
    setup_s, run_s
        Predicted seconds, compilation apart.
    nbytes
        Memory of what is set up.
    job
        The job in words.
    candidates
        Every method with its settings and predicted cost, or the reason it is out.
    """

    method: str
    settings: Settings
    tolerance: float
    error_bound: float
    patch_error: float
    setup_s: float
    run_s: float
    nbytes: int
    job: str
    candidates: tuple[Candidate, ...]

    def __str__(self) -> str:
        others = [c for c in self.candidates if c.method != self.method]
        usable = [c for c in others if c.refused is None]
        why = ""
        if usable:
            second = min(usable, key=lambda c: c.total_s)
            ratio = second.total_s / max(self.setup_s + self.run_s, 1e-12)
            why = f": {ratio:.3g} times as fast as {second.method}"
        lines = [
            f"{self.method}: {self.settings}",
            f"for {self.job}{why}",
            f"error bound {self.error_bound:.1e} (asked {self.tolerance:.1e}); "
            f"finite patch apart: about {self.patch_error:.1e}",
            f"predicted: {self.setup_s:.3g} s to set up, {self.run_s:.3g} s to run, "
            f"{self.nbytes / 1e6:.3g} MB",
        ]
        for other in others:
            lines.append(
                f"  {other.method}: {other.refused}"
                if other.refused
                else f"  {other.method}: {other.setup_s:.3g} + {other.run_s:.3g} s "
                f"with {other.settings}"
            )
        return "\n".join(lines)

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.previews import bundles, choices

        return bundles.bundle(self, choices.card)


class PreparedBRDF(eqx.Module):
    """A diffraction BRDF with its method chosen; made by `DiffractionBRDF.prepare`."""

    brdf: DiffractionBRDF
    wavelengths: Float[Array, " L"]
    weights: Float[Array, "L 3"] | None
    tables: Tables
    settings: Settings = eqx.field(static=True)
    output: Output = eqx.field(static=True)
    choice: Choice = eqx.field(static=True)

    def __call__(self, wi: Values, wo: Values) -> Float[Array, "*batch out"]:
        """Evaluate the job's output for pairs of directions.

        Parameters
        ----------
        wi, wo
            Unit vectors, [..., 3]. The error bound holds for pairs whose w and frequencies
            lie within those of the job.

        Returns
        -------
        Array
            [..., L] in 1/sr (or relative), or [..., 3] for ``output="xyz"``.

        Raises
        ------
        InputError
            For a table, if pairs lie outside the box of its job (NaN where the call is
            traced by a caller's own jit).
        """
        if isinstance(self.tables, Table):
            return stores.evaluate_pairs(self.tables, wi, wo)
        if isinstance(self.tables, few.FewWavelengths):
            checks.directions("wi", wi)
            checks.directions("wo", wo)
            dtype = self.wavelengths.dtype
            over, axis = spreading.pairs(wi, wo)
            wi, wo = jnp.broadcast_arrays(jnp.asarray(wi, dtype), jnp.asarray(wo, dtype))
            assert isinstance(self.settings, FewSettings)
            given = self.brdf, self.tables, wi, wo, self.settings
            if over is not None:
                axes = None, None, axis, axis, None
                return devices.run(few.evaluate_few, given, axes, axis, over)
            return few.evaluate_few(*given)
        return evaluate(
            self.brdf,
            wi,
            wo,
            self.wavelengths,
            self.settings,
            output=self.output,
            weights=self.weights,
            tables=self.tables,
        )

    def save(self, path: str | os.PathLike, **about: Any) -> None:
        """Write a baked table as a zarr folder; `diffopt.load_table` reads it.

        Parameters
        ----------
        path
            Folder to write; an older table of that name is replaced when all is written.
        **about
            Anything to keep with it, as ``scan="stamper.sur"``; what JSON can hold.

        Raises
        ------
        InputError
            If the method is not ``table``, or the path cannot be used.
        """
        if not isinstance(self.tables, Table):
            raise InputError(
                f"{os.fspath(path)}: method {self.choice.method!r} has no table to save; prepare "
                "with method='table'"
            )
        stores.save(path, self.tables, {**self._record(), **about})

    def _record(self) -> dict[str, Any]:
        from diffopt import __version__

        surface, choice = self.brdf.surface, self.choice
        heights = np.asarray(surface.heights)
        return {
            "program": f"diffopt {__version__}",
            "output": self.output,
            "balance": self.brdf.balance,
            "unit": "1/sr" if self.output == "spectral" else f"{self.output}, see balance",
            "wavelengths_um": np.asarray(self.wavelengths, np.float64).round(7).tolist(),
            "coherence_um": float(surface.sigma),
            "blur": float(surface.blur),
            "average": surface.coverage,
            "fresnel": eqx.tree_pformat(self.brdf.fresnel, short_arrays=False),
            "settings": dataclasses.asdict(self.settings),
            "tolerance": choice.tolerance,
            "error_bound": choice.error_bound,
            "patch_error": choice.patch_error,
            "job": choice.job,
            "heights": {
                "shape": list(heights.shape),
                "pixel_um": list(surface.pixel),
                "dtype": str(heights.dtype),
                "sha256": hashlib.sha256(heights.tobytes()).hexdigest(),
            },
        }

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.previews import bundles, choices

        return bundles.bundle(self, choices.prepared_card)


def sample_pairs(count: int, largest_angle: float = 75.0) -> tuple[np.ndarray, np.ndarray]:
    """Pairs spread evenly over the cone of `largest_angle` degrees (a fixed sequence)."""
    # The R4 low-discrepancy sequence (Roberts 2018): the root of x^5 = x + 1.
    root = 1.1673039782614187
    points = np.mod(0.5 + np.arange(1, count + 1)[:, None] / root ** np.arange(1, 5), 1.0)
    sin = np.sqrt(points[:, :2]) * np.sin(np.radians(largest_angle))
    phi = 2.0 * np.pi * points[:, 2:]
    z = np.sqrt(1.0 - sin**2)
    out = np.stack([sin * np.cos(phi), sin * np.sin(phi), z], -1)
    return out[:, 0], out[:, 1]


def prepare(
    brdf: DiffractionBRDF,
    *,
    pairs: int | tuple[Values, Values],
    wavelengths: Values | None = None,
    output: Output | str = "spectral",
    tolerance: float = 1e-3,
    gradient: Gradient | str = "none",
    method: str = "auto",
    settings: Settings | None = None,
    illuminant: colour.IlluminantLike = "D65",
    progress: Callable[[int, int], None] | None = None,
) -> PreparedBRDF:
    """Choose the cheapest method whose error bound meets a tolerance, and set it up.

    Parameters
    ----------
    brdf
        The model.
    pairs
        The job's directions (wi, wo), [..., 3] each, or their number; with a number the
        tolerance is meant for pairs within 75 degrees of the normal.
    wavelengths
        Micrometres, [L]; 380 to 780 nm by 5 nm if not given.
    output
        ``spectral`` (f, 1/sr), ``relative`` or ``xyz``.
    tolerance
        Largest error of the output over its largest value in the job, in (0, 1).
    gradient
        What will be differentiated: ``none``; ``directions``; ``model`` for heights,
        coherence and reflectance as well, which leaves out what is set up once.
    method
        ``auto``, ``direct``, ``separable``, ``taylor``, ``chebyshev``, ``lowrank`` or
        ``table``.
    settings
        Explicit settings of a method; override the choice, whatever their error.
    illuminant
        For ``output="xyz"``.
    progress
        Called with (parts done, parts in all) while a table is baked.

    Raises
    ------
    InputError
        If no method, or not the one asked for, meets the tolerance in the dtype of the
        heights; the message says why and what would.
    """
    checks.choice("method", method, ("auto", *METHODS))
    kind: Output = checks.choice("output", output, get_args(Output))
    taken: Gradient = checks.choice("gradient", gradient, get_args(Gradient))
    checks.tolerance(tolerance)
    if wavelengths is None:
        wavelengths = colour.wavelengths()
    checks.wavelengths(wavelengths)
    lam = np.atleast_1d(np.asarray(wavelengths, np.float64))
    weights = (
        np.asarray(colour.spectral_weights(lam, illuminant=illuminant)) if kind == "xyz" else None
    )
    count, wi, wo, box = _job_pairs(pairs)
    gain = candidates.gain(brdf, wi, wo, lam, kind, weights, tolerance)
    job = Job(brdf, wi, wo, count, box, lam, weights, kind, tolerance, taken, gain)
    if settings is not None:
        _refuse_settings(job, settings)
        found: tuple[Candidate, ...] = (candidates.price(job, settings),)
    else:
        names = METHODS if method == "auto" else (method,)
        found = tuple(candidates.candidate(job, name) for name in names)
    usable = [c for c in found if c.refused is None]
    if not usable:
        raise InputError(_reasons(found))
    best = min(usable, key=lambda c: c.total_s)
    assert best.settings is not None
    choice = Choice(
        method=best.method,
        settings=best.settings,
        tolerance=tolerance,
        error_bound=best.bound,
        patch_error=brdf.patch_error(),
        setup_s=best.setup_s,
        run_s=best.run_s,
        nbytes=best.nbytes,
        job=f"{count} pairs, {len(lam)} wavelengths, {kind}"
        + (f", gradient to {taken}" if taken != "none" else ""),
        candidates=found,
    )
    dtype = brdf.surface.heights.dtype
    return PreparedBRDF(
        brdf=brdf,
        wavelengths=devices.like(wavelengths, jnp.asarray(lam, dtype)),
        weights=None if weights is None else jnp.asarray(weights, dtype),
        tables=_set_up(job, best.settings, progress),
        settings=best.settings,
        output=kind,
        choice=choice,
    )


def _set_up(job: Job, settings: Settings, progress) -> Tables:
    """What the method computes once."""
    brdf, lam = job.brdf, job.wavelengths
    relative = job.output == "relative" or (job.output == "xyz" and brdf.balance == "peak")
    if isinstance(settings, TableSettings):
        return baking.bake(
            brdf, job.box, lam, job.weights, settings, relative=relative, progress=progress
        )
    if isinstance(settings, FewSettings):
        assert job.weights is not None
        return few.few_wavelengths(brdf, lam, job.weights, job.box.w, settings)
    if isinstance(settings, GatherSettings) and job.gradient != "model":
        reached = jnp.asarray(
            bounds.s_interval(brdf.surface, job.wave[:, 2], lam), brdf.surface.heights.dtype
        )
        return eqx.filter_jit(gather_tables)(brdf.surface, settings, reached)
    return None


def _refuse_settings(job: Job, settings: Settings) -> None:
    """Raise InputError for explicit settings that cannot evaluate the job."""
    if isinstance(settings, TableSettings):
        baking.refuse_table(job.brdf)
    elif isinstance(settings, FewSettings):
        if job.output != "xyz":
            raise InputError(f"method 'few' is for output='xyz'; received output={job.output!r}")
    else:
        refuse(job.brdf, settings)
        bounds.refuse_rounding(job.brdf.surface, settings, job.wave, job.wavelengths)
    if isinstance(settings, TableSettings | FewSettings) and job.gradient == "model":
        raise InputError(
            f"gradient='model': what method {settings.name!r} sets up once has no derivative to "
            "the model; use method 'separable' or 'direct'"
        )


def _job_pairs(pairs) -> tuple[int, np.ndarray, np.ndarray, Box]:
    if isinstance(pairs, int | np.integer):
        if pairs < 1:
            raise InputError(f"pairs must be at least 1; received {pairs}")
        wi, wo = sample_pairs(256)
        # The mirror directions belong to every job whose directions are not known: with
        # those at either end of the cone w has its whole range.
        sin, cos = np.sin(np.radians(75.0)), np.cos(np.radians(75.0))
        wi = np.append(wi, [[0, 0, 1.0], [sin, 0, cos]], 0)
        wo = np.append(wo, [[0, 0, 1.0], [-sin, 0, cos]], 0)
        # A table holds every pair above the horizon, though the bound is for the cone.
        return int(pairs), wi, wo, Box((-2.0, 2.0), (-2.0, 2.0), (-2.0, 0.0))
    wi, wo = pairs
    checks.directions("wi", wi)
    checks.directions("wo", wo)
    wi, wo = np.broadcast_arrays(np.asarray(wi, np.float64), np.asarray(wo, np.float64))
    wi, wo = wi.reshape(-1, 3), wo.reshape(-1, 3)
    above = (wi[:, 2] > 0) & (wo[:, 2] > 0)
    if not above.any():
        raise InputError("pairs must hold at least one pair above the horizon; received none")
    return len(wi), wi[above], wo[above], Box.around(-(wi + wo)[above])


def _reasons(found: Sequence[Candidate]) -> str:
    """Why each method is out, the same reason once for all that share it."""
    methods: dict[str | None, list[str]] = {}
    for candidate in found:
        methods.setdefault(candidate.refused, []).append(repr(candidate.method))
    return "; ".join(
        f"{'method' if len(names) == 1 else 'methods'} {', '.join(names)}: {why}"
        for why, names in methods.items()
    )
