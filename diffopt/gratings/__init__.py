"""Parametric surfaces with closed-form spectra: gratings, ridges, roughness, bumps, discs.

===============  ==========================================================
`parametric`     named parameters with their kinds
`base`           heights and spectra that all of them have
`profiles`       sinusoidal, blazed and binary gratings
`trapezoid`      gratings with flat tops and sloping walls
`crossed`        two gratings added
`disorder`       periods and angles that scatter, ridges that wander
`rough`          isotropic roughness and bumps at random places
`superposed`     a surface added to another
`disc`           the tracks of a compact disc
`series`         lines spread by a random phase
`reflectance`    their BRDF
===============  ==========================================================

Parameters are array leaves, so that fits can act on them.
"""

from diffopt.gratings.base import Components as Components
from diffopt.gratings.base import Reach as Reach
from diffopt.gratings.base import Surface as Surface
from diffopt.gratings.crossed import Crossed as Crossed
from diffopt.gratings.disc import CompactDisc as CompactDisc
from diffopt.gratings.disorder import Jittered as Jittered
from diffopt.gratings.disorder import Ridges as Ridges
from diffopt.gratings.parametric import Parametric as Parametric
from diffopt.gratings.profiles import Binary as Binary
from diffopt.gratings.profiles import Blazed as Blazed
from diffopt.gratings.profiles import Grating as Grating
from diffopt.gratings.profiles import Sinusoidal as Sinusoidal
from diffopt.gratings.profiles import bessel_j as bessel_j
from diffopt.gratings.reflectance import brdf as brdf
from diffopt.gratings.reflectance import power as power
from diffopt.gratings.reflectance import reach_for as reach_for
from diffopt.gratings.rough import Bumps as Bumps
from diffopt.gratings.rough import Rough as Rough
from diffopt.gratings.rough import Roughness as Roughness
from diffopt.gratings.superposed import Superposed as Superposed
from diffopt.gratings.trapezoid import Trapezoid as Trapezoid
