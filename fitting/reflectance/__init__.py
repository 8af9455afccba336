"""A surface's parameters from its reflectance, with a start or from the data alone.

==================  ==========================================================
`fit`               `diffopt.fitting.fit_reflectance`
`ranking`           several kinds of surfaces for the same data
`settings`          `diffopt.fitting.FitSettings`
`run`               the stages of one fit
`templates`         kinds of surfaces by name, and their lattices
`starts`            lattices by the grating equation; `start_design`: which starts are tried
`maps`              bounds of parameters
`forward`           what a surface would have measured
`solving`           least squares from several starts, coarse to fine
`answers`           errors, what the data cannot tell, and the verdict
`profiles`          the least misfit over one parameter
`schedule_studies`  what accuracy costs
==================  ==========================================================
"""
