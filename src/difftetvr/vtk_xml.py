"""VTK's XML files: their elements, and the arrays in these, in every encoding and with every compressor.

Source: "VTK XML File Formats", https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html.

No number in a file is believed: sizes are compared with what the file holds and with what `difftetvr.trust` allows
before memory is taken. Nothing is searched for by patterns that could backtrack, and no entity is ever expanded.
"""

from __future__ import annotations

import base64
import binascii
import importlib
import lzma
import math
import warnings
import xml.etree.ElementTree as ElementTree
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from difftetvr.errors import DiffTetError
from difftetvr.trust import require_modest, require_regular

TYPES = {
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
"""NumPy's name of a type, without byte order, by VTK's."""

_BIT = "Bit"
_ID = "vtkIdType"  # of 8 bytes, or of 4, as VTK was built

_MOST_ELEMENTS = 1_000_000
_MOST_RATIO = {"vtkZLibDataCompressor": 1_100, "vtkLZ4DataCompressor": 300, "vtkLZMADataCompressor": 20_000}
"""How many times its size a compressor can make of data at most, by VTK's name; a little more than in truth."""
_LZMA_MEMORY = 2**28  # four times what VTK's highest level needs

Unpack = Callable[[Any, int], bytes]
"""Unpacks a block to one byte more than its size at most; raises ValueError where it is damaged."""


def is_numeric(array: Element) -> bool:
    """Whether a DataArray holds numbers, not text or things that only VTK knows."""
    return array.get("type") in (*TYPES, _BIT, _ID)


class Document:
    """A VTK XML file.

    Attributes:
        path: The file.
        root: Its outermost element; the appended data are taken out.
    """

    def __init__(self, path: Path, error: type[DiffTetError]) -> None:
        """Read a file.

        Args:
            path: The file.
            error: The exception to raise for whatever is wrong with it, here and later.

        Raises:
            DiffTetError: (of type ``error``) It cannot be read, is no XML, or refers to entities.
        """
        self.path = path
        self._error = error
        require_regular(path, error)
        try:
            require_modest(path, path.stat().st_size, "data", error)
            content = path.read_bytes()
        except OSError as problem:
            raise error(f"Cannot read {path}: {problem.strerror or problem}; check the path.") from problem
        head, self._appended, tail = _without_appended(content)
        self.root = self._parsed(head, tail)
        section = self.root.find("AppendedData")
        self._appended_is_base64 = section is not None and section.get("encoding", "base64") != "raw"
        self._order = ">" if self.root.get("byte_order") == "BigEndian" else "<"
        self._header = np.dtype(self._order + ("u8" if self.root.get("header_type") == "UInt64" else "u4"))
        self._unpacked = 0

    def damaged(self, problem: str) -> DiffTetError:
        """The exception for a file that breaks the rules of its format.

        Args:
            problem: What is wrong and where, part of a sentence.
        """
        return self._error(f"{self.path} is damaged: {problem}; write it again or get it anew.")

    def count(self, element: Element, name: str) -> int:
        """A whole number that an attribute holds; 0 where there is no such attribute.

        Raises:
            DiffTetError: It is no number, or negative.
        """
        word = element.get(name, "0").strip()
        if not word.isascii() or not word.isdigit() or len(word) > 18:
            raise self.damaged(f"{name} is {word[:40]!r}")
        return int(word)

    def numbers(self, element: Element, name: str, count: int, default: str) -> list[float]:
        """So many finite numbers that an attribute holds.

        Raises:
            DiffTetError: There are fewer or more, or something else.
        """
        text = element.get(name, default)
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        if len(values) != count or not all(map(math.isfinite, values)):
            raise self.damaged(f"{name} is {text[:40]!r}, where {count} numbers must be")
        return values

    def array(self, element: Element, count: int | None = None) -> np.ndarray:
        """The numbers of a DataArray.

        Args:
            element: The array; see `is_numeric`.
            count: How many numbers it must hold; None: any number.

        Returns:
            (count,) numbers of the type that the file says, in native byte order.

        Raises:
            DiffTetError: It is damaged, holds another number of numbers, or is compressed as nothing here can unpack.
        """
        kind, name = element.get("type", ""), element.get("Name", "")[:40]
        if not is_numeric(element):
            raise self.damaged(f"the array {name!r} is of type {kind[:40]!r}, where numbers must be")
        is_bits = kind == _BIT
        dtype = np.dtype(self._order + (TYPES | {_ID: "i8"}).get(kind, "u1"))
        if _storage(element) == "ascii":
            values = self._parsed_numbers(element.text or "", dtype.newbyteorder("="), name)
        else:
            size = None if count is None else -(-count // 8) if is_bits else count * dtype.itemsize
            data = self._bytes(element, None if kind == _ID else size, name)
            if kind == _ID and size is not None and 2 * len(data) == size:
                dtype = np.dtype(self._order + "i4")
            if len(data) % dtype.itemsize:
                raise self.damaged(f"the array {name!r} ends within a number")
            values = np.frombuffer(data, dtype)
            # What is the file's own, not unpacked, cannot be written to, which no one expects of an array.
            values = values.astype(dtype.newbyteorder("="), copy=not values.flags.writeable)
            values = np.unpackbits(values, count=count) if is_bits else values
        if count is not None and len(values) != count:
            raise self.damaged(f"the array {name!r} holds {len(values)} numbers, where {count} must be")
        return values

    def _parsed(self, head: Any, tail: bytes) -> Element:
        parser = ElementTree.XMLParser(target=_Builder(self._error, self.path))
        try:
            parser.feed(head)
            parser.feed(tail)
            root = parser.close()
        except (ElementTree.ParseError, ValueError, LookupError) as problem:
            raise self._error(f"{self.path} is not valid XML, so no file of VTK's; write it again.") from problem
        if root.tag != "VTKFile":
            raise self._error(f"{self.path} begins with <{root.tag[:40]}>, so it is no file of VTK's; give another.")
        return root

    def _parsed_numbers(self, text: str, dtype: np.dtype, name: str) -> np.ndarray:
        wide = np.dtype(np.float64 if dtype.kind == "f" else np.uint64 if dtype == np.uint64 else np.int64)
        values = np.empty(0, wide)
        if text.strip():
            try:
                with warnings.catch_warnings():
                    # NumPy only warns of, and cuts off, what follows the last number that it understands.
                    warnings.simplefilter("error", DeprecationWarning)
                    values = np.fromstring(text, wide, sep=" ")
            except (DeprecationWarning, ValueError) as problem:
                raise self.damaged(f"the array {name!r} holds something else than numbers") from problem
        if dtype.kind in "iu" and len(values):
            limits = np.iinfo(dtype)
            if values.min() < limits.min or values.max() > limits.max:
                raise self.damaged(f"the array {name!r} holds numbers that its type {dtype.name} cannot")
        with np.errstate(over="ignore"):
            return values.astype(dtype, copy=False)

    def _bytes(self, element: Element, size: int | None, name: str) -> Any:
        """What a binary array holds, unpacked: ``size`` bytes, or as many as it says."""
        if _storage(element) == "appended":
            offset = self.count(element, "offset")
            if offset >= len(self._appended):
                raise self.damaged(f"the array {name!r} begins behind the file's end")
            source = _Source(self, self._appended[offset:], self._header, self._appended_is_base64)
        else:
            text = "".join((element.text or "").split())
            if not text.isascii():
                raise self.damaged(f"the array {name!r} is not encoded in base64")
            source = _Source(self, memoryview(text.encode("ascii")), self._header, is_base64=True)
        compressor = self.root.get("compressor")
        if not compressor:
            return source.plain()
        unpack = self._unpacker(compressor)
        return source.unpacked(unpack, lambda packed, total: self._admit(compressor, packed, total, size, name))

    def _unpacker(self, compressor: str) -> Unpack:
        if compressor not in _UNPACKERS:
            raise self._error(
                f"{self.path} is compressed with {compressor[:40]}, which cannot be read; write it with zlib, LZ4, "
                "LZMA or uncompressed."
            )
        if compressor == "vtkLZ4DataCompressor":
            try:
                importlib.import_module("lz4.block")
            except ImportError as problem:
                raise self._error(
                    f"{self.path} is compressed with LZ4, which needs a package: pip install 'difftetvr[lz4]'."
                ) from problem
        return _UNPACKERS[compressor]

    def _admit(self, compressor: str, packed: int, total: int, size: int | None, name: str) -> None:
        """Refuses what an array says that it unpacks to, before it does."""
        if size is not None and total != size:
            raise self.damaged(f"the array {name!r} holds {total} bytes, where {size} must be")
        if total > _MOST_RATIO[compressor] * packed:
            raise self.damaged(f"the array {name!r} announces {total} bytes, which its {packed} cannot unpack to")
        self._unpacked += total
        require_modest(self.path, self._unpacked, "arrays", self._error)


def _storage(array: Element) -> str:
    """Where an array's numbers are, "ascii", "binary" or "appended"; as VTK has it where the file does not say."""
    found = array.get("format", "").strip().lower()
    if not found and array.get("offset") is not None:
        return "appended"
    return found if found in ("binary", "appended") else "ascii"


class _Builder(ElementTree.TreeBuilder):
    """Builds the tree of a file that declares no entities and has no more elements than any of VTK's."""

    def __init__(self, error: type[DiffTetError], path: Path) -> None:
        super().__init__()
        self._error, self._path, self._elements = error, path, 0

    def start(self, tag: str, attrs: dict[str, str], /) -> Element:
        self._elements += 1
        if self._elements > _MOST_ELEMENTS:
            raise self._error(f"{self._path} has more than {_MOST_ELEMENTS:,} XML elements; split it up.")
        return super().start(tag, attrs)

    def doctype(self, _name: str, _public: str | None, _system: str | None) -> None:
        """Called by the parser before it reads any declaration."""
        raise self._error(f"{self._path} has a DOCTYPE, which VTK's files have not; remove it.")


class _Source:
    """Sizes and payload of one array; in base64 they are encoded one after the other, each with its padding."""

    def __init__(self, document: Document, data: memoryview, header: np.dtype, is_base64: bool) -> None:
        self._document, self._data, self._header, self._is_base64 = document, data, header, is_base64
        self._left = len(data) // 4 * 3 if is_base64 else len(data)

    def plain(self) -> Any:
        """An uncompressed array: its size, then its bytes, as a rule together in one stream of base64."""
        width = self._header.itemsize
        size = self._sizes(1)[0]
        if size > self._left:
            raise self._cut_short()
        padding = b"=" * (-width % 3)  # of the size alone
        if self._is_base64 and self._encoded(width).tobytes().endswith(padding):
            self._take(width)
            return self._take(size)
        return self._take(width + size)[width:]

    def unpacked(self, unpack: Unpack, admit: Callable[[int, int], None]) -> Any:
        """A compressed array: number of blocks, their size, the last one's, all compressed sizes; then the blocks.

        Args:
            unpack: Unpacks a block.
            admit: Is told how many bytes the file has of the array and how many it says that they unpack to.
        """
        blocks = self._sizes(1)[0]
        if not blocks:
            return b""
        block_size, last_size = self._sizes(3)[1:]
        if blocks > self._left // self._header.itemsize:
            raise self._cut_short()
        sizes = [block_size] * (blocks - 1) + [last_size or block_size]
        header = self._take((3 + blocks) * self._header.itemsize)
        lengths = np.frombuffer(header, self._header)[3:].tolist()
        packed = sum(lengths)
        if packed > self._left:
            raise self._cut_short()
        admit(packed, sum(sizes))
        payload = self._take(packed)
        result, position, place = bytearray(sum(sizes)), 0, 0
        for length, size in zip(lengths, sizes, strict=True):
            try:
                block = unpack(payload[position : position + length], size)
            except ValueError as problem:
                raise self._document.damaged("a compressed block cannot be unpacked") from problem
            if len(block) != size:
                raise self._document.damaged(f"a compressed block does not unpack to {size} bytes, as it says")
            result[place : place + size] = block
            position, place = position + length, place + size
        return result

    def _sizes(self, count: int) -> list[int]:
        """The next numbers of the header, without moving on."""
        return np.frombuffer(self._peek(count * self._header.itemsize), self._header).tolist()

    def _take(self, count: int) -> Any:
        """The next decoded bytes."""
        piece = self._peek(count)
        self._data = self._data[len(self._encoded(count)) :]
        return piece

    def _peek(self, count: int) -> Any:
        """The next decoded bytes, without moving on."""
        piece: Any = self._encoded(count)
        if self._is_base64:
            try:
                piece = memoryview(base64.b64decode(piece, validate=True))[:count]
            except (binascii.Error, ValueError) as problem:
                raise self._document.damaged("an array is not encoded in base64") from problem
        if len(piece) != count:
            raise self._cut_short()
        return piece

    def _encoded(self, count: int) -> memoryview:
        return self._data[: -(-count // 3) * 4 if self._is_base64 else count]

    def _cut_short(self) -> DiffTetError:
        return self._document.damaged("an array is cut short")


def _without_appended(content: bytes) -> tuple[memoryview, memoryview, bytes]:
    """XML before the appended data, these behind their underscore, and the XML behind them; they need not be XML."""
    view = memoryview(content)
    begin = content.find(b"<AppendedData")
    bracket = content.find(b">", begin) if begin >= 0 else -1
    mark = content.find(b"_", bracket) if bracket >= 0 else -1
    if mark < 0 or content[bracket + 1 : mark].strip():
        return view, view[:0], b""
    end = content.rfind(b"</AppendedData>", mark)
    tail = content[end:] if end >= 0 else b"</AppendedData></VTKFile>"
    return view[:mark], view[mark + 1 : end if end >= 0 else len(content)], tail


def _unpack_zlib(data: Any, size: int) -> bytes:
    try:
        return zlib.decompressobj().decompress(data, size + 1)
    except zlib.error as problem:
        raise ValueError from problem


def _unpack_lzma(data: Any, size: int) -> bytes:
    try:
        return lzma.LZMADecompressor(memlimit=_LZMA_MEMORY).decompress(data, size + 1)
    except (lzma.LZMAError, EOFError) as problem:
        raise ValueError from problem


def _unpack_lz4(data: Any, size: int) -> bytes:
    block = importlib.import_module("lz4.block")
    try:
        unpacked: bytes = block.decompress(data, uncompressed_size=size)
    except block.LZ4BlockError as problem:
        raise ValueError from problem
    return unpacked


_UNPACKERS: dict[str, Unpack] = {
    "vtkZLibDataCompressor": _unpack_zlib,
    "vtkLZMADataCompressor": _unpack_lzma,
    "vtkLZ4DataCompressor": _unpack_lz4,
}
