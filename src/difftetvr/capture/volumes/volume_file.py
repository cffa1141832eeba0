"""What the readers of volume files share: the values as stored, and checks against sizes that do not add up."""

from __future__ import annotations

import gzip
import lzma
import math
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from difftetvr.errors import CaptureError

_MAX_BYTES = 2**36


class RawVolume(NamedTuple):
    """A volume as a file stores it: (nz, ny, nx) values of any number type and spacing along (x, y, z)."""

    values: np.ndarray
    spacing: tuple[float, float, float]


def parse_shape(numbers: Sequence[int | str], source: str | Path) -> tuple[int, int, int]:
    """Three positive integers (nx, ny, nz).

    Raises:
        CaptureError: They are not.
    """
    try:
        shape = tuple(int(n) for n in numbers)
    except ValueError:
        shape = ()
    if len(shape) != 3 or min(shape) < 1:
        given = " ".join(str(n) for n in numbers)
        raise CaptureError(f"'{source}' gives the resolution '{given}'; it needs three positive whole numbers.")
    return shape


def parse_spacing(numbers: Sequence[float | str], source: str | Path) -> tuple[float, float, float]:
    """Three positive finite numbers.

    Raises:
        CaptureError: They are not.
    """
    try:
        spacing = tuple(float(n) for n in numbers)
    except ValueError:
        spacing = ()
    if len(spacing) != 3 or not all(math.isfinite(s) and s > 0 for s in spacing):
        given = " ".join(str(n) for n in numbers)
        raise CaptureError(f"'{source}' gives the sample distances '{given}'; it needs three positive numbers.")
    return spacing


def parse_dtype(name: str, source: str | Path) -> np.dtype:
    """An integer or floating-point type from its NumPy name.

    Raises:
        CaptureError: The name is unknown or of another kind of type.
    """
    try:
        dtype = np.dtype(name)
    except (TypeError, ValueError, SyntaxError):
        dtype = np.dtype(object)
    if dtype.kind not in "uif":
        raise CaptureError(f"'{name}' for '{source}' is no number type; use uint8, uint16, int16, float32 or float64.")
    return dtype


def byte_count(shape: tuple[int, int, int], dtype: np.dtype, source: str | Path) -> int:
    """Bytes that a volume occupies.

    Raises:
        CaptureError: More than any volume that can be rendered.
    """
    count = math.prod(shape) * dtype.itemsize
    if count > _MAX_BYTES:
        size = " x ".join(str(n) for n in shape)
        raise CaptureError(f"'{source}' claims {size} samples, too many to render; crop the volume or check the file.")
    return count


def read_stream(path: Path, encoding: str, start: int, count: int) -> bytes:
    """Read ``count`` decoded bytes, or up to one more, so that the caller can tell a file that is too long.

    Args:
        path: File to read.
        encoding: ``raw``, ``gzip`` or ``xz``.
        start: Encoded bytes to leave out at the beginning.
        count: Decoded bytes that are expected.

    Raises:
        CaptureError: The file cannot be read or decoded.
    """
    try:
        with path.open("rb") as file:
            file.seek(start)
            if encoding == "gzip":
                with gzip.GzipFile(fileobj=file, mode="rb") as unpacked:
                    return unpacked.read(count + 1)
            if encoding == "xz":
                with lzma.LZMAFile(file) as expanded:
                    return expanded.read(count + 1)
            return file.read(count + 1)
    except (EOFError, zlib.error, lzma.LZMAError, gzip.BadGzipFile):
        raise CaptureError(f"The {encoding} data of '{path}' is damaged or cut short; get the file anew.") from None
    except OSError as error:
        raise CaptureError(f"Cannot read '{path}': {error.strerror or error}.") from None


def text_to_volume(text: str | bytes, shape: tuple[int, int, int], dtype: np.dtype, source: str | Path) -> np.ndarray:
    """(nz, ny, nx) values in native byte order from exactly as many decimal numbers, separated by white space.

    Raises:
        CaptureError: There are fewer or more, something else, or integers that the type cannot hold.
    """
    try:
        values = np.array(text.split(), dtype=np.float64)
    except ValueError:
        raise CaptureError(f"The text in '{source}' holds something else than numbers; get the file anew.") from None
    if values.size != math.prod(shape):
        raise CaptureError(
            f"'{source}' holds {values.size} numbers where its header says {math.prod(shape)}; get the file anew."
        )
    if dtype.kind in "ui":
        limits = np.iinfo(dtype)
        if not ((values >= limits.min) & (values <= limits.max)).all():
            raise CaptureError(f"'{source}' holds numbers outside the range of its type {dtype.name}; correct either.")
    return values.astype(dtype.newbyteorder("=")).reshape(shape[::-1])


def to_volume(data: bytes, shape: tuple[int, int, int], dtype: np.dtype, source: str | Path) -> np.ndarray:
    """(nz, ny, nx) values in native byte order from exactly as many bytes as they need.

    Raises:
        CaptureError: There are fewer or more bytes.
    """
    expected = byte_count(shape, dtype, source)
    if len(data) != expected:
        size = " x ".join(str(n) for n in shape)
        amount = f"only {len(data)}" if len(data) < expected else "more"
        raise CaptureError(
            f"'{source}' holds {amount} bytes where {size} samples of {dtype.name} need {expected}; "
            "check the resolution and the type, or get the file anew."
        )
    values = np.frombuffer(data, dtype=dtype).reshape(shape[::-1])
    return values.astype(dtype.newbyteorder("="), copy=False)
