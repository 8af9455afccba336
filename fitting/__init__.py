"""Fits over the forward model; import as ``diffopt.fitting``.

Inverse problems solved with optimistix.

==================  ==========================================================
`measured`          measured reflectance, checked where it comes in
`measured_files`    the same from and to files; `measured_text`: CSV
`heightfield`       from a scan or reflectance to the surface, by one call
`reflectance`       a surface's parameters from reflectance, from the data alone: `reflectance_run`
                    stages, `fit_settings`,
                    `starts` by the grating equation and their `start_design`, `forward` values,
                    `maps` of bounds, `solving`, `answers`, `templates` of surfaces by name
`ranking`           several kinds of surfaces for the same reflectance, ranked
`scan`              a surface's parameters from its heights, models ranked: `scan_register`,
                    `scan_candidates`, `scan_random`, `scan_disc`, `scan_squares` by
                    `scan_descent`, `scan_noise`,
                    `scan_errors`, `scan_codes`, `scan_setting`, `scan_convention`
`freeform`          every height from reflectance, under `freeform_priors`: `freeform_problem`,
                    `freeform_steps`, `freeform_stages`, `freeform_equal`, `freeform_errors`,
                    `freeform_result`
`schedule_studies`  what accuracy costs for fits to reflectance
`lobes`             functions on the sphere to von Mises-Fisher lobes, by `lobe_settings`
`lobe_targets`      what they are fitted to; `lobe_samples`: samples
`brdf`              whole BRDFs, with lobes that belong together
`comparison`        EM, least squares and `rivals` on the same slices; `lobe_table`: rows
`lobe_studies`      what accuracy costs for fits of lobes; `sample_studies`: for samples
`solvers`           Levenberg-Marquardt on normal equations, for optimistix
==================  ==========================================================
"""

if __name__ != "diffopt.fitting":
    raise ImportError(
        f"this folder was imported as {__name__!r}: import it as `diffopt.fitting` "
        "(install the project with `make demo` or `pip install -e .`), or a second copy "
        "of every module would be loaded"
    )

from diffopt.fitting.answers import RankedModel as RankedModel
from diffopt.fitting.answers import ReflectanceFit as ReflectanceFit
from diffopt.fitting.brdf import fit_brdf as fit_brdf
from diffopt.fitting.comparison import compare as compare
from diffopt.fitting.fit_settings import FitSettings as FitSettings
from diffopt.fitting.freeform import HeightsFit as HeightsFit
from diffopt.fitting.freeform import fit_heights as fit_heights
from diffopt.fitting.heightfield import fit_heightfield as fit_heightfield
from diffopt.fitting.lobe_samples import fit_samples as fit_samples
from diffopt.fitting.lobe_settings import LobeSettings as LobeSettings
from diffopt.fitting.lobe_targets import fit_environment as fit_environment
from diffopt.fitting.lobe_targets import fit_lobes as fit_lobes
from diffopt.fitting.lobe_targets import fit_table as fit_table
from diffopt.fitting.lobes import LobeFit as LobeFit
from diffopt.fitting.measured import Measured as Measured
from diffopt.fitting.ranking import rank_reflectance as rank_reflectance
from diffopt.fitting.reflectance import fit_reflectance as fit_reflectance
from diffopt.fitting.scan import ScanFit as ScanFit
from diffopt.fitting.scan import fit_scan as fit_scan
from diffopt.fitting.solvers import NormalLevenbergMarquardt as NormalLevenbergMarquardt
