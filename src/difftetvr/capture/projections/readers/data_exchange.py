"""Data Exchange files (.h5) of synchrotrons, as tomopy and dxchange know them: parallel rays, flat and dark fields.

Source: De Carlo et al., "Scientific data exchange: a schema for HDF5-based storage of raw and analyzed data",
J. Synchrotron Rad. 21 (2014).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from difftetvr.capture.projections.descriptions.circular import Circular
from difftetvr.capture.projections.descriptions.described import Parts
from difftetvr.capture.projections.geometry import geometry_of
from difftetvr.capture.projections.raw_scan import RawScan, ScanOptions, require_room
from difftetvr.errors import CaptureError
from difftetvr.mesh.io.hdf5 import PlainFile

PROJECTIONS = "exchange/data"
_TURN = 6.5  # a full turn in radians, and a bit: who has fewer degrees has hardly a scan
_THETA, _FLAT, _DARK = "exchange/theta", "exchange/data_white", "exchange/data_dark"


def read_exchange(path: Path, file: PlainFile, options: ScanOptions) -> RawScan:
    """Read a file that is open. The first row is on top; without a pixel size, a pixel is the unit of length.

    Raises:
        CaptureError: Arrays are missing or do not fit.
        MeshError: The file is damaged.
    """
    options.refuse_others(path, "center", "pixel_size", "unit", "gaussian")
    shape = file.shape_of(PROJECTIONS)
    if len(shape) != 3 or min(shape) < 1:
        raise CaptureError(f"'{path}' has '{PROJECTIONS}' of shape {shape}; it needs views, rows and columns.")
    require_room(path, shape)
    notes = []
    if not file.holds(_FLAT):
        raise CaptureError(f"'{path}' has no '{_FLAT}', what pixels count without an object; add it.")
    dark = file.array(_DARK) if file.holds(_DARK) else None
    if dark is None:
        notes.append(f"'{path}' has no '{_DARK}'; what pixels count without rays is taken as 0.")
    angles = _angles(path, file, shape[0], notes)
    if options.center is None:
        notes.append(
            f"'{path}' does not tell where the axis is; it is taken as the middle of a row, {shape[2] / 2:g} pixels "
            "from the left edge, unless center says otherwise."
        )
    step = options.pixel_size or 1.0
    shift = 0.0 if options.center is None else (0.5 * shape[2] - options.center) * step
    scan = Circular(angles, shape[2], shape[1], np.array([step, step]), offset=(shift, 0.0))
    bounds = scan.field_of_view()
    if not (bounds[0] < bounds[1]).all():
        raise CaptureError(f"The axis of '{path}' at {options.center:g} lies outside of {shape[2]} pixels; correct it.")
    unit = options.unit if options.pixel_size is not None else None
    geometry = geometry_of(Parts(scan.detector(), bounds, unit, np.rad2deg(angles)), path)
    counts, flat = file.array(PROJECTIONS), file.array(_FLAT)
    return RawScan(geometry, intensities=counts, flat=flat, dark=dark, notes=tuple(notes))


def _angles(path: Path, file: PlainFile, views: int, notes: list[str]) -> np.ndarray:
    """(V,) radians."""
    if not file.holds(_THETA):
        notes.append(f"'{path}' has no '{_THETA}'; its {views} views are taken as spread evenly over 180 degrees.")
        return np.pi * np.arange(views) / views
    theta = file.array(_THETA).astype(np.float64).reshape(-1)
    if len(theta) != views or not np.isfinite(theta).all():
        raise CaptureError(f"'{path}' has {len(theta)} angles for {views} views; it needs a finite one for each.")
    unit = file.unit_of(_THETA).lower()
    if unit.startswith("rad"):
        return theta
    if not unit and views > 1 and np.ptp(theta) < _TURN:
        notes.append(
            f"The angles of '{path}' have no unit and span {np.ptp(theta):.3g}; they are taken as degrees, as Data "
            f"Exchange has them; for radians give '{_THETA}' the attribute units = 'rad'."
        )
    return np.deg2rad(theta)
