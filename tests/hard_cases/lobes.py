"""What two lobes that face away from each other need (other kernels of lobes: `lobe_cases`)."""

from math import factorial

import numpy as np

from diffopt.kernels import langevin
from hard_cases.base import LD, Hard


def _log_sinhc_root(x):
    near = np.log1p(x * sum(x**n / LD(factorial(2 * n + 3)) for n in range(30)))
    k = np.sqrt(max(x, LD(4)))
    return near if x < 4 else k + np.log1p(-np.exp(-2 * k)) - np.log(2 * k)


def lobes():
    for x in (0.0, 1e-12, 0.999999, 1.0, 1.000001, 144.0, 1e10):
        yield Hard(
            "langevin.log_sinhc_root",
            f"square={x}",
            langevin.log_sinhc_root,
            (x,),
            _log_sinhc_root,
            ulps=16,  # at 1 the logarithm of sinh(k) / k is 0.16, from terms of 1
        )
