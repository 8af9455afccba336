"""Readers and writers, on files made here: whole, cut short, renamed, empty and foreign."""

import json
import struct
import warnings
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest
import tifffile

from diffopt.errors import InputError
from diffopt.heightfield import Heightfield
from diffopt.io import Options, read
from diffopt.io.files import replacing
from diffopt.io.units import to_micrometres

PIXEL = (0.25, 0.125)
# Uneven in both axes, so that a transposed or mirrored map is seen.
HEIGHTS = np.add.outer(np.arange(6.0) ** 2, 0.5 * np.arange(9.0)) / 100


def write_npz(path):
    Heightfield(HEIGHTS, PIXEL).save(path)


def write_tiff(path):
    Heightfield(HEIGHTS, PIXEL).save(path)


def write_npy(path):
    np.save(path, HEIGHTS)


def write_png(path, dtype=np.uint16):
    PIL.Image.fromarray(grey(dtype)).save(path, format="PNG")


def grey(dtype):
    scaled = HEIGHTS / HEIGHTS.max() * np.iinfo(dtype).max
    return np.rint(scaled).astype(dtype)


def write_matrix(path):
    np.savetxt(path, HEIGHTS)


def write_xyz(path):
    y, x = np.mgrid[:6, :9]
    np.savetxt(path, np.stack([x * 125.0, y * 250.0, HEIGHTS * 1000], axis=-1).reshape(-1, 3))


def gwy_field(data, unit, unit_xy="m"):
    from gwyfile.objects import GwyDataField

    return GwyDataField(
        data, xreal=9 * 125e-9, yreal=6 * 250e-9, si_unit_xy=unit_xy, si_unit_z=unit
    )


def write_gwy(path, **more):
    from gwyfile.objects import GwyContainer

    content = GwyContainer()
    content["/0/data/title"] = "Phase"
    content["/0/data"] = gwy_field(HEIGHTS, "deg")
    content["/3/data/title"] = "Topography"
    content["/3/data"] = gwy_field(HEIGHTS * 1e-6, "m")
    content.update(more)
    content.tofile(str(path))


def write_sur(path, *, missing=(), z_unit=b"nm", cut=0):
    """A Digital Surf file by its published layout: header of 512 bytes, 32-bit points."""
    points = np.rint(HEIGHTS * 1e5).astype("<i4")
    zmin, zmax = int(points.min()), int(points.max())
    for j, i in missing:
        points[j, i] = zmin - 2
    ny, nx = points.shape

    def text(value, size):
        return value.ljust(size, b"\x00")

    header = b"DIGITAL SURF" + struct.pack("<4H", 0, 1, 1, 2)
    header += text(b"made by a test", 30) + text(b"none", 30)
    header += struct.pack("<5H2IH", 0, 0, 0, 1 if missing else 0, 1, 0, 0, 32)
    header += struct.pack("<4iI", zmin, zmax, nx, ny, nx * ny)
    # Spacings of 0.125 and 0.25 um; a height step is 1e-5 um = 0.01 nm.
    header += struct.pack("<3f", 0.125, 0.25, 0.01)
    header += text(b"X", 16) + text(b"Y", 16) + text(b"Z", 16)
    header += (text("\u00b5m".encode("latin-1"), 16) * 2 + text(z_unit, 16)) * 2
    header += struct.pack("<3f3H3I7Hf2I3H", 1, 1, 1, 0, 0, 0, 0, 0, 0, *[1] * 6, 2026, 0, *[0] * 5)
    header += bytes(128) + struct.pack("<3f", 0, 0, 0) + bytes(34)
    assert len(header) == 512
    content = header + points.tobytes()
    path.write_bytes(content[: len(content) - cut])


# suffix: writer, what must be said when loading.
FORMATS = {
    ".npz": (write_npz, {}),
    ".tif": (write_tiff, {}),
    ".npy": (write_npy, {"pixel_size": PIXEL, "height_unit": "um"}),
    ".png": (write_png, {"pixel_size": PIXEL, "height_range": HEIGHTS.max()}),
    ".txt": (write_matrix, {"pixel_size": PIXEL, "height_unit": "um"}),
    ".xyz": (write_xyz, {"height_unit": "nm"}),
    ".gwy": (write_gwy, {}),
    ".sur": (write_sur, {}),
}
# Rounding of the format's own numbers: 16-bit steps, or float32 spacings in the header.
TOLERANCE = {".tif": 0.29 / 65535, ".png": 0.29 / 65535, ".sur": 1e-5}


@pytest.fixture(params=FORMATS)
def suffix(request):
    return request.param


class TestEveryFormat:
    def test_heights_pixel_and_axes(self, tmp_path, suffix):
        writer, options = FORMATS[suffix]
        path = tmp_path / f"scan{suffix}"
        writer(path)
        scan = Heightfield.load(path, **options)
        assert scan.heights.dtype == jnp.result_type(float)
        np.testing.assert_allclose(scan.heights, HEIGHTS, atol=TOLERANCE.get(suffix, 1e-12))
        np.testing.assert_allclose(scan.pixel, PIXEL, rtol=1e-6)
        assert scan.provenance.source == f"scan{suffix}"

    def test_pixel_size_is_never_invented_nor_contradicted(self, tmp_path, suffix):
        writer, options = FORMATS[suffix]
        path = tmp_path / f"scan{suffix}"
        writer(path)
        if "pixel_size" in options:
            less = {name: value for name, value in options.items() if name != "pixel_size"}
            with pytest.raises(InputError, match=rf"scan\{suffix}: the file states no pixel size"):
                Heightfield.load(path, **less)
        else:
            Heightfield.load(path, **options, pixel_size=PIXEL)
            with pytest.raises(InputError, match=rf"scan\{suffix}: pixel_size=.*contradicts"):
                Heightfield.load(path, **options, pixel_size=0.1)

    def test_units_are_never_invented(self, tmp_path, suffix):
        writer, options = FORMATS[suffix]
        path = tmp_path / f"scan{suffix}"
        writer(path)
        for name in ("height_unit", "height_range"):
            if name in options:
                less = {key: value for key, value in options.items() if key != name}
                with pytest.raises(InputError, match=rf"scan\{suffix}:.*pass {name}="):
                    Heightfield.load(path, **less)
            else:
                value = "nm" if name == "height_unit" else (0, 1)
                with pytest.raises(InputError, match=rf"scan\{suffix}: {name}=.*does not apply"):
                    Heightfield.load(path, **options, **{name: value})

    def test_files_cut_short_are_refused(self, tmp_path, suffix):
        writer, options = FORMATS[suffix]
        path = tmp_path / f"whole{suffix}"
        writer(path)
        content = path.read_bytes()
        if suffix in (".txt", ".xyz"):
            # Text has no length: a cut is seen where it falls within a line.
            cuts = [content.rindex(b" ")]
        else:
            cuts = [5, 40, len(content) // 2, len(content) - 20]
        for cut in cuts:
            short = tmp_path / f"cut{suffix}"
            short.write_bytes(content[:cut])
            with pytest.raises(InputError, match=rf"cut\{suffix}") as caught:
                Heightfield.load(short, **options)
            assert "\n" not in str(caught.value)

    def test_foreign_files_are_refused(self, tmp_path, suffix):
        _, options = FORMATS[suffix]
        path = tmp_path / f"foreign{suffix}"
        jpeg = b"\xff\xd8\xff\xe0\x00\x10JFIF" + bytes(range(256)) * 8
        for content in (jpeg, b"lorem ipsum dolor sit amet\n" * 40, bytes(600)):
            path.write_bytes(content)
            with pytest.raises(InputError, match=rf"foreign\{suffix}") as caught:
                Heightfield.load(path, **options)
            assert "\n" not in str(caught.value)

    def test_renamed_files_are_named_for_what_they_are(self, tmp_path, suffix):
        _, options = FORMATS[suffix]
        path = tmp_path / f"renamed{suffix}"
        other = write_gwy if suffix == ".png" else write_png
        other(path)
        found = "a Gwyddion file" if suffix == ".png" else "PNG"
        with pytest.raises(InputError, match=found):
            Heightfield.load(path, **options)

    def test_empty_absent_and_folder(self, tmp_path, suffix):
        path = tmp_path / f"scan{suffix}"
        with pytest.raises(InputError, match=rf"scan\{suffix}: no such file"):
            Heightfield.load(path)
        path.write_bytes(b"")
        with pytest.raises(InputError, match=rf"scan\{suffix}: the file is empty"):
            Heightfield.load(path)
        path.unlink()
        path.mkdir()
        with pytest.raises(InputError, match=rf"scan\{suffix}: is a folder"):
            Heightfield.load(path)


class TestOwnFiles:
    @pytest.mark.parametrize("suffix", [".npz", ".tif", ".tiff"])
    def test_round_trip_keeps_units_and_history(self, tmp_path, dtype, suffix):
        scan = Heightfield(jnp.asarray(HEIGHTS - 3, dtype), (0.0195712345, 0.02)).levelled(0)
        path = tmp_path / f"scan{suffix}"
        scan.save(path)
        back = Heightfield.load(path)
        assert back.pixel == scan.pixel
        # 16 bits: half a step of peak-to-valley / 65535, and float32 rounding.
        atol = 0.0 if suffix == ".npz" else np.ptp(HEIGHTS) / 65535 * 0.51
        np.testing.assert_allclose(back.heights, np.asarray(scan.heights, "float64"), atol=atol)
        assert back.provenance.steps == ("from array", *scan.provenance.steps)
        assert [p.name for p in tmp_path.iterdir()] == [path.name]

    def test_npz_keeps_missing_pixels(self, tmp_path):
        heights = HEIGHTS.copy()
        heights[2, 3] = np.nan
        scan = Heightfield(heights, PIXEL, missing="keep")
        scan.save(tmp_path / "scan.npz")
        back = Heightfield.load(tmp_path / "scan.npz", missing="keep")
        np.testing.assert_array_equal(back.heights, heights)
        with pytest.raises(InputError, match=r"scan\.npz: 1 of 54 pixels are missing.*'fill'"):
            Heightfield.load(tmp_path / "scan.npz")
        filled = Heightfield.load(tmp_path / "scan.npz", missing="fill")
        assert filled.provenance.filled == 1
        with pytest.raises(InputError, match=r"scan\.tif: 1 missing pixels cannot be written"):
            scan.save(tmp_path / "scan.tif")
        assert not (tmp_path / "scan.tif").exists()

    def test_tiff_states_its_units_to_other_programs(self, tmp_path):
        Heightfield(HEIGHTS, PIXEL).save(tmp_path / "scan.tif")
        with tifffile.TiffFile(tmp_path / "scan.tif") as file:
            page = file.pages[0]
            stated = json.loads(page.description)
            assert page.dtype == np.uint16
            x, y = page.get_resolution("micrometer")
        assert (1 / y, 1 / x) == (pytest.approx(PIXEL[0]), pytest.approx(PIXEL[1]))
        assert stated["unit"] == "um"
        assert stated["height_range"] == [0.0, HEIGHTS.max()]

    def test_flat_tiff(self, tmp_path):
        Heightfield(np.full((4, 5), 0.3), 0.1).save(tmp_path / "flat.tif")
        np.testing.assert_array_equal(Heightfield.load(tmp_path / "flat.tif").heights, 0.3)

    def test_damaged_statements_are_refused(self, tmp_path):
        path = tmp_path / "scan.npz"
        write_npz(path)
        with np.load(path) as archive:
            content = dict(archive)
        np.savez(path, **{**content, "version": np.array(7)})
        with pytest.raises(InputError, match="version 7 in 'um'; expected version 1"):
            Heightfield.load(path)
        del content["pixel"]
        np.savez(path, **content)
        with pytest.raises(InputError, match="a damaged diffopt heightfield file"):
            Heightfield.load(path)
        description = json.dumps({"format": "diffopt heightfield", "version": 1})
        tifffile.imwrite(tmp_path / "scan.tif", grey(np.uint16), description=description)
        with pytest.raises(InputError, match="a damaged diffopt heightfield file"):
            Heightfield.load(tmp_path / "scan.tif")

    def test_other_suffixes_and_folders_are_refused(self, tmp_path):
        scan = Heightfield(HEIGHTS, PIXEL)
        with pytest.raises(InputError, match=r"cannot write '\.sur'; expected \.npz, \.tif"):
            scan.save(tmp_path / "scan.sur")
        with pytest.raises(InputError, match="does not exist"):
            scan.save(tmp_path / "none" / "scan.npz")

    def test_a_failed_write_leaves_the_old_file(self, tmp_path):
        path = tmp_path / "scan.npz"
        path.write_bytes(b"old")

        def fail():
            with replacing(path) as file:
                file.write(b"half of the n")
                raise RuntimeError("stopped")

        with pytest.raises(RuntimeError, match="stopped"):
            fail()
        assert path.read_bytes() == b"old"
        assert [p.name for p in tmp_path.iterdir()] == ["scan.npz"]


class TestArrays:
    def test_foreign_npz(self, tmp_path):
        path = tmp_path / "scan.npz"
        np.savez(path, z=HEIGHTS * 1e3, x=np.arange(9))
        options = {"pixel_size": PIXEL, "height_unit": "nm"}
        np.testing.assert_allclose(Heightfield.load(path, **options).heights, HEIGHTS)
        np.savez(path, z=HEIGHTS * 1e3, other=HEIGHTS)
        with pytest.raises(InputError, match=r"found \['other', 'z'\]; name one by channel="):
            Heightfield.load(path, **options)
        scan = Heightfield.load(path, channel="z", **options)
        np.testing.assert_allclose(scan.heights, HEIGHTS)
        assert scan.provenance.channel == "z"
        with pytest.raises(InputError, match=r"no \[ny, nx\] array 'w'"):
            Heightfield.load(path, channel="w", **options)

    @pytest.mark.parametrize(
        ("array", "text"),
        [
            (np.zeros(5), r"found float64 \(5,\)"),
            (np.zeros((3, 4), dtype=complex), "found complex128"),
            (np.zeros((1, 4)), r"a map of \(1, 4\) pixels"),
            (np.full((3, 4), np.nan), "every pixel is missing"),
            (np.full((3, 4), np.inf), "infinite heights"),
            (np.array([[{}, {}]]), "cannot be read"),
        ],
    )
    def test_arrays_that_are_no_maps(self, tmp_path, array, text):
        np.save(tmp_path / "scan.npy", array, allow_pickle=True)
        with pytest.raises(InputError, match=text):
            Heightfield.load(tmp_path / "scan.npy", pixel_size=0.1, height_unit="um")

    def test_unit_must_be_a_length(self, tmp_path):
        write_npy(tmp_path / "scan.npy")
        with pytest.raises(InputError, match="unit 'V'; expected a length: m, cm, mm, um, nm"):
            Heightfield.load(tmp_path / "scan.npy", pixel_size=0.1, height_unit="V")


class TestImages:
    @pytest.mark.parametrize("grey_type", [np.uint8, np.uint16])
    @pytest.mark.parametrize("suffix", [".png", ".tif"])
    def test_grey_maps_to_the_range(self, tmp_path, grey_type, suffix):
        path = tmp_path / f"scan{suffix}"
        if suffix == ".png":
            write_png(path, grey_type)
        else:
            tifffile.imwrite(path, grey(grey_type))
        scan = Heightfield.load(path, pixel_size=0.1, height_range=(-0.2, 0.3))
        expected = -0.2 + 0.5 * HEIGHTS / HEIGHTS.max()
        np.testing.assert_allclose(scan.heights, expected, atol=0.251 / np.iinfo(grey_type).max)
        assert float(scan.heights.max()) == pytest.approx(0.3)
        assert f"{np.iinfo(grey_type).bits}-bit" in scan.provenance.notes[0]

    def test_grey_stored_as_colour_is_accepted_colour_is_not(self, tmp_path):
        path = tmp_path / "scan.png"
        options = {"pixel_size": 0.1, "height_range": 1.0}
        rgb = np.repeat(grey(np.uint8)[..., None], 3, axis=-1)
        PIL.Image.fromarray(rgb).save(path)
        expected = grey(np.uint8) / 255
        np.testing.assert_allclose(Heightfield.load(path, **options).heights, expected)
        rgb[0, 0, 1] ^= 1
        PIL.Image.fromarray(rgb).save(path)
        with pytest.raises(InputError, match=r"a colour image \(RGB\)"):
            Heightfield.load(path, **options)
        PIL.Image.fromarray(grey(np.uint8)).convert("P").save(path)
        with pytest.raises(InputError, match="PNG of mode P"):
            Heightfield.load(path, **options)

    # Pillow itself warns beyond its limit and raises beyond twice the limit: 54 pixels of each.
    @pytest.mark.parametrize("limit", [53, 27, 26, 10])
    def test_too_many_pixels_are_refused(self, tmp_path, monkeypatch, limit):
        path = tmp_path / "scan.png"
        write_png(path)
        options = {"pixel_size": 0.1, "height_range": 1.0}
        monkeypatch.setattr(PIL.Image, "MAX_IMAGE_PIXELS", 54)
        assert Heightfield.load(path, **options).shape == (6, 9)
        monkeypatch.setattr(PIL.Image, "MAX_IMAGE_PIXELS", limit)
        text = rf"scan\.png: 54 pixels \(9 x 6\); expected at most PIL\S+ = {limit} [^\n]*$"
        with pytest.raises(InputError, match=text):
            Heightfield.load(path, **options)

    def test_float_tiff_has_a_unit_instead_of_a_range(self, tmp_path):
        path = tmp_path / "scan.tiff"
        tifffile.imwrite(path, (HEIGHTS * 1000).astype(np.float32))
        scan = Heightfield.load(path, pixel_size=PIXEL, height_unit="nm")
        np.testing.assert_allclose(scan.heights, HEIGHTS, rtol=1e-6)
        with pytest.raises(InputError, match=r"height_range=.*numbers, not grey values"):
            Heightfield.load(path, pixel_size=PIXEL, height_unit="nm", height_range=1.0)

    def test_pages_are_channels(self, tmp_path):
        path = tmp_path / "scan.tif"
        with tifffile.TiffWriter(path) as file:
            for page in (np.zeros((6, 9), np.uint16), grey(np.uint16)):
                file.write(page, contiguous=False)
        options = {"pixel_size": PIXEL, "height_range": HEIGHTS.max()}
        with pytest.raises(InputError, match="2 pages; name one by channel=0 to 1"):
            Heightfield.load(path, **options)
        scan = Heightfield.load(path, channel=1, **options)
        np.testing.assert_allclose(scan.heights, HEIGHTS, atol=1e-5)
        with pytest.raises(InputError, match="no page 2; there are 2"):
            Heightfield.load(path, channel=2, **options)

    @pytest.mark.parametrize(
        ("values", "text"),
        [
            (np.zeros((6, 9, 3), np.uint8), r"shape \(6, 9, 3\); expected heights as one grey"),
            (np.zeros((6, 9), np.int16), "type int16; expected uint8 or uint16"),
        ],
    )
    def test_other_tiffs_are_refused(self, tmp_path, values, text):
        tifffile.imwrite(tmp_path / "scan.tif", values, photometric=None)
        with pytest.raises(InputError, match=text):
            Heightfield.load(tmp_path / "scan.tif", pixel_size=0.1, height_range=1.0)

    @pytest.mark.parametrize("span", [(1.0, 1.0), (0.0, np.inf), -0.3])
    def test_height_range_must_rise(self, tmp_path, span):
        write_png(tmp_path / "scan.png")
        with pytest.raises(InputError, match=r"height_range=.*low < high"):
            Heightfield.load(tmp_path / "scan.png", pixel_size=0.1, height_range=span)


class TestText:
    @pytest.mark.parametrize("separator", [" ", "\t", ", ", ";"])
    def test_separators_comments_and_missing(self, tmp_path, separator):
        path = tmp_path / "scan.txt"
        heights = HEIGHTS.copy()
        heights[1, 1] = np.nan
        np.savetxt(path, heights, delimiter=separator, header="by hand")
        options = {"pixel_size": PIXEL, "height_unit": "um", "missing": "keep"}
        np.testing.assert_allclose(Heightfield.load(path, **options).heights, heights)

    @pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
    def test_header_of_gwyddion(self, tmp_path, encoding):
        path = tmp_path / "scan.txt"
        lines = [
            "# Channel: Z Axis",
            "# Width: 1125 nm",
            "# Height: 1.5 \u00b5m",
            "# Value units: m",
        ]
        rows = ["\t".join(f"{value * 1e-6:.12e}" for value in row) for row in HEIGHTS]
        path.write_bytes("\n".join(lines + rows).encode(encoding))
        scan = Heightfield.load(path)
        np.testing.assert_allclose(scan.heights, HEIGHTS, atol=1e-12)
        np.testing.assert_allclose(scan.pixel, PIXEL)
        assert scan.provenance.channel == "Z Axis"
        path.write_text("\n".join([*lines[:3], "# Value units: V", *rows]), encoding="utf-8")
        with pytest.raises(InputError, match="channel Z Axis has the unit 'V'; expected a length"):
            Heightfield.load(path)

    @pytest.mark.parametrize(
        ("content", "text"),
        [
            ("1 2 3\n4 5\n", "line 2 has 2 numbers, the lines before 3"),
            ("x y\n1 2\n", "line 1 is not numbers: 'x y'"),
            ("1,5;2,5\n3,5;4,5\n", "line 1 is not numbers: '1,5;2,5'"),
            ("# nothing\n", "no numbers in the file"),
        ],
    )
    def test_the_place_of_an_error_is_named(self, tmp_path, content, text):
        (tmp_path / "scan.txt").write_text(content)
        with pytest.raises(InputError, match=rf"scan\.txt: {text}"):
            Heightfield.load(tmp_path / "scan.txt", pixel_size=0.1, height_unit="um")

    def test_three_columns_are_ambiguous(self, tmp_path):
        path = tmp_path / "scan.txt"
        write_xyz(path)
        options = {"height_unit": "nm"}
        with pytest.raises(InputError, match="54 lines of 3 numbers look like a list of x, y, z"):
            Heightfield.load(path, **options)
        np.testing.assert_allclose(Heightfield.load(path, format="xyz", **options).heights, HEIGHTS)
        scan = Heightfield.load(path, format="matrix", pixel_size=0.1, **options)
        assert scan.shape == (54, 3)

    def test_xyz_in_any_order_with_gaps_and_rounding(self, tmp_path, rng):
        y, x = np.mgrid[:6, :9]
        points = np.stack([x * 1.25 / 3, -1 + y * 2.5 / 3, HEIGHTS * 1000], axis=-1).reshape(-1, 3)
        points = np.delete(points, 20, axis=0)
        rng.shuffle(points)
        path = tmp_path / "scan.xyz"
        np.savetxt(path, points, fmt="%.3f")
        scan = Heightfield.load(path, height_unit="nm", lateral_unit="um", missing="keep")
        assert scan.missing == 1
        assert np.isnan(scan.heights[2, 2])
        np.testing.assert_allclose(scan.pixel, (2.5 / 3, 1.25 / 3), rtol=1e-3)
        known = ~np.isnan(scan.heights)
        np.testing.assert_allclose(scan.heights[known], HEIGHTS[known], atol=1e-6)

    @pytest.mark.parametrize(
        ("points", "text"),
        [
            ("0 0 1\n1 0 1\n3.2 0 1\n0 1 1\n1 1 1\n3.2 1 1\n", "x values do not lie on a regular"),
            ("0 0 1\n1 0 1\n0 1 1\n1 1 1\n1 1 2\n", "row 1, column 1 is given twice"),
            ("0 0 1\n0 1 1\n0 2 1\n", "all points have the same x"),
            ("0 0 1\nnan 1 1\n", "x and y must be finite"),
            ("0 0\n1 1\n", "expected three numbers a line, found 2"),
        ],
    )
    def test_lists_that_are_no_grid(self, tmp_path, points, text):
        (tmp_path / "scan.xyz").write_text(points)
        with pytest.raises(InputError, match=text):
            Heightfield.load(tmp_path / "scan.xyz", height_unit="um")

    def test_lateral_unit_is_for_lists(self, tmp_path):
        write_matrix(tmp_path / "scan.txt")
        with pytest.raises(InputError, match="lateral_unit= is for xyz lists only"):
            Heightfield.load(tmp_path / "scan.txt", lateral_unit="um")


class TestGwyddion:
    def test_channels(self, tmp_path):
        path = tmp_path / "scan.gwy"
        write_gwy(path)
        scan = Heightfield.load(path)
        assert scan.provenance.channel == "Topography"
        for channel in (3, "Topography"):
            np.testing.assert_array_equal(
                Heightfield.load(path, channel=channel).heights, scan.heights
            )
        listing = "0: 'Phase' in 'deg', 3: 'Topography' in 'm'"
        for channel in (0, "Phase"):
            with pytest.raises(InputError, match=f"is not a height; there are {listing}"):
                Heightfield.load(path, channel=channel)
        with pytest.raises(InputError, match=f"no single channel 7; there are {listing}"):
            Heightfield.load(path, channel=7)

    def test_a_mask_is_reported(self, tmp_path):
        mask = np.zeros((6, 9))
        mask[1, :4] = 1.0
        write_gwy(tmp_path / "scan.gwy", **{"/3/mask": gwy_field(mask, "")})
        notes = Heightfield.load(tmp_path / "scan.gwy").provenance.notes
        assert notes == ("a mask over 4 pixels in the file was disregarded",)

    def test_no_lateral_unit_is_no_pixel_size(self, tmp_path):
        path = tmp_path / "scan.gwy"
        write_gwy(path, **{"/3/data": gwy_field(HEIGHTS * 1e-6, "m", unit_xy=None)})
        with pytest.raises(InputError, match="states no pixel size"):
            Heightfield.load(path)
        assert Heightfield.load(path, pixel_size=PIXEL).pixel == PIXEL

    def test_no_height_at_all(self, tmp_path):
        path = tmp_path / "scan.gwy"
        write_gwy(path, **{"/3/data": gwy_field(HEIGHTS, "V")})
        with pytest.raises(InputError, match="no channel is a height; there are"):
            Heightfield.load(path)

    def test_without_the_extra(self, tmp_path, monkeypatch):
        write_gwy(tmp_path / "scan.gwy")
        monkeypatch.setitem(__import__("sys").modules, "gwyfile", None)
        with pytest.raises(InputError, match=r"scan\.gwy: .*pip install gwyfile \(extra gwy\)"):
            Heightfield.load(tmp_path / "scan.gwy")


class TestInstruments:
    def test_points_not_measured(self, tmp_path):
        path = tmp_path / "scan.sur"
        write_sur(path, missing=[(2, 3), (5, 8)])
        with pytest.raises(InputError, match=r"scan\.sur: 2 of 54 pixels are missing"):
            Heightfield.load(path)
        kept = Heightfield.load(path, missing="keep")
        assert np.isnan(kept.heights[2, 3])
        assert np.isnan(kept.heights[5, 8])
        filled = Heightfield.load(path, missing="fill")
        assert filled.provenance.filled == 2
        # The surface is quadratic: biharmonic filling inside it is close, at the corner less.
        np.testing.assert_allclose(filled.heights[2, 3], HEIGHTS[2, 3], atol=0.005)

    def test_heights_that_are_no_length(self, tmp_path):
        write_sur(tmp_path / "scan.sur", z_unit=b"V")
        with pytest.raises(InputError, match=r"scan\.sur"):
            Heightfield.load(tmp_path / "scan.sur")

    def test_one_missing_byte(self, tmp_path):
        write_sur(tmp_path / "scan.sur", cut=1)
        with pytest.raises(InputError, match=r"scan\.sur: .*truncated"):
            Heightfield.load(tmp_path / "scan.sur")

    @pytest.mark.parametrize("channel", [1, "Phase"])
    def test_channels_are_listed(self, tmp_path, channel):
        write_sur(tmp_path / "scan.sur")
        assert Heightfield.load(tmp_path / "scan.sur", channel=0).shape == (6, 9)
        with pytest.raises(InputError, match=f"no channel {channel!r}; there are 0: 'Default'"):
            Heightfield.load(tmp_path / "scan.sur", channel=channel)

    def test_another_format_of_the_same_package(self, tmp_path):
        """X3P (ISO 5436-2), written by SurfaceTopography itself, in metres and axes [x, y]."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from SurfaceTopography import Topography

            topography = Topography(HEIGHTS.T * 1e3, (9 * 125.0, 6 * 250.0), unit="nm")
            topography.to_x3p(str(tmp_path / "scan.x3p"))
        scan = Heightfield.load(tmp_path / "scan.x3p")
        np.testing.assert_allclose(scan.heights, HEIGHTS, atol=1e-9)
        np.testing.assert_allclose(scan.pixel, PIXEL)

    def test_a_channel_whose_name_is_no_height_is_refused(self, monkeypatch):
        """Some readers label phase and amplitude as heights, with the lateral unit."""
        from diffopt.io.instruments import _choose

        class Channel:
            is_height_channel = True

            def __init__(self, index, name, unit):
                self.index, self.name, self.unit = index, name, unit

        channels = [Channel(0, "AmplitudeError", "nm"), Channel(1, "Phase", ("\u00b5m", None))]
        with pytest.raises(InputError, match="no channel is a height; there are 0: 'AmplitudeErr"):
            _choose(Path("scan.di"), channels, Options())
        channels += [Channel(2, "Height", "nm"), Channel(3, "Height", "nm")]
        assert _choose(Path("scan.di"), channels, Options()).index == 2
        with pytest.raises(InputError, match="channel 1 is not a height"):
            _choose(Path("scan.di"), channels, Options(channel=1))
        with pytest.raises(InputError, match="2 channels are called 'Height'; choose by number"):
            _choose(Path("scan.di"), channels, Options(channel="Height"))

    def test_without_the_extra(self, tmp_path, monkeypatch):
        write_sur(tmp_path / "scan.sur")
        monkeypatch.setitem(__import__("sys").modules, "SurfaceTopography.IO", None)
        expected = r"scan\.sur: a Digital Surf file .*pip install SurfaceTopography \(extra afm\)"
        with pytest.raises(InputError, match=expected):
            Heightfield.load(tmp_path / "scan.sur")

    def test_warnings_of_a_reader_go_into_the_notes(self, tmp_path, monkeypatch):
        import diffopt.io.instruments as instruments

        original = instruments._read

        def warn(*arguments):
            warnings.warn("calibration is from 1998", UserWarning, stacklevel=1)
            return original(*arguments)

        monkeypatch.setattr(instruments, "_read", warn)
        write_sur(tmp_path / "scan.sur")
        record = read(tmp_path / "scan.sur")
        assert record.notes == ("reader: calibration is from 1998",)


def test_unknown_format_is_refused(tmp_path):
    write_npy(tmp_path / "scan.npy")
    with pytest.raises(InputError, match="format='numpy': expected one of npy, npz, png"):
        Heightfield.load(tmp_path / "scan.npy", format="numpy")


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        ("m", 1e6),
        ("mm", 1e3),
        ("um", 1),
        ("\u00b5m", 1),
        ("\u03bcm", 1),
        ("nm", 1e-3),
        ("\u00c5", 1e-4),
    ],
)
def test_units(unit, factor):
    assert to_micrometres(unit, "heights") == factor


@pytest.mark.parametrize("unit", ["V", "A", "", None, ("\u00b5m", None), "deg"])
def test_units_that_are_no_length(unit):
    with pytest.raises(InputError, match="heights has the unit"):
        to_micrometres(unit, "heights")


def test_a_large_offset_does_not_cost_float32_its_resolution(tmp_path):
    import jax

    np.save(tmp_path / "scan.npy", HEIGHTS + 20_000)
    with jax.enable_x64(False):
        scan = Heightfield.load(tmp_path / "scan.npy", pixel_size=0.1, height_unit="um")
        assert scan.heights.dtype == jnp.float32
        # float32 steps at 20 mm are 2 nm; the heights come out to 1e-7 um.
        rest = np.asarray(scan.heights, np.float64) - (HEIGHTS - HEIGHTS.mean())
        assert np.abs(rest).max() < 1e-7
        assert "offset of 20000" in scan.provenance.notes[0]
