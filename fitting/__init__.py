"""Fits over the forward model; import as ``diffopt.fitting``.

Inverse problems solved with optimistix.

==================  ==========================================================
`measured`          measured reflectance, checked where it comes in
`heightfield`       a grating's parameters from it
==================  ==========================================================
"""

if __name__ != "diffopt.fitting":
    raise ImportError(
        f"this folder was imported as {__name__!r}: import it as `diffopt.fitting` "
        "(install the project with `make demo` or `pip install -e .`), or a second copy "
        "of every module would be loaded"
    )

from diffopt.fitting.heightfield import HeightfieldFit as HeightfieldFit
from diffopt.fitting.heightfield import fit_heightfield as fit_heightfield
from diffopt.fitting.heightfield import grating_brdf as grating_brdf
from diffopt.fitting.measured import Measured as Measured
