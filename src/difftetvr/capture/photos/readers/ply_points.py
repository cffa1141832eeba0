"""Sparse points in a PLY file, as nerfstudio writes them beside a transforms.json (``ply_file_path``)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from difftetvr.errors import CaptureError
from difftetvr.trust import require_regular

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 2**16
_END = b"end_header"


@dataclass(frozen=True)
class _Header:
    """What the header says, and where the data begin."""

    format: str
    count: int
    names: tuple[str, ...]
    types: tuple[str, ...]
    begin: int


def read_ply_points(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions and colours of the vertices of a PLY file; what else it holds is passed over.

    Args:
        path: Text or binary file.

    Returns:
        (P, 3) float64 finite positions, and (P, 3) float64 colours in [0, 1], None where the file has none.

    Raises:
        CaptureError: It cannot be read, or is damaged.
    """
    require_regular(path, CaptureError)
    try:
        # Numbers that are none of their type's are damage; floats that are too large for it are not finite.
        with path.open("rb") as file, np.errstate(invalid="raise", over="ignore"):
            header = _header(file.read(_LONGEST_HEADER))
            file.seek(header.begin)
            columns = _columns(header, file.read(), os.path.getsize(path))
    except OSError as error:
        raise CaptureError(f"Cannot read '{path}': {error.strerror or error}; check the capture's folder.") from None
    except (ValueError, TypeError, LookupError, ArithmeticError):
        raise CaptureError(f"'{path}' is no intact PLY file of points; get it anew.") from None
    positions = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
    finite = np.isfinite(positions).all(axis=1)
    channels = [columns.get(channel) for channel in ("red", "green", "blue")]
    if any(channel is None for channel in channels):
        return positions[finite], None
    colors = np.stack([_as_share(channel) for channel in channels if channel is not None], axis=1)[finite]
    return positions[finite], colors if ((colors >= 0) & (colors <= 1)).all() else None


def _header(data: bytes) -> _Header:
    end = data.find(_END)
    begin = data.find(b"\n", end) + 1
    if end < 0 or not begin or not data.startswith(b"ply"):
        raise ValueError("it has no header")
    lines = [line.split() for line in data[:end].decode("ascii").splitlines()]
    (kind,) = (line[1] for line in lines if line[:1] == ["format"])
    elements = [index for index, line in enumerate(lines) if line[:1] == ["element"]]
    first, *others = elements
    if lines[first][1] != "vertex":
        raise ValueError("vertices do not come first")
    properties = [line[1:] for line in lines[first : others[0] if others else None] if line[:1] == ["property"]]
    types, names = zip(*properties, strict=True)
    count = int(lines[first][2])
    if count < 0 or len(set(names)) < len(names):
        raise ValueError("its properties are not valid")
    return _Header(kind, count, names, tuple(_TYPES[kind] for kind in types), begin)


def _columns(header: _Header, data: bytes, size: int) -> dict[str, np.ndarray]:
    """The vertices' properties by name."""
    if header.count * len(header.names) > size:
        raise ValueError("it is cut short")
    if header.format == "ascii":
        words = data.split(maxsplit=header.count * len(header.names))
        table = np.array(words[: header.count * len(header.names)], dtype=np.float64)
        rows = table.reshape(header.count, len(header.names))
        return {
            name: rows[:, index].astype(np.dtype(kind))
            for index, (name, kind) in enumerate(zip(header.names, header.types, strict=True))
        }
    order = _ORDERS[header.format]
    layout = np.dtype([(name, order + kind) for name, kind in zip(header.names, header.types, strict=True)])
    records = np.frombuffer(data, layout, header.count)
    return {name: records[name] for name in header.names}


def _as_share(channel: np.ndarray) -> np.ndarray:
    """Of the largest value that an integer of its type has; floats are shares already."""
    most = np.iinfo(channel.dtype).max if channel.dtype.kind in "iu" else 1
    return channel.astype(np.float64) / most
