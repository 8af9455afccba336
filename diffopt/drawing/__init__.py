"""From a model to pictures.

==================  ============================================================
`shapes`            closed shapes under a camera
`meshes`            triangle meshes under a camera and a light
`views`             what the pictures show, as numbers
`bands`             that of large pictures, rows by rows
`lobes`             pictures of one material: lobes, map, ball, albedo, swatch
`lobe_fits`         targets, fitted lobes and residuals
`surface_fits`      scans, fitted heights and residuals; loss curves
`reflectance_fits`  measured and fitted reflectance, and residuals
`tones`             gamut, exposure and tone curve for a display
`pictures`          figures and files
`frames`            pictures at interactive rates, for moving lights (`developing`: its program)
==================  ============================================================
"""
