"""Volumes in .raw files, described by arguments, by a .dat header or by their file name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from difftetvr.capture.volumes.volume_file import (
    RawVolume,
    byte_count,
    parse_dtype,
    parse_shape,
    parse_spacing,
    read_stream,
    to_volume,
)
from difftetvr.errors import CaptureError

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
_ENCODINGS = {".gz": "gzip", ".xz": "xz"}


def read_raw(path: Path, shape: Sequence[int] | None, dtype: str | None) -> RawVolume:
    """Read a ``.raw``, ``.raw.gz`` or ``.raw.xz`` file, or the one that a ``.dat`` header names.

    Args:
        path: The data or the ``.dat`` header.
        shape: (nx, ny, nz), or None to find it in a header or in the file's name.
        dtype: NumPy name of the values' type, or None likewise.

    Raises:
        CaptureError: The description is missing or does not fit the file, or the file cannot be read.
    """
    if path.suffix.lower() == ".dat":
        if shape is not None or dtype is not None:
            raise CaptureError(f"'{path}' says itself what it holds; leave out the shape and the dtype.")
        return _read_dat(path)
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


def _read_values(path: Path, shape: tuple[int, int, int], dtype: np.dtype) -> np.ndarray:
    encoding = _ENCODINGS.get(path.suffix.lower(), "raw")
    return to_volume(read_stream(path, encoding, 0, byte_count(shape, dtype, path)), shape, dtype, path)


def _read_dat(header: Path, data: Path | None = None) -> RawVolume:
    try:
        text = header.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise CaptureError(f"'{header}' is no text header of a volume (.dat).") from None
    except OSError as error:
        raise CaptureError(f"Cannot read '{header}': {error.strerror or error}.") from None
    pairs = (line.split(":", 1) for line in text.splitlines() if ":" in line)
    entries = {key.strip().lower(): value.strip() for key, value in pairs}
    missing = [key for key in ("ObjectFileName", "Resolution", "Format") if key.lower() not in entries]
    if missing:
        raise CaptureError(f"The header '{header}' has no '{missing[0]}:' line; add it.")
    data = data or header.parent / entries["objectfilename"]
    if not data.is_file():
        raise CaptureError(f"The header '{header}' names the data file '{data}', which does not exist.")
    kind = entries["format"].upper()
    if kind not in _DAT_FORMATS:
        raise CaptureError(f"The header '{header}' has the format '{kind}'; known are {', '.join(_DAT_FORMATS)}.")
    shape = parse_shape(entries["resolution"].split(), header)
    spacing = parse_spacing(entries.get("slicethickness", "1 1 1").split(), header)
    return RawVolume(_read_values(data, shape, np.dtype(_DAT_FORMATS[kind])), spacing)
