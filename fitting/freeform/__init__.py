"""Every height of a surface from its reflectance.

=========  ==========================================================
`fit`      `diffopt.fitting.fit_heights`
`problem`  misfit and prior as a function of whitened heights
`priors`   smoothness, and spectra that heights are expected to have
`steps`    blocks of L-BFGS and of nonlinear conjugate gradients
`stages`   blocks until the minimum, and the strength of the prior
`equal`    surfaces that reflect alike, and which of them is given
`errors`   standard deviation of each height
`result`   `diffopt.fitting.HeightsFit`
=========  ==========================================================
"""
