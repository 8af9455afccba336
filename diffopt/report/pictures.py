"""Sections of pictures: a scene and its plan, soft shadows, glossy transfer."""

import dataclasses
import time
from typing import Any

import numpy as np

import diffopt as do
from diffopt.previews import markup, plans
from diffopt.report.page import Section, figure, grid
from diffopt.scenes import Directional, Environment, Scene, models
from diffopt.scenes.scene import Object

# Phases of an animation that are shown.
_PHASES = (0.1, 0.45, 0.8)
_TURNS = (0.0, 100.0, 200.0)


def planned(width: int, tolerance: float = 0.1) -> Section:
    """The scene of balls by a plan."""
    import tempfile
    from pathlib import Path

    from diffopt.scenes import examples, load_scene

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "balls.toml"
        path.write_text(examples.text("balls"), encoding="utf-8")
        found = load_scene(path)
    rows = width * found.camera.resolution[1] // found.camera.resolution[0]
    camera = dataclasses.replace(found.camera, resolution=(width, rows))
    begun = time.perf_counter()
    plan = do.plan(found.scene, camera, tolerance)
    spent = time.perf_counter() - begun
    image = do.render(found.scene, camera, plan)
    out = ", ".join(sorted(plan.excluded)) or "nothing"
    said = (
        f"Balls of gold, glass and mirror by the effects that a plan for {100 * tolerance:g} % "
        f"calls for: {image.seconds:.1f} s, the plan {spent:.1f} s (both with compilation)"
    )
    return Section(
        "scene",
        "Only what a scene calls for is computed",
        f"A plan looks at some 32,000 paths and says which effects of light a picture needs within "
        f"a tolerance. Left out here: {out}.",
        (
            grid([figure(_inline(image.display(), "Balls on a checked floor"), "The scene", said)]),
            plans.card(plan),
        ),
        "diffopt scene example balls -o balls.toml\n"
        f"diffopt plan balls.toml --tolerance {tolerance:g} --check\n"
        "diffopt render balls.toml --tolerance 0.03 -o balls.png",
    )


def shadows(width: int) -> Section:
    """Frames of the flying creature."""
    from diffopt.shadows import (
        Occluder,
        ShadowSettings,
        animations,
        distant_light,
        irradiance,
        plane,
    )
    from diffopt.shadows import pictures as drawn

    settings = ShadowSettings(bands=4)
    scene, ground = animations.animation("creature"), plane(animations.GROUND, 160)
    up = np.array([0.0, 0.0, 1.0])
    sky = distant_light(animations.sky, settings.bands)
    stage = drawn.Stage((width, width * 5 // 8), 2)
    occluder = Occluder(scene.faces, settings)
    receivers = ground.shape[0] ** 2
    figures, rows = [], []
    for t in _PHASES:  # so that tables have one shape in all frames
        occluder.move(*scene.pose(t))
        occluder.foresee(scene.shape(t), ground)
    # The first frame compiles, and is not shown.
    for k, t in enumerate((_PHASES[0] + 0.01, *_PHASES)):
        occluder.move(*scene.pose(t))
        occluder.update(scene.shape(t), receivers=ground)
        begun = time.perf_counter()
        lights = [sky, animations.lamp(t)]
        light = np.asarray(irradiance(ground, up, occluder.fields, lights, settings))
        spent = time.perf_counter() - begun
        if k == 0:
            continue
        pixels = stage.draw(occluder.vertices, scene.faces, scene.colour, light, animations.lamp(t))
        times = occluder.times
        said = f"{1e3 * (times.sampling + times.conversion + spent):.0f} ms without the picture"
        figures.append(figure(_inline(pixels, "Creature over its shadow"), f"Phase {t:g}", said))
        rows.append(
            (
                f"{t:g}",
                f"{1e3 * times.sampling:.1f} ms",
                f"{1e3 * times.conversion:.1f} ms",
                f"{1e3 * spent:.1f} ms",
                f"{1e9 * spent / receivers:.0f} ns",
            )
        )
    columns = ("phase", "rays", "tables", f"light at {receivers} receivers", "each")
    return Section(
        "shadows",
        "Soft shadows of an object that deforms",
        "What the object hides is sampled anew in every frame by rays on a few spheres about it, "
        "kept in spherical harmonics of 4 bands, and read by receivers under a sky, a sun and a "
        "lamp. Nothing is precomputed for the object.",
        (grid(figures), markup.table(columns, rows)),
        "diffopt shadow --scene creature -o out/creature\ndiffopt view creature",
    )


def glossy(width: int) -> Section:
    """A torus that sees itself, relit."""
    from diffopt import transfer

    glaze = do.materials.Sum(
        (do.materials.Lambert((0.16, 0.04, 0.03)), do.BlinnPhong((0.6, 0.55, 0.5), exponent=32.0))
    )
    lights = [Environment(_sky()), Directional((1.0, -1.0, 1.6), 2.0)]
    body = Scene([Object(models.torus(1.0, 0.42, 24, 12), glaze)], lights)
    begun = time.perf_counter()
    held = transfer.precompute(body, transfer.TransferSettings(tolerance=0.1, rays=512, splits=1))
    spent = time.perf_counter() - begun
    eye = do.Camera((0.0, -3.0, 2.3), (0.0, 0.0, -0.05), resolution=(width, width * 3 // 4))
    loop = transfer.Relit(held, body, eye, samples=2)
    loop.frame()
    figures, took = [], []
    for degrees in _TURNS:
        start = time.perf_counter()
        loop.turn(degrees)
        frame = loop.frame()
        took.append(time.perf_counter() - start)
        pixels = np.asarray(_toned(frame))
        said = f"{1e3 * took[-1]:.0f} ms"
        figures.append(figure(_inline(pixels, "Torus"), f"Light turned by {degrees:g}°", said))
    first = len(body.objects[0].place.shape.vertices)
    pairs = [
        ("precomputed in", f"{spent:.1f} s, compilation included"),
        ("vertices", f"{first} → {len(held.axes)}"),
        ("slices", f"{held.slices}"),
        (
            "a frame under turned light",
            f"{1e3 * float(np.median(took)):.0f} ms, {width}×{width * 3 // 4} pixels of 4 samples",
        ),
    ]
    return Section(
        "transfer",
        "Glossy interreflections, relit",
        "What each vertex sends to each viewing direction is kept as von Mises-Fisher lobes of the "
        "light that comes from far away, directly and by other surfaces. Light may then turn, and "
        "the camera may move, at no more than the cost of looking lobes up.",
        (grid(figures), markup.key_figures(pairs)),
        "diffopt scene example teapot -o teapot.toml\n"
        "diffopt precompute teapot.toml -o teapot.zarr\n"
        "diffopt view teapot.toml --transfer teapot.zarr",
    )


def _sky(height: int = 64) -> np.ndarray:
    """A blue sky with a warm window, as a map."""
    theta = (np.arange(height)[:, None, None] + 0.5) * np.pi / height
    phi = (np.arange(2 * height)[None, :, None] + 0.5) * np.pi / height
    up = np.clip(np.cos(theta), 0.0, None)
    blue = (0.15 + 0.5 * up) * np.array([0.55, 0.7, 1.0])
    window = (np.abs(theta - 1.0) < 0.35) & (np.abs(phi - 1.4) < 0.5)
    return (blue + window * np.array([5.0, 3.6, 2.2])).astype(np.float32)


def _toned(rgb: Any) -> np.ndarray:
    from diffopt.drawing import tones

    linear = np.maximum(np.asarray(rgb, np.float64), 0.0)
    return tones.encode(tones.tone(linear, tones.exposure(linear, 96.0)))


def _inline(pixels: np.ndarray, alt: str) -> markup.Markup:
    return markup.picture(pixels, alt, most=200_000)
