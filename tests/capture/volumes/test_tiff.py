"""What TIFF files mean by their samples: distances in units, black and white, palettes, slices without pages."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import tifffile

from difftetvr.capture import Volume
from difftetvr.capture.volumes.volume import load_raw
from difftetvr.capture.volumes.volume_file import RawVolume
from difftetvr.errors import CaptureError

VALUES = np.arange(6 * 8 * 10, dtype=np.uint16).reshape(6, 8, 10)
GREYS = np.arange(256, dtype=np.uint16) * 257


def raw(path: Path) -> RawVolume:
    return load_raw(path, None, None)


def ome(folder: Path, values: np.ndarray = VALUES, **sizes: object) -> RawVolume:
    metadata = {"axes": "ZYX", **{f"PhysicalSize{name}": value for name, value in sizes.items()}}
    tifffile.imwrite(folder / "a.ome.tif", values, photometric="minisblack", metadata=metadata)
    return raw(folder / "a.ome.tif")


def imagej(folder: Path, **metadata: object) -> RawVolume:
    tifffile.imwrite(
        folder / "i.tif", VALUES, imagej=True, resolution=(4, 4), metadata={"axes": "ZYX", "unit": "um", **metadata}
    )
    return raw(folder / "i.tif")


def refused(path: Path) -> str:
    with pytest.raises(CaptureError) as error:
        Volume.load(path)
    assert str(error.value).endswith(".") and path.name in str(error.value)
    return str(error.value)


def test_units_of_ome_are_brought_to_one(tmp_path: Path) -> None:
    volume = ome(tmp_path, X=200, XUnit="nm", Y=200, YUnit="nm", Z=1, ZUnit="µm")
    np.testing.assert_allclose(volume.spacing, (0.2, 0.2, 1.0))
    (note,) = volume.notes
    assert "in nm and µm; all are taken in µm: 0.2 x 0.2 x 1" in note
    # Without a unit it is the format's, and so is the other letter that looks like it.
    np.testing.assert_allclose(ome(tmp_path, X=2e-4, XUnit="mm", Y=0.2, Z=1, ZUnit="\u03bcm").spacing, (0.2, 0.2, 1.0))
    volume = ome(tmp_path, X=200, XUnit="nm", Y=200, YUnit="nm", Z=1000, ZUnit="nm")
    assert volume.spacing == (200.0, 200.0, 1000.0) and not volume.notes


def test_units_that_cannot_be_compared_are_said(tmp_path: Path) -> None:
    volume = ome(tmp_path, X=1, XUnit="pixel", Y=1, YUnit="pixel", Z=3, ZUnit="µm")
    assert volume.spacing == (1.0, 1.0, 1.0)
    assert "in pixel and µm, which cannot be compared" in volume.notes[0]


def test_a_distance_that_is_not_told_is_said(tmp_path: Path) -> None:
    volume = ome(tmp_path, X=200, XUnit="nm", Y=200, YUnit="nm")
    assert volume.spacing == (200.0, 200.0, 200.0)
    (note,) = volume.notes
    assert "does not tell the distance of samples along z; it is taken as that along x, 200" in note
    assert not ome(tmp_path).notes
    volume = ome(tmp_path, X=0.0, Y=1.0, Z=1.0)
    assert volume.spacing == (1.0, 1.0, 1.0) and "are not positive" in volume.notes[0]


def test_distances_of_imagej(tmp_path: Path) -> None:
    volume = imagej(tmp_path, spacing=2.0)
    assert volume.spacing == (0.25, 0.25, 2.0) and not volume.notes
    volume = imagej(tmp_path)
    assert volume.spacing == (0.25, 0.25, 1.0) and "does not tell the distance of its slices" in volume.notes[0]
    volume = imagej(tmp_path, spacing=2.0, zunit="nm")
    np.testing.assert_allclose(volume.spacing, (0.25, 0.25, 0.002))
    assert "in um and nm" in volume.notes[0]


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_white_is_zero_is_inverted(tmp_path: Path, dtype: str) -> None:
    values = VALUES.astype(dtype)
    tifffile.imwrite(tmp_path / "w.tif", values, photometric="miniswhite")
    volume = raw(tmp_path / "w.tif")
    assert np.array_equal(volume.values, np.iinfo(dtype).max - values) and "inverted" in volume.notes[0]


def test_white_is_zero_in_bits_floats_and_folders(tmp_path: Path) -> None:
    bits = VALUES % 3 == 0
    tifffile.imwrite(tmp_path / "b.tif", bits, photometric="miniswhite")
    assert np.array_equal(raw(tmp_path / "b.tif").values, ~bits)
    tifffile.imwrite(tmp_path / "f.tif", VALUES.astype(np.float32), photometric="miniswhite")
    volume = raw(tmp_path / "f.tif")
    assert np.array_equal(volume.values, VALUES) and "read as they are" in volume.notes[0]
    (tmp_path / "slices").mkdir()
    for number, layer in enumerate(VALUES):
        tifffile.imwrite(tmp_path / "slices" / f"{number}.tif", layer, photometric="miniswhite")
    volume = raw(tmp_path / "slices")
    assert np.array_equal(volume.values, 65535 - VALUES) and len(volume.notes) == 1


def test_palettes(tmp_path: Path) -> None:
    values = VALUES.astype(np.uint8)

    def write(colors: np.ndarray, **options: object) -> Path:
        tifffile.imwrite(tmp_path / "p.tif", values, photometric="palette", colormap=colors, **options)
        return tmp_path / "p.tif"

    volume = raw(write(np.stack([GREYS] * 3)))
    assert np.array_equal(volume.values, values) and volume.values.dtype == np.uint8 and not volume.notes
    volume = raw(write(np.stack([GREYS[::-1]] * 3)))
    assert np.array_equal(volume.values, GREYS[::-1][values]) and "palette" in volume.notes[0]
    fire = np.stack([GREYS, GREYS[::-1], GREYS])
    assert "with colours, by a palette" in refused(write(fire))
    volume = raw(write(fire, imagej=True, metadata={"axes": "ZYX"}))
    assert np.array_equal(volume.values, values) and "shown in colours by ImageJ" in volume.notes[0]


def test_kinds_of_pictures_that_are_no_scalars(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "c.tif") as writer:
        for layer in VALUES:
            writer.write(layer, photometric="cfa")
    assert "colours (CFA)" in refused(tmp_path / "c.tif")
    with tifffile.TiffWriter(tmp_path / "d.tif") as writer:
        writer.write(VALUES[0], photometric="minisblack")
        writer.write(VALUES[1], photometric="miniswhite")
    assert "differ in size or type" in refused(tmp_path / "d.tif")


@pytest.mark.parametrize("options", [{}, {"tile": (16, 16, 16)}, {"tile": (16, 16, 16), "compression": "zlib"}])
def test_a_page_that_is_a_volume(tmp_path: Path, options: dict) -> None:
    tifffile.imwrite(tmp_path / "v.tif", VALUES, photometric="minisblack", volumetric=True, **options)
    assert np.array_equal(raw(tmp_path / "v.tif").values, VALUES)
    with tifffile.TiffWriter(tmp_path / "s.tif") as writer:
        for _ in range(2):
            writer.write(VALUES, photometric="minisblack", volumetric=True)
    assert "several volumes" in refused(tmp_path / "s.tif")


def test_stacks_of_which_the_first_slice_has_a_page_only(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "t.tif", VALUES, photometric="minisblack", truncate=True)
    assert np.array_equal(raw(tmp_path / "t.tif").values, VALUES)
    content = (tmp_path / "t.tif").read_bytes()
    (tmp_path / "t.tif").write_bytes(content[:-50])
    assert "fewer than the 6 slices" in refused(tmp_path / "t.tif")
    tifffile.imwrite(tmp_path / "t.tif", np.stack([VALUES] * 2), photometric="minisblack", truncate=True)
    assert "2 x 6 x 8 x 10 values, more than three axes" in refused(tmp_path / "t.tif")


def test_one_file_of_several(tmp_path: Path) -> None:
    """OME's description may tell of slices in other files, which are not opened."""
    ome(tmp_path, VALUES[:2])
    content = (tmp_path / "a.ome.tif").read_bytes()
    (tmp_path / "a.ome.tif").write_bytes(content.replace(b'SizeZ="2"', b'SizeZ="9"'))
    assert raw(tmp_path / "a.ome.tif").values.shape == (2, 8, 10)
    with tifffile.TiffFile(tmp_path / "a.ome.tif") as tiff:
        description = tiff.pages[0].description
    tifffile.imwrite(tmp_path / "s.tif", VALUES[0], description=description.encode(), metadata=None)
    assert "one of the 9 slices that it tells of" in refused(tmp_path / "s.tif")


def test_what_is_chosen_is_said_once_each(tmp_path: Path) -> None:
    ome(tmp_path, X=200, XUnit="nm", Y=200, YUnit="nm", Z=1)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        Volume.load(tmp_path / "a.ome.tif")
    assert sorted("taken in µm" in str(warning.message) for warning in said) == [False, True]
