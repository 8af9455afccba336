"""From a model to pictures.

==========  ====================================================================
`shapes`    curved surfaces under a camera
`views`     what the pictures show, as numbers
`tones`     gamut, exposure and tone curve for a display
`pictures`  figures and files
==========  ====================================================================
"""
