"""Looking at what is computed, in a browser, while turning knobs.

================  ==========================================================
`server`          the page, on this machine alone by default (extra ``view``)
`session`         one browser: coarse frames in motion, fine ones at rest
`screen`          what a session knows of the viewer
`building`        tables and programs made in the background
`subject`         what can be looked at: the interface
`diffracting`     a diffracting surface on a sheet, a ball (`surfaces`) or a mesh
`glossy`          precomputed glossy transfer under lights that turn
`shadowed`        a deforming object with its soft shadow
`scenery`         any scene, by a plan or a level of image synthesis
`exponents`       of materials, replaced while looking
`controls`        sliders and menus, and what they take
`painting`        pixels in chunks of one size
`panels`, `gltf`  words beside the picture; meshes for the browser
================  ==========================================================

A subject says what its frames are made from; tables and programs are built in the background,
and until they are there frames are drawn from the ones before.
"""
