"""Adaptive precomputed transfer: glossy surfaces that light themselves, under any distant light.

Of every vertex and viewing direction, what it sends there of light from every direction is kept as
a few von Mises-Fisher lobes, for each kind of light path; more vertices and more views where they
are needed (after the glossy-transfer paper). Light averaged over the lobes makes the picture.

================  ==========================================================
`settings`        how it is precomputed
`precomputation`  vertices, their slices, and where more are needed: `result`
`beginning`       the scene as transfer sees it, its triangles, their frames
`reflectors`      materials as transfer takes them
`views`           nested viewing directions
`weighting`       of rays by the material; `tracing`: what rays bring
`slices`          lobes of a view from moments, between views, their distances
`fits`            lobes of the unoccluded material; `references`: slices over them
`angular`         views of a vertex, as many as it needs
`refinement`      which triangles are split next
`path_sampling`   slices by paths of their own, for comparison
`spatial`         how slices at the corners of triangles differ
`tessellation`    triangles split in four; `mesh_edges`, `mesh_checks`
`store`           finished transfer in zarr: `packing`, `zarrays`
`compression`     its slices in a few bytes: `quantisation`
`working`         batches of a run that another goes on from; `locking`
`lighting`        lights ready to be averaged over lobes
`pyramid`         tables of them, made by `prefiltering`
`distant`         lights with closed forms
`infinity`        lights of a scene as if from infinity
`backgrounds`     what is seen past the surfaces
`raster`          what a camera sees of the mesh
`fields`          lobes as one array for each of their numbers
`relighting`      radiance of vertices; `between`: of pictures
`interactive`     relighting in a loop
`layers`          light of one kind of path
`pictures`        the mesh, the views, the difference from a reference
================  ==========================================================
"""

from diffopt.transfer.between import picture as picture
from diffopt.transfer.infinity import from_infinity as from_infinity
from diffopt.transfer.interactive import Relit as Relit
from diffopt.transfer.layers import LAYERS as LAYERS
from diffopt.transfer.layers import layer as layer
from diffopt.transfer.lighting import HarmonicSettings as HarmonicSettings
from diffopt.transfer.lighting import prepare as prepare
from diffopt.transfer.precomputation import precompute as precompute
from diffopt.transfer.pyramid import PyramidSettings as PyramidSettings
from diffopt.transfer.raster import Raster as Raster
from diffopt.transfer.relighting import Tables as Tables
from diffopt.transfer.relighting import tables as tables
from diffopt.transfer.result import Transfer as Transfer
from diffopt.transfer.settings import TransferSettings as TransferSettings
from diffopt.transfer.store import load as load
from diffopt.transfer.store import save as save
