"""Scenes to start from, as the text of their files."""

from diffopt import checks
from diffopt.scenes import glossy_examples

_CORNELL = """\
# The Cornell box, as its authors give it in centimetres (here decimetres), with a mirror ball.
[camera]
eye = [2.78, -8.0, 2.73]
target = [2.78, 0.0, 2.73]
resolution = [320, 320]
field_of_view = 39

[materials]
white = { kind = "lambert", colour = 0.73 }
red = { kind = "lambert", colour = [0.57, 0.04, 0.04] }
green = { kind = "lambert", colour = [0.11, 0.42, 0.12] }

[[objects]]
name = "floor"
shape = "plane"
width = 5.56
height = 5.6
material = "white"
translate = [2.78, 2.8, 0]

[[objects]]
name = "ceiling"
shape = "plane"
width = 5.56
height = 5.6
material = "white"
facing = { origin = [2.78, 2.8, 5.49], target = [2.78, 2.8, 0], up = [0, 1, 0] }

[[objects]]
name = "back"
shape = "plane"
width = 5.56
height = 5.49
material = "white"
facing = { origin = [2.78, 5.6, 2.745], target = [2.78, 0, 2.745] }

[[objects]]
name = "left"
shape = "plane"
width = 5.6
height = 5.49
material = "red"
facing = { origin = [0, 2.8, 2.745], target = [1, 2.8, 2.745] }

[[objects]]
name = "right"
shape = "plane"
width = 5.6
height = 5.49
material = "green"
facing = { origin = [5.56, 2.8, 2.745], target = [0, 2.8, 2.745] }

[[objects]]
name = "tall"
shape = "box"
size = [1.65, 1.65, 3.3]
material = "white"
rotate = [[0, 0, 1, -17]]
translate = [1.85, 3.5, 1.65]

[[objects]]
name = "ball"
shape = "sphere"
radius = 0.9
material = "mirror"
translate = [3.9, 1.7, 0.9]

[[lights]]
kind = "area"
width = 1.3
height = 1.05
radiance = 14
temperature = 4200
facing = { origin = [2.78, 2.8, 5.48], target = [2.78, 2.8, 0], up = [0, 1, 0] }

[render]
level = "path"
spp = 64
depth = 12
"""

_BALLS = """\
# Balls of gold, glass and perfect mirror over a checked floor, under a warm panel and a sky.
[camera]
eye = [0, -7.2, 2.6]
target = [0, 0.3, 0.75]
resolution = [480, 270]
field_of_view = 30

[materials]
gold = { kind = "gold", alpha = 0.12 }
glass = { kind = "glass", eta = 1.5 }
red = { kind = "plastic", colour = [0.55, 0.03, 0.03], alpha = 0.05 }

[[objects]]
name = "floor"
shape = "plane"
width = 24
height = 24
material = "lambert"
texture = { checks = [0.75, [0.06, 0.08, 0.11]], repeat = [12, 12] }

[[objects]]
name = "gold"
shape = "sphere"
material = "gold"
translate = [-2.1, 0.6, 1]

[[objects]]
name = "glass"
shape = "sphere"
material = "glass"
translate = [0.1, -0.2, 1]

[[objects]]
name = "mirror"
shape = "sphere"
material = "mirror"
translate = [2.3, 0.9, 1]

[[objects]]
name = "red"
shape = "sphere"
radius = 0.45
material = "red"
translate = [1.35, -1.5, 0.45]

[[lights]]
kind = "area"
width = 4
height = 4
radiance = 5
temperature = 3800
facing = { origin = [-4, -3, 6], target = [0, 0, 0] }

[[lights]]
kind = "environment"
radiance = [0.32, 0.42, 0.62]

[render]
level = "path"
spp = 64
depth = 12
exposure = 1.8
"""

_DISC = """\
# A compact disc: the diffraction of its tracks, which run around the middle.
[camera]
eye = [0, -4.2, 3.4]
target = [0, 0, 0.35]
resolution = [400, 300]
field_of_view = 32

[materials.track]
kind = "diffraction"
scan = "sample:compact_disc"    # or a file of heights, with pixel_size and the like
coherence = 1.25                # micrometres

[materials.grey]
kind = "lambert"
colour = 0.12

[[objects]]
name = "floor"
shape = "plane"
width = 30
height = 30
material = "grey"

[[objects]]
name = "disc"
shape = "disc"
radius = 1.2
material = "track"
rotate = [[1, 0, 0, 18]]
translate = [0, 0, 0.5]

[[lights]]
kind = "area"
width = 0.3
height = 0.3
radiance = 300
facing = { origin = [-1, 4, 6], target = [0, 0, 0.4] }

[[lights]]
kind = "environment"
radiance = 0.04

[render]
level = "path"
spp = 64
depth = 4
"""

_LAMP = """\
# A lamp over a table, as spectra: a bulb at 3600 K in a shade, and dusk outside.
[scene]
wavelengths = { from = 0.40, to = 0.70, step = 0.03 }

[camera]
eye = [0, -5.5, 2.2]
target = [0, 0, 0.85]
resolution = [400, 300]
field_of_view = 32

[materials]
wood = { kind = "oren-nayar", colour = [0.42, 0.24, 0.12], sigma = 20 }
wall = { kind = "lambert", colour = [0.45, 0.5, 0.55] }
copper = { kind = "copper", alpha = 0.2 }

[[objects]]
name = "table"
shape = "plane"
width = 12
height = 12
material = "wood"

[[objects]]
name = "wall"
shape = "plane"
width = 12
height = 8
material = "wall"
facing = { origin = [0, 4, 2], target = [0, 0, 2] }

[[objects]]
name = "bulb"
shape = "sphere"
radius = 0.2
material = { kind = "lambert", colour = 0.0 }
emission = 30
temperature = 3600
translate = [0, 0.4, 2.0]

[[objects]]
name = "shade"
shape = "disc"
radius = 0.55
material = { kind = "lambert", colour = 0.7 }
translate = [0, 0.4, 2.3]

[[objects]]
name = "glass"
shape = "sphere"
radius = 0.45
material = "glass"
translate = [-0.7, -0.3, 0.45]

[[objects]]
name = "copper"
shape = "sphere"
radius = 0.55
material = "copper"
translate = [0.65, 0.2, 0.55]

[[lights]]
kind = "environment"
radiance = [0.10, 0.14, 0.22]

[render]
level = "path"
spp = 128
depth = 10
"""

#: Their texts by name.
EXAMPLES = {
    "cornell": _CORNELL,
    "balls": _BALLS,
    "disc": _DISC,
    "lamp": _LAMP,
    "teapot": glossy_examples.TEAPOT,
    "rabbit": glossy_examples.RABBIT,
    "knots": glossy_examples.KNOTS,
}


def text(name: str) -> str:
    """The text of an example.

    Raises
    ------
    InputError
        For another name.
    """
    return EXAMPLES[checks.choice("NAME", name, tuple(EXAMPLES))]
