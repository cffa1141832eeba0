"""Volumes in VTK XML image files (.vti): text, binary and appended data, plain or compressed with zlib or LZMA.

Source: "VTK XML File Formats", https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html.
"""

from __future__ import annotations

import base64
import binascii
import lzma
import re
import xml.etree.ElementTree as ElementTree
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from difftetvr.capture.volumes.volume_file import (
    RawVolume,
    byte_count,
    parse_numbers,
    parse_shape,
    parse_steps,
    text_to_volume,
    to_volume,
)
from difftetvr.errors import CaptureError

_TYPES = {
    "Int8": "i1",
    "UInt8": "u1",
    "Int16": "i2",
    "UInt16": "u2",
    "Int32": "i4",
    "UInt32": "u4",
    "Int64": "i8",
    "UInt64": "u8",
    "Float32": "f4",
    "Float64": "f8",
}
# Decompresses a block, to so many bytes at most.
Decompressor = Callable[[bytes, int], bytes]
_COMPRESSORS: dict[str, Decompressor] = {
    "vtkZLibDataCompressor": lambda data, limit: zlib.decompressobj().decompress(data, limit),
    "vtkLZMADataCompressor": lambda data, limit: lzma.LZMADecompressor().decompress(data, limit),
}


@dataclass(frozen=True)
class _Layout:
    """How a file stores its arrays; ``appended`` is the appended section behind its underscore."""

    path: Path
    order: str
    header: np.dtype
    compressor: Decompressor | None
    appended: bytes
    appended_encoding: str

    def damaged(self, why: str) -> CaptureError:
        return CaptureError(f"'{self.path}' is damaged: {why}; get the file anew.")


def read_vti(path: Path) -> RawVolume:
    """Read the active (or only, or first) scalar point array of an image in one piece.

    Raises:
        CaptureError: The file is damaged, has no scalar point data, several pieces, or is compressed otherwise.
    """
    root, appended = _parse(path)
    image = root.find("ImageData")
    if root.get("type") != "ImageData" or image is None:
        raise CaptureError(f"'{path}' holds no VTK ImageData; give a .vti file.")
    pieces = image.findall("Piece")
    if len(pieces) != 1:
        raise CaptureError(f"'{path}' has {len(pieces)} pieces; save it in one.")
    extent = (pieces[0].get("Extent") or image.get("WholeExtent") or "").split()
    try:
        limits = [int(n) for n in extent]
    except ValueError:
        limits = []
    if len(limits) != 6:
        raise CaptureError(f"'{path}' has no valid Extent; get the file anew.")
    shape = parse_shape([limits[2 * axis + 1] - limits[2 * axis] + 1 for axis in range(3)], path)
    spacing, directions = parse_steps(_steps(image), path)
    array, note = _point_array(path, pieces[0])
    code = _TYPES.get(array.get("type", ""))
    if code is None:
        raise CaptureError(f"'{path}' has values of type '{array.get('type')}'; give integers or floats.")
    layout = _layout(path, root, appended)
    dtype = np.dtype(layout.order + code)
    count = byte_count(shape, dtype)
    if array.get("format") == "ascii":
        values = text_to_volume(array.text or "", shape, dtype, path)
    else:
        values = to_volume(_array_bytes(layout, array, count), shape, dtype, path)
    return RawVolume(values, spacing, directions, note)


def _steps(image: ElementTree.Element) -> list[list[float]]:
    """From a sample to the next along each axis in the world; an empty list where the image does not tell."""
    spacing = parse_numbers((image.get("Spacing") or "1 1 1").split())
    # Row by row; the columns are the axes.
    matrix = parse_numbers((image.get("Direction") or "1 0 0 0 1 0 0 0 1").split())
    if len(spacing) != 3 or len(matrix) != 9:
        return []
    return [[spacing[axis] * matrix[axis + 3 * row] for row in range(3)] for axis in range(3)]


def _parse(path: Path) -> tuple[ElementTree.Element, bytes]:
    """The XML tree without its appended section, and that section, which need not be XML at all."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CaptureError(f"Cannot read '{path}': {error.strerror or error}.") from None
    appended = b""
    start = re.search(rb"<AppendedData[^>]*>\s*_", content)
    if start:
        end = content.rfind(b"</AppendedData>")
        appended = content[start.end() : end if end > 0 else len(content)]
        tail = content[end:] if end > 0 else b"</AppendedData></VTKFile>"
        content = content[: start.end() - 1] + tail
    try:
        return ElementTree.fromstring(content), appended
    except (ElementTree.ParseError, ValueError):
        raise CaptureError(f"'{path}' is not valid XML, so no .vti file; check the file.") from None


def _layout(path: Path, root: ElementTree.Element, appended: bytes) -> _Layout:
    compressor = root.get("compressor")
    if compressor and compressor not in _COMPRESSORS:
        raise CaptureError(f"'{path}' is compressed by {compressor}; save it with zlib or without compression.")
    order = ">" if root.get("byte_order") == "BigEndian" else "<"
    header = np.dtype(order + ("u8" if root.get("header_type") == "UInt64" else "u4"))
    section = root.find("AppendedData")
    encoding = "raw" if section is None else section.get("encoding", "base64")
    return _Layout(path, order, header, _COMPRESSORS[compressor] if compressor else None, appended, encoding)


def _point_array(path: Path, piece: ElementTree.Element) -> tuple[ElementTree.Element, tuple[str, ...]]:
    """The array to show, with a note on those that are not."""
    data = piece.find("PointData")
    arrays = [] if data is None else data.findall("DataArray")
    scalars = [a for a in arrays if (a.get("NumberOfComponents") or "1").strip() in ("1", "0")]
    if data is None or not scalars:
        raise CaptureError(f"'{path}' has no point array with one component; give a scalar volume.")
    active = [a for a in scalars if a.get("Name") == data.get("Scalars")]
    taken = (active or scalars)[0]
    if len(scalars) == 1:
        return taken, ()
    others = ", ".join(repr(array.get("Name")) for array in scalars if array is not taken)
    why = "its active one" if active else "its first one"
    return taken, (f"Of the scalars in '{path}', {taken.get('Name')!r} is read, {why}; passed over: {others}.",)


def _array_bytes(layout: _Layout, array: ElementTree.Element, count: int) -> bytes:
    """Decoded bytes of a binary or appended array that should hold ``count`` bytes."""
    if array.get("format") == "appended":
        try:
            offset = int(array.get("offset", ""))
        except ValueError:
            offset = -1
        if not 0 <= offset < len(layout.appended):
            raise layout.damaged("an array's offset lies outside the appended data")
        source = _Source(layout, layout.appended[offset:], layout.appended_encoding != "raw")
    else:
        source = _Source(layout, re.sub(rb"\s", b"", (array.text or "").encode()), True)
    return source.plain() if layout.compressor is None else source.compressed(layout.compressor, count)


class _Source:
    """Reads sizes and payload of one array; in base64 they are encoded one after the other, each with its padding."""

    def __init__(self, layout: _Layout, data: bytes, is_base64: bool) -> None:
        self.layout, self.data, self.is_base64, self.position = layout, data, is_base64, 0

    def take(self, count: int) -> bytes:
        """The next ``count`` decoded bytes."""
        if not self.is_base64:
            piece = self.data[self.position : self.position + count]
            self.position += count
        else:
            length = -(-count // 3) * 4
            piece = self.peek(count)
            self.position += length
        if len(piece) != count:
            raise self.layout.damaged("an array is cut short")
        return piece

    def peek(self, count: int) -> bytes:
        """The next ``count`` decoded bytes, or fewer at the end, without moving on."""
        if not self.is_base64:
            return self.data[self.position : self.position + count]
        encoded = self.data[self.position : self.position + -(-count // 3) * 4]
        try:
            return base64.b64decode(encoded, validate=True)[:count]
        except (binascii.Error, ValueError):
            raise self.layout.damaged("its base64 data is not valid") from None

    def sizes(self, count: int) -> list[int]:
        """The next ``count`` header numbers, without moving on."""
        header = self.layout.header
        data = self.peek(count * header.itemsize)
        if len(data) != count * header.itemsize:
            raise self.layout.damaged("an array is cut short")
        return [int(n) for n in np.frombuffer(data, dtype=header)]

    def plain(self) -> bytes:
        """An uncompressed array: its size, then its bytes, together in one base64 stream."""
        size = self.sizes(1)[0]
        offset = self.layout.header.itemsize
        if size > len(self.data):
            raise self.layout.damaged("an array is cut short")
        return self.take(offset + size)[offset:]

    def compressed(self, decompress: Decompressor, count: int) -> bytes:
        """A compressed array: block count, block size, last block's size, compressed sizes; then all blocks."""
        blocks, block_size, last_size = self.sizes(3)
        total = (blocks - 1) * block_size + last_size if last_size else blocks * block_size
        if total != count or blocks > len(self.data):
            raise self.layout.damaged(f"its blocks hold {total} bytes where its extent and type need {count}")
        lengths = self.sizes(3 + blocks)[3:]
        self.take((3 + blocks) * self.layout.header.itemsize)
        if sum(lengths) > len(self.data):
            raise self.layout.damaged("an array is cut short")
        payload = self.take(sum(lengths))
        decoded, position = [], 0
        for index, length in enumerate(lengths):
            expected = last_size if last_size and index == blocks - 1 else block_size
            decoded.append(self._decompress(decompress, payload[position : position + length], expected))
            position += length
        return b"".join(decoded)

    def _decompress(self, decompress: Decompressor, data: bytes, expected: int) -> bytes:
        try:
            block = decompress(data, expected + 1)
        except (zlib.error, lzma.LZMAError, EOFError):
            raise self.layout.damaged("a compressed block cannot be decoded") from None
        if len(block) != expected:
            raise self.layout.damaged("a compressed block has the wrong size")
        return block
