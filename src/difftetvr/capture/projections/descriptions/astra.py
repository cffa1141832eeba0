"""Projection geometries of the ASTRA toolbox as dictionaries, arrays as lists.

Either ``proj_geom`` alone, or an object of ``proj_geom`` and ``vol_geom``, which then tells the box to reconstruct. The
lowest row is the first one, and arrays have rows before views.

Source: https://github.com/astra-toolbox/astra-toolbox, ``python/astra/functions.py``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from difftetvr.capture.projections.descriptions.circular import Circular
from difftetvr.capture.projections.descriptions.described import Parts, bounds_of
from difftetvr.capture.projections.descriptions.entries import Entries
from difftetvr.errors import CaptureError
from difftetvr.rendering.cameras.detector import Detector

Floats = NDArray[np.float64]

_FLAT = ("parallel", "fanflat", "parallel_vec", "fanflat_vec")
_KINDS = (*_FLAT, "parallel3d", "cone", "parallel3d_vec", "cone_vec")


def is_astra(values: Any) -> bool:
    """Whether a description in JSON is one of ASTRA."""
    return isinstance(values, Mapping) and any(key in values for key in ("proj_geom", "ProjectionAngles", "Vectors"))


def parse_astra(values: Any, source: str) -> Parts:
    """The geometry that a dictionary of ASTRA tells.

    Raises:
        CaptureError: An entry is missing or out of range, or the kind of geometry is not known.
    """
    whole = Entries(values, source)
    entries = Entries(values["proj_geom"], f"The proj_geom of {source}") if "proj_geom" in whole else whole
    kind = entries.text("type", _KINDS)
    if kind is None:
        raise CaptureError(f"{entries.source} lacks the entry 'type'; add it.")
    scan = None if kind.endswith("_vec") else _turning(entries, kind)
    detector = _vectors(entries, kind) if scan is None else scan.detector()
    angles = None if scan is None else np.rad2deg(scan.angles)
    if "vol_geom" in whole:
        thickness = float(detector.rows[0].norm()) if kind in _FLAT else None
        bounds = _box(Entries(values["vol_geom"], f"The vol_geom of {source}"), thickness)
    else:
        bounds = bounds_of(whole, scan)
    return Parts(detector, bounds, whole.text("unit"), angles, kind not in _FLAT)


def _turning(entries: Entries, kind: str) -> Circular:
    """Views by their angles; at angle 0 the source is at -y here, where it is at +x in `Circular`."""
    angles = entries.numbers("ProjectionAngles") - 0.5 * np.pi
    if kind in _FLAT:
        width, height = entries.whole("DetectorCount"), 1
        step = entries.number("DetectorWidth", positive=True)
        pixel = np.array([step, step])
    else:
        width, height = entries.whole("DetectorColCount"), entries.whole("DetectorRowCount")
        pixel = np.array([entries.number(f"DetectorSpacing{axis}", positive=True) for axis in "XY"])
    if kind.startswith("parallel"):
        return Circular(angles, width, height, pixel, upward=True)
    source = entries.number("DistanceOriginSource", positive=True)
    behind = entries.number("DistanceOriginDetector")
    if behind < 0:
        entries.refuse("DistanceOriginDetector", "give the distance from the axis to the detector, at least 0")
    return Circular(
        angles, width, height, pixel, source_distance=source, detector_distance=source + behind, upward=True
    )


def _vectors(entries: Entries, kind: str) -> Detector:
    """Views by their vectors: source or direction, middle of the detector, steps of columns and of rows."""
    beam = "direction" if kind.startswith("parallel") else "source"
    if kind in _FLAT:
        table = entries.rows("Vectors", 6).reshape(-1, 3, 2)
        table = np.concatenate([table, np.zeros((*table.shape[:2], 1))], axis=-1)
        step = np.linalg.norm(table[:, 2], axis=-1, keepdims=True)
        table = np.concatenate([table, np.array([0.0, 0.0, 1.0]) * step[:, None]], axis=1)
        width, height = entries.whole("DetectorCount"), 1
    else:
        table = entries.rows("Vectors", 12).reshape(-1, 4, 3)
        width, height = entries.whole("DetectorColCount"), entries.whole("DetectorRowCount")
    parts = {name: torch.from_numpy(table[:, k].copy()) for k, name in enumerate((beam, "center", "columns", "rows"))}
    return Detector(width=width, height=height, **parts)


def _box(entries: Entries, thickness: float | None) -> Floats:
    """(2, 3) the window of a volume, by default of voxels of side 1 around the origin; of slices so thick."""
    options = Entries(entries.values.get("option") or {}, entries.source)
    bounds = []
    for axis, name in zip("XYZ", ("GridColCount", "GridRowCount", "GridSliceCount")):
        if thickness is not None and axis == "Z":
            bounds.append((-0.5 * thickness, 0.5 * thickness))
            continue
        half = 0.5 * entries.whole(name)
        bounds.append((options.number(f"WindowMin{axis}", -half), options.number(f"WindowMax{axis}", half)))
    box = np.array(bounds).T
    if not (box[0] < box[1]).all():
        raise CaptureError(f"{entries.source} has an empty window; correct its option.")
    return box
