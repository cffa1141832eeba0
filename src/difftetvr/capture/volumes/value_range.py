"""From values as files store them to the scalars in [0, 1] that transfer functions know."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np

from difftetvr.errors import CaptureError, counted, shown


class Normalised(NamedTuple):
    """Values of a volume as scalars.

    Attributes:
        scalars: float32 in [0, 1], of the values' shape.
        value_range: Values that stand for 0 and 1; whole numbers stay such, which float64 would round.
        notes: What was chosen or changed, a sentence each.
    """

    scalars: np.ndarray
    value_range: tuple[float, float]
    notes: tuple[str, ...]


def normalise(values: np.ndarray, value_range: Sequence[float] | None, source: str | Path) -> Normalised:
    """Maps values linearly to [0, 1], in float64; from integers that it cannot hold, the least value is taken before.

    Args:
        values: (nz, ny, nx) integers or floats.
        value_range: Values that stand for 0 and 1; None: 0 and 255 for uint8, else the least and the greatest one.
        source: The file, for the sentences.

    Raises:
        CaptureError: The range is not valid, or all values are the same or not finite, so that there is none.
    """
    notes = []
    if value_range is not None:
        low, high = checked_range(value_range)
    elif values.dtype == np.uint8:
        low, high = 0, 255
    else:
        low, high = _range_of(values, source)
        if (low, high) != (0, 1):
            notes.append(
                f"'{source}': values {range_text((low, high))} stand for 0 to 1 of the transfer function; "
                "--value-range says otherwise."
            )
    scalars = np.empty(values.shape, dtype=np.float32)
    missing = outside = 0
    base = _base(values.dtype, low)
    start, end = _less(low, base), _less(high, base)
    # The difference of two float64 may overflow, that of their halves does not.
    factor = 1.0 if math.isfinite(end - start) else 0.5
    for into, layer in zip(scalars, values):
        exact = _layer_less(layer, base)
        missing += int(np.isnan(exact).sum())
        outside += int(((exact < start) | (exact > end)).sum())
        with np.errstate(over="ignore"):
            exact = (factor * np.clip(exact, start, end) - factor * start) / (factor * end - factor * start)
        into[...] = np.nan_to_num(exact, nan=0.0)
    if missing:
        verb = "is" if missing == 1 else "are"
        notes.append(f"{counted(missing, 'value')} of '{source}' {verb} not a number (NaN), taken for the least one.")
    if outside:
        notes.append(
            f"{outside:,} of {counted(values.size, 'value')} of '{source}' lie outside of the range "
            f"{range_text((low, high))} and are taken for its ends."
        )
    return Normalised(scalars, (low, high), tuple(notes))


def checked_range(value_range: Sequence[float]) -> tuple[float, float]:
    """Two finite numbers, the smaller first; whole ones stay such.

    Raises:
        CaptureError: They are not.
    """
    try:
        low, high = (int(value) if isinstance(value, int | np.integer) else float(value) for value in value_range)
        is_valid = math.isfinite(low) and math.isfinite(high) and low < high
    except (TypeError, ValueError, OverflowError, RuntimeError):
        is_valid = False
    if not is_valid:
        raise CaptureError(f"The range of values is {shown(value_range)}; give two finite numbers, the smaller first.")
    return low, high


def finite_values(values: np.ndarray) -> np.ndarray:
    """(n,) those values that are finite; all integers are."""
    return values[np.isfinite(values)] if values.dtype.kind == "f" else values.reshape(-1)


def range_text(value_range: tuple[float, float]) -> str:
    """A range in words: 0 to 4095."""
    return " to ".join(str(value) if isinstance(value, int) else f"{value:.10g}" for value in value_range)


def _range_of(values: np.ndarray, source: str | Path) -> tuple[float, float]:
    if (ends := ends_of(values)) is None:
        raise CaptureError(f"No value of the volume '{source}' is finite; get the file anew.")
    if not ends[0] < ends[1]:
        raise CaptureError(
            f"All values of the volume '{source}' are {ends[0]:.10g}; there is no range to see, unless --value-range "
            "(value_range) gives one."
        )
    return ends


def ends_of(values: np.ndarray) -> tuple[float, float] | None:
    """The least and the greatest finite value, whole numbers of integers; None if there is none.

    Args:
        values: (nz, ny, nx) integers or floats.
    """
    ends = [(part.min().item(), part.max().item()) for layer in values if (part := finite_values(layer)).size]
    return (min(end[0] for end in ends), max(end[1] for end in ends)) if ends else None


def _base(dtype: np.dtype, low: float) -> int | None:
    """What to count integers from that float64 may round; None where it holds all values as they are."""
    if dtype.kind not in "iu" or dtype.itemsize < 8:
        return None
    limits = np.iinfo(dtype)
    return min(max(math.floor(low), limits.min), limits.max)


def _less(value: float, base: int | None) -> float:
    return float(value) if base is None else float(Fraction(value) - base)


def _layer_less(layer: np.ndarray, base: int | None) -> np.ndarray:
    """A layer in float64, less the base, which is taken before anything is rounded."""
    if base is None:
        return layer.astype(np.float64)
    # Differences of 64 bits are right modulo 2^64, which is all that those of one sign need.
    above = layer.astype(np.uint64) - np.uint64(base % 2**64)
    return np.where(layer >= base, above.astype(np.float64), -(np.uint64(0) - above).astype(np.float64))
