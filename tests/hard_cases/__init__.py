"""The inputs on which numerical code breaks, by kernel: limits, poles, cancellations.

Every array-valued public function of `diffopt.kernels` has at least one row here (a test
sees to it). A row gives the arguments and a twin in NumPy extended precision (80 bits);
values, compiled and not, in both dtypes, are compared with the twin, gradients with central
differences of the twin. `ulps` is the error allowed, in units of the dtype's eps times the
largest value; its reason stands beside it where it is not a handful of operations. Second
derivatives are in `curvatures`.
"""

from hard_cases.base import LD, PI, Hard
from hard_cases.colours import colours
from hard_cases.directions import directions
from hard_cases.ensembles import bessels, ensembles
from hard_cases.gathers import gathers
from hard_cases.lobes import lobes
from hard_cases.phases import phases
from hard_cases.reflectances import reflectances
from hard_cases.splines import splines
from hard_cases.tables import series
from hard_cases.transforms import transforms

__all__ = ["LD", "PI", "Hard", "rows"]


def rows():
    """All hard cases."""
    yield from phases()
    yield from transforms()
    yield from series()
    yield from gathers()
    yield from directions()
    yield from ensembles()
    yield from bessels()
    yield from reflectances()
    yield from colours()
    yield from splines()
    yield from lobes()
