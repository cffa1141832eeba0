"""From values as files store them to the scalars in [0, 1] that transfer functions know."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from difftetvr.errors import CaptureError, counted


class Normalised(NamedTuple):
    """Values of a volume as scalars.

    Attributes:
        scalars: float32 in [0, 1], of the values' shape.
        value_range: Values that stand for 0 and 1.
        notes: What was chosen or changed, a sentence each.
    """

    scalars: np.ndarray
    value_range: tuple[float, float]
    notes: tuple[str, ...]


def normalise(values: np.ndarray, value_range: Sequence[float] | None, source: str | Path) -> Normalised:
    """Maps values linearly to [0, 1], in float64.

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
        low, high = 0.0, 255.0
    else:
        low, high = _range_of(values, source)
        if (low, high) != (0.0, 1.0):
            notes.append(
                f"'{source}': values {range_text((low, high))} stand for 0 to 1 of the transfer function; "
                "--value-range says otherwise."
            )
    scalars = np.empty(values.shape, dtype=np.float32)
    missing = outside = 0
    # The difference of two float64 may overflow, that of their halves does not.
    factor = 1.0 if math.isfinite(high - low) else 0.5
    for into, layer in zip(scalars, values):
        exact = layer.astype(np.float64)
        missing += int(np.isnan(exact).sum())
        outside += int(((exact < low) | (exact > high)).sum())
        with np.errstate(over="ignore"):
            exact = (factor * np.clip(exact, low, high) - factor * low) / (factor * high - factor * low)
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
    """Two finite numbers, the smaller first.

    Raises:
        CaptureError: They are not.
    """
    try:
        low, high = (float(value) for value in value_range)
    except (TypeError, ValueError, OverflowError):
        low, high = math.nan, math.nan
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise CaptureError(f"The range of values is {value_range}; give two finite numbers, the smaller first.")
    return low, high


def finite_values(values: np.ndarray) -> np.ndarray:
    """(n,) those values that are finite; all integers are."""
    return values[np.isfinite(values)] if values.dtype.kind == "f" else values.reshape(-1)


def range_text(value_range: tuple[float, float]) -> str:
    """A range in words: 0 to 4095."""
    return " to ".join(f"{value:.10g}" for value in value_range)


def _range_of(values: np.ndarray, source: str | Path) -> tuple[float, float]:
    ends = [(float(part.min()), float(part.max())) for layer in values if (part := finite_values(layer)).size]
    if not ends:
        raise CaptureError(f"No value of the volume '{source}' is finite; get the file anew.")
    low, high = min(end[0] for end in ends), max(end[1] for end in ends)
    if not low < high:
        raise CaptureError(
            f"All values of the volume '{source}' are {low:.10g}; there is no range to see, unless --value-range "
            "(value_range) gives one."
        )
    return low, high
