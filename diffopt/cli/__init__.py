"""The command line: ``diffopt COMMAND``.

================  ==========================================================
`application`     the table of commands, `main`, exit codes
`options`         from the words of options to scans, models and jobs
`diffraction`     ``diffopt diffraction``: pictures and numbers of one scan
`results`         its ``result.npz`` and ``result.json``
`demo`            ``diffopt demo``: some of everything, as one page
`material`        ``diffopt material``: pictures and properties of a material
`studying`        ``diffopt accuracy`` and ``diffopt bench``
`comparing`       ``diffopt compare``; apart from it `comparing_levels`, `comparing_plans`,
                  `comparing_shadows` and `comparing_transfer`
`fitting`         ``diffopt fit``; `fit_targets`: what lobes are fitted to
`fit_heightfield` its part for surfaces (`fit_heightfield_output`, `fit_heightfield_table`)
`scene`           ``diffopt scene``: scene files checked, and examples
`plan`            ``diffopt plan``: effects that a picture calls for
`render`          ``diffopt render``: their pictures (`render_output`)
`precompute`      ``diffopt precompute``: transfer into a store (`precompute_tables`)
`relight`         ``diffopt relight``: pictures by it (`relight_output`)
`view`            ``diffopt view``: the viewer in a browser
`shadow`          ``diffopt shadow``: a deforming object and its soft shadow (`film`)
`inspection`      ``diffopt samples`` and ``diffopt info``
`limits`          refusal of files that claim to be enormous
`output`          folders that are complete or absent
`progress`        progress bar and times, compilation apart
`errors`          one line and exit code 2 for faults of the input
================  ==========================================================

Modules of commands import what is slow inside their functions.
"""

from diffopt.cli.application import main as main
