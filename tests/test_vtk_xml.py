"""Arrays of VTK's XML files as their writers encode them, and files that are damaged or mean harm."""

import base64
import lzma
import struct
import sys
import tracemalloc
import zlib

import numpy as np
import pytest

from difftetvr import trust
from difftetvr.errors import CaptureError, MeshError
from difftetvr.vtk_xml import Document, is_numeric

VALUES = np.array([1.5, -2, np.pi, 7, 0.25])


def encoded(*parts):
    return "".join(base64.b64encode(part).decode() for part in parts)


def document(folder, content, appended=b"", attributes="", error=MeshError):
    path = folder / "a.vtu"
    head = f'<?xml version="1.0"?><VTKFile type="UnstructuredGrid" {attributes}>{content}'.encode()
    path.write_bytes(head + appended + b"</VTKFile>")
    return Document(path, error)


def array(folder, content, count=None, kind="Float64", storage="binary", **options):
    element = f'<DataArray type="{kind}" Name="p" format="{storage}">{content}</DataArray>'
    file = document(folder, element, **options)
    return file.array(file.root[0], count)


def compressed(data, block, compress=zlib.compress, last=None):
    """Blocks of an array, with the header's numbers before them; the last block's size as the writer says it."""
    parts = [compress(data[i : i + block]) for i in range(0, len(data), block)]
    last = len(data) % block if last is None else last
    return struct.pack(f"<{3 + len(parts)}I", len(parts), block, last, *map(len, parts)), b"".join(parts)


ZLIB = 'compressor="vtkZLibDataCompressor"'


def test_base64_with_one_stream_or_two(tmp_path):
    data = VALUES.astype("<f8").tobytes()
    for header in ("<I", "<Q"):
        attributes = f'header_type="UInt{8 * struct.calcsize(header)}"'
        size = struct.pack(header, len(data))
        for text in (encoded(size + data), encoded(size, data), "\n " + "\n".join(encoded(size + data)) + "\n"):
            values = array(tmp_path, text, 5, attributes=attributes)
            assert values.tolist() == VALUES.tolist() and values.flags.writeable
    big = struct.pack(">I", len(data)) + VALUES.astype(">f8").tobytes()
    assert array(tmp_path, encoded(big), attributes='byte_order="BigEndian"').tolist() == VALUES.tolist()


def test_arrays_without_a_format_are_text_or_appended(tmp_path):
    """As VTK's reader takes them."""
    data = struct.pack("<I", 40) + VALUES.astype("<f8").tobytes()
    content = f'<DataArray type="Float64">{" ".join(map(repr, VALUES.tolist()))}</DataArray>'
    content += '<DataArray type="Float64" offset="0"/>'
    file = document(tmp_path, content, b'<AppendedData encoding="raw">_' + data + b"</AppendedData>")
    assert [file.array(element, 5).tolist() for element in file.root[:2]] == [VALUES.tolist()] * 2


@pytest.mark.parametrize("encoding", ["raw", "base64"])
def test_appended_data_that_look_like_xml(tmp_path, encoding):
    """What lies between is nothing but bytes, be they tags; offsets count from behind the underscore."""
    first = np.frombuffer(b"</VTKFile><AppendedData>_<<&&&\0\x80", "u1")
    second = VALUES.astype("<f8").tobytes()
    parts = [struct.pack("<I", len(data)) + data for data in (first.tobytes(), second)]
    parts = parts if encoding == "raw" else [base64.b64encode(part) for part in parts]
    content = "".join(
        f'<DataArray type="{kind}" format="appended" offset="{offset}"/>'
        for kind, offset in (("UInt8", 0), ("Float64", len(parts[0])))
    )
    section = f'<AppendedData encoding="{encoding}">\n  _'.encode()
    for end in (b"</AppendedData>", b"\n </AppendedData>"):
        file = document(tmp_path, content, section + b"".join(parts) + end)
        assert np.array_equal(file.array(file.root[0]), first)
        assert file.array(file.root[1], 5).tolist() == VALUES.tolist()
    cut = document(tmp_path, content, section + parts[0] + parts[1][:-24])
    assert np.array_equal(cut.array(cut.root[0]), first)
    with pytest.raises(MeshError, match=r"cut short|not encoded|begins behind"):
        cut.array(cut.root[1])


def test_blocks_of_compressed_arrays(tmp_path):
    data = np.arange(100, dtype="<f8").tobytes()
    for block in (8, 96, 800, 1024):
        assert np.array_equal(array(tmp_path, encoded(*compressed(data, block)), 100, attributes=ZLIB), np.arange(100))
    for header in (struct.pack("<I", 0), struct.pack("<3I", 0, 32768, 0)):
        assert array(tmp_path, encoded(header), 0, attributes=ZLIB).size == 0


def test_text_and_types(tmp_path):
    assert array(tmp_path, " 1\n-2 3.5e0 inf nan ", storage="ascii").tolist()[:4] == [1, -2, 3.5, np.inf]
    assert array(tmp_path, "18446744073709551615", 1, "UInt64", "ascii").tolist() == [2**64 - 1]
    assert array(tmp_path, "9007199254740993", 1, "Int64", "ascii").tolist() == [2**53 + 1]
    assert array(tmp_path, "1 0 1", 3, "Bit", "ascii").tolist() == [1, 0, 1]
    assert array(tmp_path, encoded(struct.pack("<I", 1) + b"\xa0"), 3, "Bit").tolist() == [1, 0, 1]
    file = document(tmp_path, '<Array type="String"/><DataArray type="String"/><DataArray type="Int8"/>')
    assert [is_numeric(element) for element in file.root] == [False, False, True]
    for text, kind in (("1 2 x", "Float64"), ("1.5", "Int32"), ("300", "UInt8"), ("-1", "UInt16"), ("1 2 3", "String")):
        with pytest.raises(MeshError, match="damaged"):
            array(tmp_path, text, kind=kind, storage="ascii")


def test_numbers_in_attributes(tmp_path):
    file = document(tmp_path, '<Piece N="12" M="-3" K="9e9" Origin="1 2 nan" Spacing="1 2"/>')
    piece = file.root[0]
    assert file.count(piece, "N") == 12 and file.count(piece, "none") == 0
    assert file.numbers(piece, "none", 3, "0 1 2") == [0, 1, 2]
    for name in ("M", "K"):
        with pytest.raises(MeshError, match=f"{name} is "):
            file.count(piece, name)
    for name in ("Origin", "Spacing"):
        with pytest.raises(MeshError, match=f"{name} is .*where 3 numbers must be"):
            file.numbers(piece, name, 3, "")


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"<VTKFile" * 130_000, "not valid XML"),
        (b"<AppendedData" * 320_000, "not valid XML"),
        (b'<VTKFile><AppendedData encoding="raw">' * 100_000, "not valid XML"),
        (b"<VTKFile>" + b"<a/>" * 1_100_000 + b"</VTKFile>", "more than 1,000,000 XML elements"),
        (b"", "not valid XML"),
        (b'<?xml version="1.0" encoding="klingon"?><VTKFile/>', "not valid XML"),
        (b"<html/>", "begins with <html>"),
        (b'<!DOCTYPE a [<!ENTITY b "bbbb"><!ENTITY c "&b;&b;">]><VTKFile>&c;</VTKFile>', "has a DOCTYPE"),
        (b'<!DOCTYPE a SYSTEM "/etc/passwd"><VTKFile/>', "has a DOCTYPE"),
    ],
    ids=range(9),
)
def test_files_that_are_hard_to_read_or_mean_harm(tmp_path, content, sentence):
    (tmp_path / "a.vtu").write_bytes(content)
    with pytest.raises(CaptureError, match=sentence) as caught:
        Document(tmp_path / "a.vtu", CaptureError)
    assert str(caught.value).endswith(".") and "\n" not in str(caught.value)


def test_files_that_are_none(tmp_path):
    with pytest.raises(MeshError, match="Cannot read"):
        Document(tmp_path / "none.vtu", MeshError)
    with pytest.raises(MeshError, match="it is a folder"):
        Document(tmp_path, MeshError)


def header_of(*numbers):
    return struct.pack(f"<{len(numbers)}Q", *numbers)


WIDE = 'header_type="UInt64"'
HUGE = 2**43


@pytest.mark.parametrize(
    ("content", "attributes", "count"),
    [
        (encoded(header_of(HUGE) + b"12345678"), WIDE, None),
        (encoded(header_of(HUGE) + b"12345678"), WIDE, HUGE // 8),
        (encoded(header_of(1, HUGE, 0, 20), zlib.compress(bytes(64))), f"{WIDE} {ZLIB}", None),
        (encoded(header_of(1, HUGE, 0, 20), zlib.compress(bytes(64))), f"{WIDE} {ZLIB}", HUGE // 8),
        (encoded(header_of(HUGE, 64, 0, 20), zlib.compress(bytes(64))), f"{WIDE} {ZLIB}", None),
        (encoded(header_of(1, 64, 0, HUGE), zlib.compress(bytes(64))), f"{WIDE} {ZLIB}", None),
        (encoded(header_of(2**64 - 1, 2**64 - 1, 2**64 - 1, 2**64 - 1)), f"{WIDE} {ZLIB}", None),
        ("1 2 3", "", HUGE),
    ],
    ids=range(8),
)
def test_headers_that_announce_terabytes(tmp_path, content, attributes, count):
    tracemalloc.start()
    with pytest.raises(MeshError, match="is damaged"):
        array(tmp_path, content, count, storage="ascii" if not attributes else "binary", attributes=attributes)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**20


@pytest.mark.parametrize("name", ["ZLib", "LZMA", "LZ4"])
def test_blocks_that_unpack_to_more_or_less_than_they_say(tmp_path, name):
    if name == "LZ4":
        block = pytest.importorskip("lz4.block")

        def compress(data):
            return block.compress(data, store_size=False)

    else:
        compress = {"ZLib": zlib.compress, "LZMA": lzma.compress}[name]
    attributes = f'compressor="vtk{name}DataCompressor"'
    data = bytes(2**25)
    bomb = compress(data)
    tracemalloc.start()
    for size in (8, 2**10, 2**12 - 8):
        content = encoded(struct.pack("<4I", 1, size, 0, len(bomb)), bomb)
        with pytest.raises(MeshError, match=r"compressed block (does not|cannot)"):
            array(tmp_path, content, attributes=attributes)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**24  # LZMA's dictionary
    less = encoded(struct.pack("<4I", 1, 2**13, 0, len(bomb)), compress(bytes(2**12)).ljust(len(bomb), b"\0"))
    with pytest.raises(MeshError, match=r"compressed block (does not|cannot)"):
        array(tmp_path, less, attributes=attributes)
    assert array(tmp_path, encoded(*compressed(data, 2**20, compress)), 2**22, attributes=attributes).sum() == 0


def test_arrays_that_unpack_to_much_are_asked_about(tmp_path, monkeypatch):
    """All arrays of a file count together; what they say is held against the limit before they are unpacked."""
    monkeypatch.setattr(trust, "UNPACKED_BYTES", 2**21)
    content = encoded(*compressed(bytes(3 * 2**19), 2**16))
    file = document(tmp_path, f'<DataArray type="Int8" format="binary">{content}</DataArray>' * 2, attributes=ZLIB)
    assert not file.array(file.root[0]).any()
    with pytest.raises(MeshError, match=r"unpack to more than 2 MiB.*--allow-large"):
        file.array(file.root[1])
    with trust.trusting(large=True):
        assert len(file.array(file.root[1])) == 3 * 2**19


def test_compressors_that_are_not_there(tmp_path, monkeypatch):
    with pytest.raises(MeshError, match=r"compressed with vtkZstd, which cannot be read"):
        array(tmp_path, "", attributes='compressor="vtkZstd"')
    monkeypatch.setitem(sys.modules, "lz4.block", None)
    monkeypatch.setitem(sys.modules, "lz4", None)
    with pytest.raises(MeshError, match=r"pip install 'difftetvr\[lz4\]'"):
        array(tmp_path, "", attributes='compressor="vtkLZ4DataCompressor"')


@pytest.mark.parametrize(
    ("content", "count"),
    [
        (encoded(struct.pack("<I", 40) + VALUES.tobytes()), 4),
        (encoded(struct.pack("<I", 39) + VALUES.tobytes()), None),
        (encoded(struct.pack("<I", 41) + VALUES.tobytes()), 5),
        ("@@@@", None),
        ("AAA", None),
        ("é", None),
        ("", None),
    ],
    ids=range(7),
)
def test_arrays_of_the_wrong_length_or_encoding(tmp_path, content, count):
    with pytest.raises(MeshError, match="is damaged"):
        array(tmp_path, content, count)
