"""Fit of parametric surfaces to a scan, and which of them describes it best.

Steps: wave vectors from the power spectrum, starts from the scan folded over a period
(`register`), least squares with plane and line offsets projected out (`squares`) or,
for random surfaces, likelihood of the spectrum (`noise`), and comparison of all on the
likelihood of what is left.
"""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.errors import InputError
from diffopt.fitting.ranked import Ranked
from diffopt.fitting.scans import candidates as scan_candidates
from diffopt.fitting.scans import noise as scan_noise
from diffopt.fitting.scans import register as scan_register
from diffopt.fitting.scans.setting import Candidate, Setting, noise_alone
from diffopt.gratings import Surface
from diffopt.heightfield import Heightfield

Progress = Callable[[str, int, int], None]

# A difference of the criterion that counts as very strong evidence (Kass and Raftery 1995).
_STRONG = 10.0


class ScanFit(eqx.Module):
    """Result of `fit_scan`; lengths in micrometres.

    Attributes
    ----------
    model
        Surface with fitted parameters, see `convention` for which of several sets.
    names, covariance
        Parameters and their covariance [P, P]; NaN for those that the scan does not tell.
    errors
        Standard error of each.
    tilt
        Slopes (along y, along x) of the plane, without unit.
    lines
        [ny], offset of each scan line.
    residual
        [ny, nx], scan less model, plane and offsets; NaN where the scan has none. The model is
        random: scan less plane.
    noise
        ``white``, ``correlated``, ``lines``: rms; ``length`` of the correlation
        exp(-(r / length)^(2 hurst)); ``hurst``; ``rough``, ``rough_length``: rms and length of
        Gaussian roughness beside it, 0 where the criterion does not ask for it.
    ranking
        All models, best first.
    converged, reason
        Whether the answer can be used, and a full sentence.
    identifiable
        ``"determined"``, or a sentence that says why not, for each parameter.
    goodness
        Share of the variance about plane and lines that the model explains; for random
        models all but the noise.
    curves
        Loss of each model by name, the least of its round up to each trial step, [steps].
        Least squares: mean over the pixels of weighted squared residuals, um^2; it jumps where
        a round sets weights anew and where all pixels take the place of averaged ones. Random
        models: -2 log likelihood, from the start that led furthest.
    """

    model: Surface
    names: tuple[str, ...] = eqx.field(static=True)
    covariance: Float[np.ndarray, "P P"]
    tilt: tuple[float, float]
    lines: Float[np.ndarray, " ny"]
    residual: Float[Array, "ny nx"]
    noise: dict[str, float]
    ranking: tuple[Ranked, ...] = eqx.field(static=True)
    converged: bool
    reason: str = eqx.field(static=True)
    identifiable: dict[str, str] = eqx.field(static=True)
    goodness: float
    curves: dict[str, Float[np.ndarray, " _"]]

    @property
    def errors(self) -> dict[str, float]:
        """Standard error of each parameter, in its unit."""
        found = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return dict(zip(self.names, map(float, found), strict=True))

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.fitting import previews
        from diffopt.previews import bundles

        return bundles.bundle(self, previews.scan_card)


def fit_scan(
    scan: Heightfield,
    model: Any = "auto",
    *,
    drift: bool = True,
    robust: bool = True,
    edges: str = "averaged",
    max_steps: int = 200,
    progress: Progress | None = None,
) -> ScanFit:
    """Fit a parametric surface to a scan, or the best of several.

    Tilt and the offsets of scan lines are fitted beside the surface; missing pixels (NaN) have
    no weight. Models are ranked by a Bayesian information criterion, -2 log L + P log n: L is
    the debiased Whittle likelihood of the heights that a model leaves as random, under white
    noise, correlated noise and line offsets fitted for each (`noise`), on pixels averaged
    to 192 on a side at most; n counts the independent numbers in it. Standard errors allow for
    the correlation of the noise. A skewness that Gaussian roughness does not have speaks for
    bumps.

    On a scan of more than 192 pixels on a side models compete on averaged pixels, and only
    those within 10 of the best criterion are fitted to all of them, until the best has been:
    the criterion is that of averaged pixels either way. The best is always such a one, unless
    its steps ended early.

    Parameters
    ----------
    scan
        At least 16 x 16 pixels, 30 % of them known.
    model
        ``"auto"``; the name or class of a surface of `diffopt.gratings`; an instance, which
        is the start; or a sequence of these. ``"auto"`` is sinusoidal, blazed, binary,
        trapezoid, crossed, ridges, roughness, bumps and compactdisc. For ridges of another
        profile than a sinusoid pass an instance.
    drift
        Whether scan lines (rows) have offsets of their own.
    robust
        Whether outliers lose weight (Cauchy's).
    edges
        Of the samples, see `diffopt.gratings.Grating.heights`; with ``"sharp"`` the derivatives
        of jumps are missing.
    max_steps
        Trial steps of one model.
    progress
        Called with (name, number, count) before each model. A KeyboardInterrupt, from it or
        the keyboard, ends the comparison: the best so far is returned.

    Raises
    ------
    InputError
        If the scan is too small, flat or empty, or a model is not known or cannot be fitted
        to one scan.
    """
    if not isinstance(scan, Heightfield):
        raise InputError(f"scan: expected a Heightfield, received {type(scan).__name__}")
    checks.choice("edges", edges, ("averaged", "sharp"))
    if max_steps < 1:
        raise InputError(f"max_steps: expected at least 1, received {max_steps}")
    dtype = scan.heights.dtype
    wanted = scan_candidates.wanted(model)
    ready = scan_register.prepared(np.asarray(scan.heights), scan.pixel)
    factor = -(-max(ready.heights.shape) // scan_noise.MOST)
    setting = Setting(
        scan=ready,
        coarse=ready.binned(factor),
        factor=factor,
        vectors=scan_register.wave_vectors(ready),
        drift=drift,
        robust=robust,
        edges=edges,
        max_steps=max_steps,
        dtype=dtype,
    )
    found: list[Candidate] = []
    stopped = False
    try:
        for k, (name, start) in enumerate(wanted):
            if progress is not None:
                progress(name, k, len(wanted))
            found.append(scan_candidates.run(name, start, setting, found))
        _refine(found, setting)
    except KeyboardInterrupt:
        stopped = True
    asked = [c for c in found if c.model is not None]
    if not asked:
        if stopped:
            raise KeyboardInterrupt
        raise InputError(f"scan: no model could be fitted: {found[0].reason}")
    return _result(found, asked, setting, scan, stopped, len(wanted))


def _refine(found: list[Candidate], setting: Setting) -> None:
    """Fit to all pixels what can still be the best; each takes the place of what it was."""
    while True:
        limit = min((c.criterion for c in found if c.model is not None), default=-math.inf)
        coarse = [
            k for k, c in enumerate(found) if c.coarse is not None and c.criterion < limit + _STRONG
        ]
        if not coarse:
            return
        best = min(coarse, key=lambda k: found[k].criterion)
        found[best] = scan_candidates.refined(found[best], setting)


def _result(
    found: list[Candidate],
    asked: list[Candidate],
    setting: Setting,
    scan: Heightfield,
    stopped: bool,
    count: int,
) -> ScanFit:
    best = min(asked, key=lambda c: c.criterion)
    converged, reason = best.converged, best.reason
    if best.deterministic:
        rough = next((c for c in found if c.name == "roughness"), None)
        if rough is None:
            rough = scan_candidates.run("roughness", None, setting, found)
            found = [*found, rough]
        none = noise_alone(setting)
        gain = min(rough.criterion, none) - best.criterion
        if gain < _STRONG:
            converged = False
            reason = (
                f"The scan does not support {best.title}: the criterion of isotropic roughness is "
                f"{abs(gain):.1f} {'lower' if gain < 0 else 'higher'}, and a grating would have "
                f"to lead by {_STRONG:g}."
            )
    if stopped:
        converged = False
        reason = f"Interrupted after {len(asked)} of {count} models; this is the best of them."
    lowest = min(c.criterion for c in found)
    order = sorted(found, key=lambda c: c.criterion)
    ranking = tuple(
        Ranked(
            c.name, c.criterion, c.criterion - lowest, c.parameters, c.rms, c.converged, c.reason
        )
        for c in order
    )
    assert isinstance(best.model, Surface)
    # Spikes are filled for the fit, not for the residual.
    spikes = np.asarray(scan.heights, np.float64) - setting.scan.heights
    residual = np.where(setting.scan.missing, np.nan, best.residual + spikes)
    return ScanFit(
        model=best.model,
        names=best.names,
        covariance=best.covariance,
        tilt=best.tilt,
        lines=best.lines,
        residual=jnp.asarray(residual, scan.heights.dtype),
        noise=best.noise,
        ranking=ranking,
        converged=converged,
        reason=reason,
        identifiable=identifiable(best),
        goodness=best.goodness,
        # Of two fits of one model the better one.
        curves={c.name: c.curve for c in reversed(order) if c.model is not None},
    )


def identifiable(found: Candidate) -> dict[str, str]:
    """For each parameter whether the scan determines it, and if not, why."""
    from diffopt.gratings.parametric import kinds

    assert found.model is not None
    kind, out = kinds(found.model), {}
    variances = np.diag(found.covariance)
    for name, variance in zip(found.names, variances, strict=True):
        value = float(found.model.get(name))
        error = math.sqrt(variance) if variance >= 0 else math.nan
        # Half of what a uniform draw over the range would leave, or half the value.
        limit = {"share": 0.15, "turns": 0.15, "angle": 0.45, "phase": 0.9}.get(
            kind[name], 0.5 * abs(value)
        )
        last = name.split(".")[-1]
        if math.isfinite(error) and 0 < error < limit:
            out[name] = "determined"
        elif not math.isfinite(error) and last in ("phase", "shift") and not found.deterministic:
            out[name] = "The positions of random ridges do not repeat, so that no phase is defined."
        elif error == 0.0 or not math.isfinite(error):
            out[name] = (
                f"The heights do not change with {name} near {value:.4g}, or it is at a bound."
            )
        else:
            out[name] = f"The standard error {error:.3g} is large against the value {value:.4g}."
    return out
