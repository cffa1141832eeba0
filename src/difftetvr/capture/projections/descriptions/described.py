"""Our own description of how projections were taken, as a file in JSON has it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from difftetvr.capture.projections.descriptions.circular import Circular
from difftetvr.capture.projections.descriptions.entries import Entries, in_sentence
from difftetvr.errors import CaptureError
from difftetvr.rendering.cameras.detector import Detector

Floats = NDArray[np.float64]

_COMMON = ("type", "unit", "comment", "detector", "angles", "volume_size", "volume_offset", "bounds")
_TURNING = (*_COMMON, "views", "arc", "start", "detector_size", "detector_offset", "tilt", "axis_offset")
_DISTANCES = ("source_distance", "detector_distance")
KNOWN = {
    "cone": (*_TURNING, *_DISTANCES, "helical"),
    "fan": (*_TURNING, *_DISTANCES),
    "parallel": (*_TURNING, *_DISTANCES),
    "free": (*_COMMON, "views"),
}
"""Kinds of geometries, and what each may say."""

_VIEW = ("source", "direction", "center", "columns", "rows")


class Parts(NamedTuple):
    """What a description comes to; see `ProjectionGeometry`.

    Attributes:
        detector: All views.
        bounds: (2, 3) box to reconstruct.
        unit: Of length.
        angles: (V,) degrees.
        rows_first: Whether arrays of its projections have rows before views, as ASTRA's.
    """

    detector: Detector
    bounds: Floats
    unit: str | None = None
    angles: Floats | None = None
    rows_first: bool = False


def parse_described(values: Any, source: str) -> Parts:
    """The geometry that a description of ours tells.

    Args:
        values: As JSON gives it.
        source: What it is, for the sentences.

    Raises:
        CaptureError: An entry is missing, unknown, or out of range.
    """
    entries = Entries(values, source)
    kind = entries.text("type", tuple(KNOWN))
    if kind is None:
        raise CaptureError(f"{source} lacks the entry 'type'; give one of {', '.join(KNOWN)}.")
    entries.require_known(KNOWN[kind])
    unit = entries.text("unit")
    if kind == "free":
        detector, angles = _free(entries)
        return Parts(detector, bounds_of(entries, None), unit, angles)
    scan = _turning(entries, kind)
    return Parts(scan.detector(), bounds_of(entries, scan), unit, np.rad2deg(scan.angles))


def bounds_of(entries: Entries, scan: Circular | None) -> Floats:
    """(2, 3) the box to reconstruct: given by its corners, or its size and the place of its middle, or what is seen.

    Raises:
        CaptureError: It is not valid, or not given where nothing else tells it.
    """
    if "bounds" in entries:
        if "volume_size" in entries or "volume_offset" in entries:
            raise CaptureError(f"{entries.source} has both 'bounds' and 'volume_size'; leave one of them out.")
        bounds = entries.rows("bounds", 3)
        if len(bounds) != 2 or not (bounds[0] < bounds[1]).all():
            entries.refuse("bounds", "give a lower and, greater in all axes, an upper corner")
        return bounds
    offset = entries.numbers("volume_offset", (3,), (0.0, 0.0, 0.0))
    if "volume_size" in entries:
        size = entries.numbers("volume_size", (1, 2, 3), positive=True)
        if len(size) == 2:
            if scan is None or scan.height != 1:
                entries.refuse("volume_size", "give 3 numbers greater than 0")
            size = np.append(size, _thickness(scan))
        return offset + np.array([[-0.5], [0.5]]) * np.broadcast_to(size, 3)
    if scan is None:
        raise CaptureError(f"{entries.source} lacks the entry 'volume_size'; give the size of the box to reconstruct.")
    bounds = scan.field_of_view() + offset
    if not (bounds[0] < bounds[1]).all():
        raise CaptureError(
            f"No place is seen by all views of {in_sentence(entries.source)}; give 'volume_size', or correct it."
        )
    return bounds


def _thickness(scan: Circular) -> float:
    """Of a slice that a single row sees: its height at the axis."""
    magnification = 1.0 if scan.source_distance is None else scan.detector_distance / scan.source_distance
    return float(scan.pixel[1] / magnification)


def _turning(entries: Entries, kind: str) -> Circular:
    """A scanner that turns around z."""
    counts = entries.numbers("detector", (1, 2) if kind == "fan" else (2,), positive=True)
    if (counts != np.round(counts)).any() or (kind == "fan" and len(counts) == 2 and counts[1] != 1):
        wanted = "the pixels of its one row" if kind == "fan" else "whole numbers of columns and of rows"
        entries.refuse("detector", f"give {wanted}")
    size = entries.numbers("detector_size", (1, 2) if len(counts) == 1 or counts[1] == 1 else (2,), positive=True)
    width, height = int(counts[0]), int(counts[1]) if len(counts) == 2 else 1
    pixel = np.array([size[0] / width, size[1] / height if len(size) == 2 else size[0] / width])
    tilt = entries.numbers("tilt", (1, 3), (0.0,))
    distances: dict[str, Any] = {}
    if kind != "parallel":
        source, detector = (entries.number(name, positive=True) for name in _DISTANCES)
        if not detector > source:
            raise CaptureError(
                f"{entries.source} has its detector {detector:g} from the source and the axis {source:g}, so that it "
                "is not behind the axis; detector_distance is that from source to detector, and greater."
            )
        distances = {"source_distance": source, "detector_distance": detector}
    offset = entries.numbers("detector_offset", (1, 2), (0.0, 0.0))
    return Circular(
        np.deg2rad(_angles(entries)),
        width,
        height,
        pixel,
        offset=np.append(offset, 0.0)[:2],
        tilt=np.deg2rad(tilt if len(tilt) == 3 else np.array([tilt[0], 0.0, 0.0])),
        axis_offset=entries.number("axis_offset", 0.0),
        pitch=entries.number("helical", 0.0),
        **distances,
    )


def _angles(entries: Entries) -> Floats:
    """(V,) degrees."""
    if "angles" in entries:
        if other := next((name for name in ("views", "arc", "start") if name in entries), None):
            raise CaptureError(f"{entries.source} has both 'angles' and '{other}'; leave one of them out.")
        return entries.numbers("angles")
    views, arc = entries.whole("views"), entries.number("arc", 360.0)
    if arc == 0.0 and views > 1:
        entries.refuse("arc", "give the degrees over which the views are spread, such as 360")
    return entries.number("start", 0.0) + arc * np.arange(views) / views


def _free(entries: Entries) -> tuple[Detector, Floats | None]:
    """Views of which each has its own vectors."""
    counts = entries.numbers("detector", (2,), positive=True)
    if (counts != np.round(counts)).any():
        entries.refuse("detector", "give whole numbers of columns and of rows")
    views = entries.required("views")
    if not isinstance(views, list | tuple) or not views:
        entries.refuse("views", "give a list with an object for each view")
    tables: dict[str, list[Floats]] = {}
    for index, view in enumerate(views):
        item = Entries(view, f"View {index} of {in_sentence(entries.source)}")
        item.require_known(_VIEW)
        for name in (name for name in _VIEW if name in item or name in ("center", "columns", "rows")):
            tables.setdefault(name, []).append(item.numbers(name, (3,)))
    beams = [name for name in ("source", "direction") if name in tables]
    if len(beams) != 1 or len(tables[beams[0]]) != len(views):
        source = in_sentence(entries.source)
        raise CaptureError(f"The views of {source} need each a 'source', or each a 'direction'; correct them.")
    tensors = {name: torch.from_numpy(np.stack(rows)) for name, rows in tables.items()}
    angles = entries.numbers("angles") if "angles" in entries else None
    if angles is not None and len(angles) != len(views):
        entries.refuse("angles", f"give one for each of {len(views)} views, or leave them out")
    return Detector(width=int(counts[0]), height=int(counts[1]), **tensors), angles


def described(
    detector: Detector, bounds: torch.Tensor, unit: str | None, angles: torch.Tensor | None
) -> dict[str, Any]:
    """The description that `parse_described` makes the same of, to the last bit: that of free views."""
    names = [name for name in _VIEW if getattr(detector, name) is not None]
    tables = {name: getattr(detector, name).detach().cpu().double().tolist() for name in names}
    found: dict[str, Any] = {"type": "free", "detector": [detector.width, detector.height]}
    found["views"] = [dict(zip(names, vectors)) for vectors in zip(*tables.values())]
    found["bounds"] = bounds.tolist()
    return found | ({} if unit is None else {"unit": unit}) | ({} if angles is None else {"angles": angles.tolist()})
