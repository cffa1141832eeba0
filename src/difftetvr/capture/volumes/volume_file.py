"""What the readers of volume files share: the values as stored, and checks of what headers and files say."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from difftetvr.capture.volumes.stored import require_memory
from difftetvr.errors import CaptureError, shown

_SHORTEST_PRINTED = 60
# Bytes of text that are parsed at once: as Python objects, numbers take ten times the room.
_TEXT_BLOCK = 2**22


class World(NamedTuple):
    """Where a volume lies in the world of its file.

    Attributes:
        origin: Place of the first sample, in the unit of the distances of samples; 0 where the file does not tell.
        space: What the world's axes are, as NRRD calls it, such as "left-posterior-superior"; empty where the file does
            not tell.
        unit: Unit of length, as the file calls it; empty where it does not tell.
    """

    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    space: str = ""
    unit: str = ""


class RawVolume(NamedTuple):
    """A volume as a file stores it.

    Attributes:
        values: (nz, ny, nx) values of any number type; x, y and z are the file's axes, x the fastest.
        spacing: Distance of neighbouring samples along (x, y, z), > 0.
        directions: (3, 3) float64, row a is the unit vector in a right-handed world along which the file's axis a
            (0 for x) runs; None where the file's axes are the world's.
        notes: What a reader chose or passed over, a sentence each.
        world: Where the samples lie in a right-handed world.
    """

    values: np.ndarray
    spacing: tuple[float, float, float]
    directions: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    world: World = World()


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
        raise CaptureError(
            f"'{source}' gives the resolution '{_joined(numbers)}'; it needs three positive whole numbers."
        )
    return shape


def parse_spacing(numbers: Sequence[float | str], source: str | Path) -> tuple[float, float, float]:
    """Three positive finite numbers.

    Raises:
        CaptureError: They are not.
    """
    spacing = parse_numbers(numbers)
    if len(spacing) != 3 or not all(math.isfinite(s) and s > 0 for s in spacing):
        raise CaptureError(
            f"'{source}' gives the sample distances '{_joined(numbers)}'; it needs three positive numbers."
        )
    return spacing[0], spacing[1], spacing[2]


def parse_steps(steps: Sequence[Sequence[float]], source: str | Path) -> tuple[tuple[float, float, float], np.ndarray]:
    """Spacing and directions of a grid.

    Args:
        steps: For each of the file's axes x, y, z the vector in the world from a sample to the next.
        source: The file, for the sentence.

    Returns:
        ``spacing`` and ``directions`` of a `RawVolume`.

    Raises:
        CaptureError: They are not three vectors of three finite numbers that differ from 0.
    """
    lengths = [math.hypot(*step) for step in steps]
    if [len(step) for step in steps] != [3, 3, 3] or not all(math.isfinite(n) and n > 0 for n in lengths):
        given = _joined([f"({_joined(step)})" for step in steps])
        raise CaptureError(f"'{source}' gives the axes '{given}'; it needs three vectors that differ from 0.")
    return (lengths[0], lengths[1], lengths[2]), np.array(steps, dtype=np.float64) / np.array(lengths)[:, None]


def parse_origin(numbers: Sequence[float]) -> tuple[float, float, float]:
    """The first three numbers; all 0 where there are fewer, or one is not finite, so that the file tells no place."""
    if len(numbers) < 3 or not all(math.isfinite(x) for x in numbers[:3]):
        return 0.0, 0.0, 0.0
    return numbers[0], numbers[1], numbers[2]


def parse_numbers(words: Sequence[float | str]) -> list[float]:
    """Floats; an empty list where one of the words is no number."""
    try:
        return [float(word) for word in words]
    except (ValueError, OverflowError):
        return []


def parse_dtype(name: str, source: str | Path) -> np.dtype:
    """An integer or floating-point type from its NumPy name.

    Raises:
        CaptureError: The name is unknown or of another kind of type.
    """
    try:
        dtype = np.dtype(name)
    except (TypeError, ValueError, SyntaxError, RuntimeError, OverflowError):
        dtype = np.dtype(object)
    if dtype.kind not in "uif" or dtype.itemsize > 8:
        raise CaptureError(f"{shown(name)} for '{source}' is no number type; use uint8, int16, uint16, float32, ....")
    return dtype


def byte_count(shape: Sequence[int], dtype: np.dtype) -> int:
    """Bytes that a volume occupies."""
    return math.prod(shape) * dtype.itemsize


def text_to_volume(text: str | bytes, shape: tuple[int, int, int], dtype: np.dtype, source: str | Path) -> np.ndarray:
    """(nz, ny, nx) values in native byte order from exactly as many decimal numbers, separated by white space.

    Raises:
        CaptureError: There are fewer or more, something else, or integers that the type cannot hold.
    """
    data = text.encode() if isinstance(text, str) else text
    try:
        blocks = [_numbers(block.split(), dtype) for block in _text_blocks(data)]
    except ValueError:
        raise CaptureError(f"The text in '{source}' holds something else than numbers; get the file anew.") from None
    values = np.concatenate(blocks) if blocks else np.empty(0)
    if values.size != math.prod(shape):
        raise CaptureError(
            f"'{source}' holds {values.size} numbers where its header says {math.prod(shape)}; it is damaged or cut "
            "short, so get the file anew."
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
    expected = byte_count(shape, dtype)
    if len(data) != expected:
        size = " x ".join(str(n) for n in shape)
        amount = f"only {len(data)}" if len(data) < expected else "more"
        raise CaptureError(
            f"'{source}' holds {amount} bytes where {size} samples of {dtype.name} need {expected}; "
            "check the resolution and the type, or get the file anew if it is damaged."
        )
    values = np.frombuffer(data, dtype=dtype).reshape(shape[::-1])
    return values.astype(dtype.newbyteorder("="), copy=False)


def scaled(values: np.ndarray, slope: float, offset: float, source: Path) -> np.ndarray:
    """What stored values stand for, slope times each plus offset, in float64; as they are where that changes nothing.

    Raises:
        CaptureError: There is not enough memory.
    """
    if (slope, offset) == (1.0, 0.0):
        return values
    require_memory(source, 8 * values.size)
    with np.errstate(over="ignore"):
        return values * np.float64(slope) + np.float64(offset)


def three_axes(shape: Sequence[int], source: str | Path) -> tuple[int, int, int]:
    """The shape of an array, if it is that of a volume of scalars.

    Raises:
        CaptureError: There are more or fewer axes than three, or one without samples.
    """
    if len(shape) != 3 or min(shape) < 1:
        sizes = " x ".join(str(n) for n in shape)
        raise CaptureError(
            f"'{source}' has {len(shape)} dimensions of {sizes} values; give a scalar volume with 3, such as one time "
            "step or one channel of it."
        )
    return shape[0], shape[1], shape[2]


def _text_blocks(data: bytes) -> Iterator[bytes]:
    """Parts of a text of numbers that are cut between these."""
    start = 0
    while start < len(data):
        end = start + _TEXT_BLOCK
        while end < len(data) and not data[end : end + 1].isspace():
            end += 1
        yield data[start:end]
        start = end


def _numbers(words: list[bytes], dtype: np.dtype) -> np.ndarray:
    """Numbers in float64, but integers that it may round as what they are, if they are written as such."""
    if dtype.kind in "ui" and dtype.itemsize == 8:
        with suppress(ValueError, OverflowError):
            return np.array([int(word) for word in words], dtype=dtype.newbyteorder("="))
    return np.array(words, dtype=np.float64)


def _joined(words: Sequence[float | str]) -> str:
    text = " ".join(str(word) for word in words)
    return text if len(text) <= _SHORTEST_PRINTED else text[:_SHORTEST_PRINTED] + "..."
