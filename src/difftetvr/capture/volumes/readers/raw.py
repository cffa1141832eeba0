"""Volumes in .raw files, described by arguments, by a .dat header or by their file name."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from difftetvr.capture.volumes.stored import Encoding, Stored, first_bytes
from difftetvr.capture.volumes.volume_file import (
    RawVolume,
    byte_count,
    parse_dtype,
    parse_shape,
    parse_spacing,
    to_volume,
)
from difftetvr.errors import CaptureError
from difftetvr.trust import file_beside

# "Format" of a .dat header, all little endian.
_DAT_FORMATS = {
    "UCHAR": "<u1",
    "BYTE": "<u1",
    "USHORT": "<u2",
    "SHORT": "<i2",
    "UINT": "<u4",
    "INT": "<i4",
    "FLOAT": "<f4",
    "DOUBLE": "<f8",
}
_NAME_PATTERN = re.compile(r"(\d+)x(\d+)x(\d+)_(u?int(?:8|16|32)|float(?:32|64))(?![0-9a-z])", re.IGNORECASE)
_ENCODINGS: dict[str, Encoding] = {".gz": "gzip", ".xz": "xz"}
_MAX_HEADER = 2**16


def read_raw(path: Path, shape: Sequence[int] | None, dtype: str | None) -> RawVolume:
    """Read a ``.raw``, ``.raw.gz`` or ``.raw.xz`` file.

    Args:
        path: The data.
        shape: (nx, ny, nz), or None to find it in a header or in the file's name.
        dtype: NumPy name of the values' type, or None likewise.

    Raises:
        CaptureError: The description is missing or does not fit the file, or the file cannot be read.
    """
    header = path.with_name(re.sub(r"\.raw(\.gz|\.xz)?$", "", path.name, flags=re.IGNORECASE) + ".dat")
    if shape is None and dtype is None and header.is_file():
        return _read_dat(header, path)
    match = _NAME_PATTERN.search(path.name)
    if shape is None and match:
        shape = [int(n) for n in match.groups()[:3]]
    if dtype is None and match:
        dtype = match.group(4).lower()
    if shape is None or dtype is None:
        missing = "shape" if shape is None else "dtype"
        raise CaptureError(
            f"What '{path}' holds is not known: give its {missing}, a .dat header, or a name like "
            "tooth_103x94x161_uint8.raw."
        )
    return RawVolume(_read_values(path, parse_shape(shape, path), parse_dtype(dtype, path)), (1.0, 1.0, 1.0))


def read_dat(path: Path) -> RawVolume:
    """Read the ``.raw`` file that a ``.dat`` header names.

    Raises:
        CaptureError: The header is damaged or names a file that is not beside it, or that file cannot be read.
    """
    return _read_dat(path, None)


def _read_values(path: Path, shape: tuple[int, int, int], dtype: np.dtype) -> np.ndarray:
    encoding = _ENCODINGS.get(path.suffix.lower(), "raw")
    return to_volume(Stored(path, encoding).read(byte_count(shape, dtype)), shape, dtype, path)


def _read_dat(header: Path, data: Path | None) -> RawVolume:
    try:
        text = first_bytes(header, _MAX_HEADER).decode()
    except UnicodeDecodeError:
        raise CaptureError(f"'{header}' is no text header of a volume (.dat).") from None
    pairs = (line.split(":", 1) for line in text.splitlines() if ":" in line)
    entries = {key.strip().lower(): value.strip() for key, value in pairs}
    missing = [key for key in ("ObjectFileName", "Resolution", "Format") if key.lower() not in entries]
    if missing:
        raise CaptureError(f"The header '{header}' has no '{missing[0]}:' line; add it.")
    data = data or file_beside(header, entries["objectfilename"], CaptureError)
    if not os.path.exists(data):
        raise CaptureError(f"The header '{header}' names the data file '{data}', which does not exist.")
    kind = entries["format"].upper()
    if kind not in _DAT_FORMATS:
        raise CaptureError(f"The header '{header}' has the format '{kind}'; known are {', '.join(_DAT_FORMATS)}.")
    shape = parse_shape(entries["resolution"].split(), header)
    spacing = parse_spacing(entries.get("slicethickness", "1 1 1").split(), header)
    return RawVolume(_read_values(data, shape, np.dtype(_DAT_FORMATS[kind])), spacing)
