"""Path tracing against an independent renderer, Mitsuba 3, on scenes that both describe."""

import numpy as np
import pytest
from lengths import but

from diffopt import rendering, scenes
from diffopt.accuracy import mitsuba_scenes
from diffopt.materials import (
    BlinnPhong,
    Dielectric,
    Lambert,
    Microfacet,
    RoughDielectric,
    Scaled,
    Sum,
)

mitsuba = pytest.importorskip("mitsuba")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

BLOCK = 8
RUNS, SAMPLES = 16, 64
CAMERA = scenes.Camera(
    eye=(0.0, -5.0, 2.0), target=(0.0, 0.0, 0.0), resolution=(32, 24), field_of_view=45.0
)
CREAM, RUST, GOLD = (0.5, 0.4, 0.3), (0.8, 0.3, 0.2), (0.9, 0.7, 0.4)
FLOOR = scenes.translate(0.0, 0.0, -1.0)
LAMP = scenes.translate(0.5, 0.0, 3.0) @ scenes.rotate((1, 0, 0), 180.0)


@pytest.fixture(scope="module")
def mi():
    mitsuba.set_variant("scalar_rgb")
    return mitsuba


def rgb(colour):
    return {"type": "rgb", "value": np.broadcast_to(colour, 3).tolist()}


def matte(colour):
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(colour)}}


def metal(alpha, colour):
    return {
        "type": "roughconductor",
        "distribution": "ggx",
        "alpha": alpha,
        "material": "none",
        "specular_reflectance": rgb(colour),
    }


def placed(kind, place, half=(1.0, 1.0, 1.0), **more):
    """A shape of Mitsuba's, 2 units wide, where ours of the same place is."""
    return {"type": kind, "to_world": np.asarray(place) @ np.diag([*half, 1.0]), **more}


def emitting(radiance):
    return {"emitter": {"type": "area", "radiance": rgb(radiance)}}


def balls(*materials):
    """One or two balls on a floor: ours, and Mitsuba's."""
    ours = [scenes.Object(scenes.Plane(6.0, 6.0), Lambert(CREAM), FLOOR)]
    theirs = {"floor": placed("rectangle", FLOOR, (3.0, 3.0, 1.0), bsdf=matte(CREAM))}
    for k, (material, described) in enumerate(materials):
        x = 1.1 * (2 * k - 1) if len(materials) > 1 else 0.0
        ours.append(scenes.Object(scenes.Sphere(1.0), material, scenes.translate(x, 0.0, 0.0)))
        theirs[f"ball{k}"] = {"type": "sphere", "center": [x, 0.0, 0.0], "bsdf": described}
    return ours, theirs


def point():
    light = {"type": "point", "position": [3.0, -2.0, 4.0], "intensity": rgb((50, 40, 30))}
    return [], [scenes.Point(position=(3.0, -2.0, 4.0), intensity=(50.0, 40.0, 30.0))], light


def lamp():
    ours = scenes.area_light(2.0, 1.0, LAMP, radiance=(6.0, 5.0, 4.0))
    black = {"bsdf": {"type": "diffuse", "reflectance": rgb(0.0)}}
    theirs = placed("rectangle", LAMP, (1.0, 0.5, 1.0), **emitting((6, 5, 4)), **black)
    return [ours], [], theirs


def sky():
    """A smooth map: the two interpolate between pixels differently."""
    theta = (np.arange(64) + 0.5) * np.pi / 64
    phi = (np.arange(128) + 0.5) * 2.0 * np.pi / 128
    x, y = np.sin(theta)[:, None] * np.cos(phi), np.sin(theta)[:, None] * np.sin(phi)
    z = np.cos(theta)[:, None] + 0.0 * phi
    bright = np.exp(4.0 * (0.6 * x - 0.48 * y + 0.64 * z - 1.0))
    image = np.stack([0.3 + 4.0 * bright, 0.4 + 3.0 * bright, 0.5 + 2.0 * bright + 0.2 * z], -1)
    # Its maps run the other way round, from another azimuth, y up.
    turn = np.array([[0.0, 0, -1, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    flipped = np.ascontiguousarray(image[:, ::-1].astype(np.float32))
    theirs = {"type": "envmap", "bitmap": mitsuba.Bitmap(flipped), "to_world": turn}
    return [], [scenes.Environment(image)], theirs


def even():
    theirs = {"type": "constant", "radiance": rgb((0.3, 0.4, 0.5))}
    return [], [scenes.Environment((0.3, 0.4, 0.5))], theirs


GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
GROUND = {
    "type": "roughdielectric",
    "int_ior": 1.5,
    "ext_ior": 1.0,
    "alpha": 0.2,
    "distribution": "ggx",
}


def of_balls(light, *materials):
    ours, described = balls(*materials)
    objects, lights, source = light()
    return scenes.Scene(ours + objects, lights), described | {"light": source}, CAMERA


def matte_and_metal(light):
    rough = Scaled(Microfacet(alpha=0.3), np.array(GOLD))
    return of_balls(light, (Lambert(RUST), matte(RUST)), (rough, metal(0.3, GOLD)))


def box():
    """Walls of three colours, a block and a ball, under a lamp (as at Cornell)."""
    white, red, green = (0.725, 0.71, 0.68), (0.63, 0.065, 0.05), (0.14, 0.45, 0.091)
    move, turn = scenes.translate, scenes.rotate
    walls = [
        (white, np.eye(4)),
        (white, move(0.0, 0.0, 2.0) @ turn((1, 0, 0), 180.0)),
        (white, move(0.0, 1.0, 1.0) @ turn((1, 0, 0), 90.0)),
        (red, move(-1.0, 0.0, 1.0) @ turn((0, 1, 0), 90.0)),
        (green, move(1.0, 0.0, 1.0) @ turn((0, 1, 0), -90.0)),
    ]
    block = move(-0.35, 0.3, 0.6) @ turn((0, 0, 1), 20.0)
    lit = move(0.0, 0.0, 1.98) @ turn((1, 0, 0), 180.0)
    objects = [scenes.Object(scenes.Plane(2.0, 2.0), Lambert(c), p) for c, p in walls]
    objects += [
        scenes.Object(scenes.Box((0.6, 0.6, 1.2)), Lambert(white), block),
        scenes.Object(scenes.Sphere(0.35), Lambert(white), move(0.4, -0.3, 0.35)),
        scenes.area_light(0.5, 0.5, lit, radiance=(17.0, 12.0, 4.0)),
    ]
    theirs = {f"wall{k}": placed("rectangle", p, bsdf=matte(c)) for k, (c, p) in enumerate(walls)}
    theirs |= {
        "block": placed("cube", block, (0.3, 0.3, 0.6), bsdf=matte(white)),
        "ball": {"type": "sphere", "radius": 0.35, "center": [0.4, -0.3, 0.35]}
        | {"bsdf": matte(white)},
        "light": placed(
            "rectangle",
            lit,
            (0.25, 0.25, 1.0),
            **emitting((17, 12, 4)),
            bsdf={"type": "diffuse", "reflectance": rgb(0.0)},
        ),
    }
    camera = scenes.Camera(
        eye=(0.0, -3.9, 1.0), target=(0.0, 0.0, 1.0), resolution=(32, 24), field_of_view=39.0
    )
    return scenes.Scene(objects), theirs, camera


CASES = {
    "matte and metal, point": lambda: matte_and_metal(point),
    "matte and metal, lamp": lambda: matte_and_metal(lamp),
    "matte and metal, sky": lambda: matte_and_metal(sky),
    "glass, even sky": lambda: of_balls(even, (Dielectric(1.5), GLASS)),
    "ground glass, even sky": lambda: of_balls(even, (RoughDielectric(1.5, 0.2), GROUND)),
    "box": box,
}


def blocks(image):
    height, width = image.shape[:2]
    return image.reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK, 3).mean((1, 3))


def theirs(mi, description, camera):
    """Mean of blocks and its standard error, from several pictures."""
    columns, rows = camera.resolution
    look = mi.ScalarTransform4f().look_at(
        origin=list(camera.eye), target=list(camera.target), up=list(camera.up)
    )

    def converted(value):
        if isinstance(value, dict):
            return {key: converted(inner) for key, inner in value.items()}
        return mi.ScalarTransform4f(value) if isinstance(value, np.ndarray) else value

    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 33},
            "camera": {
                "type": "perspective",
                "fov": camera.field_of_view,
                "fov_axis": "smaller",
                "to_world": look,
                "sampler": {"type": "independent", "sample_count": SAMPLES},
                "film": {
                    "type": "hdrfilm",
                    "width": columns,
                    "height": rows,
                    "pixel_format": "rgb",
                    "rfilter": {"type": "box"},
                },
            },
            **converted(description),
        }
    )
    found = [blocks(np.array(mi.render(scene, seed=k + 1))) for k in range(RUNS)]
    return np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(RUNS)


@pytest.mark.parametrize("name", but(["glass, even sky", "box"], CASES))
def test_paths_agree_within_their_errors(mi, name):
    scene, description, camera = CASES[name]()
    mean, error = theirs(mi, description, camera)
    image = rendering.render(scene, camera, "path", spp=512, rays=32 * 24 * 16)
    agrees(image, mean, error)


def agrees(image, mean, error):
    """A picture of ours against blocks of theirs, each with its error."""
    own = np.sqrt(blocks(image.error**2)) / BLOCK
    # Rare bright paths that neither has drawn are in neither error: half a percent of the
    # picture. Blocks without noise differ by rounding.
    allowed = 3.0 * np.hypot(error, own) + 0.005 * mean.mean()
    difference = np.abs(blocks(image.radiance) - mean)
    assert (difference < allowed).mean() > 0.98, (difference / allowed).max()
    assert (difference < 2.0 * allowed).all(), (difference / allowed).max()
    # The three channels share their noise.
    spread = np.sqrt((error**2 + own**2).mean() / (error.size / 3))
    assert abs(image.radiance.mean() - mean.mean()) < 4.0 * spread + 0.002 * mean.mean()


POTS = {
    "glossy, even sky": (BlinnPhong((0.9, 0.8, 0.7), 64.0), even),
    "glossy and matte, sky": (
        Sum([Lambert((0.1, 0.16, 0.24)), BlinnPhong((0.7, 0.65, 0.6), 64.0)], [0.3, 0.7]),
        sky,
    ),
}


@pytest.mark.parametrize("name", but(["glossy, even sky"], POTS))
def test_glossy_teapot_agrees_within_its_errors(name, mi):
    """Light from handle and spout to the body and back."""
    glaze, light = POTS[name]
    scene = scenes.Scene([scenes.Object(scenes.models.teapot(), glaze)], light()[1])
    camera = scenes.Camera(
        eye=(-3.6, -8.2, 4.6), target=(0.0, 0.0, 1.4), resolution=(32, 24), field_of_view=32.0
    )
    # An eighth of the paths of the scenes above: the lobe runs in Python.
    described = mitsuba_scenes.describe(scene, camera, spp=8, depth=6)
    loaded = mitsuba_scenes.load(mi, described)
    found = [blocks(np.array(mi.render(loaded, seed=k + 1))) for k in range(RUNS)]
    mean, error = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(RUNS)
    image = rendering.render(scene, camera, "path", spp=128, rays=32 * 24 * 16, depth=6)
    agrees(image, mean, error)
