"""The non-uniform FFT as a contender: the best that a general library does.

Averaged over positions of the window, |P|^2 at frequency f is
``sum_rs |c_rs(s)|^2 exp(-|f - f_rs|^2 / spread^2)``. By Poisson's formula that is a Fourier
series in f: at each lattice point x_n the transform of |c|^2, the autocorrelation of
exp(2 pi i s h), times the Gaussian's own transform, which falls off after a few sigma_s. A
type-2 transform (A. H. Barnett, J. Magland and L. af Klinteberg, A parallel nonuniform fast
Fourier transform library based on an "exponential of semicircle" kernel, SIAM J. Sci.
Comput. 41(5), 2019) sums it at all frequencies at once. s enters at Chebyshev points over
the job's range, as in the Chebyshev gather, two of them in each complex transform, since
the sums are real. Bins that no direction reaches are cut off first: the lattice becomes as
coarse as the frequencies allow.

It needs the optional package ``finufft``.
"""

import dataclasses
import math
import os
import time

import jax
import jax.numpy as jnp
import numpy as np

from diffopt import bounds
from diffopt.accuracy.comparison import Row, Task, widened
from diffopt.accuracy.measurement import compile_ahead
from diffopt.diffraction import factors
from diffopt.errors import InputError
from diffopt.kernels import frames, gather, phase

_powers = jax.jit(gather.node_powers, static_argnames="drop_mean")
# Outputs of one call of the library, bytes.
_OUTPUT_BYTES = 2**26


@dataclasses.dataclass(frozen=True)
class Series:
    """Fourier series of |P|^2 at Chebyshev points in s.

    Attributes
    ----------
    transforms
        Of |c|^2 on the coarse lattice, FFT order, [nodes, Ny, Nx].
    lattice
        Steps (y, x) of the lattice, micrometres.
    reach
        Lattice points (y, x) on either side where the Gaussian counts.
    middle, half
        The interval of s.
    eps
        Precision asked of the library.
    """

    transforms: np.ndarray
    lattice: tuple[float, float]
    reach: tuple[int, int]
    middle: float
    half: float
    eps: float

    def strengths(self, spread: float) -> np.ndarray:
        """Strengths of the transforms at one spread, complex, two nodes in each."""
        weights = []
        for step, reach in zip(self.lattice, self.reach, strict=True):
            x = step * np.arange(-reach, reach + 1)
            gauss = math.sqrt(math.pi) * spread * np.exp(-((math.pi * spread * x) ** 2))
            weights.append(step * gauss)
        ny, nx = self.transforms.shape[1:]
        rows = np.arange(-self.reach[0], self.reach[0] + 1) % ny
        columns = np.arange(-self.reach[1], self.reach[1] + 1) % nx
        full = self.transforms[:, rows][:, :, columns] * np.outer(*weights)
        if len(full) % 2:
            full = np.concatenate([full, np.zeros_like(full[:1])])
        return (full[0::2] + 1j * full[1::2]).astype(self.transforms.dtype)


def make_series(task: Task, slack: float = 1.0) -> Series:
    """Series of a task's surface, precise enough for half its tolerance times `slack`."""
    allowed = min(0.5 * task.allowed * slack, 0.1)
    surface, lam, wave = task.brdf.surface, task.wavelengths, task.wave
    dtype = surface.heights.dtype
    low, high = bounds.s_interval(surface, wave[:, 2], lam)
    z = bounds.expansion_argument(surface, wave, lam)
    nodes = phase.chebyshev_nodes(z, 0.3 * allowed)
    middle, half = 0.5 * (low + high), max(0.5 * (high - low), 1e-9)
    at = np.cos(math.pi * (np.arange(nodes) + 0.5) / nodes) * half + middle
    powers = np.asarray(
        _powers(surface.heights, jnp.asarray(at, dtype), drop_mean=surface.drop_mean)
    )[:, 0]
    widest = float(surface.spread(jnp.asarray(lam.min(), dtype)))
    tail = widest * math.sqrt(math.log(1.0 / (0.01 * allowed)))
    kept, lattice = [], []
    for axis, extent in enumerate(surface.extent):
        count = powers.shape[1 + axis]
        farthest = float(np.abs(wave[:, 1 - axis]).max()) / lam.min() + tail
        # Frequencies repeat after kept / extent, which must hold both ends and both tails.
        wanted = 2 * math.ceil(farthest * extent) + 1
        kept.append(np.arange(-(wanted // 2), wanted // 2 + 1) if wanted < count else None)
        lattice.append(extent / min(wanted, count))
    if kept[0] is not None:
        powers = _around_zero(powers, kept[0], 1)
    if kept[1] is not None:
        powers = _around_zero(powers, kept[1], 2)
    narrow = 1.0 / (phase.TWO_PI * float(surface.sigma))
    far = math.sqrt(math.log(1.0 / (0.01 * allowed))) / (math.pi * narrow)
    complex_type = np.complex64 if dtype == jnp.float32 else np.complex128
    return Series(
        transforms=np.fft.fft2(powers).astype(complex_type),
        lattice=(lattice[0], lattice[1]),
        reach=(math.ceil(far / lattice[0]), math.ceil(far / lattice[1])),
        middle=middle,
        half=half,
        eps=max(0.1 * allowed, 1e-6 if dtype == jnp.float32 else 1e-14),
    )


def _around_zero(powers: np.ndarray, bins: np.ndarray, axis: int) -> np.ndarray:
    """The bins around zero frequency, in FFT order."""
    return np.take(powers, np.roll(bins, -(len(bins) // 2)), axis=axis, mode="wrap")


def evaluate(
    task: Task,
    series: Series,
    wi: np.ndarray,
    wo: np.ndarray,
    budget_s: float = math.inf,
    threads: int = 1,
) -> tuple[np.ndarray, float, float, int, int]:
    """Values of the output, seconds, seconds to compile, wavelengths done, bytes at work.

    Stops after `budget_s`: the rest of the wavelengths is then missing.
    """
    import finufft

    brdf, lam = task.brdf, task.wavelengths
    dtype = brdf.surface.heights.dtype
    nodes = len(series.transforms)
    count = -(-nodes // 2)
    itemsize = 2 * np.dtype(dtype).itemsize
    blurred = float(brdf.surface.blur) > 0.0
    group = 1 if blurred else max(1, _OUTPUT_BYTES // (count * len(wi) * itemsize))
    fixed = (jnp.asarray(wi, dtype), jnp.asarray(wo, dtype))
    ends = (jnp.asarray(series.middle, dtype), jnp.asarray(series.half, dtype))
    weights = None if task.weights is None else jnp.asarray(task.weights, dtype)
    total = jnp.zeros((len(wi), 3), dtype)
    empty = jnp.zeros((count, len(wi)), series.transforms.dtype)

    def mix(brdf, total, values, wi, wo, wavelength, weight, middle, half):
        real = jnp.stack([values.real, values.imag], 1).reshape(-1, values.shape[-1])[:nodes]
        wave = frames.wave_vector(wi, wo)
        t = (brdf.surface.height_phase(wave) / wavelength - middle) / half
        square = (phase.chebyshev_weights(t, nodes) * real.T).sum(-1)
        square = square * brdf.surface.peak_loss(wavelength)
        value = factors(brdf, wi, wo, wavelength[None], task.output)[:, 0] * square
        return value[:, None] if weight is None else total + value[:, None] * weight[None, :]

    def arguments(total, values, index):
        weight = None if weights is None else weights[index]
        return (brdf, total, values, *fixed, jnp.asarray(lam[index], dtype), weight, *ends)

    program = compile_ahead(mix, *arguments(total, empty, 0))
    columns, done = [], 0
    shape = tuple(2 * reach + 1 for reach in series.reach)
    start = time.perf_counter()
    how = {"eps": series.eps, "isign": 1, "dtype": empty.dtype.name, "nthreads": threads}
    plan = finufft.Plan(2, shape, n_trans=count, **how)
    sine = (wi + wo)[:, 1::-1] * -phase.TWO_PI * np.array(series.lattice)
    strengths = None
    while done < len(lam) and time.perf_counter() - start < budget_s:
        if strengths is None or blurred:
            spread = float(brdf.surface.spread(jnp.asarray(lam[done], dtype)))
            strengths = np.ascontiguousarray(series.strengths(spread))
        part = lam[done : done + group]
        points = (sine[:, :, None] / part).astype(dtype)
        y, x = (np.ascontiguousarray(points[:, axis].T.ravel()) for axis in (0, 1))
        plan.setpts(y, x)
        values = np.asarray(plan.execute(strengths)).reshape(count, len(part), len(wi))
        for offset in range(len(part)):
            result = program(*arguments(total, jnp.asarray(values[:, offset]), done + offset))
            if weights is None:
                columns.append(np.asarray(result))
            else:
                total = result
        done += len(part)
    seconds = time.perf_counter() - start
    at_work = group * len(wi) * (count * itemsize + 2 * itemsize) + 8 * 4 * math.prod(shape) * count
    out = np.concatenate(columns, -1) if weights is None else np.asarray(total)
    return out, seconds, program.compile_s, done, at_work


def compared(task: Task, name: str) -> Row:
    """Row of a comparison: in the type of the heights if that meets the tolerance, or float64.

    Raises
    ------
    InputError
        If the library is not installed, the model is not averaged over positions, or its
        error exceeds the tolerance in either type.
    """
    try:
        import finufft
    except ImportError:
        raise InputError("left out: the package finufft is not installed") from None
    surface = task.brdf.surface
    if surface.coverage != "positions" or surface.prefactor == "kirchhoff":
        raise InputError("left out: it is made for average='positions' and no facets")
    note = f"tuned, finufft {finufft.__version__}"
    slack, error = _slack(task)
    if slack is not None:
        return _row(task, name, slack, note)
    if surface.heights.dtype != jnp.float32:
        raise InputError(f"does not meet the tolerance {task.tolerance:g}: error {error:.1e}")
    with jax.enable_x64(True):
        wide = dataclasses.replace(task, brdf=widened(task.brdf))
        slack, least = _slack(wide)
        if slack is None:
            raise InputError(f"does not meet the tolerance {task.tolerance:g}: error {least:.1e}")
        return _row(wide, name, slack, f"{note}; float32 errs by {error:.1e}")


def _slack(task: Task) -> tuple[float | None, float]:
    """How far the precision may fall behind what a bound would ask, as measured."""
    error = math.inf
    for slack in (1e4, 1e3, 1e2, 1e1, 1.0):
        series = make_series(task, slack)
        error = task.check.error(evaluate(task, series, *task.checked)[0])
        if error <= task.tolerance:
            return slack, error
    return None, error


def _row(task: Task, name: str, slack: float, note: str) -> Row:
    start = time.perf_counter()
    make_series(task, slack)
    first = time.perf_counter() - start
    start = time.perf_counter()
    series = make_series(task, slack)
    setup_s = time.perf_counter() - start
    error = task.check.error(evaluate(task, series, *task.checked)[0])
    count = len(task.wavelengths)
    # Its threads wait for each other: on a busy machine one is faster than all.
    runs = {
        threads: evaluate(task, series, task.wi, task.wo, 0.5 * task.budget_s, threads)
        for threads in sorted({1, os.cpu_count() or 1})
    }
    threads = min(runs, key=lambda n: runs[n][1] / runs[n][3])
    _, seconds, compile_s, done, at_work = runs[threads]
    run_s = seconds * count / done
    partial = "" if done == count else f"run at {done} wavelengths"
    shape = " x ".join(str(2 * reach + 1) for reach in series.reach)
    return Row(
        method=name,
        settings=f"eps {series.eps:.1e}, nodes {len(series.transforms)}, modes {shape}, "
        f"threads {threads}",
        dtype=str(task.brdf.surface.heights.dtype),
        setup_s=setup_s,
        run_s=run_s,
        compile_s=compile_s + max(0.0, first - setup_s),
        ns=1e9 * run_s / (len(task.wi) * count),
        tables_mb=series.transforms.nbytes / 1e6,
        memory_mb=(series.transforms.nbytes + at_work) / 1e6,
        error=error,
        extrapolated=bool(partial),
        note="; ".join(filter(None, (note, partial))),
    )
