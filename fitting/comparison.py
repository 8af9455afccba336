"""Expectation maximisation, least squares and their rivals on the same slices, in one run.

The glossy-transfer paper replaces a nonlinear minimisation (47 s) by its "EM" (2 s), which for
one lobe is a closed-form fit of moments with another objective. `compare` measures what each
method costs and what it reaches: time for one function and in a batch, relative L2 error on
an independent fine quadrature, energy, likelihood, steps, success.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from diffopt.accuracy.measurement import compile_ahead
from diffopt.errors import InputError
from diffopt.fitting import rivals
from diffopt.fitting.lobe_settings import LobeSettings
from diffopt.fitting.lobe_table import LobeComparison, Row
from diffopt.fitting.lobe_targets import slices
from diffopt.fitting.lobes import Nodes, fit_bytes, fit_nodes, members
from diffopt.kernels import mixture, vmf
from diffopt.materials.base import Material
from diffopt.materials.phong import BlinnPhong

#: The slices of the paper: exponents of Blinn-Phong.
EXPONENTS = (4.0, 16.0, 32.0, 64.0, 128.0)
ANGLES = (0.0, 30.0, 60.0, 80.0)
#: Methods, in the order of the table.
METHODS = (
    "moments",
    "em-samples",
    "em-10",
    "em-50",
    "em-1000",
    "em+lm",
    "em+lm-settled",
    "normal-lm",
    "optimistix-lm",
    "optimistix-dogleg",
    "optimistix-gauss-newton",
    "optimistix-bfgs",
    "scipy-trf",
)
# Steps (EM, coarse, fine) that are tried, in turn, to reach a rival's error.
BUDGETS = (
    (10, 0, 3),
    (10, 10, 3),
    (10, 10, 5),
    (10, 20, 5),
    (10, 40, 5),
    (10, 40, 10),
    (10, 40, 15),
    (10, 40, 20),
    (10, 80, 30),
    (10, 80, 60),
    (10, 80, 120),
)
_FINE = LobeSettings(rings=96, sectors=144)
_SETTLED_ROUNDS = 40


def compare(
    materials: Sequence[Material] | Material | None = None,
    lobes: Sequence[int] = (1, 2, 4, 8),
    *,
    wo: Any = None,
    methods: Sequence[str] = METHODS,
    samples: int = 10_000,
    repeats: int = 7,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> LobeComparison:
    """Fit lobes to the same slices by every method.

    Parameters
    ----------
    materials
        One or several; Blinn-Phong with the exponents of the paper if left out.
    lobes
        Numbers of lobes.
    wo
        Directions to the viewer, [V, 3]; 0, 30, 60 and 80 degrees to the normal if left out.
        All materials are seen from all of them.
    methods
        Some of `METHODS`.
    samples
        Of ``em-samples``, for each slice.
    repeats
        Timed runs, of which the median counts; those of SciPy and of optimistix's own
        solvers, which take seconds, run at most three times.
    seed
        Of the starts and samples.
    progress
        Called with what comes next.

    Returns
    -------
    LobeComparison
        Rows, and how many times as fast ``em+lm`` reaches each rival's error plus 5 %.
    """
    unknown = [m for m in methods if m not in METHODS]
    if unknown:
        raise InputError(f"methods must be some of {', '.join(METHODS)}; received {unknown[0]!r}")
    if materials is None:
        materials = [BlinnPhong(exponent=e) for e in EXPONENTS]
    chosen = [materials] if isinstance(materials, Material) else list(materials)
    if wo is None:
        theta = np.deg2rad(ANGLES)
        wo = np.stack([np.sin(theta), 0.0 * theta, np.cos(theta)], -1)
    job = _Job.of(chosen, jnp.asarray(wo, jnp.float32), samples, repeats, seed)
    rows: list[Row] = []
    for count in lobes:
        for method in methods:
            if method == "moments" and count != 1:
                continue
            if progress is not None:
                progress(f"{count} lobes, {method}")
            rows.append(job.row(method, count))
        rows += [job.reached(row) for row in rows if row.lobes == count and row.rival]
    text = f"{job.fine.values.shape[0]} slices of {len(chosen)} materials"
    return LobeComparison(tuple(rows), text)


@dataclass(frozen=True)
class _Job:
    """Slices on the nodes of the fit and on fine ones."""

    nodes: Nodes
    fine: Nodes
    drawn: tuple[Array, Array]
    repeats: int
    seed: int

    @staticmethod
    def of(
        materials: Sequence[Material], wo: Array, samples: int, repeats: int, seed: int
    ) -> "_Job":
        def all_of(settings: LobeSettings) -> Nodes:
            parts = [slices(m, wo, settings) for m in materials]
            return jax.tree.map(lambda *a: jnp.concatenate(a), *parts)

        key = jax.random.key(seed)
        drawn = []
        for material in materials:
            seen = jnp.broadcast_to(wo[:, None], (wo.shape[0], samples, 3))
            sample = material.sample(key, seen)
            weight = sample.weight.reshape(*sample.pdf.shape, -1).mean(-1)
            drawn.append((sample.wi, weight))
        directions, weights = (jnp.concatenate(column) for column in zip(*drawn, strict=True))
        return _Job(all_of(LobeSettings()), all_of(_FINE), (directions, weights), repeats, seed)

    @property
    def keys(self) -> Array:
        return jax.random.split(jax.random.key(self.seed), self.nodes.values.shape[0])

    def row(self, method: str, count: int) -> Row:
        """One method at one number of lobes."""
        if method in ("em+lm", "em+lm-settled"):
            rounds = _SETTLED_ROUNDS if method == "em+lm-settled" else 1
            return self._fitted(method, count, LobeSettings(energy="fitted", rounds=rounds))
        if method == "scipy-trf":
            return self._scipy(count)
        if method in rivals.solvers():
            return self._optimistix(method, count)
        return self._expectation(method, count)

    def reached(self, rival: Row) -> Row:
        """What ``em+lm`` takes to reach a rival's error plus 5 %, its start included."""
        row = None
        for em, coarse, steps in BUDGETS:
            settings = LobeSettings(
                em_steps=em, coarse_steps=coarse, lm_steps=steps, energy="fitted"
            )
            row = self._fitted("em+lm", rival.lobes, settings)
            if row.error <= 1.05 * rival.error:
                break
        assert row is not None
        found = row.error <= 1.05 * rival.error
        return replace(
            row,
            method=f"em+lm to {rival.method}",
            ratio=rival.time_s / row.time_s if found else None,
            single_ratio=rival.single_s / row.single_s if found else None,
            note=row.note if found else f"{row.note}; error not reached",
        )

    def _fitted(self, method: str, count: int, settings: LobeSettings) -> Row:
        key = jax.random.key(self.seed)

        def fit(nodes: Nodes) -> Any:
            return jax.block_until_ready(fit_nodes(nodes, count, settings=settings, key=key))

        first = time.perf_counter()
        fitted = fit(self.nodes)
        compile_s = time.perf_counter() - first
        one = _alone(self.nodes)
        row = self._judged(method, count, *fitted.lobes.arrays, dtype="float32")
        seconds, spread = _times(lambda: fit(self.nodes), self.repeats)
        # A function alone: the mean over all of them, each compiled in the same shape.
        alone, _ = _times(lambda: [fit(each) for each in one], max(3, self.repeats // 2))
        steps = f"{settings.em_steps} EM, {settings.coarse_steps} coarse, {settings.lm_steps} fine"
        return replace(
            row,
            compile_s=compile_s,
            time_s=seconds / len(one),
            spread_s=spread / len(one),
            single_s=alone / len(one),
            steps=_mean(fitted.steps),
            success=_mean(fitted.settled),
            memory_bytes=fit_bytes(self.nodes, count, settings, key),
            note=steps + (f", {settings.rounds} rounds at most" if settings.rounds > 1 else ""),
        )

    def _expectation(self, method: str, count: int) -> Row:
        sampled = method == "em-samples"
        steps = 0 if method == "moments" else 50 if sampled else int(method.split("-")[1])
        sharpest = 1e6

        def one(given: tuple) -> tuple[Array, Array, Array]:
            directions, weights, key = given
            if count == 1:
                total, mu, kappa = mixture.moments(directions, weights, sharpest)
                return total[None], mu[None], kappa[None]
            start = mixture.scattered_start(key, directions, weights, count, sharpest)
            found, _ = mixture.expectation_maximisation(directions, weights, start, steps, sharpest)
            return weights.sum() * jnp.exp(found.log_share), found.mu, found.kappa

        directions, solid, values = self.nodes.scalar()
        weights = solid * values
        if sampled:
            directions, weights = self.drawn
            weights = weights / weights.shape[1]
        return self._timed(
            method, count, jax.vmap(lambda *a: one(a)), (directions, weights, self.keys), steps
        )

    def _optimistix(self, method: str, count: int) -> Row:
        wide = method != "normal-lm"
        with jax.enable_x64(wide):
            nodes, start = self._begun(count, jnp.float64 if wide else jnp.float32)
            tolerance = 1e-6 if wide else 1e-4
            fit = rivals.optimistix_fit(rivals.solvers(tolerance, tolerance)[method])
            return self._timed(method, count, fit, (nodes, start), None)

    def _scipy(self, count: int) -> Row:
        with jax.enable_x64(True), rivals.one_thread() as alone:
            nodes, start = self._begun(count, jnp.float64)
            first = time.perf_counter()
            rivals.scipy_fit(*(_alone((nodes, start))[0]), max_steps=2)
            compile_s = time.perf_counter() - first
            found = rivals.scipy_fit(nodes, start)
            seconds, spread = _times(lambda: rivals.scipy_fit(nodes, start), 3)
            row = self._judged("scipy-trf", count, *found[:3], dtype="float64")
        size = nodes.values.shape[0]
        return replace(
            row,
            compile_s=compile_s,
            time_s=seconds / size,
            spread_s=spread / size,
            single_s=seconds / size,
            steps=_mean(found.steps),
            success=_mean(found.success),
            rival=True,
            note="" if alone else "BLAS threads not limited (threadpoolctl is not installed)",
        )

    def _begun(self, count: int, dtype: Any) -> tuple[Nodes, rivals.Start]:
        """Nodes and the common start of all solvers: ten steps of EM."""
        settings = LobeSettings(em_steps=10)
        with jax.enable_x64(False):
            nodes = _without_coarse(self.nodes)
            fit = fit_nodes(
                nodes, count, method="em", settings=settings, key=jax.random.key(self.seed)
            )
            held = jax.tree.map(np.asarray, (nodes, fit.lobes.arrays))
        return jax.tree.map(lambda a: jnp.asarray(a, dtype), held)

    def _timed(
        self, method: str, count: int, function: Callable, arguments: tuple, steps: int | None
    ) -> Row:
        """A row of a compiled function of a batch; single functions by the batch of one."""
        size = jax.tree.leaves(arguments)[0].shape[0]
        program = compile_ahead(function, *arguments)
        found = program(*arguments)
        one = _alone(arguments)
        single = compile_ahead(function, *one[0])
        repeats = self.repeats if steps is not None else 3
        seconds, spread = _times(lambda: program(*arguments), repeats)
        alone, _ = _times(lambda: [single(*each) for each in one], min(3, repeats))
        dtype = str(jax.tree.leaves(arguments)[0].dtype)
        row = self._judged(method, count, *found[:3], dtype=dtype)
        taken = steps if steps is not None else _mean(found.steps)
        return replace(
            row,
            compile_s=program.compile_s,
            time_s=seconds / size,
            spread_s=spread / size,
            single_s=alone / size,
            steps=float(taken),
            success=None if steps is not None else _mean(found.success),
            memory_bytes=program.peak_bytes,
            rival=steps is None,
        )

    def _judged(
        self, method: str, count: int, alpha: Array, mu: Array, kappa: Array, *, dtype: str
    ) -> Row:
        with jax.enable_x64(False):
            lobes = tuple(jnp.asarray(np.asarray(a), jnp.float32) for a in (alpha, mu, kappa))
            error, energy, likelihood = _quality(self.fine, *lobes)
        return Row(
            method=method,
            lobes=count,
            dtype=dtype,
            error=_mean(error),
            worst=float(np.asarray(error).max()),
            energy=_mean(np.abs(energy)),
            likelihood=_mean(likelihood),
        )


@jax.jit
def _quality(nodes: Nodes, alpha: Array, mu: Array, kappa: Array) -> tuple[Array, Array, Array]:
    """Relative L2 error, relative error of energy, mean log likelihood of each function."""

    def one(given: tuple) -> tuple[Array, Array, Array]:
        directions, solid, values, alpha, mu, kappa = given
        density = vmf.pdf(directions[None], mu[:, None], kappa[:, None])
        model = (alpha[:, None] * density).sum(0)
        error = jnp.sqrt((solid * (model - values) ** 2).sum() / (solid * values**2).sum())
        whole = (solid * values).sum()
        share = solid * values / whole
        fitted = jnp.log(jnp.maximum(model / alpha.sum(), 1e-30))
        return error, alpha.sum() / whole - 1.0, (share * fitted).sum()

    return jax.lax.map(one, (*nodes.scalar(), alpha, mu, kappa))


def _without_coarse(nodes: Nodes) -> Nodes:
    """Nodes without their coarse grid, for solvers that take one."""
    return Nodes(nodes.directions, nodes.solid_angles, nodes.values)


def _mean(values: Any) -> float:
    """Of an array that may have been made while 64-bit types were on."""
    return float(np.asarray(values, np.float64).mean())


def _alone(batch: Any) -> list[Any]:
    """Batches of one."""
    size = jax.tree.leaves(batch)[0].shape[0]
    return [members(batch, slice(row, row + 1)) for row in range(size)]


def _times(run: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """Median and quartile distance of the seconds of a run that waits for its result."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - start)
    low, middle, high = np.quantile(seconds, [0.25, 0.5, 0.75])
    return float(middle), float(high - low)
