"""Which method, at which settings, for a job and a tolerance.

The tolerance bounds the largest error of the output over its largest value in the job, for
the patch as given. It is turned into a bound on |P|^2 with the job's own prefactors and a
lower bound of its largest value (a few of its pairs, evaluated), so that the chosen
settings never exceed it; costs come from a model calibrated by the benchmarks.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import bounds, checks, colour
from diffopt.checks import Values
from diffopt.diffraction import DiffractionBRDF, Output, evaluate, factors, refuse
from diffopt.errors import InputError
from diffopt.kernels import phase
from diffopt.methods import taylor_tables
from diffopt.settings import DirectSettings, SeparableSettings, Settings, TaylorSettings

METHODS = ("direct", "separable", "taylor")


@dataclass(frozen=True)
class CostModel:
    """Seconds per unit of work in float32 on two x86 cores; `diffopt bench` measures them.

    Ratios between methods are what matters; float64 takes about twice as long.
    """

    window_sample: float = 2.0e-9
    positions_sample: float = 8.0e-9
    product: float = 1.5e-11
    tap_term: float = 1.2e-9
    evaluation: float = 5.0e-7
    table_sample: float = 2.0e-8


@dataclass(frozen=True)
class Candidate:
    """One way to do a job, or why it cannot be done that way."""

    method: str
    settings: Settings | None
    bound: float
    setup_s: float
    run_s: float
    refused: str | None = None

    @property
    def total_s(self) -> float:
        """Set-up and run together, seconds."""
        return self.setup_s + self.run_s


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
        What the settings guarantee in the same terms (truncation rigorous, rounding
        estimated).
    patch_error
        Estimated error of the finite patch, apart from the above.
    setup_s, run_s
        Predicted seconds.
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
    candidates: tuple[Candidate, ...]

    def __str__(self) -> str:
        lines = [
            f"{self.method}: {self.settings}",
            f"error bound {self.error_bound:.1e} (asked {self.tolerance:.1e}); "
            f"finite patch apart: about {self.patch_error:.1e}",
            f"predicted: {self.setup_s:.3g} s to set up, {self.run_s:.3g} s to run",
        ]
        for other in self.candidates:
            if other.method == self.method:
                continue
            lines.append(
                f"  {other.method}: {other.refused}"
                if other.refused
                else f"  {other.method}: {other.total_s:.3g} s with {other.settings}"
            )
        return "\n".join(lines)


class PreparedBRDF(eqx.Module):
    """A diffraction BRDF with its method chosen; made by `DiffractionBRDF.prepare`."""

    brdf: DiffractionBRDF
    wavelengths: Float[Array, " L"]
    weights: Float[Array, "L 3"] | None
    tables: Float[Array, "nyp nxp terms 2"] | None
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
        """
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
    output: Output = "spectral",
    tolerance: float = 1e-3,
    method: str = "auto",
    settings: Settings | None = None,
    illuminant: colour.IlluminantLike = "D65",
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
    method
        ``auto``, ``direct``, ``separable`` or ``taylor``.
    settings
        Explicit settings of a method; override the choice, whatever their error.
    illuminant
        For ``output="xyz"``.

    Raises
    ------
    InputError
        If no method, or not the one asked for, meets the tolerance in the dtype of the
        heights; the message says why and what would.
    """
    checks.choice("method", method, ("auto", *METHODS))
    checks.choice("output", output, ("spectral", "relative", "xyz"))
    checks.tolerance(tolerance)
    if wavelengths is None:
        wavelengths = colour.wavelengths()
    checks.wavelengths(wavelengths)
    dtype = brdf.surface.heights.dtype
    lam = np.atleast_1d(np.asarray(wavelengths, np.float64))
    weights = (
        np.asarray(colour.spectral_weights(lam, illuminant=illuminant)) if output == "xyz" else None
    )
    count, wi, wo = _job_pairs(pairs)
    wave = -(wi + wo)
    gain = _gain(brdf, wi, wo, lam, output, weights, tolerance)
    if settings is not None:
        refuse(brdf, settings)
        bounds.refuse_rounding(brdf.surface, settings, wave, lam)
        found = (_priced(brdf, settings, wave, lam, count),)
    else:
        found = tuple(
            _candidate(brdf, name, wave, lam, count, tolerance / gain, tolerance)
            for name in METHODS
            if method in ("auto", name)
        )
    usable = [c for c in found if c.refused is None]
    if not usable:
        raise InputError(_reasons(found))
    best = min(usable, key=lambda c: c.total_s)
    assert best.settings is not None
    choice = Choice(
        method=best.method,
        settings=best.settings,
        tolerance=tolerance,
        error_bound=best.bound * gain,
        patch_error=brdf.patch_error(),
        setup_s=best.setup_s,
        run_s=best.run_s,
        candidates=found,
    )
    tables = None
    if isinstance(best.settings, TaylorSettings):
        tables = eqx.filter_jit(taylor_tables)(brdf.surface, best.settings)
    return PreparedBRDF(
        brdf=brdf,
        wavelengths=jnp.asarray(lam, dtype),
        weights=None if weights is None else jnp.asarray(weights, dtype),
        tables=tables,
        settings=best.settings,
        output=output,
        choice=choice,
    )


def _job_pairs(pairs) -> tuple[int, np.ndarray, np.ndarray]:
    if isinstance(pairs, int | np.integer):
        if pairs < 1:
            raise InputError(f"pairs must be at least 1; received {pairs}")
        wi, wo = sample_pairs(256)
        # The mirror direction belongs to every job whose directions are not known.
        return int(pairs), np.append(wi, [[0, 0, 1.0]], 0), np.append(wo, [[0, 0, 1.0]], 0)
    wi, wo = pairs
    checks.directions("wi", wi)
    checks.directions("wo", wo)
    wi, wo = np.broadcast_arrays(np.asarray(wi, np.float64), np.asarray(wo, np.float64))
    wi, wo = wi.reshape(-1, 3), wo.reshape(-1, 3)
    above = (wi[:, 2] > 0) & (wo[:, 2] > 0)
    if not above.any():
        raise InputError("pairs must hold at least one pair above the horizon; received none")
    return len(wi), wi[above], wo[above]


def _gain(brdf, wi, wo, lam, output, weights, tolerance) -> float:
    """Error of the output over its largest value, per error of |P|^2."""
    before = _prefactors(brdf, wi, wo, lam, output, weights)
    # A few pairs, half of them the brightest by direction, give a lower bound of the
    # largest value: the tolerance then holds for any larger one.
    near = np.argsort(np.square(wi[:, :2] + wo[:, :2]).sum(-1))[:8]
    some = np.unique(np.concatenate([near, np.linspace(0, len(wi) - 1, 8).astype(int)]))
    part = np.unique(np.linspace(0, len(lam) - 1, min(len(lam), 17)).astype(int))
    scale = evaluate(
        brdf,
        wi[some],
        wo[some],
        lam[part],
        DirectSettings(),
        output=output,
        weights=None if weights is None else weights[part],
    )
    largest = float(jnp.max(scale))
    if not largest > 0.0:
        raise InputError(
            f"tolerance {tolerance:g} is relative to the largest value, which is "
            f"{largest:g} on the pairs that were tried: give a method and its settings"
        )
    return before / largest


def _prefactors(brdf, wi, wo, lam, output, weights) -> float:
    """Largest value that the output would have with |P|^2 = 1."""
    dtype = brdf.surface.heights.dtype
    wi, wo = jnp.asarray(wi, dtype), jnp.asarray(wo, dtype)
    value = factors(brdf, wi, wo, jnp.asarray(lam, dtype), output)
    if weights is not None:
        value = jnp.matmul(value, jnp.asarray(weights, dtype))
    return float(jnp.max(value))


def _candidate(brdf, name, wave, lam, count, allowed, tolerance) -> Candidate:
    """Settings of one method that keep the error of |P|^2 within `allowed`."""
    surface = brdf.surface
    floor = bounds.rounding_estimate(surface, wave, lam)
    dtype = surface.heights.dtype
    if floor > allowed:
        return _refused(
            name, f"tolerance {tolerance:g} is below the rounding of {dtype}" + _advice(dtype)
        )
    room = allowed - floor
    settings: Settings
    if name == "direct":
        settings = DirectSettings()
    elif name == "separable":
        share = room if surface.coverage == "positions" else room / 3.0
        sweep = bounds.separable_sweep(surface, wave, lam)
        settings = SeparableSettings(nodes=phase.chebyshev_nodes(sweep, min(share, 1.0)))
    else:
        # Centred heights halve the argument: fewer terms and far less rounding.
        total = bounds.phase_range(surface, wave, lam)
        rounding = phase.taylor_rounding(0.5 * total, float(jnp.finfo(dtype).eps))
        # It counts twice in the bound, as an error of the amplitude.
        if rounding > min(0.25 * room, bounds.LARGEST_ROUNDING):
            return _refused(
                name,
                f"{dtype} cannot carry Taylor terms over a phase range of {total:.1f} at this "
                f"tolerance (rounding {rounding:.1e} of the mirror's peak)" + _advice(dtype),
            )
        reach = 1
        longest = min(surface.heights.shape) // 2 - 1
        while bounds.gather_cut(surface, reach, lam) > 0.25 * room and reach < longest:
            reach += 1
        terms = phase.taylor_terms(0.5 * total, room / 12.0)
        settings = TaylorSettings(terms=terms, reach=reach, centred=True)
    try:
        refuse(brdf, settings)
    except InputError as error:
        return _refused(name, str(error))
    priced = _priced(brdf, settings, wave, lam, count)
    if priced.bound > allowed:
        # A window of few pixels, say, that no gather of this patch can hold.
        return _refused(
            name,
            f"the error bound {priced.bound * tolerance / allowed:.1e} of {settings} stays above "
            f"the tolerance {tolerance:g}",
        )
    return priced


def _advice(dtype) -> str:
    return "; use float64 heights" if dtype == jnp.float32 else ""


def _reasons(found: Sequence[Candidate]) -> str:
    """Why each method is out, the same reason once for all that share it."""
    methods: dict[str | None, list[str]] = {}
    for candidate in found:
        methods.setdefault(candidate.refused, []).append(repr(candidate.method))
    return "; ".join(
        f"{'method' if len(names) == 1 else 'methods'} {', '.join(names)}: {why}"
        for why, names in methods.items()
    )


def _refused(name: str, why: str) -> Candidate:
    return Candidate(name, None, np.inf, np.inf, np.inf, refused=why)


def _priced(brdf, settings, wave, lam, count) -> Candidate:
    surface, cost = brdf.surface, CostModel()
    samples, evaluations = surface.heights.size, count * len(lam)
    averaged = surface.coverage == "positions"
    sample = cost.positions_sample if averaged else cost.window_sample
    setup = 0.0
    if isinstance(settings, DirectSettings):
        run = evaluations * samples * sample
    elif isinstance(settings, SeparableSettings):
        blocks = -(-count // settings.chunk)
        products = samples * (2 if averaged else 8) * max(count, 1) * cost.product
        run = len(lam) * settings.nodes * (blocks * samples * sample + products)
    else:
        setup = settings.terms * samples * cost.table_sample
        taps = (2 * settings.reach + 1) ** 2
        run = evaluations * (cost.evaluation + taps * settings.terms * cost.tap_term)
    scale = 2.0 if surface.heights.dtype == jnp.float64 else 1.0
    bound = bounds.error_bound(surface, settings, wave, lam)
    return Candidate(settings.name, settings, bound, scale * setup, scale * run)
