"""Readers and writers of heightfields, and readers of pictures.

==============  ================================================================
`record`        what a reader returns, and the options that a caller passes
`files`         checks before reading, atomic writing
`units`         length units to micrometres
`arrays`        ``.npy`` and ``.npz``
`images`        8- and 16-bit PNG and TIFF, floating-point TIFF
`text`          ASCII matrices and xyz lists
`gwyddion`      ``.gwy`` (extra ``gwy``)
`instruments`   the instrument formats of SurfaceTopography (extra ``afm``)
`environments`  maps of radiance and pictures: EXR, Radiance HDR, PNG
`dispatch`      which reader or writer a file name calls for
==============  ================================================================

No reader invents a pixel size or a unit: what the file does not state must be passed, and
what the file does state cannot be contradicted.
"""

from diffopt.io.dispatch import read as read
from diffopt.io.dispatch import write as write
from diffopt.io.record import Options as Options
from diffopt.io.record import Record as Record
