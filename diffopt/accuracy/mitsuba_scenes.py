"""Scenes as Mitsuba 3 has them, for comparison with an independent renderer.

`describe` gives plain dictionaries and arrays that can be sent to another process; `load` makes
Mitsuba's objects of them, under whatever variant is set.
"""

from typing import Any

import numpy as np

from diffopt import fresnel
from diffopt.accuracy import mitsuba_lobes
from diffopt.errors import InputError
from diffopt.kernels import reflectance
from diffopt.materials import (
    BlinnPhong,
    Dielectric,
    Lambert,
    Material,
    Microfacet,
    Mirror,
    RoughDielectric,
    Scaled,
    Sum,
)
from diffopt.scenes import Camera, Environment, Object, Point, Scene, shapes

Description = dict[str, Any]
# Mitsuba's maps run the other way round, from another azimuth, y up.
_MAP = np.array([[0.0, 0, -1, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def describe(scene: Scene, camera: Camera, *, spp: int = 16, depth: int = 32) -> Description:
    """A scene with a camera and path tracing, as in `diffopt.rendering`.

    Parameters
    ----------
    scene, camera
        In linear RGB.
    spp
        Paths a pixel.
    depth
        Surfaces that light is scattered at, at most.

    Raises
    ------
    InputError
        For a shape, material or light that is not among those that were compared.
    """
    found: Description = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth + 1},
        "camera": _camera(camera, spp),
    }
    for number, one in enumerate(scene.objects):
        found[f"object{number}"] = _object(one)
    for number, light in enumerate(scene.lights):
        found[f"light{number}"] = _light(light)
    return found


def load(mi: Any, description: Description) -> Any:
    """Mitsuba's scene of a description; `mi` is its module with a variant set."""
    mitsuba_lobes.register(mi)
    return mi.load_dict(_loaded(mi, description))


def _camera(camera: Camera, spp: int) -> Description:
    # Mitsuba's cameras look along z, with x to the left.
    place = np.eye(4)
    place[:3] = np.asarray(camera.matrix)[:3]
    place = place @ np.diag([-1.0, 1.0, -1.0, 1.0])
    width, height = camera.resolution
    return {
        "type": "perspective",
        "fov": camera.field_of_view,
        "fov_axis": "smaller",
        "to_world": place,
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
        },
        "sampler": {"type": "independent", "sample_count": spp},
    }


def _object(one: Object) -> Description:
    shape, matrix = one.place.shape, np.array(one.place.matrix).reshape(4, 4)
    if not isinstance(one.material, Material):
        raise InputError(f"{one.name or 'object'}: textures are not given to Mitsuba")
    found: Description = {"bsdf": _bsdf(one.material)}
    if one.emission is not None:
        found["emitter"] = {"type": "area", "radiance": _rgb(one.emission)}
    if isinstance(shape, shapes.Mesh):
        placed = shapes.placed(shape, matrix)
        assert isinstance(placed, shapes.Triangles)
        arrays = {"vertices": placed.vertices, "normals": placed.normals, "faces": placed.faces}
        return {"type": "mesh", **arrays, **found}
    # Mitsuba's rectangles and cubes reach from -1 to 1.
    if isinstance(shape, shapes.Plane):
        kind, size = "rectangle", (0.5 * shape.width, 0.5 * shape.height, 1.0)
    elif isinstance(shape, shapes.Box):
        kind, size = "cube", tuple(0.5 * side for side in shape.size)
    else:
        kind = "sphere" if isinstance(shape, shapes.Sphere) else "disk"
        size = (shape.radius,) * 3
    return {"type": kind, "to_world": matrix @ np.diag([*size, 1.0]), **found}


def _bsdf(material: Material) -> Description:
    """What Mitsuba calls a material; both sides of surfaces that are opaque."""
    if isinstance(material, Dielectric):
        return {"type": "dielectric", "int_ior": float(material.eta), "ext_ior": 1.0}
    if isinstance(material, RoughDielectric):
        return {
            "type": "roughdielectric",
            "distribution": material.normals,
            "int_ior": float(material.eta),
            "ext_ior": 1.0,
            "alpha": float(material.alpha[0]),
        }
    if isinstance(material, BlinnPhong | Sum):
        return _two(_lobe(material))
    if isinstance(material, Lambert):
        return _two({"type": "diffuse", "reflectance": _rgb(material.colour)})
    factor: Any = 1.0
    if isinstance(material, Scaled):
        factor, material = material.factor, material.material
    if isinstance(material, Mirror | Microfacet) and isinstance(material.fresnel, fresnel.Constant):
        colour = _rgb(np.asarray(factor) * np.asarray(material.fresnel.value))
        if isinstance(material, Mirror):
            kind: Description = {"type": "conductor"}
        else:
            along, across = np.asarray(material.alpha).tolist()
            kind = {
                "type": "roughconductor",
                "distribution": material.normals,
                "alpha_u": along,
                "alpha_v": across,
            }
        return _two({**kind, "material": "none", "specular_reflectance": colour})
    raise InputError(f"{type(material).__name__}: not given to Mitsuba")


def _lobe(material: BlinnPhong | Sum) -> Description:
    """A lobe of Blinn's alone, or over matte parts."""
    parts = material.parts if isinstance(material, Sum) else (material,)
    lobes = [part for part in parts if isinstance(part, BlinnPhong)]
    matte = [part for part in parts if isinstance(part, Lambert)]
    if len(lobes) != 1 or len(lobes) + len(matte) != len(parts):
        names = " + ".join(type(part).__name__ for part in parts)
        raise InputError(f"{names}: of sums, Lambert + BlinnPhong is given to Mitsuba")
    lobe = lobes[0]
    found: Description = {
        "type": mitsuba_lobes.NAME,
        "exponent": float(lobe.exponent),
        "constant": float(reflectance.blinn_phong_constant(lobe.exponent))
        if lobe.normalised
        else 1.0,
    }
    colours = {
        "diffuse": sum((np.asarray(part.colour, np.float64) for part in matte), np.zeros(())),
        "specular": np.asarray(lobe.colour, np.float64),
    }
    for name, colour in colours.items():
        for channel, value in zip("rgb", np.broadcast_to(colour, 3).tolist(), strict=True):
            found[f"{name}_{channel}"] = value
    return found


def _light(light: Any) -> Description:
    if isinstance(light, Point):
        place = np.asarray(light.position, np.float64).tolist()
        return {"type": "point", "position": place, "intensity": _rgb(light.intensity)}
    if isinstance(light, Environment) and not light.is_map:
        radiance = np.asarray(light.radiance) * np.asarray(light.scale)
        return {"type": "constant", "radiance": _rgb(radiance)}
    if isinstance(light, Environment) and light.up == "z" and light.turn == 0.0:
        pixels = np.asarray(light.radiance, np.float32) * np.float32(light.scale)
        flipped = np.ascontiguousarray(pixels[:, ::-1])
        return {"type": "envmap", "bitmap": flipped, "to_world": _MAP}
    raise InputError(f"{type(light).__name__}: not given to Mitsuba")


def _rgb(value: Any) -> Description:
    # Lists of Python's numbers: Mitsuba takes no others.
    return {"type": "rgb", "value": np.broadcast_to(np.asarray(value, np.float64), 3).tolist()}


def _two(bsdf: Description) -> Description:
    return {"type": "twosided", "bsdf": bsdf}


def _loaded(mi: Any, value: Any, name: str = "") -> Any:
    if isinstance(value, dict):
        if value.get("type") == "mesh":
            return _mesh(mi, value)
        return {key: _loaded(mi, one, key) for key, one in value.items()}
    if name == "to_world":
        return mi.ScalarTransform4f(value)
    return mi.Bitmap(value) if name == "bitmap" else value


def _mesh(mi: Any, value: Description) -> Any:
    more = mi.Properties()
    for part in ("bsdf", "emitter"):
        if part in value:
            more[part] = mi.load_dict(_loaded(mi, value[part]))
    counts = len(value["vertices"]), len(value["faces"])
    mesh = mi.Mesh("mesh", *counts, has_vertex_normals=True, props=more)
    parameters = mi.traverse(mesh)
    for theirs, ours in (
        ("vertex_positions", value["vertices"].astype(np.float32)),
        ("vertex_normals", value["normals"].astype(np.float32)),
        ("faces", value["faces"].astype(np.uint32)),
    ):
        parameters[theirs] = type(parameters[theirs])(ours.ravel())
    parameters.update()
    return mesh
