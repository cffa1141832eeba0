"""Volumes in NRRD files (.nrrd, or .nhdr with detached data): raw, gzip and text encodings.

Source: the format's definition, https://teem.sourceforge.net/nrrd/format.html.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from difftetvr.capture.volumes.volume_file import (
    RawVolume,
    byte_count,
    parse_shape,
    parse_spacing,
    read_stream,
    text_to_volume,
    to_volume,
)
from difftetvr.errors import CaptureError

_MAX_HEADER = 2**20
_TYPES = {
    "i1": ("signed char", "int8", "int8_t"),
    "u1": ("uchar", "unsigned char", "uint8", "uint8_t"),
    "i2": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
    "u2": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
    "i4": ("int", "signed int", "int32", "int32_t"),
    "u4": ("uint", "unsigned int", "uint32", "uint32_t"),
    "i8": ("longlong", "long long", "long long int", "signed long long", "int64", "int64_t"),
    "u8": ("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"),
    "f4": ("float",),
    "f8": ("double",),
}
_CODES = {name: code for code, names in _TYPES.items() for name in names}
_ENCODINGS = {"raw": "raw", "gzip": "gzip", "gz": "gzip", "txt": "text", "text": "text", "ascii": "text"}


def read_nrrd(path: Path) -> RawVolume:
    """Read a three-dimensional scalar NRRD volume.

    Raises:
        CaptureError: The file is damaged, not three-dimensional, or of a type or encoding that is not supported.
    """
    fields, header_size = _read_header(path)
    for key in ("type", "dimension", "sizes", "encoding"):
        if key not in fields:
            raise CaptureError(f"The NRRD header of '{path}' has no '{key}' field; get the file anew.")
    if fields["dimension"] != "3":
        raise CaptureError(f"'{path}' has {fields['dimension']} dimensions; give a scalar volume with 3.")
    encoding = _ENCODINGS.get(fields["encoding"].lower())
    if encoding is None:
        raise CaptureError(f"'{path}' is encoded as '{fields['encoding']}'; save it as raw, gzip or text.")
    shape = parse_shape(fields["sizes"].split(), path)
    data, start = _data_location(path, fields, header_size)
    dtype = _dtype(path, fields, encoding)
    if encoding == "text":
        return RawVolume(_read_text(data, start, shape, dtype), _spacing(path, fields))
    decoded = read_stream(data, encoding, start, byte_count(shape, dtype, path))
    return RawVolume(to_volume(decoded, shape, dtype, path), _spacing(path, fields))


def _read_header(path: Path) -> tuple[dict[str, str], int]:
    """Fields by name in lower case without spaces, and the number of bytes up to the data."""
    try:
        with path.open("rb") as file:
            start = file.read(_MAX_HEADER)
    except OSError as error:
        raise CaptureError(f"Cannot read '{path}': {error.strerror or error}.") from None
    if not start.startswith(b"NRRD000"):
        raise CaptureError(f"'{path}' does not start like an NRRD file; check the file.")
    end = re.search(rb"\r?\n\r?\n", start)
    # A detached header may end with the file instead of with an empty line.
    lines = start[: end.start() if end else len(start)].decode("latin-1").splitlines()[1:]
    fields: dict[str, str] = {}
    for line in lines:
        key, separator, value = line.partition(":")
        if line.startswith("#") or not separator or value.startswith("="):
            continue
        fields[key.strip().lower().replace(" ", "")] = value.strip()
    return fields, end.end() if end else len(start)


def _data_location(path: Path, fields: dict[str, str], header_size: int) -> tuple[Path, int]:
    """The file that holds the data, and the bytes before them."""
    name = fields.get("datafile")
    if fields.get("lineskip", "0") != "0" or fields.get("byteskip", "0") != "0":
        raise CaptureError(f"'{path}' skips lines or bytes before its data, which is not supported; save it without.")
    if name is None:
        return path, header_size
    data = path.parent / name
    if not data.is_file():
        raise CaptureError(f"'{path}' names the data file '{name}', which does not exist beside it.")
    return data, 0


def _dtype(path: Path, fields: dict[str, str], encoding: str) -> np.dtype:
    code = _CODES.get(fields["type"].lower())
    if code is None:
        raise CaptureError(f"'{path}' has the type '{fields['type']}'; give integers or floats.")
    order = {"little": "<", "big": ">"}.get(fields.get("endian", "").lower())
    if order is None:
        if not code.endswith("1") and encoding != "text":
            raise CaptureError(f"The NRRD header of '{path}' has no valid 'endian' field; get the file anew.")
        order = "<"
    return np.dtype(order + code)


def _spacing(path: Path, fields: dict[str, str]) -> tuple[float, float, float]:
    if "spacings" in fields:
        return parse_spacing(fields["spacings"].split(), path)
    if "spacedirections" not in fields:
        return (1.0, 1.0, 1.0)
    vectors = re.findall(r"\(([^)]*)\)", fields["spacedirections"])
    try:
        lengths = [math.hypot(*(float(v) for v in vector.split(","))) for vector in vectors]
    except ValueError:
        lengths = []
    return parse_spacing(lengths, path)


def _read_text(path: Path, start: int, shape: tuple[int, int, int], dtype: np.dtype) -> np.ndarray:
    # A number needs two bytes at least, but nobody writes more than 32.
    text = read_stream(path, "raw", start, 32 * math.prod(shape))
    return text_to_volume(text, shape, dtype, path)
