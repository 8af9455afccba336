"""The windowed transform of exp(2 pi i s h) over a heightfield: the direct reference.

Phases are in turns and directions enter as the spatial frequency vector
``q = (u, v, w) / wavelength`` in cycles per micrometre, so that the transform of one
evaluation is ``P = sum_ji a_y[j] exp(2 pi i s h_ji) a_x[i]`` with s = w / wavelength and
*axis factors* ``a_x, a_y`` that hold the window, the phases exp(2 pi i f x) and the
normalisation to a unit mean: a flat mirror at its specular direction gives |P|^2 = 1.

Sample positions are ``x_i = (i - nx // 2) dx``, ``y_j = (j - ny // 2) dy``.
Complex numbers are pairs (real, imaginary) on an axis of length two.

Both intensities carry their closed form
``d|P|^2/dh_ji = 2 Re(P* 2 pi i s a_y p_ji a_x)`` as a custom derivative, valid in forward
and in reverse mode; a loop over many evaluations recomputes it and stores nothing of the
size of the heightfield per evaluation.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.kernels.phase import TWO_PI, cis_turns
from diffopt.kernels.special import dirichlet

# Copies of the patch on either side that a Gaussian window can still reach: with a patch
# of at least two sigma the next copy would weigh exp(-9^2/2) = 3e-18.
IMAGES = 4


def _product(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")


def positions(samples: int, step: float, dtype) -> Float[Array, " samples"]:
    """Sample positions (i - samples // 2) step along one axis, micrometres."""
    return (jnp.arange(samples, dtype=dtype) - samples // 2) * step


def gaussian_axis(
    samples: int,
    step: float,
    frequency: Float[Array, ""],
    sigma: Float[Array, ""],
    center: Float[Array, ""],
) -> Float[Array, "2 samples"]:
    """Axis factor of a Gaussian window on the periodic continuation of a patch.

    Parameters
    ----------
    samples, step
        Number of samples and their distance in micrometres.
    frequency
        Spatial frequency u / wavelength, cycles per micrometre.
    sigma
        Standard deviation sigma_s of exp(-x^2 / 2 sigma_s^2), micrometres, between the
        step and half the patch.
    center
        Position of the window, micrometres from the middle of the patch.

    Returns
    -------
    Array
        Real and imaginary part of ``g(x - x0) exp(2 pi i f x) / sum(g)``, with the copies
        of the patch that the window reaches folded in, [2, samples].
    """
    x = positions(samples, step, frequency.dtype)
    shift = jnp.arange(-IMAGES, IMAGES + 1, dtype=x.dtype) * (samples * step)
    # Nearest copy first: the window may sit anywhere on the periodic surface.
    middle = center - samples * step * jnp.round(center / (samples * step))
    distance = (x[None, :] + shift[:, None] - middle) / sigma
    window = jnp.exp(-0.5 * distance**2) * (step / (math.sqrt(TWO_PI) * sigma))
    # exp(2 pi i f (x + shift)) as a product: the window, which no direction changes, is
    # summed over the copies by one matrix product for all directions.
    turn_re, turn_im = cis_turns(frequency * shift)
    re, im = _product(turn_re, window), _product(turn_im, window)
    cos, sin = cis_turns(frequency * x)
    return jnp.stack([cos * re - sin * im, cos * im + sin * re])


def finite_axis(
    samples: int, step: float, frequency: Float[Array, ""], repeats: int = 1
) -> Float[Array, "2 samples"]:
    """Axis factor of the bare patch, repeated `repeats` times side by side.

    Returns
    -------
    Array
        Real and imaginary part of ``exp(2 pi i f x) D / (samples * repeats)`` with D the
        Dirichlet kernel of the copies, [2, samples]. The first copy is the patch itself.
    """
    cos, sin = cis_turns(frequency * positions(samples, step, frequency.dtype))
    if repeats > 1:
        real, imag = dirichlet(frequency * (samples * step), repeats)
        cos, sin = cos * real - sin * imag, cos * imag + sin * real
    return jnp.stack([cos, sin]) / samples


def bin_weights(
    samples: int,
    step: float,
    frequency: Float[Array, "..."],
    spread: Float[Array, "..."],
) -> Float[Array, "... samples"]:
    """Gaussian weight of each Fourier bin of a patch at a spatial frequency.

    Averaged over every position of a Gaussian window, |P|^2 is exactly
    ``sum_rs |c_rs|^2 exp(-|f - f_rs|^2 / sigma_f^2)``, sigma_f = 1 / (2 pi sigma_s); a blur
    over directions widens the Gaussian.

    Parameters
    ----------
    samples, step
        Number of samples and their distance in micrometres; bins in FFT order.
    frequency
        Spatial frequency, cycles per micrometre, [...].
    spread
        Width of exp(-df^2 / spread^2), cycles per micrometre, [...].
    """
    bins = jnp.arange(samples, dtype=frequency.dtype) / (samples * step)
    distance = frequency[..., None] - bins.reshape((1,) * frequency.ndim + (samples,))
    # The spectrum of samples is periodic with 1/step: the nearest alias counts.
    distance = distance - jnp.round(distance * step) / step
    return jnp.exp(-((distance / spread[..., None]) ** 2))


def _moments(cos: Array, sin: Array, ax: Array) -> tuple[Array, Array]:
    """Row sums of p a_x: real and imaginary part, [ny] each."""
    c, s = _product(cos, ax.T), _product(sin, ax.T)
    return c[:, 0] - s[:, 1], c[:, 1] + s[:, 0]


def amplitude(
    heights: Float[Array, "ny nx"],
    s: Float[Array, ""],
    ax: Float[Array, "2 nx"],
    ay: Float[Array, "2 ny"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Windowed transform P = a_y^T exp(2 pi i s h) a_x of one evaluation.

    Parameters
    ----------
    heights
        Heights in micrometres, [ny, nx].
    s
        w / wavelength (negative), cycles per micrometre.
    ax, ay
        Axis factors, see `gaussian_axis` and `finite_axis`.
    """
    cos, sin = cis_turns(s * heights)
    re, im = _moments(cos, sin, ax)
    return jnp.vdot(re, ay[0]) - jnp.vdot(im, ay[1]), jnp.vdot(re, ay[1]) + jnp.vdot(im, ay[0])


@jax.custom_jvp
def coherent_intensity(
    heights: Float[Array, "ny nx"],
    s: Float[Array, ""],
    ax: Float[Array, "2 nx"],
    ay: Float[Array, "2 ny"],
) -> Float[Array, ""]:
    """|P|^2 of one coherent window; arguments as in `amplitude`, closed-form derivative."""
    re, im = amplitude(heights, s, ax, ay)
    return re * re + im * im


@coherent_intensity.defjvp
def _coherent_intensity_jvp(primals, tangents):
    heights, s, ax, ay = primals
    d_heights, d_s, d_ax, d_ay = tangents
    cos, sin = cis_turns(s * heights)
    re, im = _moments(cos, sin, ax)
    p_re = jnp.vdot(re, ay[0]) - jnp.vdot(im, ay[1])
    p_im = jnp.vdot(re, ay[1]) + jnp.vdot(im, ay[0])
    # b = P* a_y; the derivative to a height is -4 pi s Im(b_j p_ji a_i).
    b_re = p_re * ay[0] + p_im * ay[1]
    b_im = p_re * ay[1] - p_im * ay[0]
    b = jnp.stack([b_re, b_im]).T
    slope = cos * _product(b, ax[::-1]) + sin * _product(b, jnp.stack([ax[0], -ax[1]]))
    tangent = -2.0 * TWO_PI * ((slope * d_heights).sum() * s + (slope * heights).sum() * d_s)
    d_re, d_im = _moments(cos, sin, d_ax)
    tangent += 2.0 * (jnp.vdot(d_re, b_re) - jnp.vdot(d_im, b_im))
    tangent += 2.0 * p_re * (jnp.vdot(re, d_ay[0]) - jnp.vdot(im, d_ay[1]))
    tangent += 2.0 * p_im * (jnp.vdot(re, d_ay[1]) + jnp.vdot(im, d_ay[0]))
    return p_re * p_re + p_im * p_im, tangent


def _phase_spectrum(heights: Array, s: Array, drop_mean: bool) -> tuple[Array, Array, Array]:
    cos, sin = cis_turns(s * heights)
    c = jnp.fft.ifft2(jax.lax.complex(cos, sin))
    return cos, sin, c.at[0, 0].set(0.0) if drop_mean else c


def power_spectrum(
    heights: Float[Array, "ny nx"], s: Float[Array, ""], *, drop_mean: bool = False
) -> Float[Array, "ny nx"]:
    """|c_rs|^2 of exp(2 pi i s h), FFT order, c = ifft2; sums to one (Parseval).

    `drop_mean` sets the zero order c_00 (the mirror part) to zero.
    """
    _, _, c = _phase_spectrum(heights, s, drop_mean)
    return c.real**2 + c.imag**2


@partial(jax.custom_jvp, nondiff_argnums=(4,))
def averaged_intensity(
    heights: Float[Array, "ny nx"],
    s: Float[Array, ""],
    wx: Float[Array, " nx"],
    wy: Float[Array, " ny"],
    drop_mean: bool = False,
) -> Float[Array, ""]:
    """|P|^2 averaged over all positions of the window: sum of w_y |c|^2 w_x.

    Parameters
    ----------
    heights, s
        As in `amplitude`.
    wx, wy
        Weights of the Fourier bins, see `bin_weights`.
    drop_mean
        Leave out the zero order (the mirror part).
    """
    return jnp.vdot(wy, _product(power_spectrum(heights, s, drop_mean=drop_mean), wx))


@averaged_intensity.defjvp
def _averaged_intensity_jvp(drop_mean, primals, tangents):
    heights, s, wx, wy = primals
    d_heights, d_s, d_wx, d_wy = tangents
    cos, sin, c = _phase_spectrum(heights, s, drop_mean)
    power = c.real**2 + c.imag**2
    weight = wy[:, None] * wx[None, :] / heights.size
    back = jnp.fft.fft2(jax.lax.complex(c.real * weight, c.imag * weight))
    slope = sin * back.real - cos * back.imag
    tangent = -2.0 * TWO_PI * ((slope * d_heights).sum() * s + (slope * heights).sum() * d_s)
    rows = _product(power, wx)
    tangent += jnp.vdot(d_wy, rows) + jnp.vdot(wy, _product(power, d_wx))
    return jnp.vdot(wy, rows), tangent
