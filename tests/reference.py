"""Reference values (mpmath, 40 digits) and slow readable twins in NumPy.

``data/diffraction.json`` states its conventions; strings there hold 18 digits.
"""

import json
from functools import cache
from pathlib import Path

import numpy as np

DATA = Path(__file__).parent / "data"


@cache
def diffraction():
    """All reference cases of the scalar model by id."""
    return {c["id"]: c for c in json.loads((DATA / "diffraction.json").read_text())["cases"]}


def cases(kind):
    return [c for c in diffraction().values() if c["type"] == kind]


def heights_of(spec):
    """Heights [ny, nx] of a reference case, from its stated formula."""
    nx, ny, step = spec["nx"], spec["ny"], spec["T0_um"]
    i, j = np.meshgrid(np.arange(nx), np.arange(ny))
    x, y = (i - nx // 2) * step, (j - ny // 2) * step
    kind = spec["kind"]
    if kind == "flat":
        return np.full((ny, nx), spec["h0"])
    if kind == "r2noise":
        return spec["H"] * np.mod(0.7548776662466927 * i + 0.5698402909980532 * j, 1.0)
    if kind == "sin":
        return spec["a"] * np.cos(2 * np.pi * x / spec["d"] + spec.get("phase", 0.0))
    if kind == "blazed":
        return spec["slope"] * (i % spec["period_px"]) * step
    if kind == "binary":
        return np.where(i % spec["period_px"] < spec["high_px"], spec["b"], 0.0)
    if kind == "crossed":
        return spec["a"] * np.sin(2 * np.pi * x / spec["dx"]) * np.cos(2 * np.pi * y / spec["dy"])
    if kind == "bump":
        return spec["H"] * np.exp(-(x**2) / (2 * spec["sx"] ** 2) - y**2 / (2 * spec["sy"] ** 2))
    raise ValueError(kind)


def positions(n, step):
    return (np.arange(n) - n // 2) * step


def direct_p(heights, pixel, q):
    """P = sum exp(2 pi i (s h + fx x + fy y)), q = (u, v, w)/wavelength, plain NumPy."""
    ny, nx = heights.shape
    x, y = positions(nx, pixel[1]), positions(ny, pixel[0])
    phase = q[2] * heights + q[0] * x[None, :] + q[1] * y[:, None]
    return np.exp(2j * np.pi * phase).sum()


def window_p(heights, pixel, q, sigma, center=(0.0, 0.0), copies=3):
    """Unit-mean windowed P on the periodic continuation, summed copy by copy."""
    ny, nx = heights.shape
    x, y = positions(nx, pixel[1]), positions(ny, pixel[0])
    total, weight = 0.0, 0.0
    for a in range(-copies, copies + 1):
        for b in range(-copies, copies + 1):
            xx, yy = x + a * nx * pixel[1], y + b * ny * pixel[0]
            g = np.exp(
                -((xx[None, :] - center[1]) ** 2 + (yy[:, None] - center[0]) ** 2) / (2 * sigma**2)
            )
            phase = q[2] * heights + q[0] * xx[None, :] + q[1] * yy[:, None]
            total = total + (g * np.exp(2j * np.pi * phase)).sum()
            weight = weight + g.sum()
    return total / weight


def directions(rng, count, largest=70.0):
    """Random unit vectors within an angle (degrees) of the normal."""
    sin = np.sqrt(rng.uniform(0, 1, count)) * np.sin(np.radians(largest))
    phi = rng.uniform(0, 2 * np.pi, count)
    return np.stack([sin * np.cos(phi), sin * np.sin(phi), np.sqrt(1 - sin**2)], -1)
