"""Materials: how surfaces scatter light.

=================  ==============================================================
`base`             what every material offers: f, sample, pdf, albedo
`diffuse`          Lambert's, Oren and Nayar's
`phong`            Phong's, as in textbooks and normalised; Blinn's
`microfacet`       rough metals, and the mapping from roughness
`interfaces`       mirrors, glass, ground glass
`combined`         sums, scaled materials, emission
`diffracting`      a diffracting surface as a material
`merl`             measured: MERL tables of half and difference angles
`rgl`              measured: RGL's ``.bsdf``; `pbsdf`: polarised; `tensorfile`: their files
`scattered`        measured: tables of a gonioreflectometer
`goniometer`       a virtual gonioreflectometer, which measures any material
`naming`           materials by name or file, for the command line
`report`           what a material declares, and whether it holds
`checking`         checks of parameters
=================  ==============================================================
"""

from diffopt.materials.base import Material as Material
from diffopt.materials.base import Sample as Sample
from diffopt.materials.combined import Emission as Emission
from diffopt.materials.combined import Scaled as Scaled
from diffopt.materials.combined import Sum as Sum
from diffopt.materials.diffracting import Diffraction as Diffraction
from diffopt.materials.diffracting import FlatDiffraction as FlatDiffraction
from diffopt.materials.diffuse import Lambert as Lambert
from diffopt.materials.diffuse import OrenNayar as OrenNayar
from diffopt.materials.goniometer import Measurement as Measurement
from diffopt.materials.goniometer import measure as measure
from diffopt.materials.interfaces import Dielectric as Dielectric
from diffopt.materials.interfaces import Mirror as Mirror
from diffopt.materials.interfaces import RoughDielectric as RoughDielectric
from diffopt.materials.merl import Merl as Merl
from diffopt.materials.merl import load_merl as load_merl
from diffopt.materials.merl import save_merl as save_merl
from diffopt.materials.microfacet import Microfacet as Microfacet
from diffopt.materials.microfacet import alpha_from_roughness as alpha_from_roughness
from diffopt.materials.pbsdf import load_pbsdf as load_pbsdf
from diffopt.materials.phong import BlinnPhong as BlinnPhong
from diffopt.materials.phong import Phong as Phong
from diffopt.materials.rgl import load_rgl as load_rgl
from diffopt.materials.scattered import load_table as load_table
