"""Formats of volumes that libraries write, data in several files, and what is no scalar volume at all."""

from __future__ import annotations

import bz2
import gzip
import importlib
import struct
from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK
import tifffile

from difftetvr.capture import Volume, is_photo_source, is_volume_file, load_capture
from difftetvr.capture.volumes.readers.table import KNOWN
from difftetvr.errors import CaptureError, CaptureWarning

pytestmark = pytest.mark.filterwarnings("ignore:.*stand for 0 to 1:difftetvr.errors.CaptureWarning")

# (nz, ny, nx): no axis can be mistaken for another.
VALUES = np.random.default_rng(0).integers(-1000, 3000, (3, 4, 5)).astype(np.int16)
HEAD = "NRRD0005\ntype: int16\ndimension: 3\nsizes: 5 4 3\nendian: little\n"


def check(path: Path, spacing: tuple[float, float, float] = (1.0, 1.0, 1.0), values: np.ndarray = VALUES) -> None:
    volume = Volume.load(path)
    exact = values.astype(np.float64)
    np.testing.assert_allclose(volume.values, (exact - exact.min()) / (exact.max() - exact.min()), atol=1e-7)
    np.testing.assert_allclose(volume.spacing, spacing, rtol=1e-6)


def refused(path: Path) -> str:
    with pytest.raises(CaptureError) as error:
        Volume.load(path)
    assert str(error.value).endswith(".") and "\n" not in str(error.value) and path.name in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("name", ["v.mha", "v.mhd", "v.nrrd", "v.nhdr", "v.nii", "v.nii.gz"])
@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", ["int16", "uint8", "float64"])
def test_written_by_itk(tmp_path: Path, name: str, compressed: bool, dtype: str) -> None:
    values = VALUES.astype(dtype)
    values.ravel()[:2] = 0, 255  # so that the range of bytes is what is there, too
    image = SimpleITK.GetImageFromArray(values)
    image.SetSpacing((1.0, 2.0, 3.0))
    if ".nii" in name:
        image.SetDirection((-1, 0, 0, 0, -1, 0, 0, 0, 1))  # ITK's x and y are NIfTI's reversed
    SimpleITK.WriteImage(image, tmp_path / name, compressed)
    check(tmp_path / name, (1, 2, 3), values)


@pytest.mark.parametrize("kind", [nibabel.Nifti1Image, nibabel.Nifti2Image])
@pytest.mark.parametrize("order", ["<", ">"])
def test_nifti_of_both_versions_and_byte_orders_with_its_scale(tmp_path: Path, kind: type, order: str) -> None:
    header = kind.header_class(endianness=order)
    header.set_data_dtype(np.int16)
    image = kind(VALUES.T[..., None], np.diag([1, 2, 3, 1]), header)  # one time step is no dimension
    nibabel.save(image, tmp_path / "v.nii")
    content = bytearray((tmp_path / "v.nii").read_bytes())
    place, form = (112, "ff") if kind is nibabel.Nifti1Image else (176, "dd")
    struct.pack_into(order + form, content, place, 2.0, -1024.0)
    (tmp_path / "v.nii").write_bytes(content)
    check(tmp_path / "v.nii", (1, 2, 3))
    ends = 2.0 * VALUES.min() - 1024, 2.0 * VALUES.max() - 1024
    assert Volume.load(tmp_path / "v.nii").value_range == ends


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"byteorder": ">", "rowsperstrip": 2},
        {"compression": "zlib", "predictor": True},
        {"compression": "zlib", "tile": (16, 16)},
        {"bigtiff": True},
    ],
)
def test_tiff_stacks(tmp_path: Path, options: dict) -> None:
    tifffile.imwrite(tmp_path / "v.tif", VALUES, photometric="minisblack", **options)
    check(tmp_path / "v.tif")


def test_tiff_stacks_tell_distances(tmp_path: Path) -> None:
    values = VALUES.astype(np.uint16)
    tifffile.imwrite(
        tmp_path / "i.tif", values, imagej=True, resolution=(4, 2), metadata={"spacing": 3.0, "axes": "ZYX"}
    )
    check(tmp_path / "i.tif", (0.25, 0.5, 3.0), values)
    sizes = {"PhysicalSizeX": 0.5, "PhysicalSizeY": 0.5, "PhysicalSizeZ": 2.0}
    tifffile.imwrite(tmp_path / "o.ome.tiff", values, metadata={"axes": "ZYX", **sizes})
    check(tmp_path / "o.ome.tiff", (0.5, 0.5, 2.0), values)


def test_large_stacks_of_imagej_describe_their_first_slice_only(tmp_path: Path) -> None:
    values = VALUES.astype(np.uint16)
    tifffile.imwrite(tmp_path / "v.tif", values, imagej=True, metadata={"axes": "ZYX"})
    content = bytearray((tmp_path / "v.tif").read_bytes())
    with tifffile.TiffFile(tmp_path / "v.tif") as tiff:
        place, start, order = tiff.pages[0].offset, tiff.pages[0].dataoffsets[0], tiff.byteorder
    tags = struct.unpack_from(order + "H", content, place)[0]
    struct.pack_into(order + "I", content, place + 2 + 12 * tags, 0)  # no next page
    (tmp_path / "v.tif").write_bytes(content)
    check(tmp_path / "v.tif", values=values)
    (tmp_path / "v.tif").write_bytes(content[: start + values.nbytes - 1])
    assert "damaged" in refused(tmp_path / "v.tif")


def test_folder_of_slices_by_number(tmp_path: Path) -> None:
    folder = tmp_path / "slices"
    folder.mkdir()
    for name, layer in zip(("s2.tif", "s10.tif", "s11.TIFF"), VALUES):
        tifffile.imwrite(folder / name, layer)
    (folder / "scan.log").write_text("kV 80")
    assert is_volume_file(folder) and not is_photo_source(folder)
    check(folder)
    tifffile.imwrite(folder / "s3.tif", VALUES[0, 1:])
    with pytest.raises(CaptureError, match=r"s3\.tif' has another size or type than 's2\.tif'"):
        Volume.load(folder)
    (folder / "transforms.json").write_text("{}")
    assert is_photo_source(folder) and not is_volume_file(folder)


@pytest.mark.parametrize("values", [VALUES, np.asfortranarray(VALUES), VALUES.astype(">i2"), VALUES[None, ..., None]])
def test_npy(tmp_path: Path, values: np.ndarray) -> None:
    np.save(tmp_path / "v.npy", values)
    check(tmp_path / "v.npy")


@pytest.mark.parametrize("folder", ["", "parts/"])
@pytest.mark.parametrize("encoding, pack", [("raw", bytes), ("gzip", gzip.compress), ("bzip2", bz2.compress)])
def test_nrrd_in_several_files(tmp_path: Path, folder: str, encoding: str, pack) -> None:
    (tmp_path / "parts").mkdir()
    for number, layer in enumerate(VALUES):
        (tmp_path / folder / f"s{7 + 2 * number:03d}.bin").write_bytes(pack(layer.tobytes()))
    names = "\n".join(f"{folder}s{n}.bin" for n in ("007", "009", "011"))
    for line in (f"LIST\n{names}", f"LIST 2\n{names}\n", f"{folder}s%03d.bin 7 11 2", f"{folder}s%03d.bin 7 12 2 2"):
        (tmp_path / "v.nhdr").write_text(f"{HEAD}encoding: {encoding}\ndata file: {line}")
        check(tmp_path / "v.nhdr")
    (tmp_path / "v.nhdr").write_text(f"{HEAD}encoding: {encoding}\ndata file: {folder}s%03d.bin 11 7 -2")
    check(tmp_path / "v.nhdr", values=VALUES[::-1])


def test_nrrd_in_slabs_and_rows(tmp_path: Path) -> None:
    values = np.concatenate([VALUES, VALUES[:1]])
    head = HEAD.replace("5 4 3", "5 4 4")
    for dimensions, parts in ((3, np.split(values, 2)), (1, values.reshape(16, 5))):
        for number, part in enumerate(parts):
            (tmp_path / f"p{number}").write_bytes(part.tobytes())
        (tmp_path / "v.nhdr").write_text(f"{head}encoding: raw\ndata file: p%d 0 {len(parts) - 1} 1 {dimensions}")
        check(tmp_path / "v.nhdr", values=values)


@pytest.mark.parametrize("data", [None, "v.bin"])
def test_nrrd_skips(tmp_path: Path, data: str | None) -> None:
    def write(fields: str, content: bytes) -> Path:
        name = tmp_path / ("v.nrrd" if data is None else "v.nhdr")
        head = HEAD + fields + ("" if data is None else f"data file: {data}\n") + "\n"
        name.write_bytes(head.encode() + (content if data is None else b""))
        if data is not None:
            (tmp_path / data).write_bytes(content)
        return name

    raw, text = VALUES.tobytes(), " ".join(map(str, VALUES.ravel())).encode()
    check(write("encoding: raw\nbyte skip: -1\n", b"junk\n\n" + raw))
    check(write("encoding: raw\nbyteskip: 6\n", b"\nabcde" + raw))
    check(write("encoding: raw\nline skip: 2\nbyte skip: 1\n", b"one\ntwo\n!" + raw))
    check(write("encoding: gzip\nline skip: 1\nbyte skip: 3\n", b"one\n" + gzip.compress(b"abc" + raw)))
    check(write("encoding: text\nline skip: 1\nbyte skip: 2\n", b"one\nab" + text))
    assert "from the end" in refused(write("encoding: gzip\nbyte skip: -1\n", gzip.compress(raw)))
    assert "no whole number" in refused(write("encoding: raw\nbyte skip: all\n", raw))
    assert "only 0 bytes" in refused(write(f"encoding: raw\nline skip: {10**17}\n", raw))


def test_metaimage_written_otherwise(tmp_path: Path) -> None:
    head = "ObjectType = Image\nNDims = 3\nDimSize = 5 4 3\nElementSpacing = 1 2 3\nElementType = MET_SHORT\n"
    for number, layer in enumerate(VALUES):
        (tmp_path / f"s{number}.raw").write_bytes(layer.astype(">i2").tobytes())
    (tmp_path / "v.raw").write_bytes(b"header" + VALUES.tobytes())
    big = head + "ElementByteOrderMSB = True\n"
    text = " ".join(map(str, VALUES.ravel()))
    for content in (
        big + "ElementDataFile = LIST\ns0.raw\ns1.raw\ns2.raw\n",
        big + "ElementDataFile = s%d.raw 0 2 1",
        head + "HeaderSize = 6\nElementDataFile = v.raw\n",
        head + "HeaderSize = -1\nElementDataFile = v.raw\n",
        head + f"BinaryData = False\nElementDataFile = LOCAL\n{text}\n",
    ):
        (tmp_path / "v.mhd").write_text(content)
        check(tmp_path / "v.mhd", (1, 2, 3))
    (tmp_path / "v.mhd").write_text(head + "ElementNumberOfChannels = 3\nElementDataFile = v.raw\n")
    assert "3 channels" in refused(tmp_path / "v.mhd")


def test_lists_that_do_not_fit(tmp_path: Path) -> None:
    for number in range(3):
        (tmp_path / f"s{number}").write_bytes(VALUES[number].tobytes()[: 40 - number])

    def said(line: str) -> str:
        (tmp_path / "v.nhdr").write_text(f"{HEAD}encoding: raw\ndata file: {line}")
        return refused(tmp_path / "v.nhdr")

    assert "2 data files for 5 x 4 x 3" in said("LIST\ns0\ns1")
    assert "0 data files" in said("LIST")
    assert "'s1' holds 39 bytes" in said("LIST\ns0\ns1\ns2").replace(f"{tmp_path}/", "")
    assert "steps of 0" in said("s%d 0 2 0")
    assert "1000000000 data files" in said("s%d 0 999999999 1")
    assert "one whole number" in said("s%s 0 2 1")
    assert "one whole number" in said("s%d%d 0 2 1")
    assert "does not exist" in said("s%d 1 3 1")


@pytest.mark.parametrize(
    "fields, message",
    [
        ("dimension: 3\nsizes: 3 4 5\nkinds: RGB-color domain domain", "of the kinds RGB-color domain domain"),
        ("dimension: 3\nsizes: 5 4 3\nkinds: space space vector", "kinds"),
        ("dimension: 3\nsizes: 5 4 3\nkinds: space space time", "kinds"),
        ("dimension: 3\nsizes: 3 4 5\nspace directions: none (1,0,0) (0,1,0)", "not three of space"),
        ("dimension: 4\nsizes: 3 2 2 5", "4 dimensions of 3 x 2 x 2 x 5"),
        ("dimension: 4\nsizes: 5 4 1 3\nkinds: space space space list", "4 dimensions"),
        ("dimension: 2\nsizes: 15 4", "2 dimensions"),
        ("dimension: 3\nsizes: 5 4 3\nkinds: space space", "2 kinds"),
    ],
)
def test_nrrd_of_something_else_is_no_volume(tmp_path: Path, fields: str, message: str) -> None:
    (tmp_path / "v.nrrd").write_bytes(f"NRRD0005\ntype: uint8\n{fields}\nencoding: raw\n\n".encode() + bytes(60))
    assert message in refused(tmp_path / "v.nrrd")


def test_axes_of_one_sample_are_none(tmp_path: Path) -> None:
    fields = "dimension: 4\nsizes: 1 5 4 3\nkinds: stub domain domain domain\nspacings: nan 1 2 3\n"
    head = HEAD.replace("dimension: 3\nsizes: 5 4 3\n", fields)
    (tmp_path / "v.nrrd").write_bytes(f"{head}encoding: raw\n\n".encode() + VALUES.tobytes())
    check(tmp_path / "v.nrrd", (1, 2, 3))


def test_colours_and_time_steps_are_refused_by_every_format(tmp_path: Path) -> None:
    np.save(tmp_path / "t.npy", np.zeros((2, 3, 4, 5)))
    assert "4 dimensions of 2 x 3 x 4 x 5" in refused(tmp_path / "t.npy")
    np.save(tmp_path / "c.npy", np.zeros((3, 4, 5), np.complex64))
    assert "complex64" in refused(tmp_path / "c.npy")
    nibabel.save(nibabel.Nifti1Image(np.zeros((5, 4, 1, 3), np.uint8), np.eye(4)), tmp_path / "t.nii.gz")
    assert "4 dimensions" in refused(tmp_path / "t.nii.gz")
    colours = np.zeros((5, 4, 3), [("R", "u1"), ("G", "u1"), ("B", "u1")])
    nibabel.save(nibabel.Nifti1Image(colours, np.eye(4)), tmp_path / "c.nii")
    assert "scalar volume" in refused(tmp_path / "c.nii")
    SimpleITK.WriteImage(SimpleITK.GetImageFromArray(np.zeros((3, 4, 5, 3)), isVector=True), tmp_path / "c.mha")
    assert "3 channels" in refused(tmp_path / "c.mha")
    tifffile.imwrite(tmp_path / "c.tif", np.zeros((4, 5, 6, 3), np.uint8), photometric="rgb")
    assert "colours" in refused(tmp_path / "c.tif")
    axes = {"axes": "ZCYX"}
    tifffile.imwrite(tmp_path / "h.tif", np.zeros((2, 3, 5, 7), np.uint16), imagej=True, metadata=axes)
    assert "3 channels" in refused(tmp_path / "h.tif")
    tifffile.imwrite(tmp_path / "o.tif", np.zeros((5, 7), np.uint16))
    assert "single slice" in refused(tmp_path / "o.tif")


@pytest.mark.parametrize("name, needed", [("v.nii", "nibabel"), ("v.tif", "tifffile")])
def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, needed: str) -> None:
    (tmp_path / name).write_bytes(b"anything")
    monkeypatch.setattr(importlib, "import_module", lambda wanted: __import__(f"missing_{wanted}"))
    assert refused(tmp_path / name).endswith(
        f"needs the package {needed} to be read; pip install 'difftetvr[volumes]' installs it."
    )


def test_suffixes_come_from_one_table(tmp_path: Path) -> None:
    for suffix in KNOWN.split(", ")[:-1]:
        assert is_volume_file(f"scan{suffix.upper()}")
    with pytest.raises(CaptureError) as error:
        load_capture(tmp_path / "scan.doc")
    assert KNOWN in str(error.value)


def test_faults_that_tifffile_passes_over_are_said(tmp_path: Path, caplog) -> None:
    tifffile.imwrite(tmp_path / "v.tif", VALUES, photometric="minisblack", software="x" * 50)
    content = (tmp_path / "v.tif").read_bytes()
    with tifffile.TiffFile(tmp_path / "v.tif") as tiff:
        place = tiff.pages[0].tags["Software"].offset
    (tmp_path / "v.tif").write_bytes(content[: place + 2] + b"\xff\x7f" + content[place + 4 :])  # of no known type
    with pytest.warns(CaptureWarning, match="damaged and were passed over"):
        check(tmp_path / "v.tif")
