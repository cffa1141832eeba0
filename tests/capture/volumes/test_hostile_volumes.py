"""Volumes and transfer functions from strangers: they lead nowhere, take no memory, and never end in a traceback."""

from __future__ import annotations

import gzip
import json
import lzma
import os
import struct
from pathlib import Path

import nibabel
import numpy as np
import pytest
import tifffile
from capture.damage import damaged_copies

from difftetvr import TransferFunction, trust
from difftetvr.capture import Volume
from difftetvr.errors import CaptureError

pytestmark = pytest.mark.filterwarnings("ignore::difftetvr.errors.CaptureWarning")

NRRD = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: {}\nencoding: {}\n{}\n"
META = "ObjectType = Image\nNDims = 3\nDimSize = {}\nElementType = MET_UCHAR\n{}ElementDataFile = {}\n"


def refused(path: Path) -> str:
    with pytest.raises(CaptureError) as error:
        Volume.load(path)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    "name, header",
    [
        ("a.nhdr", NRRD.format("2 2 2", "raw", "data file: {}\n")),
        ("a.nhdr", NRRD.format("2 2 2", "raw", "data file: LIST\nhere.raw\n{}\n")),
        ("a.nhdr", NRRD.format("2 2 2", "raw", "data file: {}%d 1 2 1\n")),
        ("a.dat", "ObjectFileName: {}\nResolution: 2 2 2\nFormat: UCHAR\n"),
        ("a.mhd", META.format("2 2 2", "", "{}")),
        ("a.mhd", META.format("2 2 2", "", "LIST\nhere.raw\n{}")),
    ],
)
def test_headers_lead_nowhere_else(tmp_path: Path, name: str, header: str) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    for secret in ("secret", "secret1", "secret2", "in/here.raw"):
        (tmp_path / secret).write_bytes(b"password")
    (folder / "link").symlink_to(tmp_path / "secret")
    for target in ("../secret", str(tmp_path / "secret"), "link", "..\\secret"):
        (folder / name).write_text(header.format(target))
        message = refused(folder / name)
        assert "lies outside of its folder" in message or (target == "link" and "does not exist" in message)


def test_a_folder_can_be_allowed(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "data.raw").write_bytes(bytes(range(8)))
    (tmp_path / "in" / "a.nhdr").write_text(NRRD.format("2 2 2", "raw", "data file: ../data.raw\n"))
    with trust.trusting(outside=tmp_path):
        assert Volume.load(tmp_path / "in" / "a.nhdr").resolution == (2, 2, 2)


@pytest.mark.parametrize(
    "name, header",
    [
        ("a.nrrd", NRRD.format("100000 100000 100000", "raw", "")),
        ("a.nrrd", NRRD.format("100000 100000 100000", "gzip", "")),
        ("a.nrrd", NRRD.format("100000 100000 100000", "bzip2", "")),
        ("a.nrrd", NRRD.format("1 1 999999999999999999", "text", "")),
        ("a.nrrd", NRRD.format("2 2 2", "gzip", "byte skip: 999999999999999999\n")),
        ("a.mha", META.format("99999 99999 99999", "", "LOCAL")),
        ("a.mha", META.format("99999 99999 99999", "CompressedData = True\n", "LOCAL")),
        ("a.mha", META.format("99999 99999 99999", "BinaryData = False\n", "LOCAL")),
    ],
)
def test_terabytes_that_are_announced_are_not_there(tmp_path: Path, name: str, header: str) -> None:
    (tmp_path / name).write_bytes(header.encode() + b"1 2 3 4 5 6 7 8")
    assert "damaged" in refused(tmp_path / name)


def test_terabytes_in_binary_headers(tmp_path: Path) -> None:
    header = nibabel.Nifti1Header()
    header.set_data_shape((30000, 30000, 30000))
    (tmp_path / "a.nii").write_bytes(header.binaryblock + bytes(100))
    (tmp_path / "a.nii.gz").write_bytes(gzip.compress(header.binaryblock + bytes(100)))
    assert "damaged" in refused(tmp_path / "a.nii") and "damaged" in refused(tmp_path / "a.nii.gz")
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((2, 8, 8), np.uint8), photometric="minisblack")
    content = bytearray((tmp_path / "a.tif").read_bytes())
    with tifffile.TiffFile(tmp_path / "a.tif") as tiff:
        places = [page.tags[tag].offset for page in tiff.pages for tag in ("ImageWidth", "ImageLength")]
    for place in places:
        struct.pack_into("<HHII", content, place, *struct.unpack_from("<H", content, place), 4, 1, 2**30)
    (tmp_path / "a.tif").write_bytes(content)
    assert "damaged" in refused(tmp_path / "a.tif")


def test_bombs_are_held_against_a_limit_that_can_be_lifted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trust, "UNPACKED_BYTES", 2**16)
    zeros = bytes(2**21)
    head = NRRD.format("128 128 128", "gzip", "").encode()
    tail = NRRD.format("2 2 2", "gzip", f"byte skip: {2**21 - 8}\n").encode()
    meta = META.format("128 128 128", "CompressedData = True\n", "LOCAL").encode()
    header = nibabel.Nifti1Header()
    header.set_data_shape((128, 128, 128))
    header.set_data_dtype(np.uint8)
    header["vox_offset"] = 352
    bombs = {
        "a_128x128x128_uint8.raw.gz": gzip.compress(zeros),
        "a_128x128x128_uint8.raw.xz": lzma.compress(zeros),
        "a.nrrd": head + gzip.compress(zeros),
        "b.nrrd": tail + gzip.compress(zeros),
        "a.mha": meta + gzip.compress(zeros),
        "a.nii.gz": gzip.compress(header.binaryblock + bytes(4) + zeros),
    }
    for name, content in bombs.items():
        (tmp_path / name).write_bytes(content)
        assert "--allow-large" in refused(tmp_path / name)
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((8, 512, 512), np.uint8), compression="zlib")
    assert "--allow-large" in refused(tmp_path / "a.tif")
    with trust.trusting(large=True):
        assert Volume.load(tmp_path / "a.nrrd").resolution == (128, 128, 128)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes have no names here")
@pytest.mark.parametrize("suffix", ["nrrd", "raw", "dat", "vti", "mha", "mhd", "nii", "nii.gz", "tif", "npy"])
def test_pipes_are_no_volumes(tmp_path: Path, suffix: str) -> None:
    os.mkfifo(tmp_path / f"a_2x2x2_uint8.{suffix}")
    assert "a pipe or a device" in refused(tmp_path / f"a_2x2x2_uint8.{suffix}")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes have no names here")
def test_pipes_hold_no_samples(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "a.nhdr").write_text(NRRD.format("2 2 2", "raw", "data file: pipe\nline skip: 1\n"))
    assert "a pipe or a device" in refused(tmp_path / "a.nhdr")
    os.mkfifo(tmp_path / "tf.json")
    with pytest.raises(CaptureError, match="a pipe or a device"):
        TransferFunction.load(tmp_path / "tf.json")


def test_names_that_are_no_paths(tmp_path: Path) -> None:
    for name in ("x" * 100_000, "a\0b", ".", "%" + " " * 500_000):
        (tmp_path / "a.nhdr").write_text(NRRD.format("2 2 2", "raw", f"data file: {name}\n"))
        assert len(refused(tmp_path / "a.nhdr")) < 600


def test_pages_that_lead_in_a_circle(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((3, 8, 8), np.uint8), photometric="minisblack")
    content = bytearray((tmp_path / "a.tif").read_bytes())
    with tifffile.TiffFile(tmp_path / "a.tif") as tiff:
        first, second, last = (page.offset for page in tiff.pages)
    for target in (first, second, last):
        tags = struct.unpack_from("<H", content, last)[0]
        struct.pack_into("<I", content, last + 2 + 12 * tags, target)
        (tmp_path / "a.tif").write_bytes(content)
        assert "a.tif" in refused(tmp_path / "a.tif")


@pytest.mark.parametrize("name", ["v.mha", "v.nii", "v.nii.gz", "v.tif", "v.npy"])
def test_damaged_files_load_or_give_one_sentence(tmp_path: Path, name: str) -> None:
    values = np.random.default_rng(0).integers(0, 4096, (3, 4, 5)).astype(np.uint16)
    path = tmp_path / name
    if name.endswith(".mha"):
        path.write_bytes(META.format("5 4 3", "", "LOCAL").replace("UCHAR", "USHORT").encode() + values.tobytes())
    elif ".nii" in name:
        nibabel.save(nibabel.Nifti1Image(values.T, np.eye(4)), path)
    elif name.endswith(".tif"):
        tifffile.imwrite(path, values, photometric="minisblack", compression="zlib")
    else:
        np.save(path, values)
    failures = 0
    for data in damaged_copies(path.read_bytes(), seed=5):
        path.write_bytes(data)
        try:
            Volume.load(path)
        except CaptureError as error:
            failures += 1
            assert "\n" not in str(error)
    assert failures > 40


@pytest.mark.parametrize(
    "content",
    [
        "[" * 100_000,
        '{"scalar": ' + "[" * 100_000,
        '{"a": ' * 100_000,
        json.dumps({"scalar": [0, 1], "opacity": [0, 1], "color": [[0, 0, 0], [1, 1, 1]]}).replace(
            "1]", "1" * 401 + "]"
        ),
        '{"scalar": [0, 1e999], "opacity": [0, 1], "color": [[0, 0, 0], [1, 1, 1]]}',
        '{"scalar": [0, 1], "opacity": [0, 1e200], "color": [[0, 0, 0], [1, 1, 1]]}',
        '{"scalar": [0, 1], "opacity": [0, 1], "color": [[0, 0, 0], [1, 1, 1e200]]}',
        '{"scalar": [' + "1" * 5000 + "]}",
    ],
)
@pytest.mark.filterwarnings("error")
def test_transfer_functions_beyond_all_limits(tmp_path: Path, content: str) -> None:
    (tmp_path / "tf.json").write_text(content)
    with pytest.raises(CaptureError) as error:
        TransferFunction.load(tmp_path / "tf.json")
    assert len(str(error.value)) < 300 and "tf.json" in str(error.value)
