"""Volumes as numbers in space: what projections are made from, and what reconstructions are compared with."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from difftetvr.capture.volumes.value_range import normalise, range_text
from difftetvr.capture.volumes.volume import load_raw
from difftetvr.declared import require_value
from difftetvr.errors import CaptureError, CaptureWarning


@dataclass(frozen=True, eq=False)
class VoxelVolume:
    """Scalars at the middles of voxels.

    Attributes:
        values: (X, Y, Z) float32.
        spacing: Distances of neighbouring samples along x, y and z, in the file's unit.
        unit: Of length, as the file calls it; empty where it does not tell.
        name: Of the file.
    """

    values: torch.Tensor
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    unit: str = ""
    name: str = "volume"

    @property
    def extent(self) -> tuple[float, float, float]:
        """Lengths of the box that the outer faces of the voxels bound, along x, y and z."""
        x, y, z = (count * step for count, step in zip(self.values.shape, self.spacing))
        return x, y, z


def load_volume(
    path: str | Path,
    shape: Sequence[int] | None = None,
    dtype: str | None = None,
    value_range: Sequence[float] | None = None,
) -> VoxelVolume:
    """Read a volume's values in the order of the world's axes.

    Floats are what the file holds. Integers stand for [0, 1], as for `Volume.load`: 0 and 255 of uint8, the least and
    the greatest value of other types, unless ``value_range`` tells which.

    Args:
        path: Any file that `Volume.load` reads.
        shape: (nx, ny, nz) of a ``.raw`` file, x fastest.
        dtype: NumPy name of a ``.raw`` file's values.
        value_range: Values that stand for 0 and 1, of floats, too; others are clamped.

    Raises:
        CaptureError: The file is missing, damaged or of an unknown kind, or holds values that are not finite.

    Warns:
        CaptureWarning: Values were scaled or clamped, or a reader had to choose.
    """
    try:
        raw = load_raw(path, shape, dtype)
        values, notes = raw.values, list(raw.notes)
        if values.dtype.kind == "f" and value_range is None:
            with np.errstate(over="ignore"):
                scalars = np.asarray(values, dtype=np.float32)
            if not np.isfinite(scalars).all():
                raise CaptureError(f"'{path}' holds values that are not finite numbers of 32 bits; replace them first.")
        else:
            if value_range is not None:
                value_range = require_value(value_range, tuple[float, float], "value_range", CaptureError)
            scalars, ends, more = normalise(values, value_range, path)
            if value_range is None and tuple(ends) != (0, 1):
                note = f"'{path}': values {range_text(ends)} stand for 0 to 1; value_range says otherwise."
                more = (note, *(other for other in more if "transfer function" not in other))
            notes += more
        ordered = torch.from_numpy(np.ascontiguousarray(scalars.transpose(2, 1, 0)))
    except MemoryError as error:
        raise CaptureError(f"The volume '{path}' needs more memory than there is; crop or shrink it.") from error
    for note in notes:
        warnings.warn(note, CaptureWarning, stacklevel=2)
    return VoxelVolume(ordered, raw.spacing, raw.world.unit, Path(path).name)
