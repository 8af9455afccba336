"""Scenes: texts without end, meshes without end, and names that lead elsewhere."""

from fuzzing.crafted.base import PIPE, Crafted, strange
from fuzzing.readers.base import single


def scenes() -> dict[str, Crafted]:
    ball = '[[objects]]\nshape = "sphere"\nmaterial = "lambert"\n'
    mesh = '[[objects]]\nshape = "mesh"\nmaterial = "lambert"\nfile = "{}"\n'

    def toml(text: str, **others: str | int) -> Crafted:
        return Crafted(single("a.toml", text), dict(others))

    doubled = "".join(
        f'[materials.m{k}]\nkind = "sum"\nparts = ["m{k + 1}", "m{k + 1}"]\n' for k in range(40)
    )
    doubled += '[materials.m40]\nkind = "lambert"\n[[objects]]\nshape = "sphere"\nmaterial = "m0"\n'
    sizes = {
        "torus": 'shape = "torus"\naround = 1000000\nacross = 1000000',
        "knot": 'shape = "knot"\naround = 2000000000\nacross = 1000',
        "teapot": 'shape = "teapot"\ndivisions = 100000',
        "rabbit": 'shape = "rabbit"\nsubdivisions = 60',
    }
    found = {
        "brackets": toml("a = " + "[" * 100_000),
        "tables in tables": toml("a = " + "{a = " * 5000 + "1" + "}" * 5000),
        "dots": toml("a." * 20_000 + "b = 1"),
        "a header of blanks": toml("[" + " " * 60_000 + "x"),
        "a header of blanks that ends": toml("[a" + " " * 60_000 + "b]"),
        "a key of blanks": toml("a" + " " * 60_000 + "b = 1"),
        "digits": toml(ball + "radius = " + "9" * 100_000),
        "400 digits": toml(ball + "radius = " + "9" * 400),
        "not a date": toml(ball + "radius = 2026-99-99"),
        "materials doubled": toml(doubled),
        "materials in materials": toml(
            ball.replace('"lambert"', '{kind = "scaled", material = ' * 600 + '"x"' + "}" * 600)
        ),
        "a circle": toml('[materials.a]\nkind = "scaled"\nmaterial = "a"\n' + ball),
        "NUL": toml(ball + 'name = "a\\u0000b"\nfile = "a\\u0000b"'),
        "a name of NUL": toml(mesh.format("a\\u0000b")),
        "a long name": toml(mesh.format("a" * 5000)),
        "a user that is none": toml(mesh.format("~nobody-here/a.ply")),
    }
    found |= {
        f"a {name} of gigabytes": toml(f'[[objects]]\nmaterial = "lambert"\n{words}\n')
        for name, words in sizes.items()
    }
    targets = {
        "device": "/dev/zero",
        "system": "/proc/self/environ",
        "memory": "/proc/self/mem",
        "passwords": "/etc/passwd",
        "up": "../../../../../../../../../etc/passwd",
        "itself": "a.toml",
        "folder": ".",
        "pipe": "pipe",
        "link": "link",
    }
    places = {
        "mesh": (".ply", mesh),
        "map": (".hdr", ball + '[[lights]]\nkind = "environment"\nfile = "{}"\n'),
        "lobes": (".json", ball + '[[lights]]\nkind = "lobes"\nfile = "{}"\n'),
        "material": (".csv", '[materials.a]\nfile = "{}"\n' + ball),
        "texture": (".png", ball + 'texture = {{ colour = "{}" }}\n'),
        "scan": (".txt", '[materials.a]\nkind = "diffraction"\nscan = "{}"\n' + ball),
    }
    for place, (suffix, text) in places.items():
        for label, target in targets.items():
            found[f"{place}: {label}"] = toml(text.format(target), pipe=PIPE, link="/etc/passwd")
        # By a link with the suffix that the reader wants.
        for label in ("device", "system", "passwords"):
            named = {f"a{suffix}": targets[label]}
            found[f"{place}: link to {label}"] = toml(text.format(f"a{suffix}"), **named)
        found[f"{place}: pipe {suffix}"] = toml(text.format(f"a{suffix}"), **{f"a{suffix}": PIPE})
        found[f"{place}: terabyte"] = toml(text.format(f"a{suffix}"), **{f"a{suffix}": 2**40})
    return found | strange("a.toml")
