"""Differentiable optics in JAX: from a measured heightfield to its colours.

==================  ==========================================================
`heightfield`       a scan with its pixel: loading, conditioning, saving
`conditioning`      levelling, filling, cropping, resampling, rotating
`statistics`        roughness, slope, spectrum, dominant period
`io`                readers and writers of the file formats
`samples`           embedded surfaces, made by code
`gratings`          sinusoidal, blazed and binary gratings with closed forms
`diffraction`       the diffraction BRDF of a heightfield, and its reference sum
`statistical`       closed forms for surfaces known by their statistics
`methods`           the ways to evaluate it
`settings`          their settings
`bounds`            their errors before they run
`choice`            the cheapest method within a tolerance
`fresnel`           reflectance of mirrors, glasses and metals
`colour`            spectra to XYZ to sRGB
==================  ==========================================================
"""

from diffopt import colour as colour
from diffopt import fresnel as fresnel
from diffopt.choice import Choice as Choice
from diffopt.choice import PreparedBRDF as PreparedBRDF
from diffopt.diffraction import DiffractionBRDF as DiffractionBRDF
from diffopt.errors import InputError as InputError
from diffopt.heightfield import Heightfield as Heightfield
from diffopt.settings import DirectSettings as DirectSettings
from diffopt.settings import SeparableSettings as SeparableSettings
from diffopt.settings import TaylorSettings as TaylorSettings

__version__ = "0.1.0"
