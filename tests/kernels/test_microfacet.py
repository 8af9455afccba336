"""Distributions of normals and their areas against quadrature."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import roots_legendre

from diffopt.kernels import microfacet

# Peaks are narrow: the rule runs in the tangent, scaled by the width.
WIDTHS = [(0.05, 0.05), (0.4, 0.4), (0.2, 1.0)]


def normals(alpha, nodes=400, turns=256):
    """Half vectors [nodes, turns, 3] and weights of solid angle, dense about the peak."""
    x, w = roots_legendre(nodes)
    # theta = atan(alpha tan(t)), t over a quarter turn: the tails of GGX end at t = pi/2.
    t, w = 0.25 * np.pi * (x + 1), 0.25 * np.pi * w
    phi = (np.arange(turns) + 0.5) / turns * 2 * np.pi
    width = np.sqrt((alpha[0] * np.cos(phi)) ** 2 + (alpha[1] * np.sin(phi)) ** 2)
    tan = width * np.tan(t)[:, None]
    cos = 1 / np.sqrt(1 + tan**2)
    sin = tan * cos
    h = np.stack([sin * np.cos(phi), sin * np.sin(phi), cos], -1)
    slope = width / np.cos(t[:, None]) ** 2 * cos**2  # d theta / dt
    return h, w[:, None] * slope * sin * (2 * np.pi / turns)


@pytest.mark.parametrize(
    ("kind", "alpha"),
    [
        *((kind, alpha) for kind in ("ggx", "beckmann") for alpha in WIDTHS),
        *(("gaussian", alpha) for alpha in WIDTHS if alpha[0] == alpha[1]),
    ],
)
def test_the_distribution_covers_the_surface_once(kind, alpha, dtype):
    h, weight = normals(alpha)
    d = microfacet.density(kind, jnp.asarray(h, dtype), tuple(jnp.asarray(a, dtype) for a in alpha))
    total = (np.asarray(d, np.float64) * h[..., 2] * weight).sum()
    # Rounding of the directions over the width, in float32; the trapezoid in azimuth.
    assert total == pytest.approx(1.0, abs=1e-5 if dtype == "float32" else 1e-7)


@pytest.mark.parametrize("kind", ["ggx", "beckmann"])
@pytest.mark.parametrize("alpha", WIDTHS)
@pytest.mark.parametrize("degrees", [0.0, 40.0, 75.0, 89.0])
def test_projected_area(kind, alpha, degrees):
    """A(w) is the integral of max(w.h, 0) D(h); with it G1 shows the mean surface (Heitz)."""
    h, weight = normals(alpha)
    t = np.radians(degrees)
    w = np.array([np.sin(t) * 0.6, np.sin(t) * 0.8, np.cos(t)])
    both = tuple(jnp.asarray(a) for a in alpha)
    d = np.asarray(microfacet.density(kind, jnp.asarray(h), both))
    facing = np.maximum(h @ w, 0.0)
    area = float(microfacet.projected_area(kind, jnp.asarray(w), both))
    # The edge of the facing facets crosses cells of the rule.
    assert area == pytest.approx((d * facing * weight).sum(), rel=2e-5)
    g1 = float(microfacet.masking(kind, jnp.asarray(w), both))
    assert (g1 * d * facing * weight).sum() == pytest.approx(np.cos(t), rel=2e-5)


@pytest.mark.parametrize("cos", [1.0, 0.7, 0.1, 1e-3])
def test_visible_slopes_invert_their_distribution(cos, dtype):
    """Beckmann's slopes at equal steps of the random number split the density equally."""
    u = np.linspace(0.002, 0.998, 200)
    points = jnp.asarray(np.stack([u, np.full_like(u, 0.5)], -1), dtype)
    w = jnp.broadcast_to(jnp.asarray([np.sqrt(1 - cos**2), 0.0, cos], dtype), (200, 3))
    one = jnp.asarray(1.0, dtype)
    h = np.asarray(microfacet.sample_visible("beckmann", points, w, (one, one)), np.float64)
    slopes = -h[:, 0] / h[:, 2]
    # C(x) = (cos (1 + erf x) + sin exp(-x^2)/sqrt(pi))/2 by the trapezoid of its density.
    x = np.linspace(-6, min(cos / np.sqrt(max(1 - cos**2, 1e-12)), 6), 200_001)
    density = (cos - x * np.sqrt(1 - cos**2)) * np.exp(-x * x)
    steps = 0.5 * (density[1:] + density[:-1]) * np.diff(x)
    share = np.concatenate([[0], np.cumsum(steps)]) / steps.sum()
    np.testing.assert_allclose(
        np.interp(slopes, x, share), u, atol=2e-4 if dtype == "float32" else 1e-7
    )
