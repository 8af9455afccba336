"""Fits over the forward model; import as ``diffopt.fitting``.

Inverse problems solved with optimistix.

==================  ==========================================================
`heightfield`       from a scan or reflectance back to the surface, by one call
`measured`          measured reflectance, checked where it comes in; `measured_files`: from and to
                    files; `measured_text`: CSV
`reflectance`       a surface's parameters from reflectance, from the data alone
`scans`             a surface's parameters from its heights, models ranked
`freeform`          every height from reflectance
`ranked`            a row of a ranking
`lobes`             functions on the sphere to von Mises-Fisher lobes, by `lobe_settings`
`lobe_targets`      what they are fitted to; `lobe_samples`: samples
`brdf`              whole BRDFs, with lobes that belong together
`comparison`        EM, least squares and `rivals` on the same slices; `lobe_table`: rows
`lobe_studies`      what accuracy costs for fits of lobes; `sample_studies`: for samples
`previews`          what a notebook shows of fits
`solvers`           Levenberg-Marquardt on normal equations, for optimistix
==================  ==========================================================
"""

if __name__ != "diffopt.fitting":
    raise ImportError(
        f"this folder was imported as {__name__!r}: import it as `diffopt.fitting` "
        "(install the project with `make demo` or `pip install -e .`), or a second copy "
        "of every module would be loaded"
    )

from diffopt.fitting.brdf import fit_brdf as fit_brdf
from diffopt.fitting.comparison import compare as compare
from diffopt.fitting.freeform.fit import HeightsFit as HeightsFit
from diffopt.fitting.freeform.fit import fit_heights as fit_heights
from diffopt.fitting.heightfield import fit_heightfield as fit_heightfield
from diffopt.fitting.lobe_samples import fit_samples as fit_samples
from diffopt.fitting.lobe_settings import LobeSettings as LobeSettings
from diffopt.fitting.lobe_targets import fit_environment as fit_environment
from diffopt.fitting.lobe_targets import fit_lobes as fit_lobes
from diffopt.fitting.lobe_targets import fit_table as fit_table
from diffopt.fitting.lobes import LobeFit as LobeFit
from diffopt.fitting.measured import Measured as Measured
from diffopt.fitting.ranked import Ranked as Ranked
from diffopt.fitting.reflectance.answers import ReflectanceFit as ReflectanceFit
from diffopt.fitting.reflectance.fit import fit_reflectance as fit_reflectance
from diffopt.fitting.reflectance.profiles import Profile as Profile
from diffopt.fitting.reflectance.profiles import profile as profile
from diffopt.fitting.reflectance.ranking import rank_reflectance as rank_reflectance
from diffopt.fitting.reflectance.settings import FitSettings as FitSettings
from diffopt.fitting.scans.fit import ScanFit as ScanFit
from diffopt.fitting.scans.fit import fit_scan as fit_scan
from diffopt.fitting.solvers import NormalLevenbergMarquardt as NormalLevenbergMarquardt
