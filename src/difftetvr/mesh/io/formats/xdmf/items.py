"""The arrays of an XDMF file, wherever they lie."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import damaged, parse_numbers
from difftetvr.mesh.io.formats.xdmf.document import Document
from difftetvr.mesh.io.hdf5 import PlainFile
from difftetvr.trust import file_beside, require_modest, require_regular

_MOST_REFERENCES = 16
_LETTERS = {"float": "f", "int": "i", "uint": "u"}
_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2"}


class Items:
    """Arrays of the elements DataItem; a context manager, as HDF5 files stay open."""

    def __init__(self, document: Document) -> None:
        """Read later."""
        self.document = document
        self.path = document.path
        self._files: dict[Path, PlainFile] = {}
        self._arrays: dict[int, np.ndarray] = {}
        self._open = ExitStack()
        self._size = 0

    def __enter__(self) -> Items:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def hdf5_files(self) -> list[Path]:
        """Files in HDF5 that the document names; not all of them need to be there.

        Raises:
            MeshError: One of them lies where none may be.
        """
        texts = {(item.text or "").strip() for item in self.document.root.iter("DataItem") if _storage(item) == "hdf"}
        return [self._beside(text.rpartition(":")[0]) for text in sorted(texts)]

    def of(self, element: Element) -> list[np.ndarray]:
        """All arrays in an element, such as a Geometry."""
        return [self.array(child) for child in self.document.children(element) if child.tag == "DataItem"]

    def array(self, item: Element) -> np.ndarray:
        """The array of an element DataItem; the same object for the same element, so do not change it.

        Raises:
            MeshError: It cannot be read.
        """
        item = self._resolved(item)
        if id(item) not in self._arrays:
            self._arrays[id(item)] = self._read(item)
        values = self._arrays[id(item)]
        self._size += values.nbytes  # each time, as each user may copy it
        require_modest(self.path, self._size, "arrays", MeshError)
        return values

    def _resolved(self, item: Element) -> Element:
        """The element itself, or the one that it refers to."""
        for _ in range(_MOST_REFERENCES):
            reference = item.get("Reference")
            if reference is None:
                return item
            found = self.document.referred((item.text or "") if reference.upper() == "XML" else reference)[0]
            item = found if found.tag == "DataItem" else next(found.iter("DataItem"), found)
        raise damaged(self.path, "its arrays refer to each other without end")

    def _read(self, item: Element) -> np.ndarray:
        if item.tag != "DataItem":
            raise damaged(self.path, f"an element {item.tag[:40]!r} stands where an array should be")
        kind = item.get("ItemType", "Uniform").lower()
        if kind == "hyperslab":
            return self._read_part(item)
        if kind != "uniform":
            raise MeshError(f"{self.path} has arrays of the kind {kind[:40]!r}, which is not read; write them in full.")
        if _storage(item) == "hdf":
            return self._shaped(item, self._read_hdf(item))
        text = (item.text or "").strip()
        if _storage(item) == "xml":
            return self._shaped(item, parse_numbers(self.path, text.encode(), self._type(item).type))
        if _storage(item) == "binary":
            return self._shaped(item, self._read_binary(item, self._beside(text)))
        raise damaged(self.path, f"it keeps arrays in the unknown format {item.get('Format', '')[:40]!r}")

    def _shape(self, item: Element) -> list[int]:
        words = item.get("Dimensions", "").split()
        if not all(word.isascii() and word.isdigit() and len(word) < 19 for word in words):
            raise damaged(self.path, f"an array has the dimensions {' '.join(words)[:40]!r}")
        return [int(word) for word in words]

    def _shaped(self, item: Element, values: np.ndarray) -> np.ndarray:
        shape = self._shape(item) or list(values.shape)
        if math.prod(shape) != values.size:
            raise damaged(self.path, f"an array of shape {tuple(shape)} holds {values.size} numbers")
        return values.reshape(shape)

    def _type(self, item: Element) -> np.dtype:
        name = item.get("NumberType", item.get("DataType", "Float")).lower()
        size = item.get("Precision", "4")
        if name in _TYPES:
            return np.dtype(_TYPES[name])
        if name not in _LETTERS or size not in ("1", "2", "4", "8") or (name == "float" and size in ("1", "2")):
            raise damaged(self.path, f"it has numbers of the unknown type {name[:40]!r} of {size[:40]} bytes")
        return np.dtype(_LETTERS[name] + size)

    def _read_binary(self, item: Element, file: Path) -> np.ndarray:
        if item.get("Compression", "Raw").lower() not in ("raw", "none"):
            raise MeshError(f"{self.path} has compressed binary arrays, which are not read; write them in HDF5.")
        kind, seek = self._type(item), item.get("Seek", "0")
        endian = item.get("Endian", "Native").lower()
        stored = kind.newbyteorder(">" if endian == "big" else "<" if endian == "little" else "=")
        count = math.prod(self._shape(item))
        self._require_there(file)
        size = file.stat().st_size
        if not seek.isascii() or not seek.isdigit() or int(seek[:18]) + count * kind.itemsize > size:
            raise damaged(self.path, f"{file.name} is shorter than announced")
        return np.fromfile(file, stored, count, offset=int(seek[:18])).astype(kind)

    def _read_hdf(self, item: Element, part: tuple[slice, ...] = ()) -> np.ndarray:
        name, _, inside = (item.text or "").strip().rpartition(":")
        path = self._beside(name)
        self._require_there(path)
        if path not in self._files:
            self._files[path] = self._open.enter_context(PlainFile(path))
        return self._files[path].array(inside, part)

    def _read_part(self, item: Element) -> np.ndarray:
        """A part of another array: rows of start, stride and count, then the array."""
        inner = [self._resolved(child) for child in self.document.children(item) if child.tag == "DataItem"]
        table = self._read(inner[0]) if len(inner) == 2 and inner[0] is not item else np.empty(0)
        if table.size == 0 or table.size % 3 or table.dtype.kind not in "iu" or (table < 0).any():
            raise damaged(self.path, "a part of an array lacks start, stride and count")
        rows = zip(*table.reshape(3, -1).tolist())
        part = tuple(slice(start, start + max(stride, 1) * count, max(stride, 1)) for start, stride, count in rows)
        source = inner[1]
        if _storage(source) == "hdf" and source.get("ItemType", "Uniform").lower() == "uniform":
            return self._shaped(item, self._read_hdf(source, part))
        if source.get("ItemType", "Uniform").lower() != "uniform":
            raise damaged(self.path, "a part of an array is taken from a part")
        return self._shaped(item, self._read(source)[part])

    def _require_there(self, file: Path) -> None:
        require_regular(file, MeshError)
        if not file.is_file():
            raise MeshError(f"{self.path} keeps its arrays in {file.name!r}, which is not there; put it beside it.")

    def _beside(self, name: str) -> Path:
        return file_beside(self.path, name.strip(), MeshError)


def _storage(item: Element) -> str:
    return {"hdf5": "hdf"}.get(item.get("Format", "XML").lower(), item.get("Format", "XML").lower())
