"""What is evaluated on eight simulated devices, in a process of its own: ``device_cases.py FILE``.

Each case gives where its result is, how far it is from one device, and what the compiled program
sends between devices; they are written as JSON.
"""

import json
import os
import re
import sys

COUNT = 8

if __name__ == "__main__":  # before JAX is imported
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} --xla_force_host_platform_device_count={COUNT}"

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import diffopt as do  # noqa: E402
from diffopt import devices  # noqa: E402
from diffopt.choice import sample_pairs  # noqa: E402

_SENT = re.compile(r"(all-gather|all-to-all|collective-permute|all-reduce)(?:-start)?\(")


def sent(function, *arguments):
    """Names of what a compiled program sends between devices."""
    return _SENT.findall(jax.jit(function).lower(*arguments).compile().as_text())


def compared(found, expected, axis=0):
    """Devices of a result, members of each, and the largest difference over the largest value."""
    shards = found.addressable_shards
    whole = np.asarray(expected)
    return {
        "devices": len({shard.device for shard in shards}),
        "members": [shard.data.shape[axis] for shard in shards],
        "error": float(np.abs(np.asarray(found) - whole).max() / np.abs(whole).max()),
        "eps": float(np.finfo(whole.dtype).eps),
    }


def model():
    scan = do.samples.compact_disc(jax.random.key(1), shape=(32, 32), pixel=0.1)
    return do.DiffractionBRDF(do.Heightfield(scan.heights.astype(np.float32), scan.pixel), 0.4)


LAMBDA = np.linspace(0.4, 0.7, COUNT)


def pairs():
    return sample_pairs(8 * COUNT)


def direct():
    """Pairs, then wavelengths, by the direct sum; slopes in the heights."""
    brdf, (wi, wo) = model(), pairs()
    whole = brdf(wi, wo, LAMBDA)
    over = do.spread(wi)
    value = compared(brdf(over, wo, LAMBDA), whole)
    on_grid = wi[:, None], wo[None, :4]
    grid = compared(brdf(do.spread(on_grid[0]), on_grid[1], LAMBDA), brdf(*on_grid, LAMBDA))
    bands = compared(brdf(wi, wo, do.spread(LAMBDA)), whole, -1)

    def total(heights, wi):
        like = do.Heightfield(heights, brdf.surface.pixel)
        return do.DiffractionBRDF(like, 0.4)(wi, wo, LAMBDA[:2]).sum()

    slopes = [np.asarray(jax.grad(total)(brdf.surface.heights, d)) for d in (wi, over)]
    apart = np.abs(slopes[0] - slopes[1]).max() / np.abs(slopes[0]).max()
    xyz = brdf.xyz(over, wo, step_nm=50.0)
    both = compared(xyz, brdf.xyz(wi, wo, step_nm=50.0))
    return {"pairs": value, "grid": grid, "wavelengths": bands, "xyz": both, "slope": float(apart)}


def programs():
    """What is sent where the caller compiles: by `each`, and left to the compiler."""
    brdf, (wi, wo) = model(), pairs()
    over = do.spread((jnp.asarray(wi, jnp.float32), jnp.asarray(wo, jnp.float32)))

    def value(wi, wo):
        return brdf(wi, wo, LAMBDA)

    return {"each": sent(do.each(value, axes=(0, 0)), *over), "left": sent(value, *over)}


def prepared():
    """Methods set up for a job."""
    brdf, (wi, wo) = model(), pairs()
    out = {}
    for method in ("separable", "chebyshev", "table"):
        made = brdf.prepare(pairs=(wi, wo), wavelengths=LAMBDA, tolerance=0.1, method=method)
        out[method] = compared(made(do.spread(wi), do.spread(wo)), made(wi, wo))
        out[method]["bound"] = made.choice.error_bound
        if method == "table":
            from diffopt.stores import _evaluate

            given = [jnp.asarray(a, jnp.float32) for a in (wi, wo)]
            out[method]["sent"] = sent(_evaluate, made.tables, *do.spread(given))
    like = do.spread(LAMBDA)
    made = brdf.prepare(pairs=(wi, wo), wavelengths=like, tolerance=0.1, method="separable")
    out["wavelengths"] = compared(made(wi, wo), brdf(wi, wo, LAMBDA), -1)
    out["wavelengths"]["bound"] = made.choice.error_bound
    made = brdf.prepare(
        pairs=(wi, wo), wavelengths=like, output="xyz", tolerance=0.1, method="chebyshev"
    )
    alone = brdf.prepare(
        pairs=(wi, wo), wavelengths=LAMBDA, output="xyz", tolerance=0.1, method="chebyshev"
    )
    whole = np.asarray(alone(wi, wo))
    out["sum"] = float(np.abs(np.asarray(made(wi, wo)) - whole).max() / whole.max())
    return out


def lobes():
    """Functions fitted side by side, in several rounds."""
    from diffopt.fitting.lobe_settings import LobeSettings
    from diffopt.fitting.lobe_targets import slices
    from diffopt.fitting.lobes import fit_nodes

    angle = np.radians(np.linspace(0.0, 75.0, COUNT))
    wo = jnp.asarray(np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], -1), jnp.float32)
    settings = LobeSettings(rings=16, sectors=24, lm_steps=3, coarse_steps=3, rounds=3)
    nodes = slices(do.BlinnPhong(1.0, 32.0), wo, settings)
    alone = fit_nodes(nodes, 2, settings=settings)
    found = fit_nodes(do.spread(nodes), 2, settings=settings)
    out = compared(found.lobes.kappa, alone.lobes.kappa)
    out["steps"] = [np.asarray(f.steps).tolist() for f in (alone, found)]
    out["errors"] = [np.asarray(f.error).tolist() for f in (alone, found)]
    return out


def vertices():
    """Relighting of transfer: slices of any kind, as no picture is looked at."""
    from diffopt.scenes import Environment, LobeEnvironment
    from diffopt.scenes.channels import Channels
    from diffopt.transfer import references, relighting
    from diffopt.transfer.lighting import prepare
    from diffopt.transfer.views import hemisphere, locator

    rng, count = np.random.default_rng(1), 20

    def rows(number):
        mu = rng.normal(size=(number, 3, 3)) + np.array([0.0, 0.0, 2.0])
        mu /= np.linalg.norm(mu, axis=-1, keepdims=True)
        rest = rng.uniform(0.1, 2.0, size=(number, 3, 2))
        return jnp.asarray(np.concatenate([mu, rest], -1).reshape(number, 15), jnp.float32)

    views, known = hemisphere(1).counts[1], hemisphere(references.LEVEL).counts[-1]
    up = np.broadcast_to([0.0, 0.0, 1.0], (known, 1, 3))
    over = references.pack(np.ones((known, 1, 1)), up, np.full((known, 1), 5.0))
    held = relighting.Tables(
        jnp.asarray(rng.normal(size=(count, 3)), jnp.float32),
        jnp.asarray(np.tile(np.eye(3), (count, 1, 1)), jnp.float32),
        jnp.ones(count, jnp.int32),
        jnp.arange(count, dtype=jnp.int32) * views,
        jnp.zeros(count, jnp.int32),
        references.reference([over], 1, references.LEVEL),
        rows(count * views),
        rows(count),
        locator(1),
        3,
        3,
        True,
        True,
    )
    which = jnp.asarray(np.arange(4 * COUNT) % count, jnp.int32)
    angle = np.linspace(0.1, 1.2, 4 * COUNT)
    wo = jnp.asarray(np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], -1), jnp.float32)
    channels = Channels()
    sky = np.random.default_rng(1).uniform(size=(16, 32))
    soft = do.Lobes(np.ones((2, 3)), np.array([[0, 0, 1.0], [1.0, 0, 0]]), np.array([3.0, 20.0]))
    lights = {
        "map": prepare([Environment(sky)], channels),
        "lobes": prepare([LobeEnvironment(soft)], channels, "lobes"),
    }
    out = {}
    for name, light in lights.items():
        given = do.spread((which, wo))
        found = relighting.vertex_radiance(held, light, *given)
        out[name] = compared(found, relighting.vertex_radiance(held, light, which, wo))
        out[name]["sent"] = sent(
            lambda *a, b=light: relighting.vertex_radiance(held, b, *a), *given
        )
    return out


def starts():
    """Solves of one fit, divided among devices."""
    from reflectance_cases import REACH, disc, simulated

    from diffopt import fitting, gratings
    from diffopt.fitting.reflectance import solving

    true = gratings.Sinusoidal(1.9, 0.1, 0.0, -0.9)
    wavelengths = np.linspace(0.42, 0.68, 4)
    measured = simulated(true, np.random.default_rng(1), disc(19), wavelengths)
    given = [gratings.Sinusoidal(1.88 + 0.01 * k, 0.09, 0.0, -0.9) for k in range(3)]
    out = []
    for count in (1, COUNT):
        settings = fitting.FitSettings(stages=0, max_steps=12, devices=count)
        found = fitting.fit_reflectance(measured, given, settings=settings)
        out.append([found.model.get("period"), found.model.get("amplitude"), found.loss])
    box = fitting.reflectance.maps.default_bounds(
        true, ("period", "amplitude"), frequency=3.0, coherence=1.5, wavelengths=(0.42, 0.68)
    )
    y = jnp.asarray(box.unbounded(np.array([[1.8 + 0.02 * k, 0.09] for k in range(5)])))
    given = fitting.reflectance.forward.job(measured), solving.copies(true, 5), box, y, None
    options = {"reach": REACH, "solver": "normal-lm", "tolerance": 1e-4, "max_steps": 8}
    alone = solving.solve(*given, **options)
    found = solving.solve_on(COUNT, *given, **options)
    spread = devices.spread(devices.filled((given[1], y), COUNT))
    given = given[0], spread[0], box, spread[1], None
    text = solving.solve.lower(*given, **options).compile().compiled.as_text()
    apart = np.abs(np.asarray(found.loss) - np.asarray(alone.loss)).max()
    return {
        "fit": np.asarray(out, float).tolist(),
        "loss": float(apart / np.asarray(alone.loss).max()),
        "devices": len(solving.solve(*given, **options).loss.addressable_shards),
        "sent": _SENT.findall(text),
    }


def parts():
    """A long batch of any length, part by part."""
    brdf, (wi, wo) = model(), sample_pairs(45)
    found = do.in_batches(lambda a, b: brdf(a, b, LAMBDA), wi, wo, size=2)
    whole = np.asarray(brdf(wi, wo, LAMBDA))
    return {
        "shape": found.shape,
        "error": float(np.abs(found - whole).max() / whole.max()),
        "mesh": devices.mesh().size,
    }


CASES = (direct, programs, prepared, lobes, vertices, starts, parts)

if __name__ == "__main__":
    import time
    import traceback

    result = {}
    for case in CASES:
        began = time.perf_counter()
        try:
            result[case.__name__] = case()
        except Exception:
            result[case.__name__] = traceback.format_exc()
        print(case.__name__, round(time.perf_counter() - began, 2), file=sys.stderr)
    with open(sys.argv[1], "w") as file:
        json.dump(result, file)
