"""Projections in NumPy's files (.npy), with their geometry as JSON beside them: ours, TIGRE's or ASTRA's."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from difftetvr.archive import read_array
from difftetvr.capture.projections.geometry import geometry_of, load_parts
from difftetvr.capture.projections.raw_scan import RawScan, ScanOptions, require_room
from difftetvr.errors import CaptureError


def read_npy(path: Path, options: ScanOptions) -> RawScan:
    """Read an array of line integrals: (V, H, W), of ASTRA (H, V, W), or (V, W) of a single row.

    Raises:
        CaptureError: A file is missing or damaged, or they do not fit.
    """
    options.refuse_others(path, "geometry")
    beside = path.with_suffix(".json") if options.geometry is None else Path(options.geometry)
    if not beside.exists():
        raise CaptureError(f"'{path}' needs its geometry, but there is no file '{beside}'; write it, or name another.")
    parts = load_parts(beside)
    geometry = geometry_of(parts, beside)
    require_room(path, geometry.shape)
    values = read_array(path, CaptureError)
    if values.dtype.kind not in "iuf":
        raise CaptureError(f"'{path}' holds values of the type {values.dtype}; give line integrals as numbers.")
    if values.ndim == 2:
        values = values[:, None]
    elif values.ndim == 3 and parts.rows_first:
        values = values.transpose(1, 0, 2)
    if values.shape != geometry.shape:
        views, height, width = geometry.shape
        order = "rows, views and columns" if parts.rows_first else "views, rows and columns"
        raise CaptureError(
            f"'{path}' has another size than '{beside}', which tells of {views} views of {height} rows and {width} "
            f"columns; the array needs {order}."
        )
    return RawScan(geometry, np.ascontiguousarray(values, dtype=np.float32))
