"""Hard inputs of the kernels of spherical harmonics: see `hard_cases`.

The twins hold the definitions: derivatives of Legendre polynomials by their integer
coefficients, rotations and matrices as integrals.
"""

from dataclasses import replace
from functools import cache, partial
from math import comb, factorial

import jax
import jax.numpy as jnp
import numpy as np
from hard_cases import LD, PI, Hard

from diffopt.kernels import (
    harmonic_products,
    harmonic_rotation,
    harmonics,
    hemispherical,
    rescaling,
    rescaling_matrices,
    rescaling_tables,
)

SLANT = np.array([0.48, -0.36, 0.8])
NORTH = np.array([0.0, 0.0, 1.0])
LEVEL = np.array([0.6, -0.8, 0.0])
# Of three bands: no two alike, of both signs.
SOME = np.round(np.cos(np.arange(9) * 1.7) * (1 + np.arange(9) / 4), 3)
OTHER = np.round(np.sin(np.arange(9) * 2.3 + 1), 3)
QUARTER = np.pi / 2


def harmonic_rows():
    """All of them, each compiled whole."""
    parts = (_values, _zonals, _rotations, _products, _hemispheres, _maps, _matrices, _tables)
    for part in parts:
        for row in part():
            yield replace(row, call=jax.jit(row.call))


@cache
def _legendre(degree, slopes=0):
    """Powers of a derivative of a Legendre polynomial, with its integer coefficients."""
    powers = {}
    for k in range(degree // 2 + 1):
        power = degree - 2 * k
        if power >= slopes:
            fall = factorial(power) // factorial(power - slopes)
            value = (-1) ** k * comb(degree, k) * comb(2 * degree - 2 * k, degree) * fall
            powers[power - slopes] = LD(value) / LD(2) ** degree
    return powers


def _at(powers, z):
    return sum((value * z**power for power, value in powers.items()), 0 * z)


def _harmonics(d, bands):
    x, y, z = d[..., 0], d[..., 1], d[..., 2]
    rows = []
    for degree in range(bands):
        for order in range(-degree, degree + 1):
            m = abs(order)
            square = LD(2 * degree + 1) / (4 * PI) * factorial(degree - m) / factorial(degree + m)
            around = (x + 1j * y) ** m
            part = around.imag if order < 0 else around.real
            value = np.sqrt(square * (2 if m else 1)) * _at(_legendre(degree, m), z)
            rows.append(value * part)
    return np.stack(rows)


@cache
def _gauss(nodes):
    """Gauss-Legendre of 80 bits on [-1, 1]: Newton's method from that of 64."""
    x = np.polynomial.legendre.leggauss(nodes)[0].astype(LD)
    for _ in range(3):
        below, value = np.ones_like(x), x
        for n in range(1, nodes):
            below, value = value, ((2 * n + 1) * x * value - n * below) / (n + 1)
        slope = nodes * (x * value - below) / (x * x - 1)
        x = x - value / slope
    return x, 2 / ((1 - x * x) * slope**2)


@cache
def _sphere(polar, azimuthal):
    z, weight = _gauss(polar)
    phi = (np.arange(azimuthal) + LD(0.5)) * (2 * PI / azimuthal)
    sine = np.sqrt(1 - z * z)
    d = np.stack(
        [np.outer(sine, np.cos(phi)), np.outer(sine, np.sin(phi)), z[:, None] + 0 * phi], -1
    )
    weights = weight[:, None] * (2 * PI / azimuthal) + 0 * phi
    return d.reshape(-1, 3), weights.reshape(-1)


def _values():
    for label, d in (("north", NORTH), ("south", -NORTH), ("level", LEVEL), ("slant", SLANT)):
        for bands in (4, 9):
            yield Hard(
                "harmonics.basis",
                f"{label}, {bands} bands",
                partial(harmonics.basis, bands=bands),
                (d,),
                partial(_harmonics, bands=bands),
                ulps=8 if bands == 4 else 20,  # as many steps as bands
            )
    for label, d in (("south", -NORTH), ("slant", SLANT)):
        yield Hard(
            "harmonics.evaluate",
            label,
            harmonics.evaluate,
            (SOME, d),
            lambda c, d: c @ _harmonics(d, 3),
            ulps=16,  # of nine terms that cancel
        )
    nodes, weights = harmonics.sphere_rule(2, 3)
    d, w = _sphere(2, 3)
    yield Hard(
        "harmonics.project",
        "two bands",
        lambda f: harmonics.project(
            f, jnp.asarray(nodes, f.dtype), jnp.asarray(weights, f.dtype), 2
        ),
        (np.array([1.0, -2.0, 0.0, 1e-30, 0.3, 0.7]),),
        lambda f: (_harmonics(d, 2) * w) @ f,
    )


def _cap(a, bands):
    x, rise = np.cos(a), np.sin(a) ** 2
    rows = [2 * np.sqrt(PI) * np.sin(a / 2) ** 2]
    for n in range(1, bands):
        rows.append(np.sqrt(PI * (2 * n + 1)) / (n * (n + 1)) * rise * _at(_legendre(n, 1), x))
    return np.stack(rows)


def _zonal(z, axis):
    degrees = np.repeat(np.arange(len(z)), 2 * np.arange(len(z)) + 1)
    return np.sqrt(4 * PI / (2 * degrees + 1)) * z[degrees] * _harmonics(axis, len(z))


def _zonals():
    for label, axis in (("north", NORTH), ("slant", SLANT)):
        yield Hard(
            "harmonics.zonal", label, harmonics.zonal, (np.array([1.0, -0.5, 0.25]), axis), _zonal
        )
    for x in (1.0, -1.0, 0.0, 0.3):
        yield Hard(
            "harmonics.legendre",
            f"x={x}",
            partial(harmonics.legendre, bands=6),
            (x,),
            lambda x: np.stack([_at(_legendre(n), x) for n in range(6)]),
        )
    for a in (0.0, 1e-6, 1.2, QUARTER, np.pi - 1e-4, np.pi):
        yield Hard(
            "harmonics.cap",
            f"a={a:.6g}",
            partial(harmonics.cap, bands=6),
            (a,),
            partial(_cap, bands=6),
            ulps=20,
        )


def _turns(angle, xp):
    """About z and about y, stacked; in either library."""
    c, s, one, zero = xp.cos(angle), xp.sin(angle), xp.ones_like(angle), xp.zeros_like(angle)
    about_z = xp.stack(
        [xp.stack([c, -s, zero]), xp.stack([s, c, zero]), xp.stack([zero, zero, one])]
    )
    about_y = xp.stack(
        [xp.stack([c, zero, s]), xp.stack([zero, one, zero]), xp.stack([-s, zero, c])]
    )
    return about_z, about_y


def _turned(c, matrix, bands=3):
    """Coefficients of f(R^T d), by an integral over the sphere."""
    return _blocked(matrix, bands) @ c


def _blocked(matrix, bands):
    d, w = _sphere(bands, 2 * bands - 1)
    return (_harmonics(d, bands) * w) @ _harmonics(d @ matrix, bands).T


def _euler(first, middle, last, xp):
    high = jax.lax.Precision.HIGHEST
    product = np.matmul if xp is np else partial(jnp.matmul, precision=high)
    return product(product(_turns(first, xp)[0], _turns(middle, xp)[1]), _turns(last, xp)[0])


def _diagonal(first, middle, last):
    whole = _blocked(_euler(first, middle, last, np), 3)
    return [whole[n * n : (n + 1) ** 2, n * n : (n + 1) ** 2] for n in range(3)]


def _frame(c, theta, phi):
    """Columns -e_theta, e_phi, -n."""
    around, tilt = _turns(phi, np)[0], _turns(theta, np)[1]
    return _turned(c, around @ tilt @ np.diag([LD(-1), LD(1), LD(-1)]))


def _rotations():
    for label, angles in (
        ("none", (0.0, 0.0, 0.0)),
        ("slant", (0.3, 1.1, -2.0)),
        ("over", (0.0, np.pi, 0.5)),
    ):
        yield Hard(
            "harmonic_rotation.blocks",
            label,
            lambda a, b, c: harmonic_rotation.blocks(_euler(a, b, c, jnp), 3),
            angles,
            _diagonal,
            ulps=12,
        )
        yield Hard(
            "harmonic_rotation.rotate",
            label,
            lambda s, a, b, c: harmonic_rotation.rotate(s, _euler(a, b, c, jnp)),
            (SOME, *angles),
            lambda s, a, b, c: _turned(s, _euler(a, b, c, np)),
            ulps=12,
        )
    for angle in (0.0, 0.7, QUARTER, np.pi):
        for place, name in enumerate(("about_z", "about_y")):
            yield Hard(
                f"harmonic_rotation.{name}",
                f"{angle:.3g}",
                lambda c, t, name=name: getattr(harmonic_rotation, name)(c, jnp.cos(t), jnp.sin(t)),
                (SOME, angle),
                lambda c, t, place=place: _turned(c, _turns(t, np)[place]),
            )
    for theta, phi in ((0.0, 0.0), (1.1, -2.0), (np.pi, 0.4)):
        yield Hard(
            "harmonic_rotation.to_frame",
            f"{theta:.3g}, {phi}",
            lambda c, t, p: harmonic_rotation.to_frame(
                c, jnp.cos(t), jnp.sin(t), jnp.cos(p), jnp.sin(p)
            ),
            (SOME, theta, phi),
            _frame,
            ulps=12,
        )


@cache
def _on_grid(polar, azimuthal, bands):
    d, w = _sphere(polar, azimuthal)
    values = _harmonics(d, bands)
    return values, values * w


def _multiplied(a, b):
    bands = round(len(a) ** 0.5)
    values, back = _on_grid(2 * bands, 3 * bands, bands)
    return back @ ((a @ values) * (b @ values))


def _mapped_grid(function, c):
    """On the grid of the kernels: twice as fine as products of two bands need."""
    values, back = _on_grid(4, 8, 2)
    return back @ function(c @ values)


def _products():
    yield Hard(
        "harmonic_products.product",
        "sparse",
        harmonic_products.product,
        (SOME, OTHER),
        _multiplied,
    )
    five = np.round(np.cos(np.arange(25) * 2.1), 3)
    yield Hard(
        "harmonic_products.product",
        "on a grid",
        harmonic_products.product,
        (five, five[::-1].copy()),
        _multiplied,
        ulps=30,  # two sums of 25, one of 91
    )
    yield Hard(
        "harmonic_products.product",
        "by nothing",
        harmonic_products.product,
        (SOME, 0 * SOME),
        _multiplied,
    )
    for label, c in (
        ("positive", [3.0, 0.5, -0.3, 0.8]),
        ("ringing", [0.7, 0.4, -0.3, 0.6]),  # in part below the floor
        ("nothing", [0.0, 0.0, 0.0, 0.0]),
    ):
        yield Hard(
            "harmonic_products.logarithm",
            label,
            harmonic_products.logarithm,
            (np.array(c),),
            lambda c: _mapped_grid(lambda v: np.log(np.maximum(v, LD(0.02))), c),
            ulps=40,  # 32 nodes; near the floor a value is a difference of numbers near 1
        )
    for label, c in (("some", [-3.0, 0.5, -0.3, 0.8]), ("black", [-90.0, 9.0, 0.0, 9.0])):
        yield Hard(
            "harmonic_products.exponential",
            label,
            harmonic_products.exponential,
            (np.array(c),),
            partial(_mapped_grid, np.exp),
            ulps=100 if label == "black" else 20,  # the exponent's rounding
        )


def _spread(d):
    x, y, z = d
    g = 2 * np.sqrt(max(z, LD(0)) / (1 + max(z, LD(0))))
    return np.array([x * g, y * g, 2 * max(z, LD(0)) - 1])


def _hemispheres():
    low = np.array([0.6, 0.8, 1e-12])
    for label, d in (("top", NORTH), ("slant", SLANT), ("low", low), ("below", -SLANT)):
        options = {"smooth": label != "low"}  # a root
        yield Hard("hemispherical.spread", label, hemispherical.spread, (d,), _spread, **options)
        yield Hard(
            "hemispherical.basis",
            label,
            partial(hemispherical.basis, bands=3),
            (d,),
            lambda d: np.sqrt(LD(2)) * _harmonics(_spread(d), 3),
            **options,
        )


def _square(t, k):
    angle = np.arctan2(k * np.sin(t), np.cos(t) + (1 - k) * np.sin(t))
    return angle + 2 * PI if angle < 0 and np.cos(t) < 0 else angle


def _norm2(t, k):
    s, c = np.sin(t), np.cos(t)
    return (k * s) ** 2 + (c + (1 - k) * s) ** 2


def _ruled(t, k):
    if 3 * PI / 8 <= t <= PI / 2:
        return np.arctan2(k * np.sin(2 * t), 1 + k * np.cos(2 * t))
    return _square(t, k)


def _maps():
    for theta, k in (
        (0.0, 0.0),
        (0.0, 8.0),
        (1e-20, 0.125),
        (QUARTER, 1.0),
        (QUARTER, 8.0),
        (0.75 * np.pi, 0.125),
        (1.0, 1e-6),
        (np.pi, 0.5),
        (np.pi, 8.0),
    ):
        # At 3 pi / 4 sine and cosine cancel: a slope of 2 / k.
        options = {"ulps": 40 if k == 0.125 else 8}
        for kernel, twin in (
            ("square", _square),
            ("square_slope", lambda t, k: k / _norm2(t, k)),
            ("square_slope_k", lambda t, k: np.sin(t) * (np.cos(t) + np.sin(t)) / _norm2(t, k)),
            ("square_sine_ratio", lambda t, k: k / np.sqrt(_norm2(t, k))),
            ("square_density", lambda t, k: k * k / np.sqrt(_norm2(t, k)) ** 3),
        ):
            if kernel == "square_slope_k" and k == 0.125 and theta > 1:
                continue  # 0 there, and its rounding is all there is
            yield Hard(
                f"rescaling.{kernel}",
                f"{theta:.3g}, {k}",
                getattr(rescaling, kernel),
                (theta, k),
                twin,
                **options,
            )
    for theta, k in ((0.0, 0.5), (1.0, 2.0), (1.3, 0.5), (1.57, 0.9), (2.0, 0.5), (QUARTER, 1.0)):
        yield Hard(
            "rescaling.sphere_rule",
            f"{theta:.3g}, {k}",
            rescaling.sphere_rule,
            (theta, k),
            _ruled,
            smooth=theta != QUARTER,
        )
    for theta, k in ((0.0, 0.9), (1.0, 0.0), (QUARTER, 0.5), (1.0, 1e-20), (1.5, 0.999)):
        yield Hard(
            "rescaling.tangent",
            f"{theta:.3g}, {k}",
            rescaling.tangent,
            (theta, k),
            lambda t, k: np.arcsin(k * np.sin(t)),
        )
    yield Hard(
        "rescaling.tangent",
        "the horizon from the sphere",
        rescaling.tangent,
        (QUARTER, 1.0),
        lambda t, k: np.arcsin(k * np.sin(t)),
        smooth=False,
    )
    for theta, k in ((0.0, 0.5), (0.4, 0.5), (1e-3, 2e-3), (0.6, 0.5), (1.0, 0.0), (2.0, 1.0)):
        yield Hard(
            "rescaling.tangent_inverse",
            f"{theta:.3g}, {k}",
            rescaling.tangent_inverse,
            (theta, k),
            lambda t, k: np.arcsin(np.sin(t) / k) if np.sin(t) < k and np.cos(t) > 0 else PI / 2,
        )


def _profile(theta, degree, order):
    """With the azimuth's 2 pi, of which order 0 has all and the others half."""
    direction = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], -1)
    values = _harmonics(direction, degree + 1)[degree * degree + degree + order]
    return values * np.sqrt(PI if order else 2 * PI)


def _entered(far, near, weights, bands, source=lambda theta: theta):
    return np.array(
        [
            (_profile(far, row, m) * _profile(source(near), column, m) * weights).sum()
            for m in range(bands)
            for row in range(m, bands)
            for column in range(m, bands)
        ]
    )


def _square_matrix(k, bands, masked=False):
    x, w = _gauss(100)
    half = np.sqrt(max(k, LD(1)))
    end = _square(PI / 2, k / half) if masked else PI
    psi = end * (x + 1) / 2
    far = np.array([_square(t, half) for t in psi])
    near = np.array([_square(t, half / k) for t in psi])
    return _entered(far, near, end / 2 * w * half / _norm2(psi, half) * np.sin(far), bands)


def _tangent_matrix(k, bands, spread):
    x, w = _gauss(60)
    x, w = (x + 1) / 2, w / 2
    u = PI / 2 * (1 - x * x)
    far = np.arcsin(k * np.sin(u))
    weights = PI * x * w * k * np.cos(u) * np.sin(far) / np.cos(far)
    if not spread:
        return _entered(far, u, weights, bands)
    source = _entered(far, u, weights, bands, lambda u: np.arccos(2 * np.cos(u) - 1))
    return np.sqrt(LD(2)) * source


def _ruled_matrix(k, bands):
    """Up to where the map turns, with a slope of 0 (for k < 1)."""
    x, w = _gauss(120)
    x, w = (x + 1) / 2, w / 2
    turn = max(np.arccos(-min(k, LD(1))) / 2, 3 * PI / 8)
    under = 3 * PI / 8 * x
    over = turn - (turn - 3 * PI / 8) * (1 - x) ** 2
    far = np.array([_square(t, k) for t in under])
    found = _entered(far, under, 3 * PI / 8 * w * k / _norm2(under, k) * np.sin(far), bands)
    c2 = np.cos(over) ** 2
    y, across = k * np.sin(2 * over), (1 - k) + 2 * k * c2
    slope = 2 * k * ((k - 1) + 2 * c2) / (y * y + across * across)
    far = np.arctan2(y, across)
    weights = 2 * (turn - 3 * PI / 8) * (1 - x) * w * slope * np.sin(far)
    return found + _entered(far, over, weights, bands)


def _whole(entries):
    """Of two bands: 0 with 0, 0 with 1, 1 with 0, 1 with 1; then order 1."""
    a, b, c, d, e = entries
    return np.array([[a, 0, b, 0], [0, e, 0, 0], [c, 0, d, 0], [0, 0, 0, e]])


def _matrices():
    for k in (0.5, 1.0, 3.0):
        yield Hard(
            "rescaling_matrices.square",
            f"k={k}",
            partial(rescaling_matrices.square, bands=3, nodes=96),
            (k,),
            partial(_square_matrix, bands=3),
            ulps=40,  # weights of 96 nodes
        )
    for k in (0.25, 2.0):
        yield Hard(
            "rescaling_matrices.square",
            f"k={k}, masked",
            partial(rescaling_matrices.square, bands=3, source="masked"),
            (k,),
            partial(_square_matrix, bands=3, masked=True),
            ulps=40,
        )
    for k in (0.25, 0.9, 1.0, 2.0):
        yield Hard(
            "rescaling_matrices.sphere_rule",
            f"k={k}",
            partial(rescaling_matrices.sphere_rule, bands=3, nodes=40),
            (k,),
            partial(_ruled_matrix, bands=3),
            ulps=40,
            smooth=k != 1.0,  # it jumps
        )
    for k in (0.0, 0.125, 0.9, 0.999):
        for source in ("hemisphere", "masked") if k in (0.0, 0.9) else ("hemisphere",):
            yield Hard(
                "rescaling_matrices.tangent",
                f"k={k}, {source}",
                partial(rescaling_matrices.tangent, bands=3, source=source, nodes=48),
                (k,),
                partial(_tangent_matrix, bands=3, spread=source == "hemisphere"),
                ulps=40,
            )
    entries = np.array([1.0, -0.25, 0.0, 0.7, 1e-30])
    yield Hard(
        "rescaling_matrices.dense",
        "two bands",
        partial(rescaling_matrices.dense, bands=2),
        (entries,),
        _whole,
    )
    yield Hard(
        "rescaling_matrices.transposed",
        "two bands",
        partial(rescaling_matrices.transposed, bands=2),
        (entries,),
        lambda e: e[np.array([0, 2, 1, 3, 4])],
    )
    yield Hard(
        "rescaling_matrices.apply",
        "two bands",
        partial(rescaling_matrices.apply, bands=2),
        (entries, SOME[:4]),
        lambda e, c: _whole(e) @ c,
    )


def _placed(k, kind):
    """The variable of a table of matrices, in [0, 1]."""
    if kind == "square":
        return np.log(k * 8) / np.log(LD(64))
    most = LD(rescaling_tables.NEAREST)
    if kind == "tangent masked":
        return np.arcsin(k) / np.arcsin(most)
    first, last = np.sqrt(np.arccos(most)), np.sqrt(PI / 2)
    return (np.sqrt(np.arccos(k)) - first) / (last - first)


def _lined(table, k, kind):
    value = _placed(k, kind) * (len(table) - 1)
    low = int(min(np.floor(value), len(table) - 2))
    return table[low] + (value - low) * (table[low + 1] - table[low])


def _summed(table, k, kind):
    return np.polynomial.chebyshev.chebval(2 * _placed(k, kind) - 1, table)


def _tables():
    table = np.round(np.cos(np.arange(12.0)), 3).reshape(4, 3)
    for kind, values in (
        ("square", (0.2, 1.1, 7.0)),
        ("tangent masked", (0.05, 0.5, 0.98)),
        ("tangent hemisphere", (0.05, 0.5, 0.98)),
    ):
        for k in values:
            yield Hard(
                "rescaling_tables.place",
                f"{kind}, k={k}",
                partial(rescaling_tables.place, kind=kind),
                (k,),
                partial(_placed, kind=kind),
                ulps=64,  # rounding of k near 1 moves acos k by its slope
            )
        for name, twin in (("from_linear", _lined), ("from_chebyshev", _summed)):
            yield Hard(
                f"rescaling_tables.{name}",
                kind,
                partial(getattr(rescaling_tables, name), kind=kind),
                (table, values[1]),
                partial(twin, kind=kind),
                ulps=100,
            )
    for name in ("linear", "chebyshev"):
        make = getattr(rescaling_tables, name)
        yield Hard(
            f"rescaling_tables.{name}",
            "two rows",
            lambda x, make=make: make(1, "tangent masked", 2, x.dtype) * x,
            (1.0,),
            partial(_two_rows, line=name == "linear"),
            ulps=64,
        )


def _two_rows(x, line):
    """M_00 of one band at both ends, or its mean and slope between two Chebyshev points."""
    # One band: 1/2 sin t_d dt_d from 0 to asin k, that is (1 - cos t_d) / 2.
    most = np.arcsin(LD(rescaling_tables.NEAREST))
    places = np.array([0, 1], LD) if line else (1 + np.array([1, -1], LD) / np.sqrt(LD(2))) / 2
    first, second = (1 - np.cos(most * places)) / 2
    if line:
        return np.array([[first], [second]]) * x
    return np.array([[(first + second) / 2], [(first - second) / np.sqrt(LD(2))]]) * x
