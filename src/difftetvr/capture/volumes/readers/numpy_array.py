"""Volumes in NumPy's files (.npy)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from difftetvr.archive import read_array
from difftetvr.capture.volumes.volume_file import RawVolume, three_axes
from difftetvr.errors import CaptureError


def read_npy(path: Path) -> RawVolume:
    """Read an array (nz, ny, nx) of numbers or truth values.

    Raises:
        CaptureError: The file is damaged, or holds something else.
    """
    values = read_array(path, CaptureError)
    if values.dtype == np.bool_:
        values = values.astype(np.int8)  # whose range is what there is, 0 to 1
    if values.dtype.kind not in "uif" or values.dtype.itemsize > 8:
        raise CaptureError(f"'{path}' holds values of the type {values.dtype}; give integers or floats.")
    while values.ndim > 3 and 1 in (values.shape[0], values.shape[-1]):
        values = values[0] if values.shape[0] == 1 else values[..., 0]
    three_axes(values.shape, path)
    return RawVolume(values.astype(values.dtype.newbyteorder("="), copy=False), (1.0, 1.0, 1.0))
