"""Volumes in NRRD files (.nrrd, or .nhdr with detached data): raw, gzip, bzip2 and text encodings.

Source: the format's definition, https://teem.sourceforge.net/nrrd/format.html.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from difftetvr.capture.volumes.readers.detached import data_files
from difftetvr.capture.volumes.readers.nrrd_axes import axis_steps, spatial_axes
from difftetvr.capture.volumes.stored import AT_END, Encoding, Stored, behind_lines, first_bytes, read_parts
from difftetvr.capture.volumes.volume_file import (
    RawVolume,
    World,
    byte_count,
    parse_shape,
    parse_steps,
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
_ENCODINGS: dict[str, Encoding] = {"raw": "raw", "gzip": "gzip", "gz": "gzip", "bzip2": "bzip2", "bz2": "bzip2"}
_TEXT = ("txt", "text", "ascii")


def read_nrrd(path: Path) -> RawVolume:
    """Read a three-dimensional scalar NRRD volume.

    Raises:
        CaptureError: The file is damaged, no scalar volume in space, or of a type or encoding that is not supported.
    """
    fields, listed, header_size = _read_header(path)
    for key in ("type", "dimension", "sizes", "encoding"):
        if key not in fields:
            raise CaptureError(f"The NRRD header of '{path}' has no '{key}' field; get the file anew.")
    axes = spatial_axes(path, fields)
    sizes = fields["sizes"].split()
    shape = parse_shape([sizes[axis] for axis in axes], path)
    encoding = fields["encoding"].lower()
    if encoding not in _ENCODINGS and encoding not in _TEXT:
        raise CaptureError(f"'{path}' is encoded as '{fields['encoding']}'; save it as raw, gzip, bzip2 or text.")
    dtype = _dtype(path, fields, encoding)
    told = axis_steps(path, fields, axes)
    spacing, directions = (None, None) if told is None else parse_steps(told.steps, path)
    parts = _parts(path, fields, listed, header_size, shape)
    if encoding in _TEXT:
        text = b"\n".join(part.read_text(math.prod(shape) // len(parts)) for part in parts)
        values = text_to_volume(text, shape, dtype, path)
    else:
        values = to_volume(read_parts(parts, byte_count(shape, dtype), path), shape, dtype, path)
    notes, world = (told.notes, told.world) if told else ((), World())
    return RawVolume(values, spacing or (1.0, 1.0, 1.0), directions, notes, world)


def _read_header(path: Path) -> tuple[dict[str, str], list[str], int]:
    """Fields by name in lower case without spaces, listed data files, and the number of bytes up to the data."""
    start = first_bytes(path, _MAX_HEADER)
    if not start.startswith(b"NRRD000"):
        raise CaptureError(f"'{path}' does not start like an NRRD file; check the file.")
    end = re.search(rb"\r?\n\r?\n", start)
    # A detached header may end with the file instead of with an empty line.
    lines = start[: end.start() if end else len(start)].decode("latin-1").splitlines()[1:]
    fields: dict[str, str] = {}
    for number, line in enumerate(lines, 1):
        key, separator, value = line.partition(":")
        if line.startswith("#") or not separator or value.startswith("="):
            continue
        key, value = key.strip().lower().replace(" ", ""), value.strip()
        fields[key] = value
        if key == "datafile" and value.split()[:1] == ["LIST"]:
            return fields, [name.strip() for name in lines[number:] if name.strip()], len(start)
    return fields, [], end.end() if end else len(start)


def _parts(
    path: Path, fields: dict[str, str], listed: list[str], header_size: int, shape: tuple[int, int, int]
) -> list[Stored]:
    """The files that hold the data, each with what lies before them."""
    encoding = _ENCODINGS.get(fields["encoding"].lower(), "raw")
    lines, skip = _whole_number(path, fields, "lineskip"), _whole_number(path, fields, "byteskip")
    if lines < 0 or skip < AT_END or (skip == AT_END and fields["encoding"].lower() != "raw"):
        raise CaptureError(
            f"'{path}' skips {lines} lines and {skip} bytes before its data; only raw data can be found from the end, "
            "by -1 bytes."
        )
    if "datafile" not in fields:
        files, start = [path], header_size
    else:
        files, start = data_files(path, fields["datafile"], listed, shape), 0
    return [Stored(file, encoding, behind_lines(file, start, lines) if lines else start, skip) for file in files]


def _whole_number(path: Path, fields: dict[str, str], key: str) -> int:
    text = fields.get(key, "0")
    if not re.fullmatch(r"[+-]?\d{1,18}", text):
        raise CaptureError(f"The NRRD header of '{path}' has the {key} '{text[:40]}', which is no whole number.")
    return int(text)


def _dtype(path: Path, fields: dict[str, str], encoding: str) -> np.dtype:
    code = _CODES.get(fields["type"].lower())
    if code is None:
        raise CaptureError(f"'{path}' has the type '{fields['type']}'; give integers or floats.")
    order = {"little": "<", "big": ">"}.get(fields.get("endian", "").lower())
    if order is None:
        if not code.endswith("1") and encoding not in _TEXT:
            raise CaptureError(f"The NRRD header of '{path}' has no valid 'endian' field; get the file anew.")
        order = "<"
    return np.dtype(order + code)
