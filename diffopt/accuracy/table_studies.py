"""Studies of baked tables, and of what is chosen over the range of coherence lengths."""

import dataclasses
import functools
import time

import jax
import jax.numpy as jnp
import numpy as np

from diffopt import baking, bounds, colour, samples
from diffopt.accuracy.comparison import Check, random_pairs, truth, widened
from diffopt.accuracy.output import label
from diffopt.accuracy.studies import Case, Job, Study
from diffopt.baking import Box
from diffopt.choice import PreparedBRDF
from diffopt.diffraction import DiffractionBRDF, evaluate
from diffopt.fresnel import Constant, Dielectric, metal
from diffopt.kernels import phase
from diffopt.settings import ChebyshevSettings, TableSettings

TOLERANCE = 1e-2
_RUN, _CHECKED = 10_000, 60


def _look(prepared: PreparedBRDF, wi, wo):
    return prepared(wi, wo)


def _baked_in(prepared: PreparedBRDF, wi: np.ndarray, wo: np.ndarray) -> float:
    """Seconds to bake the table once more, now that all is compiled."""
    assert isinstance(prepared.settings, TableSettings)
    weights, lam = np.asarray(prepared.weights, np.float64), np.asarray(prepared.wavelengths)
    start = time.perf_counter()
    baking.bake(
        prepared.brdf,
        Box.around(-(wi + wo)),
        np.asarray(lam, np.float64),
        weights,
        prepared.settings,
        relative=False,
    ).coefficients.block_until_ready()
    return time.perf_counter() - start


def _table(quick: bool) -> list[Case]:
    n, pixel, sigma = 64, 0.1, 0.8
    materials = {"mirror": Constant, "glass n=1.5": lambda: Dielectric(1.5)}
    if not quick:
        materials["gold"] = lambda: metal("Au")
    wi, wo = random_pairs(4096)
    lam = colour.wavelengths()
    weights = np.asarray(colour.spectral_weights(lam))
    fine = TableSettings(step=0.25, order=3, nodes=12, intervals=24, error=1e-7)

    @functools.cache
    def model(name):
        with jax.enable_x64(False):
            scan = samples.compact_disc(jax.random.key(0), shape=(n, n), pixel=pixel)
            return DiffractionBRDF(scan, sigma, fresnel=materials[name]())

    @functools.cache
    def expected(name):
        with jax.enable_x64(False):
            return truth(model(name), wi, wo, lam, weights, "xyz", 40 if quick else 150)

    def case(name, axis, step, settings):
        def build():
            check = expected(name)
            prepared = model(name).prepare(
                pairs=(wi, wo), output="xyz", tolerance=TOLERANCE, settings=settings
            )

            def judge(value):
                baked = _baked_in(prepared, wi, wo)
                size = sum(leaf.nbytes for leaf in jax.tree.leaves(prepared.tables))
                return check.error(
                    np.asarray(value)[check.index]
                ), f"baked in {baked:.2g} s, {size / 1e6:.2g} MB"

            arguments = (prepared, jnp.asarray(wi, "float32"), jnp.asarray(wo, "float32"))
            return Job(_look, arguments, judge, prepared.choice.error_bound)

        varied = {"order": settings.order, "nodes": settings.nodes}
        return Case({"material": name, "axis": axis, "step": step, **varied}, "float32", build)

    def across(name, step, order):
        settings = TableSettings(step, order, fine.nodes, fine.intervals, fine.error)
        return case(name, "u, v", step, settings)

    def along(intervals, nodes):
        settings = TableSettings(fine.step, 3, nodes, intervals, fine.error)
        w = -(wi + wo)[:, 2]
        band = float(np.ptp(w)) * baking.height_band(model("mirror").surface) / lam.min()
        return case("mirror", "w", round(band / intervals, 3), settings)

    if quick:
        found = [across("mirror", 0.4, 3), *(across(name, 0.8, 3) for name in materials)]
        return [*found, along(3, 12), along(12, 3)]
    steps = (0.2, 0.35, 0.5, 0.7, 1.0)
    found = [across("mirror", step, order) for order in (1, 2, 3) for step in steps]
    found += [across(n, step, 3) for n in ("glass n=1.5", "gold") for step in (0.2, 0.5, 1.0)]
    return found + [along(intervals, nodes) for nodes in (3, 6, 12) for intervals in (3, 6, 12)]


TABLE = Study(
    name="diffraction.table",
    quantity="steps of a table over (u, v, w) on a compact disc: u and v in standard deviations "
    "of the finest line, w in radians of phase; largest error of XYZ over the largest",
    reference="the direct sum in float64",
    cases=_table,
    conditions=("material", "axis"),
    against="step",
)


def _gathered(brdf: DiffractionBRDF, wi, wo, lam, weights) -> np.ndarray:
    """XYZ by a Chebyshev gather in float64 whose bound is 1e-9 of a mirror's peak."""
    with jax.enable_x64(True):
        wide, wave = widened(brdf), -(wi + wo)
        z = bounds.expansion_argument(wide.surface, wave, lam)
        reach, longest = 1, min(wide.surface.heights.shape) // 2 - 1
        while bounds.gather_cut(wide.surface, reach, lam) > 3e-10 and reach < longest:
            reach += 1
        settings = ChebyshevSettings(terms=phase.chebyshev_nodes(z, 3e-10), reach=reach)
        found = evaluate(wide, wi, wo, lam, settings, output="xyz", weights=weights)
        return np.asarray(found)


def _coherence(quick: bool) -> list[Case]:
    # sigma_s, samples on a side, pixel, largest angle: 8 sigma_s on a side, 4 for the longer.
    # The pixel of the longest resolves 20 degrees only.
    disc = [
        (1.0, 80, 0.1, 75.0),
        (4.0, 320, 0.1, 75.0),
        (16.0, 640, 0.1, 75.0),
        (65.0, 1024, 0.25, 20.0),
    ]
    lam = colour.wavelengths()
    weights = np.asarray(colour.spectral_weights(lam))

    def case(sigma, n, pixel, angle, blur, pairs):
        def build():
            scan = samples.compact_disc(jax.random.key(0), shape=(n, n), pixel=pixel)
            brdf = DiffractionBRDF(scan, sigma, blur=blur)
            wi, wo = random_pairs(pairs, angle)
            # Some seconds of the direct sum; it confirms the reference on more pairs.
            count = int(np.clip(2e8 / (len(lam) * n * n), 2, _CHECKED))
            direct = truth(brdf, wi, wo, lam, weights, "xyz", count)
            rest = np.setdiff1d(np.arange(pairs), direct.index)
            some = np.concatenate([direct.index, rest])[: min(pairs, _RUN)]
            values = _gathered(brdf, wi[some[:_CHECKED]], wo[some[:_CHECKED]], lam, weights)
            check = Check(some[:_CHECKED], values)
            apart = direct.error(values)
            how = {"pairs": (wi, wo), "output": "xyz", "tolerance": TOLERANCE}
            prepared = brdf.prepare(**how)
            start = time.perf_counter()
            again = brdf.prepare(**how, settings=prepared.settings)
            jax.block_until_ready(jax.tree.leaves(again.tables))
            setup_s = time.perf_counter() - start
            arguments = [jnp.asarray(v[some], "float32") for v in (wi, wo)]
            choice = prepared.choice
            settings = label(dataclasses.asdict(choice.settings))

            def judge(value):
                tables = jax.tree.leaves(prepared.tables)
                size = sum(leaf.nbytes for leaf in tables) / 1e6
                jax.block_until_ready(prepared(*arguments))
                start = time.perf_counter()
                jax.block_until_ready(prepared(*arguments))
                each = (time.perf_counter() - start) / len(some)
                return check.error(value), (
                    f"{choice.method}: {settings}; "
                    f"set-up {setup_s:.2g} s (predicted {choice.setup_s:.2g}), "
                    f"run {each * pairs:.2g} s (predicted {choice.run_s:.2g}) for {pairs} pairs, "
                    f"{1e9 * each / len(lam):.3g} ns a pair and wavelength, {size:.3g} MB, "
                    f"patch {n * pixel:g} um, within {angle:g} degrees; reference {apart:.0e} from "
                    f"the direct sum on {count} pairs"
                )

            return Job(_look, (prepared, *arguments), judge, choice.error_bound)

        return Case({"sigma_um": sigma, "blur": blur}, "float32", build)

    if quick:
        return [case(1.0, 80, 0.1, 75.0, 0.0023, 20_000)]
    return [case(*each, blur, 100_000) for each in disc for blur in (0.0, 0.0023)]


COHERENCE = Study(
    name="diffraction.coherence",
    quantity="what is chosen for XYZ of 100,000 pairs within 1e-2 on a compact disc, largest error "
    "over the largest; timed on 10,000 pairs",
    reference="a Chebyshev gather in float64 within 1e-9 on 60 pairs, the direct sum on some",
    cases=_coherence,
    conditions=("sigma_um", "blur"),
    against="sigma_um",
)
