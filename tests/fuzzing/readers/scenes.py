"""Scenes, with the files that they name."""

from pathlib import Path
from typing import Any

from fuzzing.readers.assets import solid
from fuzzing.readers.base import Seed, colours, npy, picture, sky
from fuzzing.readers.materials import lobes, tables

SCENE = """\
[scene]
# wavelengths = { from = 0.4, to = 0.7, step = 0.1 }

[camera]
eye = [0, -6, 2]
target = [0, 0, 1]
resolution = [32, 24]
field_of_view = 40

[materials.brass]
kind = "gold"
alpha = 0.15
[materials.felt]
file = "felt.csv"
[materials.paint]
kind = "sum"
parts = ["felt", { kind = "phong", colour = 0.2 }]
[materials.dark]
kind = "scaled"
material = "paint"
factor = [0.5, 0.2, 0.1]

[[objects]]
name = "ball"
shape = "sphere"
radius = 0.5
material = "felt"
translate = [0, 0, 0.5]
rotate = [[0, 0, 1, 30]]
[[objects]]
shape = "mesh"
file = "box.ply"
material = "dark"
scale = 0.5
[[objects]]
shape = "plane"
width = 4
height = 4
material = "lambert"
texture = { checks = [0.8, 0.2], repeat = [4, 4] }
emission = [1, 2, 3]
[[objects]]
shape = "torus"
radius = 1.0
tube = 0.4
around = 8
across = 5
material = "plastic"

[[lights]]
kind = "area"
radiance = 8
temperature = 3200
width = 1
facing = { origin = [0, 0, 4], target = [0, 0, 0], up = [0, 1, 0] }
[[lights]]
kind = "environment"
file = "sky.npy"
[[lights]]
kind = "flood"
aim = [0, 0, -1]
position = [0, 0, 3]
exponent = 3
falloff = { a = 1, m = 2, b = 0.1 }

[render]
level = "path"
spp = 64
"""
SPECTRAL = """\
[scene]
wavelengths = [0.45, 0.55, 0.65]
[materials.wood]
kind = "phong"
[[objects]]
shape = "disc"
material = { kind = "lambert", colour = [0.1, 0.5, 0.2] }
matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]]
tangent = [1, 0, 0]
[[objects]]
shape = "plane"
material = "wood"
texture = { colour = "wood.png", repeat = [2, 2], space = "linear" }
[[lights]]
kind = "point"
position = [0, 0, 2]
illuminant = "A"
"""
LOBES = """\
[[objects]]
shape = "box"
size = [1, 2, 3]
material = "mirror"
[[lights]]
kind = "lobes"
file = "lamp.json"
[[lights]]
kind = "ambient"
radiance = [1, 1, 1]
"""


def load_scene(path: Path) -> Any:
    from diffopt.scenes import load_scene as load

    return load(path)


def scenes() -> dict[str, Seed]:
    lamp = lobes()["lobes json"].files["a.json"]
    parts = {
        "felt.csv": tables()["csv"].files["a.csv"],
        "box.ply": solid("ply"),
        "sky.npy": npy(sky()),
    }
    wood = {"wood.png": picture(colours(), "PNG")}
    return {
        "rgb": Seed({"a.toml": SCENE.encode(), **parts}, "a.toml"),
        "spectral": Seed({"a.toml": SPECTRAL.encode(), **wood}, "a.toml"),
        "lobes": Seed({"a.toml": LOBES.encode(), "lamp.json": lamp}, "a.toml"),
    }
