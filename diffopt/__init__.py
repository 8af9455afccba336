"""Differentiable optics in JAX: from a measured heightfield to its colours.

=====================  ==========================================================
`heightfield`          a scan with its pixel: loading, conditioning, saving
`conditioning`         levelling, filling, cropping, resampling, rotating
`loading`              file to heights and provenance, for `heightfield`
`statistics`           roughness, slope, spectrum, dominant period
`sampling`             is the pixel fine enough for a wavelength and an angle
`io`                   readers and writers of the file formats
`samples`              embedded surfaces, made by code
`random_fields`        periodic random fields, for `samples`
`discs`                run lengths and pits of a compact disc
`gratings`             parametric surfaces with closed-form spectra
`diffraction`          the diffraction BRDF of a heightfield, and its reference sum
`scalar`               what scalar models multiply the transform by
`statistical`          closed forms for surfaces known by their statistics
`methods`              the ways to evaluate it
`gathering`            those that gather from tables of Fourier bins
`settings`             their settings
`bounds`               their errors before they run
`choice`               the cheapest method within a tolerance, among `candidates`, by `costs`
`lookup`               reflectance as a table over wave vectors
`baking`               how it is made; `table_bounds`: its error; `stores`: its files
`few`                  a few wavelengths, the mirror peak apart
`accuracy`             studies of accuracy against time, and benchmarks
`fresnel`              reflectance of mirrors, glasses and metals
`glasses`              glasses and water by Sellmeier's formula
`metals`               measured tables of n and k of metals
`lobes`                functions on the sphere as von Mises-Fisher lobes
`brdf_lobes`           those of a BRDF over viewing directions
`materials`            how surfaces scatter light: values, samples, densities, albedos
`scenes`               objects, lights and cameras
`rendering`            pictures of scenes, at several levels of image synthesis
`planning`             which effects a picture calls for
`shadows`              soft shadows of deforming objects
`transfer`             glossy surfaces relit from precomputed transfer
`workers`              work of several threads, in order
`devices`              batches over several devices; `spreading`: of pairs of directions
`colour`               spectra to XYZ to sRGB
`illuminants`          illuminants, the observer, weights from spectra to XYZ
`bands`                three bands in place of the matching functions
`drawing`              curved surfaces, tones, pictures
`previews`             what a notebook shows of all these
`viewer`               looking at all that in a browser
`report`               one page of what was computed just now
`cli`                  the command line
=====================  ==========================================================
"""

# Before the imports: modules write it into their files.
__version__ = "0.1.0"

from diffopt import colour as colour
from diffopt import fresnel as fresnel
from diffopt import gratings as gratings
from diffopt import materials as materials
from diffopt import samples as samples
from diffopt import scenes as scenes
from diffopt import shadows as shadows
from diffopt import transfer as transfer
from diffopt.accuracy.studies import study as study
from diffopt.brdf_lobes import BRDFLobes as BRDFLobes
from diffopt.choice import Choice as Choice
from diffopt.choice import PreparedBRDF as PreparedBRDF
from diffopt.devices import each as each
from diffopt.devices import in_batches as in_batches
from diffopt.devices import spread as spread
from diffopt.diffraction import DiffractionBRDF as DiffractionBRDF
from diffopt.errors import InputError as InputError
from diffopt.heightfield import Heightfield as Heightfield
from diffopt.lobes import Lobes as Lobes
from diffopt.materials.phong import BlinnPhong as BlinnPhong
from diffopt.planning.choosing import plan as plan
from diffopt.planning.plans import Plan as Plan
from diffopt.rendering.images import Image as Image
from diffopt.rendering.synthesis import record as record
from diffopt.rendering.synthesis import render as render
from diffopt.scenes.camera import Camera as Camera
from diffopt.scenes.scene import Object as Object
from diffopt.scenes.scene import Scene as Scene
from diffopt.settings import ChebyshevSettings as ChebyshevSettings
from diffopt.settings import DirectSettings as DirectSettings
from diffopt.settings import FewSettings as FewSettings
from diffopt.settings import LowRankSettings as LowRankSettings
from diffopt.settings import SeparableSettings as SeparableSettings
from diffopt.settings import TableSettings as TableSettings
from diffopt.settings import TaylorSettings as TaylorSettings
from diffopt.statistical import GaussianRoughness as GaussianRoughness
from diffopt.statistical import RandomBumps as RandomBumps
from diffopt.stores import BakedBRDF as BakedBRDF
from diffopt.stores import load_table as load_table
