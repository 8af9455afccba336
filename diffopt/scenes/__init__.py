"""Scenes: shapes, materials in their places, lights, cameras.

==============  ==================================================================
`scene`         objects and scenes, and their geometry
`shapes`        spheres, discs, planes, boxes and meshes
`transforms`    matrices that place them
`textures`      parameters that vary over an object
`lights`        light sources; `sky`: environment maps
`camera`        pinhole cameras
`channels`      RGB or wavelengths, and how one becomes the other
`world`         all shapes in arrays, and the surface where a ray meets one
`raycasting`    what a ray meets; `primary`: what a camera sees of a mesh, faster
`meshfiles`     meshes from files and arrays: winding, creases, normals
`tangents`      directions of the material on a mesh
`models`        teapot, torus, knot and rabbit; `newell`: the teapot's patches, of
                `teapot_points`; `tubes` about curves; `blends`: smooth bodies of ellipsoids
`files`         scenes as TOML files; `tables`: their faults; `toml_lines`: where
`reading`       objects from tables; `material_tables`, `light_tables`
`writing`       scenes to files; `material_words`: their materials
`assets`        textures, maps and materials from files; `origins`: which ones
`spectra`       colours of lights by illuminant or temperature
`findings`      what is odd about a scene; `overlaps`: surfaces in one place
`examples`      scenes to start from; `glossy_examples`
==============  ==================================================================
"""

from diffopt.scenes import meshfiles as meshfiles
from diffopt.scenes import models as models
from diffopt.scenes.assets import checkerboard as checkerboard
from diffopt.scenes.assets import load_environment as load_environment
from diffopt.scenes.assets import load_lobes as load_lobes
from diffopt.scenes.assets import load_material as load_material
from diffopt.scenes.assets import load_texture as load_texture
from diffopt.scenes.camera import Camera as Camera
from diffopt.scenes.files import SceneFile as SceneFile
from diffopt.scenes.files import load_scene as load_scene
from diffopt.scenes.files import save_scene as save_scene
from diffopt.scenes.findings import Finding as Finding
from diffopt.scenes.findings import check as check
from diffopt.scenes.lights import Ambient as Ambient
from diffopt.scenes.lights import Directional as Directional
from diffopt.scenes.lights import Environment as Environment
from diffopt.scenes.lights import Falloff as Falloff
from diffopt.scenes.lights import Flood as Flood
from diffopt.scenes.lights import LobeEnvironment as LobeEnvironment
from diffopt.scenes.lights import Point as Point
from diffopt.scenes.meshfiles import Mesh as Mesh
from diffopt.scenes.scene import Object as Object
from diffopt.scenes.scene import Scene as Scene
from diffopt.scenes.scene import area_light as area_light
from diffopt.scenes.shapes import Box as Box
from diffopt.scenes.shapes import Disc as Disc
from diffopt.scenes.shapes import Plane as Plane
from diffopt.scenes.shapes import Sphere as Sphere
from diffopt.scenes.textures import PerFace as PerFace
from diffopt.scenes.textures import Texture as Texture
from diffopt.scenes.textures import Textured as Textured
from diffopt.scenes.transforms import facing as facing
from diffopt.scenes.transforms import rotate as rotate
from diffopt.scenes.transforms import scale as scale
from diffopt.scenes.transforms import translate as translate

load_mesh = meshfiles.load
build_mesh = meshfiles.build
