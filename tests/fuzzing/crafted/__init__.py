"""Files made to do harm: promises of terabytes, bombs, pickles, pipes, names that lead elsewhere.

For each reader some folders; all of them must be refused, but for those that say otherwise.
"""

from collections.abc import Callable

from fuzzing.crafted import assets, heights, materials, scenes, stores
from fuzzing.crafted.base import Crafted, arrays_of, strange
from fuzzing.crafted.pictures import pictures_of
from fuzzing.readers.base import BARE, Seed

#: By the names of `fuzzing.readers.READERS`.
CRAFTED: dict[str, Callable[[dict[str, Seed]], dict[str, Crafted]]] = {
    "heights: arrays": lambda _: (
        arrays_of(".npy", ("",), **BARE)
        | arrays_of(".npz", ("z",), **BARE)
        | strange("a.npy", **BARE)
        | strange("a.npz", **BARE)
    ),
    "heights: pictures": lambda _: heights.pictures(),
    "heights: text": lambda _: heights.texts(),
    "heights: Gwyddion": lambda _: heights.gwyddion(),
    "heights: instruments": lambda _: heights.instruments(),
    "materials: MERL": lambda _: strange("a.binary"),
    "materials: tensor files": lambda _: materials.tensor_files(),
    "materials: tables": lambda _: materials.tables(),
    "lobes": lambda _: materials.lobes(),
    "targets of lobes": lambda _: (
        arrays_of(".npy", ("",)) | arrays_of(".npz", ("directions",)) | strange("a.csv")
    ),
    "measured reflectance": lambda _: materials.reflectance(),
    "environment maps": lambda _: assets.maps(),
    "environment maps: EXR": lambda _: assets.exr(),
    "textures": lambda _: pictures_of() | pictures_of(space="linear") | strange("a.png"),
    "meshes": lambda _: assets.meshes(),
    "scenes": lambda _: scenes.scenes(),
    "stores: tables": lambda seeds: stores.of(seeds["table"], "a.zarr/coefficients"),
    "stores: transfer": lambda seeds: stores.of(seeds["exact"], "a.zarr/transfer/diffuse_mu"),
}
