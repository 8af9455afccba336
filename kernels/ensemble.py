"""Ensemble means of |P|^2 for surfaces that are known by their statistics.

Both are spectral densities: the mean of |integral p exp(i k (u x + v y))|^2 per area, in
square micrometres, without the coherent (mirror) part, which is a delta and is returned by
a function of its own.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.kernels.expansions import taylor_coefficients
from diffopt.kernels.phase import TWO_PI


def log_poisson(m: Array, g: Array) -> Array:
    """log(exp(-g) g^m / m!) for real m >= 1 and g >= 1e-20, without cancellation of large terms."""
    delta = (g - m) / m
    # log(g/m) keeps its digits far below the mean, log1p near it.
    near = jnp.abs(delta) < 0.5
    log_ratio = jnp.where(
        near, jnp.log1p(jnp.where(near, delta, 0.0)), jnp.log(jnp.where(near, 1.0, g / m))
    )
    small = jnp.minimum(m, 16.0)
    exact = jax.lax.lgamma(small + 1.0) - (
        small * jnp.log(small) - small + 0.5 * jnp.log(TWO_PI * small)
    )
    # Stirling's series; the first omitted term at m = 16 is 1/1188/16^9 = 1e-14.
    inverse = 1.0 / jnp.maximum(m, 16.0)
    i2 = inverse * inverse
    series = inverse * (1 / 12 - i2 * (1 / 360 - i2 * (1 / 1260 - i2 / 1680)))
    correction = jnp.where(m < 16.0, exact, series)
    return -m * (delta - log_ratio) - 0.5 * jnp.log(TWO_PI * m) - correction


def poisson_terms(
    g: Float[Array, "*batch"],
    a: Float[Array, "*batch"],
    terms: int,
    *,
    widths: float,
    halvings: int,
) -> tuple[Float[Array, " terms *batch"], Float[Array, " terms *batch"]]:
    """The m that matter in sum_{m>=1} exp(-g) g^m / m! exp(-a / m) / m, and their weights.

    `terms` whole numbers about the largest term; where the bell is wider, every second, third,
    ... m (a trapezoid rule, exact to rounding for a smooth bell). The weights are
    exp(-g) g^m / m! times the step and have a derivative in g.

    Parameters
    ----------
    g
        Mean of the Poisson weights, above 0.
    a
        0 or more.
    terms
        Static.
    widths
        Standard deviations of the bell that must be covered, about its largest term.
    halvings
        Of the interval in which the largest term is looked for, in its logarithm: its relative
        error is about log(2 g) / 2^halvings, and the bell's width about 1 / sqrt(g) of it.
    """
    mean, a = jax.lax.stop_gradient((g, a))

    def slope(m):
        return jnp.log(mean / m) + a / m**2 - 1.5 / m

    def halve(_, ends):
        low, high = ends
        middle = jnp.sqrt(low * high)
        up = slope(middle) > 0
        return jnp.where(up, middle, low), jnp.where(up, high, middle)

    ends = (jnp.ones_like(g), 2.0 * (mean + jnp.sqrt(a) + 10.0))
    peak, _ = jax.lax.fori_loop(0, halvings, halve, ends)
    width = 1.0 / jnp.sqrt(1.0 / peak + 2.0 * a / peak**3)
    step = jnp.maximum(1.0, jnp.ceil(widths * width / terms))
    first = jnp.maximum(1.0, jnp.floor(peak - 0.5 * terms * step))
    count = jnp.arange(terms, dtype=g.dtype).reshape((terms,) + (1,) * g.ndim)
    m = first[None] + step[None] * count
    return m, step[None] * jnp.exp(log_poisson(m, g[None]))


def gaussian_roughness(
    q: Float[Array, ""],
    kappa: Float[Array, ""],
    rms: Float[Array, ""],
    length: Float[Array, ""],
    *,
    terms: int = 256,
) -> Float[Array, ""]:
    """Incoherent spectral density of an isotropic Gaussian random surface.

    ``sum_{m>=1} exp(-g) g^m / m! (pi l^2 / m) exp(-q^2 l^2 / 4m)``, g = (kappa rms)^2, for
    the correlation exp(-r^2 / l^2) (Beckmann and Spizzichino 1963, section 5.3; Stam 1999).
    The sum runs over the `terms` values of m that matter, around its largest term; where
    they are more than `terms` it is a trapezoid rule in m, which is exact to rounding for a
    smooth bell: any g from 0 to 1e8. In float32 the value keeps 1e-4 up to there; the
    derivative to `rms`, a small difference of large terms, keeps 2e-3 to g = 1e6 and a
    quarter at 1e8 (rms heights of 44 and 440 micrometres at 550 nm): use float64 there.

    Parameters
    ----------
    q
        Transverse wave number k sqrt(u^2 + v^2), radians per micrometre, >= 0.
    kappa
        k w, radians per micrometre.
    rms
        Root mean square height, micrometres, >= 0.
    length
        Correlation length l, micrometres, > 0.
    terms
        Static number of terms.
    """
    g = jnp.maximum((kappa * rms) ** 2, jnp.finfo(kappa.dtype).tiny * 1e3)
    a = 0.25 * (q * length) ** 2
    m, weight = poisson_terms(g, a, terms, widths=20.0, halvings=50)
    return (weight * jnp.exp(-a / m) * (math.pi * length**2 / m)).sum()


def gaussian_mirror(kappa: Float[Array, "..."], rms: Float[Array, "..."]) -> Float[Array, "..."]:
    """Share of the power that stays in the mirror direction: exp(-(kappa rms)^2)."""
    return jnp.exp(-((kappa * rms) ** 2))


def _bump(
    qx: Array, qy: Array, kappa: Array, height: Array, sx: Array, sy: Array, terms: int
) -> tuple[Array, Array]:
    """Transform of exp(i kappa b) - 1 for one Gaussian bump b, by its Taylor series."""
    n = jnp.arange(1, terms, dtype=kappa.dtype)
    # Every power of a Gaussian is a Gaussian: the transform is known term by term.
    size = TWO_PI * sx * sy / n * jnp.exp(-0.5 * ((qx * sx) ** 2 + (qy * sy) ** 2) / n)
    series = taylor_coefficients(kappa * height, terms)[1:] * size
    # The powers of i are i, -1, -i, 1 from the first term on.
    odd, even = series[0::2], series[1::2]
    return even[1::2].sum() - even[0::2].sum(), odd[0::2].sum() - odd[1::2].sum()


def random_bumps(
    qx: Float[Array, ""],
    qy: Float[Array, ""],
    kappa: Float[Array, ""],
    height: Float[Array, ""],
    sx: Float[Array, ""],
    sy: Float[Array, ""],
    density: Float[Array, ""],
    *,
    terms: int = 64,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Spectral density and mirror share of sparse Gaussian bumps at random places.

    For bumps ``b = H exp(-x^2/2 sx^2 - y^2/2 sy^2)`` placed independently (Poisson) with
    ``density`` per square micrometre and heights that add, the mean of p p* is
    ``exp(density (2 Re Q(0) + A(r)))`` with Q the transform of exp(i kappa b) - 1 and A its
    autocorrelation. To first order in A (Stam 1999, section on random bumps, has the
    second factor only): ``density |Q|^2 exp(2 density Re Q(0))``; the relative error is
    about ``density A(0) / 2``.

    Parameters
    ----------
    qx, qy
        k u and k v, radians per micrometre.
    kappa
        k w, radians per micrometre; |kappa height| up to about 10 in float32, 25 in
        float64, beyond which the series cancels.
    height, sx, sy
        Bump height and standard deviations, micrometres.
    density
        Bumps per square micrometre.
    terms
        Static number of Taylor terms.

    Returns
    -------
    tuple
        Incoherent density in square micrometres, and the share of the mirror.
    """
    zero = jnp.zeros_like(qx)
    re0, _ = _bump(zero, zero, kappa, height, sx, sy, terms)
    re, im = _bump(qx, qy, kappa, height, sx, sy, terms)
    mirror = jnp.exp(2.0 * density * re0)
    return density * (re**2 + im**2) * mirror, mirror
