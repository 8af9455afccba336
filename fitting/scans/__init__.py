"""A surface's parameters from its heights, and which kind describes them best.

=================  ==========================================================
`fit`              `diffopt.fitting.fit_scan` and its result
`register`         periods, orientations and phases to start from
`candidates`       the models that compete, each started and fitted in its way
`squares`          least squares on heights, by `descent`; `errors` under correlated noise
`noise`            likelihood of what a model leaves as random
`random_surfaces`  ridges, roughness and bumps, by that likelihood
`disc`             pits and tracks; `codes`: the channel bits of their lengths
`convention`       which of several equal sets of parameters is given
`setting`          what all of them are handed
=================  ==========================================================
"""
