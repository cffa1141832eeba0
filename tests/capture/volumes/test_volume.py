"""Volume files: every format against known values, and one-sentence errors for what is wrong with a file."""

from __future__ import annotations

import gzip
import lzma
import warnings
from pathlib import Path

import numpy as np
import pytest
from capture.damage import damaged_copies

from difftetvr.capture import Volume
from difftetvr.errors import CaptureError, CaptureWarning

SHAPE = (5, 4, 3)
RANDOM = np.random.default_rng(0)
# (nz, ny, nx): no axis can be mistaken for another.
BYTES = RANDOM.integers(0, 256, SHAPE[::-1]).astype(np.uint8)
SHORTS = RANDOM.integers(0, 65536, SHAPE[::-1]).astype(np.uint16)
FLOATS = RANDOM.normal(size=SHAPE[::-1]).astype(np.float32)


pytestmark = pytest.mark.filterwarnings("ignore:.*stand for 0 to 1:difftetvr.errors.CaptureWarning")


def normalised(values: np.ndarray) -> np.ndarray:
    if values.dtype == np.uint8:
        return values.astype(np.float64) / 255.0
    return (values.astype(np.float64) - values.min()) / (float(values.max()) - float(values.min()))


def check(volume: Volume, values: np.ndarray, spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> None:
    assert volume.resolution == SHAPE
    assert volume.values.dtype == np.float32
    np.testing.assert_allclose(volume.values, normalised(values), atol=1e-7)
    np.testing.assert_allclose(volume.spacing, spacing)


def nrrd_header(values: np.ndarray, encoding: str = "raw", extra: str = "") -> bytes:
    kind = {"u1": "unsigned char", "u2": "uint16", "f4": "float"}[values.dtype.str[1:]]
    return f"NRRD0004\n# made here\ntype: {kind}\ndimension: 3\nsizes: 5 4 3\nencoding: {encoding}\n{extra}\n".encode()


def test_raw_described_by_arguments_name_or_header(tmp_path: Path) -> None:
    plain = tmp_path / "scan.raw"
    plain.write_bytes(BYTES.tobytes())
    check(Volume.load(plain, SHAPE, "uint8"), BYTES)
    named = tmp_path / "scan_5x4x3_uint16.raw"
    named.write_bytes(SHORTS.astype("<u2").tobytes())
    check(Volume.load(named), SHORTS)
    check(Volume.load(named, spacing=(1, 2, 3)), SHORTS, (1, 2, 3))
    big = tmp_path / "big.raw"
    big.write_bytes(SHORTS.astype(">u2").tobytes())
    check(Volume.load(big, SHAPE, ">u2"), SHORTS)
    header = tmp_path / "scan.dat"
    header.write_text("ObjectFileName: scan.raw\nResolution: 5 4 3\nSliceThickness: 1 1 2.5\nFormat: UCHAR\n")
    check(Volume.load(header), BYTES, (1, 1, 2.5))
    check(Volume.load(plain), BYTES, (1, 1, 2.5))


@pytest.mark.parametrize(("suffix", "pack"), [(".gz", gzip.compress), (".xz", lzma.compress)])
def test_compressed_raw(tmp_path: Path, suffix: str, pack) -> None:
    path = tmp_path / f"scan_5x4x3_float32.raw{suffix}"
    path.write_bytes(pack(FLOATS.tobytes()))
    check(Volume.load(path), FLOATS)


def test_signed_values_are_normalised_by_their_range(tmp_path: Path) -> None:
    values = (SHORTS.astype(np.int32) - 32768).astype(np.int16)
    (tmp_path / "s_5x4x3_int16.raw").write_bytes(values.tobytes())
    volume = Volume.load(tmp_path / "s_5x4x3_int16.raw")
    check(volume, values)
    assert volume.values.min() == 0 and volume.values.max() == 1


def test_box_spans_first_to_last_sample_with_longest_side_one() -> None:
    volume = Volume(BYTES, spacing=(1.0, 1.0, 3.0))
    np.testing.assert_allclose(volume.bounds, [[-1 / 3, -0.25, -0.5], [1 / 3, 0.25, 0.5]], atol=1e-7)
    np.testing.assert_allclose(volume.cell_size, [1 / 6, 1 / 6, 1 / 2])


@pytest.mark.parametrize("values", [BYTES, SHORTS, FLOATS], ids=["uint8", "uint16", "float32"])
@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("encoding", ["raw", "gzip", "ascii"])
def test_nrrd(tmp_path: Path, values: np.ndarray, order: str, encoding: str) -> None:
    data = values.astype(values.dtype.newbyteorder("<" if order == "little" else ">")).tobytes()
    if encoding == "ascii":
        data = " ".join(repr(float(v)) if values.dtype.kind == "f" else str(v) for v in values.ravel()).encode()
    data = gzip.compress(data) if encoding == "gzip" else data
    header = nrrd_header(values, encoding, f"endian: {order}\nspacings: 1 2 3\n")
    (tmp_path / "v.nrrd").write_bytes(header + data)
    check(Volume.load(tmp_path / "v.nrrd"), values, (1, 2, 3))
    (tmp_path / "v.bin").write_bytes(data)
    detached = header.replace(b"spacings: 1 2 3", b"space directions: (1,0,0) (0,2,0) (0,0,5)\ndata file: v.bin")
    (tmp_path / "v.nhdr").write_bytes(detached)
    check(Volume.load(tmp_path / "v.nhdr"), values, (1, 2, 5))


@pytest.mark.parametrize("values", [BYTES, SHORTS, FLOATS], ids=["uint8", "uint16", "float32"])
@pytest.mark.parametrize("mode", ["ascii", "binary", "appended", "appended-base64"])
@pytest.mark.parametrize("compressor", [None, "zlib", "lzma"])
def test_vti_written_by_vtk(tmp_path: Path, values: np.ndarray, mode: str, compressor: str | None) -> None:
    path = tmp_path / "v.vti"
    write_vti(path, values, mode, compressor)
    with pytest.warns(CaptureWarning, match="'scan' is read, its active one; passed over: 'other'"):
        check(Volume.load(path), values, (1, 2, 3))


def write_vti(path: Path, values: np.ndarray, mode: str, compressor: str | None) -> None:
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import numpy_to_vtk

    image = vtk.vtkImageData()
    image.SetExtent(1, 5, 0, 3, 2, 4)
    image.SetSpacing(1, 2, 3)
    vectors = numpy_to_vtk(np.zeros((values.size, 3)), deep=True)
    vectors.SetName("direction")
    image.GetPointData().AddArray(vectors)
    for name, data in (("other", values[::-1]), ("scan", values)):
        array = numpy_to_vtk(np.ascontiguousarray(data).ravel(), deep=True)
        array.SetName(name)
        image.GetPointData().AddArray(array)
    image.GetPointData().SetActiveScalars("scan")
    writer = vtk.vtkXMLImageDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(image)
    {"ascii": writer.SetDataModeToAscii, "binary": writer.SetDataModeToBinary}.get(mode, writer.SetDataModeToAppended)()
    writer.SetEncodeAppendedData(mode == "appended-base64")
    writer.SetBlockSize(32)
    {None: writer.SetCompressorTypeToNone, "zlib": writer.SetCompressorTypeToZLib}.get(
        compressor, writer.SetCompressorTypeToLZMA
    )()
    assert writer.Write() == 1


def test_vti_without_vtk(tmp_path: Path) -> None:
    text = " ".join(str(v) for v in BYTES.ravel())
    (tmp_path / "v.vti").write_text(
        '<VTKFile type="ImageData"><ImageData WholeExtent="0 4 0 3 0 2" Spacing="1 2 3"><Piece Extent="0 4 0 3 0 2">'
        f'<PointData><DataArray type="UInt8" Name="a" format="ascii">{text}</DataArray></PointData>'
        "</Piece></ImageData></VTKFile>"
    )
    check(Volume.load(tmp_path / "v.vti"), BYTES, (1, 2, 3))


def bad(tmp_path: Path, name: str, content: bytes, **arguments) -> str:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(CaptureError) as error:
        Volume.load(path, **arguments)
    message = str(error.value)
    assert message.endswith(".") and "\n" not in message and name.split(".")[0] in message
    return message


def test_raw_errors(tmp_path: Path) -> None:
    data = BYTES.tobytes()
    with pytest.raises(CaptureError, match="no file"):
        Volume.load(tmp_path / "none.raw", SHAPE, "uint8")
    assert "only 59 bytes" in bad(tmp_path, "a.raw", data[:-1], shape=SHAPE, dtype="uint8")
    assert "more bytes" in bad(tmp_path, "a.raw", data + b"x", shape=SHAPE, dtype="uint8")
    assert "need 120" in bad(tmp_path, "a.raw", data, shape=SHAPE, dtype="uint16")
    assert "give its shape" in bad(tmp_path, "a.raw", data)
    assert "give its dtype" in bad(tmp_path, "a.raw", data, shape=SHAPE)
    assert "number type" in bad(tmp_path, "a.raw", data, shape=SHAPE, dtype="colour")
    assert "number type" in bad(tmp_path, "a.raw", data, shape=SHAPE, dtype="bool")
    assert "positive whole" in bad(tmp_path, "a.raw", data, shape=(5, -4, 3), dtype="uint8")
    assert "only 60 bytes" in bad(tmp_path, "a.raw", data, shape=(10**6, 10**6, 3), dtype="uint8")
    assert "at least 2 samples" in bad(tmp_path, "a.raw", data, shape=(60, 1, 1), dtype="uint8")
    assert "positive" in bad(tmp_path, "a.raw", data, shape=SHAPE, dtype="uint8", spacing=(1, 0, 1))
    assert "damaged" in bad(tmp_path, "a_5x4x3_uint8.raw.gz", gzip.compress(data)[:-12])
    assert "damaged" in bad(tmp_path, "a_5x4x3_uint8.raw.xz", lzma.compress(data)[:40])
    assert "no volume that can be read" in bad(tmp_path, "a.png", data)
    assert "All values" in bad(tmp_path, "a_5x4x3_float32.raw", np.ones(60, np.float32).tobytes())
    assert "finite" in bad(tmp_path, "a_5x4x3_float32.raw", np.full(60, np.nan, np.float32).tobytes())


def test_header_errors(tmp_path: Path) -> None:
    dat = b"ObjectFileName: d.raw\nResolution: 5 4 3\nFormat: UCHAR\n"
    assert "does not exist" in bad(tmp_path, "h.dat", dat)
    (tmp_path / "d.raw").write_bytes(BYTES.tobytes())
    assert "no 'Format:' line" in bad(tmp_path, "h.dat", dat.replace(b"Format", b"Kind"))
    assert "format 'HALF'" in bad(tmp_path, "h.dat", dat.replace(b"UCHAR", b"HALF"))
    assert "'5 4'" in bad(tmp_path, "h.dat", dat.replace(b"5 4 3", b"5 4"))
    assert "leave out the shape" in bad(tmp_path, "h.dat", dat, shape=SHAPE)
    nrrd = nrrd_header(SHORTS, "raw", "endian: little\n")
    assert "only" in bad(tmp_path, "n.nrrd", nrrd + SHORTS.tobytes()[:-1])
    assert "like an NRRD" in bad(tmp_path, "n.nrrd", b"hello")
    assert "'endian'" in bad(tmp_path, "n.nrrd", nrrd_header(SHORTS) + SHORTS.tobytes())
    assert "'zstd'" in bad(tmp_path, "n.nrrd", nrrd.replace(b"raw", b"zstd"))
    assert "4 dimensions" in bad(tmp_path, "n.nrrd", nrrd.replace(b"dimension: 3", b"dimension: 4"))
    assert "type 'block'" in bad(tmp_path, "n.nrrd", nrrd.replace(b"uint16", b"block"))
    assert "no 'sizes'" in bad(tmp_path, "n.nrrd", nrrd.replace(b"sizes", b"size"))
    assert "not valid XML" in bad(tmp_path, "x.vti", b"<VTKFile")
    assert "no VTK ImageData" in bad(tmp_path, "x.vti", b"<VTKFile type='PolyData'/>")


@pytest.mark.parametrize("kind", ["dat", "nrrd", "nrrd-gzip", "vti-binary", "vti-appended", "vti-ascii", "raw.xz"])
def test_damaged_files_load_or_give_a_capture_error(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"v_5x4x3_uint16.{kind.split('-')[0]}"
    if kind == "dat":
        (tmp_path / "d.raw").write_bytes(SHORTS.tobytes())
        path.write_bytes(b"ObjectFileName: d.raw\nResolution: 5 4 3\nSliceThickness: 1 1 1\nFormat: USHORT\n")
    elif kind.startswith("nrrd"):
        packed = gzip.compress(SHORTS.tobytes()) if "gzip" in kind else SHORTS.tobytes()
        path.write_bytes(nrrd_header(SHORTS, "gzip" if "gzip" in kind else "raw", "endian: little\n") + packed)
    elif kind.startswith("vti"):
        write_vti(path, SHORTS, kind[4:], "zlib")
    else:
        path.write_bytes(lzma.compress(SHORTS.tobytes()))
    failures = 0
    for data in damaged_copies(path.read_bytes(), seed=5):
        path.write_bytes(data)
        try:
            with warnings.catch_warnings():
                # What a damaged name makes of the active array is said, and may be.
                warnings.simplefilter("ignore", CaptureWarning)
                Volume.load(path)
        except CaptureError as error:
            failures += 1
            assert "\n" not in str(error)
    assert failures > 40
