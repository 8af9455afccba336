"""Readers of files that come from outside, each with small sound files to be damaged."""

from fuzzing.readers import assets, heights, materials, scenes, stores
from fuzzing.readers.base import Reader

#: All readers of files that a user may have got from somebody else.
READERS: dict[str, Reader] = {
    "heights: arrays": Reader(heights.load_heights, heights.arrays),
    "heights: pictures": Reader(heights.load_heights, heights.pictures),
    "heights: text": Reader(heights.load_heights, heights.texts),
    "heights: Gwyddion": Reader(heights.load_heights, heights.gwyddion),
    "heights: instruments": Reader(heights.load_heights, heights.instruments, 300),
    "materials: MERL": Reader(materials.load_small_merl, materials.merl),
    "materials: tensor files": Reader(materials.load_named, materials.tensors),
    "materials: tables": Reader(materials.load_named, materials.tables, 600),
    "lobes": Reader(materials.load_lobes, materials.lobes),
    "targets of lobes": Reader(materials.load_target, materials.targets),
    "measured reflectance": Reader(materials.load_measured, materials.reflectance),
    "environment maps": Reader(assets.load_map, assets.maps),
    "environment maps: EXR": Reader(assets.load_map, assets.exr),
    "textures": Reader(assets.load_texture, assets.textures),
    "meshes": Reader(assets.load_mesh, assets.meshes),
    "scenes": Reader(scenes.load_scene, scenes.scenes, 600),
    "stores: tables": Reader(stores.load_store, stores.lookup),
    "stores: transfer": Reader(stores.load_transfer, stores.transfer, 200),
}
