"""Scenes of glossy bodies that light themselves, as the text of their files."""

TEAPOT = """\
# The Utah teapot, glossy: its handle is seen in its body, under an even sky and two panels.
[camera]
eye = [-5.4, -6.4, 4.2]
target = [-0.1, 0, 1.45]
resolution = [400, 300]
field_of_view = 32

[materials.glaze]
kind = "sum"
parts = [
    { kind = "lambert", colour = [0.05, 0.08, 0.12] },
    { kind = "blinn-phong", colour = [0.72, 0.70, 0.66], exponent = 128 },
]
chances = [0.3, 0.7]

[[objects]]
name = "pot"
shape = "teapot"                # divisions
divisions = 16
material = "glaze"

[[lights]]
kind = "environment"
radiance = [0.45, 0.52, 0.62]

[[lights]]
kind = "area"
width = 5
height = 5
radiance = 5
temperature = 4300
facing = { origin = [-7, -5, 8], target = [0, 0, 1] }

[[lights]]
kind = "area"
width = 3
height = 5
radiance = 2.5
facing = { origin = [8, -4, 3], target = [0, 0, 1.5] }

[render]
level = "path"
spp = 64
depth = 6
"""

RABBIT = """\
# A glossy rabbit on a matte floor.
[camera]
eye = [2.6, -5.4, 2.5]
target = [0, 0, 0.95]
resolution = [320, 320]
field_of_view = 29

[materials]
floor = { kind = "lambert", colour = [0.42, 0.36, 0.30] }

[materials.bronze]
kind = "sum"
parts = [
    { kind = "lambert", colour = [0.14, 0.07, 0.03] },
    { kind = "blinn-phong", colour = [0.78, 0.56, 0.34], exponent = 64 },
]
chances = [0.3, 0.7]

[[objects]]
name = "rabbit"
shape = "rabbit"                # detail
material = "bronze"

[[objects]]
name = "floor"
shape = "plane"
width = 40
height = 40
material = "floor"

[[lights]]
kind = "environment"
radiance = [0.35, 0.40, 0.48]

[[lights]]
kind = "area"
width = 2.5
height = 2.5
radiance = 9
temperature = 4500
facing = { origin = [3.5, -3, 5], target = [0, 0, 0.8] }

[render]
level = "path"
spp = 64
depth = 6
"""

KNOTS = """\
# A glossy torus knot over a glossy ring, in even light and one lamp.
[camera]
eye = [0, -6.4, 4.2]
target = [0, 0, 0.75]
resolution = [400, 300]
field_of_view = 34

[materials]
floor = { kind = "lambert", colour = 0.35 }
ring = { kind = "sum", parts = [
    { kind = "lambert", colour = [0.30, 0.05, 0.04] },
    { kind = "blinn-phong", colour = 0.35, exponent = 32 },
] }
steel = { kind = "blinn-phong", colour = [0.85, 0.86, 0.88], exponent = 128 }

[[objects]]
name = "knot"
shape = "knot"                  # p, q, radius, swing, tube, around, across
p = 2
q = 3
swing = 0.45
tube = 0.19
material = "steel"
rotate = [[1, 0, 0, 22]]
translate = [0, 0, 1.35]

[[objects]]
name = "ring"
shape = "torus"                 # radius, tube, around, across
radius = 1.9
tube = 0.28
around = 96
material = "ring"
translate = [0, 0, 0.28]

[[objects]]
name = "floor"
shape = "plane"
width = 40
height = 40
material = "floor"

[[lights]]
kind = "environment"
radiance = [0.42, 0.46, 0.52]

[[lights]]
kind = "area"
width = 2
height = 2
radiance = 12
temperature = 4000
facing = { origin = [-3, -2, 6], target = [0, 0, 0.6] }

[render]
level = "path"
spp = 64
depth = 8
"""
