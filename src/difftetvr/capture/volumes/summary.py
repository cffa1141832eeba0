"""What there is to know of a volume before it is seen through a transfer function."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from difftetvr.capture.volumes.value_range import checked_range, ends_of, finite_values
from difftetvr.capture.volumes.volume import load_raw
from difftetvr.capture.volumes.volume_file import parse_spacing
from difftetvr.errors import CaptureWarning

# More values are counted in part only: quantiles of a sample this large are exact to three digits.
_MOST_SORTED = 2**22


@dataclass(frozen=True)
class VolumeSummary:
    """A volume in numbers.

    Attributes:
        resolution: Number of samples (nx, ny, nz).
        spacing: Distance of neighbouring samples along (x, y, z).
        dtype: Name of the type of the values, as stored.
        missing: Values that are not finite.
        ends: The least and the greatest finite value; None if there is none.
        quantiles: Finite values below which a share of them lies, by share.
        value_range: Values that stand for 0 and 1 of a transfer function; None where all are the same.
    """

    resolution: tuple[int, int, int]
    spacing: tuple[float, float, float]
    dtype: str
    missing: int
    ends: tuple[float, float] | None
    quantiles: dict[float, float]
    value_range: tuple[float, float] | None


def summarise(
    path: str | Path,
    shape: Sequence[int] | None = None,
    dtype: str | None = None,
    spacing: Sequence[float] | None = None,
    value_range: Sequence[float] | None = None,
    shares: Sequence[float] = (0.01, 0.25, 0.5, 0.75, 0.99),
) -> VolumeSummary:
    """Describes a volume, one of which nothing can be seen, too.

    Args:
        path: As for `Volume.load`, and so are the next four.
        shape: (nx, ny, nz) of a ``.raw`` file.
        dtype: NumPy name of the type of its values.
        spacing: Distances of samples; overrides the file's.
        value_range: Values that stand for 0 and 1.
        shares: Of the quantiles, in [0, 1].

    Raises:
        CaptureError: The file cannot be read.

    Warns:
        CaptureWarning: A reader had to choose.
    """
    raw = load_raw(path, shape, dtype)
    for note in raw.notes:
        warnings.warn(note, CaptureWarning, stacklevel=2)
    values = finite_values(raw.values)
    ends = ends_of(raw.values)
    sample = values[:: max(1, -(-values.size // _MOST_SORTED))].astype(np.float64)
    stands: tuple[float, float] | None
    if value_range is not None:
        stands = checked_range(value_range)
    elif raw.values.dtype == np.uint8:
        stands = (0, 255)
    else:
        stands = ends if ends is not None and ends[0] < ends[1] else None
    nz, ny, nx = raw.values.shape
    return VolumeSummary(
        resolution=(nx, ny, nz),
        spacing=raw.spacing if spacing is None else parse_spacing(spacing, path),
        dtype=raw.values.dtype.name,
        missing=raw.values.size - values.size,
        ends=ends,
        quantiles=dict(zip(shares, np.quantile(sample, shares).tolist())) if sample.size else {},
        value_range=stands,
    )
