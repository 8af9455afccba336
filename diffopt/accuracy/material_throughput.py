"""Evaluations and samples per second of materials, beside Mitsuba's on the same cores.

Mitsuba 3 is an independent renderer; where its package is installed its vectorised variant
(LLVM) and its scalar one run the same models on the same directions in the same process. The
entries of a model take turns, so that ratios hold on a busy machine.

The vectorised variant needs an LLVM library newer than 15, named in DRJIT_LIBLLVM_PATH: with an
older one it ends the whole process, so without that name it is left out.
"""

import contextlib
import importlib
import io
import os
import time
from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffopt import fresnel
from diffopt.accuracy import output
from diffopt.accuracy.comparison import random_pairs
from diffopt.accuracy.measurement import compile_ahead, time_together
from diffopt.errors import InputError
from diffopt.materials import BlinnPhong, Lambert, Material, Microfacet, OrenNayar, Phong
from diffopt.materials import RoughDielectric as Rough

ETA, K = 0.27, 3.1
# Calls of the scalar variant: each takes some ten microseconds.
_SCALAR_CALLS = 2_000


@dataclass(frozen=True)
class Row:
    """Rates of one model; None where a program has no such model or does not run.

    Attributes
    ----------
    model, what
        Name, and ``f`` or ``sample``.
    compile_s
        Seconds to trace and compile ours.
    rate, gradient_rate
        Pairs (or samples) per second of ours, and of value and gradient in the parameters.
    vectorised_rate, scalar_rate
        Mitsuba's, LLVM and scalar.
    """

    model: str
    what: str
    compile_s: float
    rate: float
    gradient_rate: float | None
    vectorised_rate: float | None
    scalar_rate: float | None


def models() -> dict[str, tuple[Material, dict[str, Any] | None]]:
    """Materials by name, with what Mitsuba calls the same, where it has it."""
    metal = fresnel.Conductor([0.3, 1.0], [ETA, ETA], [K, K])

    def conductor(normals, au, av):
        return {
            "type": "roughconductor",
            "distribution": normals,
            "alpha_u": au,
            "alpha_v": av,
            "eta": {"type": "spectrum", "value": ETA},
            "k": {"type": "spectrum", "value": K},
        }

    def rough(normals, alpha):
        return Microfacet(alpha, metal, normals=normals, masking="uncorrelated")

    return {
        "lambert": (
            Lambert(0.5),
            {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
        ),
        "oren-nayar": (OrenNayar(0.5, 0.4), None),
        "phong": (Phong(0.5, 50.0), None),
        "blinn-phong": (BlinnPhong(0.5, 50.0), None),
        "conductor, ggx": (rough("ggx", 0.3), conductor("ggx", 0.3, 0.3)),
        "conductor, ggx 0.2/0.6": (rough("ggx", (0.2, 0.6)), conductor("ggx", 0.2, 0.6)),
        "conductor, beckmann": (rough("beckmann", 0.3), conductor("beckmann", 0.3, 0.3)),
        "dielectric, ggx": (
            Rough(1.5, 0.3),
            {"type": "roughdielectric", "distribution": "ggx", "alpha": 0.3},
        ),
    }


def compare(count: int = 1_000_000, repeats: int = 5) -> list[Row]:
    """Time all models.

    Parameters
    ----------
    count
        Pairs, and samples, of one run.
    repeats
        Runs of which the median counts.

    Raises
    ------
    InputError
        For a count or a number of repeats below 1.
    """
    for name, value in (("count", count), ("repeats", repeats)):
        if value < 1:
            raise InputError(f"{name} must be at least 1; received {value}")
    wi, wo = random_pairs(count, 87.0)
    rows = []
    for name, (material, description) in models().items():
        theirs = None if description is None else _Mitsuba(description, wi, wo)
        with jax.enable_x64(False):
            arrays = jnp.asarray(wi, "float32"), jnp.asarray(wo, "float32")
            model = material.typed(jnp.float32)
            rows += _rows(name, model, arrays, theirs, count, repeats)
    return rows


def _rows(name, model, arrays, theirs, count, repeats) -> list[Row]:
    def value(model, wi, wo):
        return model.f(wi, wo)

    def slopes(model, wi, wo):
        return jax.value_and_grad(lambda m: m.f(wi, wo).sum())(model)

    def draw(model, u, wo):
        sample = model.scatter(u, wo)
        return sample.wi, sample.weight, sample.pdf

    leaves, tree = jax.tree.flatten(model)

    def flat(function):
        return lambda leaves, *rest: function(jax.tree.unflatten(tree, leaves), *rest)

    # Both programs are given their random numbers.
    u = jax.random.uniform(jax.random.key(0), arrays[1].shape)
    forward = compile_ahead(flat(value), leaves, *arrays)
    backward = compile_ahead(flat(slopes), leaves, *arrays)
    sampler = compile_ahead(flat(draw), leaves, u, arrays[1])
    runs: list[tuple[Callable[..., Any], tuple]] = [
        (forward, (leaves, *arrays)),
        (backward, (leaves, *arrays)),
        (sampler, (leaves, u, arrays[1])),
    ]
    if theirs is not None:
        runs += [(run, ()) for run in theirs.vectorised()]
    rates = [count / seconds for seconds, _ in time_together(runs, repeats)]
    # After the timing: it changes Mitsuba's variant.
    scalar = (None, None) if theirs is None else theirs.scalar_rates()
    beside = rates[3:] or (None, None)
    return [
        Row(name, "f", forward.compile_s, rates[0], rates[1], beside[0], scalar[0]),
        Row(name, "sample", sampler.compile_s, rates[2], None, beside[1], scalar[1]),
    ]


class _Mitsuba:
    """One of Mitsuba's models on given directions; nothing where it is not installed."""

    def __init__(self, description: dict[str, Any], wi: np.ndarray, wo: np.ndarray) -> None:
        self.description, self.pairs = description, (wi, wo)

    def _load(self, variant: str) -> Any:
        try:
            mi = importlib.import_module("mitsuba")
        except ImportError:
            return None
        # Where LLVM is missing it says so on the terminal, and raises.
        with contextlib.redirect_stderr(io.StringIO()):
            try:
                mi.set_variant(variant)
                if variant.startswith("llvm"):
                    importlib.import_module("drjit").arange(mi.Float, 2)
            except Exception:
                return None
        return mi

    def vectorised(self) -> tuple[Callable[[], Any], ...]:
        """Calls of the vectorised variant that evaluate and that draw; none without it."""
        mi = self._load("llvm_ad_rgb") if os.environ.get("DRJIT_LIBLLVM_PATH") else None
        if mi is None:
            return ()
        dr = importlib.import_module("drjit")
        dr.set_thread_count(os.cpu_count() or 1)
        bsdf, context = mi.load_dict(self.description), mi.BSDFContext()
        wi, wo = (mi.Vector3f(w.T.astype(np.float32)) for w in self.pairs)
        rng = np.random.default_rng(1)
        u = rng.random((3, len(self.pairs[0])))
        u1, u2 = mi.Float(u[0].astype(np.float32)), mi.Point2f(u[1:].astype(np.float32))
        at = dr.zeros(mi.SurfaceInteraction3f, len(self.pairs[0]))
        at.wi = wo
        dr.eval(wi, at.wi, u1, u2)

        def evaluate():
            # The cosine stays in: it is a multiplication.
            value = bsdf.eval(context, at, wi)
            dr.eval(value)
            dr.sync_thread()

        def draw():
            sample, weight = bsdf.sample(context, at, u1, u2)
            dr.eval(sample.wo, sample.pdf, weight)
            dr.sync_thread()

        return evaluate, draw

    def scalar_rates(self) -> tuple[float | None, float | None]:
        """Calls per second of the scalar variant, from Python."""
        mi = self._load("scalar_rgb")
        if mi is None:
            return None, None
        bsdf, context = mi.load_dict(self.description), mi.BSDFContext()
        at = mi.SurfaceInteraction3f()
        wi, wo = (w[:_SCALAR_CALLS].tolist() for w in self.pairs)
        rates = []
        for run in (
            lambda light: bsdf.eval(context, at, light),
            lambda light: bsdf.sample(context, at, 0.5, light[:2]),
        ):
            start = time.perf_counter()
            for light, viewer in zip(wi, wo, strict=True):
                at.wi = viewer
                run(light)
            rates.append(len(wi) / (time.perf_counter() - start))
        return rates[0], rates[1]


def table(rows: list[Row]) -> Any:
    """The rows as a table for the terminal; ratios are ours over Mitsuba's."""
    from rich.table import Table

    found = Table(
        title="Materials: million pairs, or samples, per second",
        caption="Without compilation; random numbers given. Ratio: ours over the vectorised "
        "variant of Mitsuba. Its scalar variant is called from Python, pair by pair.",
    )
    columns = ("compile", "run", "gradient", "Mitsuba LLVM", "ratio", "Mitsuba scalar")
    for name in ("material", "what"):
        found.add_column(name)
    for name in columns:
        found.add_column(name, justify="right")

    def millions(rate):
        return "" if rate is None else f"{rate / 1e6:.3g}"

    for row in rows:
        ratio = "" if row.vectorised_rate is None else f"{row.rate / row.vectorised_rate:.2g}"
        found.add_row(
            row.model,
            row.what,
            f"{row.compile_s:.2g} s",
            millions(row.rate),
            millions(row.gradient_rate),
            millions(row.vectorised_rate),
            ratio,
            millions(row.scalar_rate),
        )
    return found


def save_csv(rows: list[Row], path: str | os.PathLike) -> None:
    """Write the rows; empty where unknown."""
    output.write_csv(list(Row.__dataclass_fields__), [astuple(row) for row in rows], path)
