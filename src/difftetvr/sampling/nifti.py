"""Headers of NIfTI 1 files, which tell where the values of a grid are.

Source: https://nifti.nimh.nih.gov/nifti-1, the definition of ``nifti_1_header``.
"""

from __future__ import annotations

import struct

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.sampling.grids import Grid

_SIZE, _OFFSET = 348, 352.0
_MOST_POINTS = 2**15 - 1  # along an axis
_CODES = {"f4": 16, "f8": 64}
_VECTOR = 1007
_UNITS = {"m": 1, "mm": 2, "um": 3, "\u00b5m": 3, "\u03bcm": 3}
_SCANNER, _ALIGNED = 1, 2
# Signs of the world's axes in NIfTI's, which run to the right, to the front and upwards.
_SIGNS = {"right-anterior-superior": (1.0, 1.0, 1.0), "left-posterior-superior": (-1.0, -1.0, 1.0)}


def nifti_header(grid: Grid, dtype: np.dtype, components: int | None, name: str, remark: str) -> bytes:
    """The bytes before the values of a single file.

    Args:
        grid: Where they are; along the world's axes as they are where its space is not that of a patient.
        dtype: float32 or float64, little-endian in the file.
        components: Numbers for each point, where they are vectors.
        name: What they are.
        remark: What else to say; cut off after 80 bytes.

    Raises:
        MeshError: The grid has more points along an axis than the format can tell.
    """
    if max(grid.shape) > _MOST_POINTS:
        raise MeshError(
            f"A .nii holds at most {_MOST_POINTS:,} points along an axis, not {max(grid.shape):,}; use .nrrd."
        )
    axes = np.eye(3) if grid.directions is None else np.array(grid.directions)
    signs = np.array(_SIGNS.get(grid.space, (1.0, 1.0, 1.0)))
    affine = np.concatenate([axes.T * np.array(grid.spacing), np.array(grid.origin)[:, None]], axis=1) * signs[:, None]
    sizes = [*grid.shape] if components is None else [*grid.shape, 1, components]
    header = struct.pack("<i36x", _SIZE)
    header += struct.pack("<8h", len(sizes), *sizes, *[1] * (7 - len(sizes)))
    intent = 0 if components is None else _VECTOR
    header += struct.pack("<3f4h", 0.0, 0.0, 0.0, intent, _CODES[dtype.str[1:]], 8 * dtype.itemsize, 0)
    header += struct.pack("<8f", 1.0, *grid.spacing, *[1.0] * 4)
    header += struct.pack("<3fhBB", _OFFSET, 1.0, 0.0, 0, 0, _UNITS.get(grid.unit, 0))
    header += struct.pack("<4f2i", 0.0, 0.0, 0.0, 0.0, 0, 0)
    header += struct.pack("<80s24s", _ascii(remark), b"")
    header += struct.pack("<2h", 0, _SCANNER if grid.space in _SIGNS else _ALIGNED)
    header += struct.pack("<6f", *[0.0] * 6)
    header += struct.pack("<12f", *affine.reshape(-1).tolist())
    header += struct.pack("<16s4s4x", _ascii(name), b"n+1")
    return header


def _ascii(text: str) -> bytes:
    return " ".join(text.split()).encode("ascii", "backslashreplace")
