"""What a fit of free heights minimises: misfit to reflectance plus a Gaussian prior.

The unknowns y are coordinates in which the prior is (or is not) white: h = base + C y with C a
circular convolution. Their mean has no effect, so that the mean height is that of the base.
"""

import math
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import bounds, costs, methods
from diffopt.baking import Box
from diffopt.diffraction import DiffractionBRDF, factors
from diffopt.errors import InputError
from diffopt.fitting.measured import Measured
from diffopt.heightfield import Heightfield
from diffopt.kernels import frames, phase
from diffopt.settings import DirectSettings, SeparableSettings

Prior = Literal["smooth", "spectrum"]
Gain = Literal["known", "free"]

# Standard deviation of the change that a smooth prior of weight 1 expects, in wavelengths.
_CHANGE = 0.1
# White share of the variance in a spectrum that is taken from the start: 1 % in height.
_FLOOR = 1e-4
# Information on what is fixed by convention, in units of that of the prior.
_HELD = 1e4
# Lags that a spectrum from the start keeps, standard deviation as a share of the side.
_LAGS = 0.15


def filtered(
    field: Float[Array, "ny nx"], response: Float[Array, "ny half"]
) -> Float[Array, "ny nx"]:
    """Circular convolution with a real, even kernel, given by its half-plane response."""
    spectrum = jnp.fft.rfft2(field)
    return jnp.fft.irfft2(spectrum * response.astype(spectrum.dtype), field.shape)


def smooth_root(shape: tuple[int, int], pixel: tuple[float, float], rms: float) -> np.ndarray:
    """Root spectrum of fields whose Laplacian is nearly white, [ny, nx // 2 + 1].

    1 / (f_0^2 + f^2) with f_0 the inverse of the longer side, for a variance of `rms`^2: the
    penalty is that of (f_0^2 - laplacian / 4 pi^2) of the field, squared.

    Parameters
    ----------
    shape, pixel
        (ny, nx) and (dy, dx), micrometres.
    rms
        Standard deviation of the field, micrometres.
    """
    longest = max(n * step for n, step in zip(shape, pixel, strict=True))
    return _scaled(1.0 / (longest**-2 + _squared_frequency(shape, pixel)), rms, shape)


def gaussian_root(
    shape: tuple[int, int], pixel: tuple[float, float], rms: float, length: float
) -> np.ndarray:
    """Root spectrum of correlation exp(-r^2 / length^2) and variance `rms`^2, as `smooth_root`.

    A share of 1e-4 of the variance is white, so that no frequency is forbidden.
    """
    power = np.exp(-((math.pi * length) ** 2) * _squared_frequency(shape, pixel))
    power /= _mean(power, shape)
    return _scaled(np.sqrt(power + _FLOOR), rms, shape)


def start_root(heights: np.ndarray) -> np.ndarray:
    """Root of the smoothed power spectrum of a surface, as `gaussian_root`.

    Smoothed by a Gaussian taper over lags, which keeps it positive; 1e-4 of the variance is
    white.

    Parameters
    ----------
    heights
        Micrometres, [ny, nx].
    """
    heights = np.asarray(heights, np.float64) - np.mean(heights, dtype=np.float64)
    shape = heights.shape
    covariance = np.fft.irfft2(np.abs(np.fft.rfft2(heights)) ** 2, shape)
    lags = [
        np.fft.fftfreq(n)[:, None] ** 2 if k == 0 else np.fft.fftfreq(n)[None, :] ** 2
        for k, n in enumerate(shape)
    ]
    taper = np.exp(-0.5 * (lags[0] + lags[1]) / _LAGS**2)
    power = np.maximum(np.fft.rfft2(covariance * taper).real, 0.0)
    power /= _mean(power, shape)
    return _scaled(np.sqrt(power + _FLOOR), float(heights.std()), shape)


def slopes(heights: Float[Array, "ny nx"]) -> Float[Array, "2 ny nx"]:
    """Derivatives along y and x of a periodic field, a pixel each: how it changes when moved."""
    spectrum = jnp.fft.fft2(heights)
    ny, nx = heights.shape
    fy, fx = (jnp.asarray(np.fft.fftfreq(n), heights.dtype) for n in (ny, nx))
    rates = jnp.stack(jnp.broadcast_arrays(fy[:, None], fx[None, :])) * (2.0 * math.pi)
    # The product with i, in parts.
    turned = jax.lax.complex(-spectrum.imag, spectrum.real)
    return jnp.fft.ifft2(rates.astype(spectrum.dtype) * turned[None]).real


def _squared_frequency(shape: tuple[int, int], pixel: tuple[float, float]) -> np.ndarray:
    fy, fx = np.fft.fftfreq(shape[0], pixel[0]), np.fft.rfftfreq(shape[1], pixel[1])
    return fy[:, None] ** 2 + fx[None, :] ** 2


def _mean(half: np.ndarray, shape: tuple[int, int]) -> float:
    """Mean over the whole plane of what is given on its half: inner columns count twice."""
    count = np.full(half.shape[1], 2.0)
    count[0] = 1.0
    if shape[1] % 2 == 0:
        count[-1] = 1.0
    return float((half * count[None, :]).sum() / (shape[0] * shape[1]))


def _scaled(root: np.ndarray, rms: float, shape: tuple[int, int]) -> np.ndarray:
    """The root spectrum without its mean, for a field of standard deviation `rms`."""
    root = root.copy()
    root[0, 0] = 0.0
    return root * (rms / math.sqrt(_mean(root**2, shape)))


def prior_root(
    start: Heightfield, shortest: float, prior: Prior, roughness: tuple[float, float] | None
) -> np.ndarray:
    """Root spectrum of a prior by name; arguments as in `fit_heights`.

    Raises
    ------
    InputError
        If roughness is not two positive lengths, or given for another prior.
    """
    if prior == "smooth":
        if roughness is not None:
            raise InputError(
                f"roughness needs prior='spectrum'; received prior='smooth' and {roughness}"
            )
        return smooth_root(start.shape, start.pixel, _CHANGE * shortest)
    if roughness is not None:
        if len(roughness) != 2 or not all(0.0 < float(r) < math.inf for r in roughness):
            raise InputError(
                f"roughness must be (rms, length), positive, in micrometres; received {roughness}"
            )
        return gaussian_root(start.shape, start.pixel, float(roughness[0]), float(roughness[1]))
    return start_root(np.asarray(start.heights))


class Problem(eqx.Module):
    """Loss of free heights over unknowns y, [ny, nx].

    ``0.5 (sum ((a f - values) / noise)^2 + weight sum (white change)^2)`` with
    ``change = colour y`` of the heights from the base; colour and white are circular
    convolutions, white with the inverse root of the prior's covariance.

    Attributes
    ----------
    surface
        What is transformed; its heights are not used.
    wave, before
        Wave vectors [M, 3], and all factors before |P|^2 [M, L].
    wavelengths, weights
        Micrometres [L], and what turns spectra into colours [L, 3], or None.
    values, inverse
        Data and the inverse of their noise, [M, L] or [M, 3].
    base
        Heights at y = 0, micrometres.
    colour, white
        Half-plane responses.
    weight
        Strength of the prior.
    """

    surface: methods.Surface
    wave: Float[Array, "M 3"]
    before: Float[Array, "M L"]
    wavelengths: Float[Array, " L"]
    weights: Float[Array, "L 3"] | None
    values: Float[Array, "M C"]
    inverse: Float[Array, "M C"]
    base: Float[Array, "ny nx"]
    colour: Float[Array, "ny half"]
    white: Float[Array, "ny half"]
    weight: Float[Array, ""]
    settings: DirectSettings | SeparableSettings = eqx.field(static=True)
    gain: Gain = eqx.field(static=True)

    def heights(self, y: Float[Array, "ny nx"]) -> Float[Array, "ny nx"]:
        """Micrometres, at unknowns y."""
        return self.base + filtered(y.astype(self.base.dtype), self.colour)

    def residuals(
        self, heights: Float[Array, "ny nx"]
    ) -> tuple[Float[Array, "M C"], Float[Array, ""]]:
        """(a f - values) / noise, and the gain a: 1, or the best one where it is free."""
        surface = eqx.tree_at(lambda s: s.heights, self.surface, heights)
        if isinstance(self.settings, DirectSettings):
            power = methods.direct(surface, self.wave, self.wavelengths, self.settings)
        else:
            power = methods.separable_pairs(surface, self.wave, self.wavelengths, self.settings)
        model, values = self.before * power, self.values * self.inverse
        if self.weights is not None:
            model = jnp.matmul(model, self.weights, precision="highest")
        model = model * self.inverse
        gain = jnp.ones((), heights.dtype)
        if self.gain == "free":
            # The minimum over a in closed form: the derivative of the loss stays exact.
            gain = (model * values).sum() / (model * model).sum()
        return gain * model - values, gain

    def misfit(self, y: Float[Array, "ny nx"]) -> tuple[Array, Array]:
        """Sum of squared residuals in the default dtype, and the gain."""
        residual, gain = self.residuals(self.heights(y))
        # A sum of many squares wants more digits than each of them.
        return jnp.sum(residual.astype(jnp.result_type(float)) ** 2), gain

    def loss(self, y: Float[Array, "ny nx"]) -> tuple[Float[Array, ""], tuple[Array, Array]]:
        """The loss, and with it the sum of squared residuals and the gain."""
        chi2, gain = self.misfit(y)
        wide = chi2.dtype
        rough = filtered(y.astype(wide), self.colour.astype(wide) * self.white.astype(wide))
        return 0.5 * (chi2 + self.weight.astype(wide) * jnp.sum(rough**2)), (chi2, gain)

    def curvature(
        self, y: Float[Array, "ny nx"], way: Float[Array, "ny nx"] | None = None
    ) -> Float[Array, ""]:
        """Second derivative of the loss along a way, Gauss and Newton's; the gradient if None."""
        dtype = self.base.dtype
        if way is None:
            way = jnp.asarray(jax.grad(lambda y: self.loss(y)[0])(y))
        size = jnp.linalg.norm(way.astype(dtype))
        unit = way.astype(dtype) / jnp.where(size > 0.0, size, 1.0)
        y = y.astype(dtype)
        _, slope = jax.jvp(lambda y: self.residuals(self.heights(y))[0], (y,), (unit,))
        rough = filtered(unit, self.colour * self.white)
        return jnp.sum(slope**2) + self.weight * jnp.sum(rough**2)


def problem(
    measured: Measured,
    start: Heightfield,
    brdf: DiffractionBRDF,
    settings: DirectSettings | SeparableSettings,
    *,
    inverse: np.ndarray,
    root: np.ndarray,
    prior: Prior,
    gain: Gain,
) -> tuple[Problem, Float[Array, "ny nx"]]:
    """The loss of a fit with weight 0 over changes of height, and the change of its start.

    A smooth prior is one of the change from the start, a spectrum one of the heights about
    their mean. `inverse` is one over the noise, `root` from `prior_root`.
    """
    heights, dtype = start.heights, start.heights.dtype
    white = np.divide(1.0, root, out=np.zeros_like(root), where=root > 0)
    base = heights if prior == "smooth" else jnp.full_like(heights, heights.mean())
    wide = jnp.result_type(float)
    lam = measured.wavelengths
    made = Problem(
        surface=brdf.surface,
        wave=frames.wave_vector(measured.wi, measured.wo),
        before=_before(measured, brdf),
        wavelengths=lam,
        weights=measured.weights,
        values=measured.values,
        inverse=jnp.asarray(inverse, dtype),
        base=base,
        colour=jnp.asarray(root > 0, dtype),
        white=jnp.asarray(white, dtype),
        weight=jnp.zeros((), dtype),
        settings=settings,
        gain=gain,
    )
    return made, (heights - base).astype(wide)


def weighted(
    made: Problem, change: Float[Array, "ny nx"], weight: Float[Array, ""], data: Float[Array, ""]
) -> tuple[Problem, Float[Array, "ny nx"]]:
    """The problem at a weight, in unknowns in which its curvature is about one, and these.

    By the curvature of the prior and the mean one of the data, `data`, at every frequency: a
    prior alone would be white in unknowns in which the data are not.
    """
    curvature = data + weight * made.white**2
    colour = jnp.where(made.white > 0.0, 1.0 / jnp.sqrt(curvature), 0.0)
    back = jnp.where(made.white > 0.0, jnp.sqrt(curvature), 0.0)
    made = eqx.tree_at(lambda p: (p.colour, p.weight), made, (colour, weight))
    return made, filtered(change, back.astype(change.dtype))


def _before(measured: Measured, brdf: DiffractionBRDF) -> Float[Array, "M L"]:
    """What |P|^2 is multiplied by to give the measured quantity, colours aside."""
    if measured.quantity == "power":
        return jnp.ones((len(measured.wi), len(measured.wavelengths)), measured.values.dtype)
    output = "relative" if measured.quantity == "relative" else "spectral"
    return factors(brdf, measured.wi, measured.wo, measured.wavelengths, output)


def forward_settings(
    surface: methods.Surface, wave: np.ndarray, lam: np.ndarray, error: float
) -> DirectSettings | SeparableSettings:
    """The cheaper of the direct sum and matrix products within an error of |P|^2.

    Parameters
    ----------
    surface
        Its heights' span is what the settings hold for.
    wave, lam
        Wave vectors [M, 3] and wavelengths [L], micrometres.
    error
        Relative to a mirror's peak; truncation only.
    """
    share = error if surface.coverage == "positions" else error / 3.0
    nodes = phase.chebyshev_nodes(bounds.separable_sweep(surface, wave, lam), share)
    found = (DirectSettings(), SeparableSettings(nodes=nodes, chunk=min(len(wave), 1024)))
    shortest, box = float(lam.min()), Box.around(wave)
    work = {"pairs": len(wave), "wavelengths": len(lam), "box": box, "shortest": shortest}

    def seconds(settings):
        cost = costs.cost(surface, settings, **work, channels=len(lam), gradient=True)
        return cost.run_s

    return min(found, key=seconds)


@eqx.filter_jit
def posterior_deviation(
    made: Problem,
    heights: Float[Array, "ny nx"],
    root: Float[Array, "ny half"],
    weight: Float[Array, ""],
    fixed: Float[Array, "count ny nx"],
    key: Array,
    *,
    rank: int,
) -> Float[Array, "ny nx"]:
    """Standard deviation of each height in Laplace's approximation, from above.

    With A the Gauss-Newton matrix of the misfit in white unknowns the covariance is
    C (weight + A)^-1 C^T. A is replaced by its Nystroem approximation on the range of A applied
    to `rank` random vectors, which is never larger than A (Halko, Martinsson and Tropp, SIAM
    Rev. 53, 217, 2011): too small a rank makes deviations too large, never too small.

    Parameters
    ----------
    made, heights
        The problem, and where it is linearised.
    root
        Root spectrum of the prior.
    weight
        Of the prior.
    fixed
        Changes of the heights that are excluded by convention, as translations are.
    key
        Of the random vectors.
    rank
        Their number; time grows in proportion (twice a forward and an adjoint product each),
        memory by two fields each.
    """
    shape, dtype = heights.shape, heights.dtype

    def along(z):
        return made.residuals(heights + filtered(z, root))[0]

    zero = jnp.zeros(shape, dtype)
    _, adjoint = jax.vjp(along, zero)

    known = jax.vmap(lambda field: filtered(field, root).reshape(-1))(fixed)
    known = jnp.linalg.qr(known.T)[0]

    def product(z):
        _, change = jax.jvp(along, (zero,), (z,))
        held = jnp.matmul(known, jnp.matmul(z.reshape(-1), known, precision="highest"))
        return adjoint(change)[0] + _HELD * weight * held.reshape(shape)

    def products(rows):
        return jax.lax.map(product, rows.reshape(rank, *shape)).reshape(rank, -1)

    def dot(a, b):
        return jnp.matmul(a, b, precision="highest")

    spanned = products(jax.random.normal(key, (rank, heights.size), dtype))
    basis = jnp.linalg.qr(spanned.T)[0].T
    image = products(basis)
    core = dot(basis, image.T)
    core = 0.5 * (core + core.T)
    values, turns = jnp.linalg.eigh(core)
    # A shift by rounding keeps the small eigenvalues away from zero, and the result below A.
    floor = values[-1] * rank * jnp.finfo(dtype).eps
    factor = dot(turns.T, image) / jnp.sqrt(jnp.maximum(values, floor))[:, None]
    # A ~ factor^T factor; its eigenpairs by the small Gram matrix.
    gram, turns = jnp.linalg.eigh(dot(factor, factor.T))
    gram = jnp.maximum(gram, 0.0)
    vectors = dot(turns.T, factor) / jnp.sqrt(jnp.maximum(gram, floor))[:, None]
    share = gram / (weight + gram)

    def gained(total, pair):
        vector, share = pair
        return total + share * filtered(vector.reshape(shape), root) ** 2, None

    total, _ = jax.lax.scan(gained, zero, (vectors, share))
    unit = zero.at[0, 0].set(1.0)
    prior = jnp.sum(filtered(unit, root) ** 2)
    return jnp.sqrt(jnp.maximum(prior - total, 0.0) / weight)
