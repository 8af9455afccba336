"""Materials as the tables of a scene file that mean them."""

import math
from typing import Any

import equinox as eqx
import numpy as np

from diffopt import colour, fresnel
from diffopt.errors import InputError
from diffopt.materials import naming
from diffopt.materials.base import Material
from diffopt.materials.combined import Scaled, Sum
from diffopt.materials.diffuse import Lambert, OrenNayar
from diffopt.materials.interfaces import Dielectric, Mirror, RoughDielectric
from diffopt.materials.microfacet import Microfacet
from diffopt.materials.phong import BlinnPhong, Phong
from diffopt.scenes.origins import origin

#: What ``kind`` may be.
KINDS = (*naming.NAMES, "sum", "scaled", "diffraction")
#: Metals by name.
METALS = {"gold": "Au", "silver": "Ag", "aluminium": "Al", "copper": "Cu"}


def described(material: Material) -> dict[str, Any]:
    """The table that means a material; a path in it is absolute.

    Raises
    ------
    InputError
        For a material that no table means.
    """
    known = origin(material)
    if known is not None:
        return known
    if isinstance(material, Lambert):
        return {"kind": "lambert", "colour": plain(material.colour)}
    if isinstance(material, OrenNayar):
        sigma = math.degrees(float(plain(material.sigma)))
        return {"kind": "oren-nayar", "colour": plain(material.colour), "sigma": sigma}
    lobe = {"colour", "exponent"}
    if isinstance(material, Phong) and (material.form, material.normalisation) == (
        "reflected",
        "energy",
    ):
        return {"kind": "phong", **{n: plain(getattr(material, n)) for n in sorted(lobe)}}
    if isinstance(material, BlinnPhong) and material.normalised:
        return {"kind": "blinn-phong", **{n: plain(getattr(material, n)) for n in sorted(lobe)}}
    if isinstance(material, Mirror) and _same(material.fresnel, fresnel.Constant()):
        return {"kind": "mirror"}
    if isinstance(material, Dielectric) and material.radiance:
        return {"kind": "glass", "eta": plain(material.eta)}
    if isinstance(material, RoughDielectric) and material.radiance:
        return {"kind": "rough-glass", "eta": plain(material.eta), **_facets(material)}
    if isinstance(material, Microfacet):
        for name, symbol in METALS.items():
            if _same(material.fresnel, fresnel.metal(symbol)):
                return {"kind": name, **_facets(material), **_wavelengths(material)}
    if isinstance(material, Scaled):
        inner, factor = described(material.material), plain(material.factor)
        return {"kind": "scaled", "material": inner, "factor": factor}
    if isinstance(material, Sum):
        plastic = _plastic(material)
        if plastic is not None:
            return plastic
        parts = [described(part) for part in material.parts]
        even = np.allclose(np.asarray(material.chances), 1.0 / len(parts))
        return {
            "kind": "sum",
            "parts": parts,
            **({} if even else {"chances": plain(material.chances)}),
        }
    raise InputError(
        f"a {type(material).__name__} with these options has no name in scene files; expected "
        f"what {', '.join(KINDS)} make, or a material of `load_material`"
    )


def plain(array: Any) -> Any:
    """Numbers as they are written: the shortest that give the same number again."""
    values = np.asarray(array)
    # Not str(): libraries change how NumPy prints.
    found = [float(np.format_float_scientific(value, unique=True)) for value in values.ravel()]
    return found[0] if values.ndim == 0 else np.reshape(found, values.shape).tolist()


def _plastic(material: Sum) -> dict[str, Any] | None:
    """The table of a plastic; None for another sum."""
    if len(material.parts) != 2:
        return None
    base, coat = material.parts
    if not isinstance(base, Lambert) or not isinstance(coat, Microfacet):
        return None
    law = coat.fresnel
    if not isinstance(law, fresnel.Dielectric) or law.coefficients.shape != (1,):
        return None
    even = np.allclose(np.asarray(material.chances), 0.5)
    if not even or base.colour.shape not in ((), (3,)) or coat.wavelengths.ndim:
        return None
    eta = plain(law.coefficients[0])
    return {"kind": "plastic", "colour": plain(base.colour), "eta": eta, **_facets(coat)}


def _facets(material: Any) -> dict[str, Any]:
    """Alpha, and what is not the default."""
    pair = plain(material.alpha)
    found: dict[str, Any] = {"alpha": pair[0] if pair[0] == pair[1] else pair}
    fields = {"normals": "ggx", "masking": "correlated", "compensation": "none"}
    for name, usual in fields.items():
        value = getattr(material, name, usual)
        if value != usual:
            found[name] = value
    return found


def _wavelengths(material: Microfacet) -> dict[str, Any]:
    usual, own = colour.wavelengths(naming.STEP_NM), np.asarray(material.wavelengths)
    if own.shape == usual.shape and np.allclose(own, usual, rtol=1e-6, atol=0.0):
        return {}
    return {"wavelengths": [plain(own)] if own.ndim == 0 else plain(own)}


def _same(one: Any, other: Any) -> bool:
    return type(one) is type(other) and bool(eqx.tree_equal(one, other, rtol=1e-6))
