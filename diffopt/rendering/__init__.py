"""Image synthesis at several levels, from the same shading functions.

===========  ===================================================================
`synthesis`  a picture of a scene by a level; `settings`: how
`driver`     tile by tile, in bounded memory, by several `diffopt.workers`
`direct`     incremental shading and recursive ray tracing
`radiosity`  light between `patches` of surfaces (`charts`): `formfactors`,
             direct light on them (`illumination`), smooth over them
             (`smoothing`), as a level (`coupled`)
`ambient`    even light in place of what a level leaves out
`pathtrace`  everything, with a standard error
`composed`   some `effects` and no others, told apart by their `happenings`, in `ledgers`
`shading`    where a ray meets a surface
`stage`      a scene as arrays: `groups` of materials, `sources` of light of several `families`
`standins`   abstract lights in place of all others
`albedos`    of materials, for even light
`rows`       of arrays, between compiled `programs`
`queries`    what rays meet, asked or recorded; `recording`: for derivatives
`images`     pictures; `files`: what they are written to
===========  ===================================================================
"""

from diffopt.rendering.images import Image as Image
from diffopt.rendering.radiosity_settings import RadiosityRaysSettings as RadiosityRaysSettings
from diffopt.rendering.radiosity_settings import RadiositySettings as RadiositySettings
from diffopt.rendering.settings import IncrementalSettings as IncrementalSettings
from diffopt.rendering.settings import PathSettings as PathSettings
from diffopt.rendering.settings import RecursiveSettings as RecursiveSettings
from diffopt.rendering.synthesis import record as record
from diffopt.rendering.synthesis import render as render
