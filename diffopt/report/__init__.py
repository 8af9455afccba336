"""One page that says what was computed just now, on this machine.

==================  ============================================================
`page`              the page: sections, tables that can be sorted, nothing outside it
`machine`           versions, processor, precision
`pictures`          sections of pictures: a plan, soft shadows, glossy transfer
`numbers`           sections of numbers: lobes, a grating, accuracy, hard cases
==================  ============================================================

At the top of the house, as the command line is: it may look up to `diffopt.fitting`.
"""
