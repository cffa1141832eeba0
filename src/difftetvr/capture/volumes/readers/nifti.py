"""Volumes in NIfTI files (.nii, .nii.gz), versions 1 and 2; nibabel understands their headers.

Source: https://nifti.nimh.nih.gov/nifti-1.
"""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.capture.volumes.readers.packages import package
from difftetvr.capture.volumes.stored import Encoding, Stored, first_bytes
from difftetvr.capture.volumes.volume_file import (
    RawVolume,
    World,
    byte_count,
    parse_origin,
    parse_steps,
    scaled,
    three_axes,
    to_volume,
)
from difftetvr.errors import CaptureError

_SPACE = "right-anterior-superior"
_UNITS = {1: "m", 2: "mm", 3: "um"}  # by the lowest three bits of xyzt_units
# Bytes of the header, with which it begins: for version 1 and 2.
_CLASSES = {348: "Nifti1Header", 540: "Nifti2Header"}


def read_nifti(path: Path) -> RawVolume:
    """Read a three-dimensional scalar image, with the values that its slope and intercept give.

    Raises:
        CaptureError: The file is damaged, holds several volumes, colours or vectors, or nibabel is missing.
    """
    nibabel = package("nibabel", path)
    encoding: Encoding = "gzip" if path.name.lower().endswith(".gz") else "raw"
    try:
        header = _header(nibabel, first_bytes(path, max(_CLASSES), encoding))
        dtype, sizes = header.get_data_dtype(), [int(n) for n in header.get_data_shape()]
        slope, intercept, notes = _scale(path, header)
        affine, world = _affine(header)
        start = int(header.get_data_offset())
    except CaptureError:
        raise
    # What is wrong with a header is for nibabel to say, by exceptions of many kinds.
    except Exception as error:
        raise CaptureError(f"The NIfTI header of '{path}' is damaged; get the file anew.") from error
    if dtype.kind not in "uif" or dtype.itemsize > 8:
        raise CaptureError(f"'{path}' holds values of the type {dtype}; give a scalar volume of integers or floats.")
    # Behind the third come time and components.
    while len(sizes) > 3 and sizes[-1] == 1:
        sizes.pop()
    shape = three_axes(sizes, path)
    spacing, directions = parse_steps(affine[:3, :3].T.tolist(), path)
    size = byte_count(shape, dtype)
    values = to_volume(Stored(path, encoding, skip=max(start, 0)).read(size)[:size], shape, dtype, path)
    return RawVolume(scaled(values, slope, intercept, path), spacing, directions, notes, world)


def _header(nibabel: Any, data: bytes) -> Any:
    sizes = {int.from_bytes(data[:4], "little"), int.from_bytes(data[:4], "big")} & _CLASSES.keys()
    if not sizes:
        raise ValueError("it does not begin with its size")
    size = sizes.pop()
    header = getattr(nibabel, _CLASSES[size]).from_fileobj(io.BytesIO(data[:size]), check=False)
    if not bytes(header["magic"]).startswith(b"n+"):
        raise ValueError("it is not the beginning of a single file")
    return header


def _scale(path: Path, header: Any) -> tuple[float, float, tuple[str, ...]]:
    """Slope and intercept of the values, and what to say of them."""
    # nibabel refuses headers of a slope alone.
    slope, intercept = float(header["scl_slope"]), float(header["scl_inter"])
    # By the format's definition 0 is no slope; NaN is what nibabel and others write for none.
    if slope == 0.0 or not math.isfinite(slope):
        return 1.0, 0.0, ()
    if math.isfinite(intercept):
        return slope, intercept, ()
    return slope, 0.0, (f"The intercept of '{path}' is {intercept}; it is taken as 0, with the slope {slope:.6g}.",)


def _affine(header: Any) -> tuple[np.ndarray, World]:
    """(4, 4) float64 from indices to the world, by what the format's definition prefers, and what that tells."""
    unit = _UNITS.get(int(header["xyzt_units"]) & 7, "")
    if header["sform_code"] > 0:
        affine = header.get_sform()
    elif header["qform_code"] > 0:
        affine = header.get_qform()
    else:
        # nibabel would reverse x here, as SPM did for Analyze files; the definition of NIfTI does not.
        return np.diag([*(abs(float(size)) for size in header["pixdim"][1:4]), 1.0]), World(unit=unit)
    affine = affine.astype(np.float64)
    return affine, World(parse_origin(affine[:3, 3].tolist()), _SPACE, unit)
