"""Soft shadows of deforming objects: shadow fields in spherical harmonics.

A field tells what an object hides as seen from any point, in a few coefficients. It is sampled by
rays on a few spheres about the object, at every frame in which the object changed, and carried to
all other distances (after Zhou et al., "Soft shadows of deforming objects", put right and taken
further).

===============  ==========================================================
`settings`       how fields are sampled, combined and shaded
`choosing`       settings that meet a tolerance
`shells`         where they are sampled; `rays`: what rays meet
`sampling`       samples of a mesh; `tables`: from them to all distances
`fields`         a field in its place, read by receivers
`parts`          an object as several fields
`lights`         distant light, spheres, emitting meshes
`responses`      matte receivers and BRDFs
`combining`      several occluders
`shading`        irradiance and reflected radiance
`truth`          ray-cast reference
`moving`         an object over time: sampled anew only where it changed
`animations`     deforming objects to watch; `creatures`: their meshes
`pictures`       pictures of them over the ground
===============  ==========================================================
"""

from diffopt.shadows.choosing import settings_for as settings_for
from diffopt.shadows.fields import Field as Field
from diffopt.shadows.fields import shadow_field as shadow_field
from diffopt.shadows.lights import DistantLight as DistantLight
from diffopt.shadows.lights import FieldLight as FieldLight
from diffopt.shadows.lights import SphereLight as SphereLight
from diffopt.shadows.lights import distant_light as distant_light
from diffopt.shadows.moving import Occluder as Occluder
from diffopt.shadows.parts import part_fields as part_fields
from diffopt.shadows.responses import ProjectedBRDF as ProjectedBRDF
from diffopt.shadows.responses import project_brdf as project_brdf
from diffopt.shadows.settings import ShadowSettings as ShadowSettings
from diffopt.shadows.shading import irradiance as irradiance
from diffopt.shadows.shading import plane as plane
from diffopt.shadows.shading import reflected as reflected
