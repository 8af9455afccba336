"""Phases, Chebyshev polynomials, sinc and the factor of many periods."""

from functools import partial

import numpy as np

from diffopt.kernels import phase, special
from hard_cases.base import LD, PI, Hard, dirichlet, polynomials, turn


def phases():
    for t in (0.0, 0.25, 0.5, -0.75, 1e-30, 2.0**20 + 0.125):
        yield Hard("phase.cis_turns", f"t={t}", phase.cis_turns, (t,), turn, gradient_ulps=64)
    for t in (-1.0, 1.0, 0.0, float(np.cos(np.pi / 10))):
        yield Hard(
            "phase.chebyshev_weights",
            f"t={t}",
            partial(phase.chebyshev_weights, nodes=5),
            (t,),
            lambda t: _lagrange(t, 5),
            ulps=30,
            gradient_ulps=500,  # the slope of a Chebyshev polynomial of degree 4 is up to 16
        )
        for kernel in (phase.chebyshev_rows, phase.chebyshev_polynomials):
            yield Hard(
                f"phase.{kernel.__name__}",
                f"t={t}",
                partial(kernel, count=40),
                (t,),
                lambda t: polynomials(t, 40),
                # T_n' is n^2 at the ends, and so is what rounding of t and of the recurrence makes
                ulps=800,
                gradient_ulps=1e6,  # T_39'' is up to 1e6
            )
    yield Hard(
        "phase.chebyshev_points",
        "one node",
        lambda x: phase.chebyshev_points(1, x.dtype) + 0.0 * x,
        (1.0,),
        lambda x: 0.0 * x,
    )
    for x in (0.0, 1e-9, 0.5, -0.4999999, 13.25):
        yield Hard(
            "special.sinc",
            f"x={x}",
            special.sinc,
            (x,),
            lambda x: np.sin(PI * x) / (PI * x) if x else LD(1),
            smooth=abs(x) > 1e-8,
            gradient_ulps=200,
        )
    for t, n in ((0.0, 26), (3.0, 26), (2.0 + 2.0**-12, 26), (0.5, 7), (1e-9, 1001)):
        yield Hard(
            "special.dirichlet",
            f"t={t}, N={n}",
            partial(special.dirichlet, copies=n),
            (t,),
            partial(dirichlet, n=n),
            ulps=8 + n,  # rounding of N t
            gradient_ulps=20 * n,
        )


def _lagrange(t, nodes):
    points = np.cos(PI * (np.arange(nodes) + LD(0.5)) / nodes)
    out = []
    for j in range(nodes):
        others = np.delete(points, j)
        out.append(np.prod((t - others) / (points[j] - others)))
    return np.array(out)
