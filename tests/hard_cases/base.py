"""What a hard input is, and what several topics share."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

LD = np.longdouble
PI = LD("3.14159265358979323846264338327950288")


@dataclass(frozen=True)
class Hard:
    """One hard input of one kernel."""

    kernel: str
    label: str
    call: Callable
    arguments: tuple
    twin: Callable
    ulps: float = 8.0
    smooth: bool = True
    gradient_ulps: float = 1e3


def turn(t):
    """Cosine and sine of an angle in turns, reduced exactly."""
    angle = 2 * PI * (t - np.round(t))
    return np.cos(angle), np.sin(angle)


def polynomials(t, count):
    values = [LD(1), t]
    for _ in range(count - 2):
        values.append(2 * t * values[-1] - values[-2])
    return np.array(values[:count])


def dirichlet(t, n):
    cos, sin = turn((t - np.round(t)) * np.arange(n))
    return cos.mean(), sin.mean()
