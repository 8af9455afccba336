"""What a notebook shows of an object: a small picture and its key figures.

==================  ============================================================
`bundles`           the display hook: a card, or plain text where there is none
`markup`            pictures, tables and cards as HTML that needs nothing else
`colours`           labelled squares of colours, `swatches`
`polar`             polar plots about the normal
`heights`           cards of heightfields
`lobes`             cards of lobes and of lobes over viewing directions
`materials`         cards of materials
`plans`             cards of plans
`studies`           cards of studies and their results
`choices`           cards of prepared BRDFs and of why their method was chosen
`renders`           cards of rendered pictures
==================  ============================================================

A card is made from what the object holds: nothing is fitted, rendered or measured for it.
Cards of fits are in `diffopt.fitting.previews`.
"""

from diffopt.previews.colours import swatches as swatches
