"""Scalar volumes on regular grids: the values, where they lie in space, and reading them from files."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from difftetvr.capture.volumes.orientation import in_world_axes
from difftetvr.capture.volumes.readers.table import is_volume_file as is_volume_file
from difftetvr.capture.volumes.readers.table import read_volume
from difftetvr.capture.volumes.value_range import normalise
from difftetvr.capture.volumes.volume_file import RawVolume
from difftetvr.declared import require_declared, require_value
from difftetvr.errors import CaptureError, CaptureWarning, shown
from difftetvr.inputs import require_type

# Samples are indexed with 32 bits in records of four values.
MAX_SAMPLES = 2**30


@dataclass(frozen=True, eq=False)
class Volume:
    """A scalar field sampled on a regular grid, trilinear between the samples.

    The box spans from the centres of the first to those of the last samples, is centred at the origin, and its longest
    side has length 1, whatever unit ``spacing`` has.

    Attributes:
        values: (nz, ny, nx) float32 scalars, x fastest; in [0, 1] when the volume was loaded from a file.
        spacing: Distance of neighbouring samples along (x, y, z), in any unit, > 0.
        name: What to call it, for messages.
        value_range: What the file held where the scalars are 0 and 1.

    Raises:
        CaptureError: An axis has fewer than two samples, a value is not finite, or the spacing is not positive.
    """

    values: np.ndarray
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    name: str = "volume"
    value_range: tuple[float, float] = (0.0, 1.0)

    def __post_init__(self) -> None:
        require_declared(self, CaptureError, "volume's ", ("spacing", "name", "value_range"))
        values = _numbers(self.values, self.name)
        object.__setattr__(self, "values", values)
        if values.ndim != 3 or min(values.shape) < 2:
            raise CaptureError(
                f"The volume '{self.name}' has shape {values.shape[::-1]}; give at least 2 samples along 3 axes."
            )
        if values.size > MAX_SAMPLES:
            raise CaptureError(
                f"The volume '{self.name}' has {values.size} samples, more than {MAX_SAMPLES}; crop or shrink it."
            )
        if len(self.spacing) != 3 or not all(math.isfinite(s) and s > 0 for s in self.spacing):
            raise CaptureError(f"The volume '{self.name}' has the spacing {self.spacing}; give three positive numbers.")
        if not np.isfinite(values).all():
            raise CaptureError(f"The volume '{self.name}' holds values that are not finite; replace them first.")

    @property
    def resolution(self) -> tuple[int, int, int]:
        """Number of samples (nx, ny, nz)."""
        nz, ny, nx = self.values.shape
        return nx, ny, nz

    @property
    def cell_size(self) -> np.ndarray:
        """(3,) float64 distance of neighbouring samples along x, y and z in world units."""
        extent = (np.array(self.resolution) - 1) * np.array(self.spacing, dtype=np.float64)
        return np.array(self.spacing, dtype=np.float64) / extent.max()

    @property
    def bounds(self) -> torch.Tensor:
        """(2, 3) float32 lower and upper corner of the box in world space."""
        half = 0.5 * (np.array(self.resolution) - 1) * self.cell_size
        return torch.tensor(np.stack([-half, half]), dtype=torch.float32)

    @staticmethod
    def load(
        path: str | Path,
        shape: Sequence[int] | None = None,
        dtype: str | None = None,
        spacing: Sequence[float] | None = None,
        value_range: Sequence[float] | None = None,
    ) -> Volume:
        """Read a volume, turn it to the world's axes and map its values to [0, 1].

        Exchanged and reversed axes of a file are put right, so that x, y and z are the world's as the file defines
        these ("Volumes in" in the manual).

        Args:
            path: ``.raw`` (also ``.raw.gz``, ``.raw.xz``), ``.dat``, ``.nrrd``, ``.nhdr``, ``.vti``, ``.mha``, ``.mhd``
                or ``.npy``, and with the extra ``volumes`` ``.nii``, ``.nii.gz``, ``.tif``, ``.tiff`` or a folder of
                ``.tif`` slices. What a ``.raw`` file holds is taken from ``shape`` and ``dtype``, else from a ``.dat``
                header of the same name beside it, else from its name, as in ``tooth_103x94x161_uint8.raw``.
            shape: (nx, ny, nz) of a ``.raw`` file, x fastest.
            dtype: NumPy name of a ``.raw`` file's values, e.g. ``uint8``, ``uint16``, ``>u2``, ``float32``.
            spacing: Distances of samples along (x, y, z) of the world; overrides the file's.
            value_range: Values that stand for 0 and 1; others are clamped. None: 0 and 255 for uint8, and for all other
                types the least and the greatest value.

        Raises:
            CaptureError: The file is missing, damaged, of another size than described, or of an unknown kind, or its
                values have no range.

        Warns:
            CaptureWarning: The range was taken from the values, values are clamped or not a number, or a reader had to
                choose; once for each.
        """
        if spacing is not None:
            spacing = require_value(spacing, tuple[float, float, float], "spacing", CaptureError)
        try:
            raw = load_raw(path, shape, dtype)
            scalars, ends, notes = normalise(raw.values, value_range, path)
        except MemoryError as error:
            raise CaptureError(f"The volume '{path}' needs more memory than there is; crop or shrink it.") from error
        for note in (*raw.notes, *notes):
            warnings.warn(note, CaptureWarning, stacklevel=2)
        chosen = raw.spacing if spacing is None else spacing
        return Volume(scalars, chosen, Path(path).name, ends)  # type: ignore[arg-type]


def _numbers(values: Any, name: str) -> np.ndarray:
    """Values as a contiguous array of float32."""
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "buif":
            raise TypeError
        return np.ascontiguousarray(array, dtype=np.float32)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise CaptureError(
            f"The values of the volume '{name}' are {shown(values)}; pass an array (nz, ny, nx) of numbers."
        ) from None


def load_raw(path: str | Path, shape: Sequence[int] | None, dtype: str | None) -> RawVolume:
    """A volume's values as its file stores them, in the order of the world's axes; arguments as for `Volume.load`.

    Raises:
        CaptureError: As for `Volume.load`.
    """
    require_type(path, (str, os.PathLike), "The path of the volume", "give the name of a file or folder", CaptureError)
    if shape is not None:
        shape = require_value(shape, tuple[int, int, int], "shape", CaptureError)
    raw = in_world_axes(read_volume(Path(path), shape, dtype), path)
    if raw.values.size > MAX_SAMPLES:
        raise CaptureError(f"'{path}' has {raw.values.size} samples, more than {MAX_SAMPLES}; crop or shrink it.")
    return raw
