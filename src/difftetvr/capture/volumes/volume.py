"""Scalar volumes on regular grids: the values, where they lie in space, and reading them from files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from difftetvr.capture.volumes.readers.nrrd import read_nrrd
from difftetvr.capture.volumes.readers.raw import read_raw
from difftetvr.capture.volumes.readers.vti import read_vti
from difftetvr.capture.volumes.volume_file import RawVolume
from difftetvr.errors import CaptureError

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

    Raises:
        CaptureError: An axis has fewer than two samples, a value is not finite, or the spacing is not positive.
    """

    values: np.ndarray
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    name: str = "volume"

    def __post_init__(self) -> None:
        values = np.ascontiguousarray(self.values, dtype=np.float32)
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
    ) -> Volume:
        """Read a volume and normalise its values to [0, 1].

        Unsigned integers are divided by the largest value of their type (255, 65535, ...); signed integers and floats
        are mapped linearly from their smallest and largest value.

        Args:
            path: ``.raw`` (also ``.raw.gz``, ``.raw.xz``), ``.dat``, ``.nrrd``, ``.nhdr`` or ``.vti``. What a ``.raw``
                file holds is taken from ``shape`` and ``dtype``, else from a ``.dat`` header of the same name beside
                it, else from its name, as in ``tooth_103x94x161_uint8.raw``.
            shape: (nx, ny, nz) of a ``.raw`` file, x fastest.
            dtype: NumPy name of a ``.raw`` file's values, e.g. ``uint8``, ``uint16``, ``>u2``, ``float32``.
            spacing: Distances of samples along (x, y, z); overrides the file's.

        Raises:
            CaptureError: The file is missing, damaged, of another size than described, or of an unknown kind.
        """
        raw = _read(Path(path), shape, dtype)
        chosen = raw.spacing if spacing is None else tuple(float(s) for s in spacing)
        return Volume(_normalise(raw.values, path), chosen, Path(path).name)  # type: ignore[arg-type]


def is_volume_file(path: str | Path) -> bool:
    """Whether a file's name says that it holds a volume that `Volume.load` reads."""
    name = Path(path).name.lower()
    return name.endswith((".raw", ".raw.gz", ".raw.xz", ".dat", ".nrrd", ".nhdr", ".vti"))


def _read(path: Path, shape: Sequence[int] | None, dtype: str | None) -> RawVolume:
    name = path.name.lower()
    if not is_volume_file(path):
        raise CaptureError(f"'{path}' is no volume that can be read; give a .raw, .dat, .nrrd, .nhdr or .vti file.")
    if path.is_dir():
        raise CaptureError(f"'{path}' is a folder; give the volume file in it.")
    if not path.is_file():
        raise CaptureError(f"There is no file '{path}'; check the path of the volume.")
    if name.endswith((".raw", ".raw.gz", ".raw.xz", ".dat")):
        return read_raw(path, shape, dtype)
    if shape is not None or dtype is not None:
        raise CaptureError(f"'{path}' says itself what it holds; leave out the shape and the dtype.")
    return read_vti(path) if name.endswith(".vti") else read_nrrd(path)


def _normalise(values: np.ndarray, path: str | Path) -> np.ndarray:
    if values.dtype.kind == "u":
        return (values / np.float32(np.iinfo(values.dtype).max)).astype(np.float32)
    if not np.isfinite(values).all():
        raise CaptureError(f"The volume '{path}' holds values that are not finite; replace them first.")
    lower, upper = float(values.min()), float(values.max())
    if not lower < upper:
        raise CaptureError(f"All values of the volume '{path}' are {lower}; there is no range to normalise.")
    return ((values.astype(np.float64) - lower) / (upper - lower)).astype(np.float32)
