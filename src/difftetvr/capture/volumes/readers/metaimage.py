"""Volumes in MetaImage files (.mha, or .mhd with detached data), as ITK writes them.

Read here and not by ITK, which opens whatever file a header names and takes the memory that it announces.

Source: https://itk.org/Wiki/ITK/MetaIO/Documentation.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from difftetvr.capture.volumes.readers.detached import data_files
from difftetvr.capture.volumes.stored import AT_END, Stored, first_bytes, read_parts
from difftetvr.capture.volumes.volume_file import (
    RawVolume,
    World,
    byte_count,
    parse_numbers,
    parse_origin,
    parse_shape,
    parse_steps,
    scaled,
    text_to_volume,
    to_volume,
)
from difftetvr.errors import CaptureError

_MAX_HEADER = 2**20
_TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_LONG": "i4",
    "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
# Names that one thing has had in the course of the years, the newest first.
_DIRECTIONS = ("transformmatrix", "rotation", "orientation")
_ORIGIN = ("offset", "position", "origin")
_SPACING = ("elementspacing", "elementsize")
_SPACE = "left-posterior-superior"  # as ITK takes it
_BYTE_ORDER = ("elementbyteordermsb", "binarydatabyteordermsb")


def read_metaimage(path: Path) -> RawVolume:
    """Read a three-dimensional scalar image.

    Raises:
        CaptureError: The file is damaged, holds something else than one scalar volume, or names files elsewhere.
    """
    fields, listed, header_size = _read_header(path)
    for key, label in (("dimsize", "DimSize"), ("elementtype", "ElementType"), ("elementdatafile", "ElementDataFile")):
        if key not in fields:
            raise CaptureError(f"The MetaImage header of '{path}' has no '{label}'; get the file anew.")
    dtype = _dtype(path, fields)
    sizes = fields["dimsize"].split()
    while len(sizes) > 3 and sizes[-1] == "1":
        sizes.pop()
    channels = fields.get("elementnumberofchannels", "1")
    if len(sizes) != 3 or channels != "1":
        raise CaptureError(
            f"'{path}' has {len(sizes)} dimensions and {channels[:20]} channels; give a scalar volume with 3 "
            "dimensions, such as one channel or one time step of it."
        )
    shape = parse_shape(sizes, path)
    spacing, directions = parse_steps(_steps(fields), path)
    scale = _scale(path, fields)
    parts = _parts(path, fields, listed, header_size, shape)
    if _is_true(fields, "binarydata", default="true"):
        values = to_volume(read_parts(parts, byte_count(shape, dtype), path), shape, dtype, path)
    else:
        text = b"\n".join(part.read_text(math.prod(shape) // len(parts)) for part in parts)
        values = text_to_volume(text, shape, dtype, path)
    world = World(parse_origin(parse_numbers(_first(fields, _ORIGIN, "").split())), _SPACE)
    return RawVolume(scaled(values, *scale, path), spacing, directions, world=world)


def _read_header(path: Path) -> tuple[dict[str, str], list[str], int]:
    """Fields by name in lower case, listed data files, and the number of bytes up to the data."""
    lines = first_bytes(path, _MAX_HEADER).splitlines(keepends=True)
    fields: dict[str, str] = {}
    size = 0
    for number, line in enumerate(lines, 1):
        key, separator, value = line.decode("latin-1").partition("=")
        size += len(line)
        if not separator:
            break
        fields[key.strip().lower()] = value.strip()
        if key.strip().lower() == "elementdatafile":
            return fields, [name.decode("latin-1").strip() for name in lines[number:] if name.strip()], size
    return fields, [], size


def _parts(
    path: Path, fields: dict[str, str], listed: list[str], header_size: int, shape: tuple[int, int, int]
) -> list[Stored]:
    """The files that hold the data, each with what lies before them."""
    value = fields["elementdatafile"]
    is_local = value.upper() == "LOCAL"
    files = [path] if is_local else data_files(path, value, listed, shape)
    if _is_true(fields, "compresseddata"):
        return [Stored(file, "zlib", start=header_size if is_local else 0) for file in files]
    try:
        skip = int(fields.get("headersize", "0"))
    except ValueError:
        skip = AT_END - 1
    if skip < AT_END:
        raise CaptureError(f"The MetaImage header of '{path}' has no valid 'HeaderSize'; correct it.")
    return [Stored(file, start=header_size if is_local else 0, skip=skip) for file in files]


def _dtype(path: Path, fields: dict[str, str]) -> np.dtype:
    kind = fields["elementtype"].upper()
    if kind not in _TYPES:
        raise CaptureError(f"'{path}' has the element type '{kind[:40]}'; give integers or floats of one component.")
    return np.dtype((">" if any(_is_true(fields, key) for key in _BYTE_ORDER) else "<") + _TYPES[kind])


def _steps(fields: dict[str, str]) -> list[list[float]]:
    """From a sample to the next along each axis in the world; an empty list where the header does not tell."""
    spacing = parse_numbers(_first(fields, _SPACING, "1 1 1").split())
    # A row for each axis.
    matrix = parse_numbers(_first(fields, _DIRECTIONS, "1 0 0 0 1 0 0 0 1").split())
    if len(spacing) < 3 or len(matrix) not in (9, len(spacing) ** 2):
        return []
    width = math.isqrt(len(matrix))
    return [[spacing[axis] * matrix[width * axis + k] for k in range(3)] for axis in range(3)]


def _scale(path: Path, fields: dict[str, str]) -> tuple[float, float]:
    """Slope and offset from the stored values to those that are meant, such as Hounsfield units."""
    found = []
    for name, default, least in (("Slope", "1", math.ulp(0.0)), ("Offset", "0", 0.0)):
        text = fields.get(f"elementtointensityfunction{name.lower()}", default)
        number = (parse_numbers([text]) or [math.nan])[0]
        if not least <= abs(number) < math.inf:
            what = f"ElementToIntensityFunction{name} '{text[:40]}'"
            raise CaptureError(f"The MetaImage header of '{path}' has the {what}, which is no number it can be.")
        found.append(number)
    return found[0], found[1]


def _first(fields: dict[str, str], names: tuple[str, ...], default: str) -> str:
    return next((fields[name] for name in names if name in fields), default)


def _is_true(fields: dict[str, str], key: str, default: str = "false") -> bool:
    return fields.get(key, default).lower()[:1] in ("t", "1")
