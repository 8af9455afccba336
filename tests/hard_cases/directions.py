"""Directions, wave vectors, factors before the transform, random numbers."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from diffopt.kernels import frames, prefactor, uniforms, vmf_sampling
from hard_cases.base import LD, Hard, turn
from hard_cases.patch import ROUGH


def _unit(degrees, azimuth=0.0):
    t, p = np.radians(degrees), np.radians(azimuth)
    return np.array([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)])


GRAZING = _unit(89.999)


def _square(q):
    return (q * q).sum()


def directions():
    pairs = {
        "normal": (_unit(0), _unit(0)),
        "grazing mirror": (GRAZING, GRAZING * [-1, -1, 1]),
        "grazing retro": (GRAZING, GRAZING),
        "one grazing": (GRAZING, _unit(10, 40.0)),
    }
    # The pole, the horizon, a full turn less a rounding, many turns.
    for sin, turns, cos in ((0.0, 0.3, 1.0), (1.0, 0.25, 0.0), (0.6, 1.0 - 2.0**-24, -0.8)):
        yield Hard(
            "frames.around",
            f"turns={turns:.3g}",
            frames.around,
            (sin, turns, cos),
            lambda s, t, c: np.array([s * turn(t)[0], s * turn(t)[1], c]),
        )
    # Not real-valued in its arguments; the numbers have tests of their own.
    held = np.stack(uniforms.pairs(jax.random.key(7), 3)).astype(LD)
    yield Hard(
        "uniforms.pairs",
        "scaled",
        lambda x: tuple(p.astype(x.dtype) * x for p in uniforms.pairs(jax.random.key(7), 3)),
        (2.0,),
        lambda x: tuple(row * x for row in held),
    )
    # Counted from 0, a pair at a time: the same words.
    counter = jnp.arange(3, dtype=jnp.uint32)

    def at(x):
        return uniforms.at(jax.random.key(7), jnp.zeros_like(counter), counter)

    yield Hard(
        "uniforms.at",
        "scaled",
        lambda x: tuple(p.astype(x.dtype) * x for p in at(x)),
        (2.0,),
        lambda x: tuple(row * x for row in held),
    )
    up = jnp.asarray([0.0, 0.0, 1.0])

    def around_z(kappa):
        u, v = held
        t = -np.log1p(v * np.expm1(-2 * kappa)) / kappa
        sin, (cos_u, sin_u) = np.sqrt(t * (2 - t)), turn(u)
        return np.stack([sin * cos_u, sin * sin_u, 1 - t], -1)

    yield Hard(
        "vmf_sampling.sample",
        "kappa=30",
        lambda k: vmf_sampling.sample(jax.random.key(7), up.astype(k.dtype), k, 3),
        (30.0,),
        around_z,
    )
    for name, (wi, wo) in pairs.items():
        wave = -(wi + wo)
        yield Hard("frames.wave_vector", name, frames.wave_vector, (wi, wo), lambda a, b: -(a + b))
        yield Hard(
            "frames.half_cosine",
            name,
            frames.half_cosine,
            (wave,),
            lambda q: np.sqrt(_square(q)) / 2,
        )
        yield Hard(
            "frames.v_cavity",
            name,
            frames.v_cavity,
            (wave, wi[2], wo[2]),
            lambda q, a, b: min(LD(1), 4 * abs(q[2]) * min(a, b) / _square(q)),
            smooth=name == "one grazing",
        )
        yield Hard(
            "frames.above_horizon",
            name,
            lambda a, b: frames.above_horizon(a, b)[1:],
            (wi, wo),
            lambda a, b: (a, b),
            smooth=False,
        )
        twins = {
            "stam": lambda q, a, b: (_square(q) / q[2]) ** 2 / (4 * a * b),
            "ghs": lambda q, a, b: b / a,
            "rghs": lambda q, a, b: q[2] ** 2 / (4 * a * b),
            "kirchhoff": lambda q, a, b: 1 / (4 * a * b),
        }
        for model, twin in twins.items():
            # the gradient divides by cosines of 1.7e-5: relative differences, not ulps, of it
            yield Hard(
                "prefactor.geometric_factor",
                f"{model}, {name}",
                partial(prefactor.geometric_factor, model),
                (wave, wi[2], wo[2]),
                twin,
                ulps=16,
            )
        yield Hard(
            "prefactor.height_factor",
            name,
            partial(prefactor.height_factor, "stam"),
            (wave,),
            lambda q: q[2],
        )
        yield Hard(
            "prefactor.kirchhoff_weight",
            name,
            prefactor.kirchhoff_weight,
            (wave, ROUGH, -ROUGH),
            lambda q, x, y: q[0] * x + q[1] * y - q[2],
        )
    for theta, phi in ((0.0, 0.0), (np.pi / 2, np.pi), (1e-20, 3.0)):
        yield Hard(
            "frames.spherical",
            f"{theta:.3g}, {phi:.3g}",
            frames.spherical,
            (theta, phi),
            lambda t, p: np.array([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)]),
        )
