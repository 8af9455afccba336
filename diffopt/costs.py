"""What a method costs for a job: seconds and bytes, by a model calibrated by benchmarks."""

import math
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from diffopt import baking
from diffopt.baking import Box
from diffopt.kernels import expansions
from diffopt.methods import Surface
from diffopt.settings import (
    DirectSettings,
    FewSettings,
    GatherSettings,
    LowRankSettings,
    SeparableSettings,
    Settings,
    TableSettings,
    TaylorSettings,
)


@dataclass(frozen=True)
class CostModel:
    """Seconds per unit of work in float32 on two x86 cores; `diffopt bench` measures them.

    Ratios between methods are what matters; float64 takes about twice as long. Compilation,
    one to three seconds for each new shape, is not counted.
    """

    window_sample: float = 2.0e-9
    positions_sample: float = 8.0e-9
    product: float = 1.5e-11
    tap_entry: float = 1.1e-10
    tap_square: float = 1.0e-9
    evaluation: float = 7.5e-8
    # A Chebyshev polynomial in the series of a low-rank expansion, and its use in a term.
    series_node: float = 2.0e-9
    series_entry: float = 1.0e-10
    table_sample: float = 2.0e-8
    # A node of a baked table, for each wavelength; a step of a lookup, for each channel.
    bake_node: float = 7.0e-9
    bake_channel: float = 4.0e-10
    lookup_tap: float = 5.5e-10
    # Beyond the caches each row that a lookup touches costs more.
    lookup_miss: float = 1.5e-8


@dataclass(frozen=True)
class Cost:
    """Predicted cost of one method for one job.

    Attributes
    ----------
    setup_s, run_s
        Seconds to set up once, and to evaluate the job's pairs.
    nbytes
        Memory that the set-up leaves occupied.
    """

    setup_s: float
    run_s: float
    nbytes: int = 0


def cost(
    surface: Surface,
    settings: Settings,
    *,
    pairs: int,
    wavelengths: int,
    box: Box,
    shortest: float,
    channels: int,
    gradient: bool = False,
) -> Cost:
    """Predict the cost of a job.

    Parameters
    ----------
    surface, settings
        The model's surface, and the method.
    pairs, wavelengths, channels
        Of the job: directions, wavelengths, values of the output for each pair.
    box
        Wave vectors of the job, in micrometre-free units (u, v, w).
    shortest
        Shortest wavelength, micrometres.
    gradient
        Whether each run takes a derivative as well: about three runs more.
    """
    model, samples = CostModel(), surface.heights.size
    evaluations = pairs * wavelengths
    averaged = surface.coverage == "positions"
    sample = model.positions_sample if averaged else model.window_sample
    itemsize = surface.heights.dtype.itemsize
    setup, nbytes = 0.0, 0
    if isinstance(settings, DirectSettings):
        run = evaluations * samples * sample
    elif isinstance(settings, SeparableSettings | FewSettings):
        count = settings.count if isinstance(settings, FewSettings) else wavelengths
        chunk = SeparableSettings().chunk if isinstance(settings, FewSettings) else settings.chunk
        blocks = -(-pairs // chunk)
        products = samples * (2 if averaged else 8) * max(pairs, 1) * model.product
        run = count * settings.nodes * (blocks * samples * sample + products)
        if isinstance(settings, FewSettings):
            run += evaluations * 4.0e-8
    elif isinstance(settings, GatherSettings):
        spectra = settings.terms
        if isinstance(settings, LowRankSettings):
            spectra = expansions.lowrank_nodes(settings.terms)
        setup = spectra * samples * model.table_sample
        nbytes = settings.terms * samples * itemsize * (1 if averaged else 2)
        entries = (2 * settings.reach + 1) ** 2 * settings.terms
        if averaged:
            # Powers add up at once; amplitudes are squared bin by bin.
            entry = model.tap_square if isinstance(settings, TaylorSettings) else model.tap_entry
        else:
            entries, entry = 2 * entries, model.tap_entry
        each = model.evaluation + entries * entry
        if isinstance(settings, LowRankSettings):
            each += spectra * (model.series_node + settings.terms * model.series_entry)
        run = evaluations * each
    else:
        setup, run, nbytes = _table(surface, settings, pairs, wavelengths, box, shortest, channels)
    scale = 2.0 if surface.heights.dtype == jnp.float64 else 1.0
    return Cost(scale * setup, scale * run * (4.0 if gradient else 1.0), nbytes)


def _table(surface, settings: TableSettings, pairs, wavelengths, box, shortest, channels):
    model = CostModel()
    plan = baking.layout(surface, box, np.asarray([shortest, 2.0 * shortest]), settings)
    nodes = plan.nodes * plan.columns * plan.rows
    setup = plan.spectra * surface.heights.size * model.table_sample
    setup += wavelengths * nodes * (model.bake_node + model.bake_channel * channels)
    nbytes = plan.nbytes(channels, surface.heights.dtype.itemsize)
    taps = 4 * (settings.order + 1) ** 2
    lookup = taps * channels * model.lookup_tap
    if nbytes > 2**23:
        rows = (settings.order + 1) ** 2 * math.ceil(channels / 4)
        lookup += rows * model.lookup_miss * min(1.0, math.log2(nbytes / 2**23) / 6.0)
    return setup, pairs * lookup, nbytes
