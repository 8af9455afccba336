"""A patch of 6 x 5 samples, its window and its transforms, written out."""

import numpy as np

from hard_cases.base import LD, PI, turn

STEP = 0.25


ROUGH = np.mod(0.7548776662466927 * np.arange(5) + 0.5698402909980532 * np.arange(6)[:, None], 1)


FLAT = np.zeros((6, 5))


DEEP = 11.0 * ROUGH  # 20 wavelengths of 0.55 um


def positions(n):
    return (np.arange(n) - n // 2) * LD(STEP)


def gaussian(f, sigma, center, n=6):
    length = n * LD(STEP)
    center = center - length * np.round(center / length)
    x = positions(n)[None] + length * np.arange(-12, 13)[:, None]
    g = np.exp(-((x - center) ** 2) / (2 * sigma**2)) * LD(STEP) / (np.sqrt(2 * PI) * sigma)
    cos, sin = turn(f * x)
    return np.stack([(g * cos).sum(0), (g * sin).sum(0)])


def bins(f, spread, n=6):
    d = f - np.arange(n) / (n * LD(STEP))
    d = d - np.round(d * LD(STEP)) / LD(STEP)
    return np.exp(-((d / spread) ** 2))


def amplitude(h, s, ax, ay):
    cos, sin = turn(s * h)
    p = (cos + 1j * sin) * (ay[0] + 1j * ay[1])[:, None] * (ax[0] + 1j * ax[1])[None, :]
    return p.sum().real, p.sum().imag


def intensity(h, s, ax, ay):
    re, im = amplitude(h, s, ax, ay)
    return re**2 + im**2


def power(h, s):
    cos, sin = turn(s * h)
    p = cos + 1j * sin
    out = []
    for n in h.shape:
        k = np.outer(np.arange(n), np.arange(n)) / LD(n)
        c, q = turn(k)
        out.append((c + 1j * q) / n)
    c = out[0] @ p @ out[1].T
    return c.real**2 + c.imag**2


def averaged(h, s, wx, wy):
    return wy @ power(h, s) @ wx
