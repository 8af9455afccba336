"""Blinn-Phong over Lambert as a material of Mitsuba 3, which has neither the lobe nor sums.

The lobe is written here anew, from its formula: the comparison is with another renderer, and
shares no line with `diffopt.materials`.
"""

import math
from typing import Any

#: The name under which Mitsuba knows the material.
NAME = "diffopt_blinn_phong"


def register(mi: Any) -> None:
    """Make the material known to a variant; once for each that is set.

    Its parameters are ``diffuse_r`` and so on and ``specular_r`` and so on, reflectances, the
    ``exponent`` e, and ``constant``, which the lobe (n.h)^e is multiplied by. It is of one
    side; a lobe is drawn by the half vector's density (e + 1) / (2 pi) cos^e, the diffuse part by
    the cosine, either half the time where both are there.
    """
    import drjit as dr

    class BlinnPhong(mi.BSDF):
        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self.diffuse, self.specular = (
                [float(props.get(f"{part}_{channel}")) for channel in "rgb"]
                for part in ("diffuse", "specular")
            )
            self.exponent = float(props.get("exponent"))
            self.constant = float(props.get("constant"))
            matte, glossy = any(self.diffuse), any(self.specular)
            self.chance = 0.5 if matte and glossy else float(glossy)
            flag = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            self.m_components, self.m_flags = [flag], flag

        def sample(self, ctx: Any, si: Any, s1: Any, s2: Any, active: Any = True) -> Any:
            cosine: Any = dr.power(1.0 - s2[0], 1.0 / (self.exponent + 1.0))
            sine: Any = dr.sqrt(dr.maximum(1.0 - cosine * cosine, 0.0))
            turn = 2.0 * math.pi * s2[1]
            half = mi.Vector3f(sine * dr.cos(turn), sine * dr.sin(turn), cosine)
            mirrored = 2.0 * dr.dot(si.wi, half) * half - si.wi
            even = mi.warp.square_to_cosine_hemisphere(s2)
            found = mi.BSDFSample3f()
            found.wo = dr.select(s1 < self.chance, mirrored, even)
            found.pdf = self.pdf(ctx, si, found.wo, active)
            found.eta = 1.0
            found.sampled_type = +mi.BSDFFlags.GlossyReflection
            found.sampled_component = 0
            drawn = found.pdf > 0.0
            weight = self.eval(ctx, si, found.wo, active) / dr.select(drawn, found.pdf, 1.0)
            return found, dr.select(active & drawn, weight, mi.Color3f(0.0))

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            above = active & (si.wi[2] > 0.0) & (wo[2] > 0.0)
            half = dr.normalize(si.wi + wo)
            power: Any = dr.power(dr.maximum(half[2], 0.0), self.exponent)
            lobe = self.constant * power
            value = mi.Color3f(self.diffuse) / math.pi + mi.Color3f(self.specular) * lobe
            return dr.select(above, value * wo[2], mi.Color3f(0.0))

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            above = active & (si.wi[2] > 0.0) & (wo[2] > 0.0)
            half = dr.normalize(si.wi + wo)
            power: Any = dr.power(dr.maximum(half[2], 0.0), self.exponent)
            lobe = (self.exponent + 1.0) / (2.0 * math.pi) * power
            # Mirroring at a half vector spreads directions by four times its cosine.
            lobe = lobe / dr.maximum(4.0 * dr.dot(si.wi, half), 1e-9)
            even = wo[2] / math.pi
            return dr.select(above, self.chance * lobe + (1.0 - self.chance) * even, 0.0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self) -> str:
            return f"{NAME}[exponent = {self.exponent}]"

    mi.register_bsdf(NAME, BlinnPhong)
