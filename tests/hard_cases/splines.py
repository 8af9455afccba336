"""Splines, and the one pair that is left of many."""

from functools import partial

import jax.numpy as jnp
import numpy as np

from diffopt.kernels import frames, spline
from hard_cases.base import LD, Hard


def _bspline(x, order):
    """The B-spline of a degree, centred, by its truncated powers."""
    total = LD(0) * x
    for k, binomial in enumerate({1: (1, 2, 1), 2: (1, 3, 3, 1), 3: (1, 4, 6, 4, 1)}[order]):
        term = np.maximum(x - k + LD(order + 1) / 2, LD(0)) ** order
        total = total + (-1) ** k * binomial * term
    return total / {1: 1, 2: 2, 3: 6}[order]


def _spline_value(table, x, y, z, order):
    total = LD(0)
    for j, i, k in np.ndindex(table.shape[:3]):
        weight = _bspline(y[0] - j, order) * _bspline(x[0] - i, order) * _bspline(z[0] - k, 3)
        total = total + weight * table[j, i, k]
    return total[None]


def _spline_coefficients(values, order):
    """Those whose spline passes through the samples, reflected at both ends, by iteration."""
    middle, side = {2: (LD(6) / 8, LD(1) / 8), 3: (LD(4) / 6, LD(1) / 6)}[order]
    c = values
    for _ in range(400):  # the error falls by 2/3 each time
        padded = np.concatenate([c[1:2], c, c[-2:-1]])
        c = c + values - (middle * c + side * (padded[:-2] + padded[2:]))
    return c


def splines():
    for order in (1, 2, 3):
        # At the knots, beside them, and in the middle between.
        for t in (0.0, 1e-8, 0.5) if order == 2 else (0.0, 1e-8, 0.5, 1.0):
            shift = 0 if order == 2 else 1
            places = range(-1, 2) if order == 2 else range(1 - (order + 1) // 2, order // 2 + 2)
            yield Hard(
                "spline.weights",
                f"order={order},t={t}",
                partial(spline.weights, order=order),
                (t,),
                partial(
                    lambda t, order, places: tuple(_bspline(t - k, order) for k in places),
                    order=order,
                    places=tuple(places),
                ),
                # The slope of order 1 and the curvature of order 2 jump at the knots.
                smooth=order == 3 or (order == 2 and t < 0.5) or (0 < t < 1 and shift == 1),
                gradient_ulps=1e9 if t == 1e-8 else 1e3,
            )
        table = np.cos(np.arange(5 * 6 * 5.0)).reshape(5, 6, 5, 1)
        for x in (2.0, 2.5, 3.9999, 4.0):
            yield Hard(
                "spline.lookup",
                f"order={order},x={x}",
                partial(spline.lookup, order=order),
                (table, np.array([x]), np.array([2.25]), np.array([3.0])),
                partial(_spline_value, order=order),
                ulps=40,
                smooth=order == 3,
            )
    for x in (0.0, 3.0, 4.9999, 9.0, -2.5, 30.0):
        yield Hard(
            "spline.locate",
            f"x={x}",
            lambda x: spline.locate(x, 10, 3)[1],
            (x,),
            lambda x: x - np.clip(np.floor(x) - 1, 0, 6) - 1,
            smooth=False,
        )
    for order in (2, 3):
        for label, values in (
            ("two", [1.0, -1.0]),
            ("constant", [3.0] * 5),
            ("alternating", [1.0, -1.0] * 6),
        ):
            yield Hard(
                "spline.prefilter",
                f"order={order},{label}",
                partial(spline.prefilter, axis=0, order=order),
                (np.array(values),),
                partial(_spline_coefficients, order=order),
                ulps=40,
            )
    yield Hard(
        "frames.valid_wave_vector",
        "one pair masked",
        partial(frames.valid_wave_vector, jnp.array([False, True])),
        (np.array([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8]]), np.array([[0.0, 0, 1.0], [0.0, -0.6, 0.8]])),
        lambda a, b: -(a + b)[[1, 1]],
    )
