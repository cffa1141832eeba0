"""What programs write into the description of a TIFF file: how many slices there are, and the distances of samples.

Sources: https://imagej.net/formats/tiff, https://ome-model.readthedocs.io, https://pypi.org/project/tifffile.
"""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any, NamedTuple

from difftetvr.capture.volumes.units import Distances, filled, in_one_unit
from difftetvr.capture.volumes.volume_file import parse_numbers
from difftetvr.errors import CaptureError

_NONE = Distances((1.0, 1.0, 1.0))
_UNIT_OF_OME = "µm"


class Description(NamedTuple):
    """Of a stack.

    Attributes:
        slices: How many follow each other behind the first page, if that is the only one; None where it says nothing.
        distances: Of samples; 1 along all axes where it does not tell them.
        is_imagej: Whether ImageJ's, whose colours are how it shows its samples.
    """

    slices: int | None = None
    distances: Distances = _NONE
    is_imagej: bool = False


def described(path: Path, tiff: Any) -> Description:
    """The description of a file that is open in tifffile.

    Raises:
        CaptureError: It tells of several channels or time steps.
    """
    if told := tiff.imagej_metadata:
        _require_single(path, {"channels": told.get("channels", 1), "time steps": told.get("frames", 1)})
        images = told.get("images")
        slices = images if isinstance(images, int) else None
        return Description(slices, _positive(path, _imagej_distances(path, tiff.pages[0], told)), is_imagej=True)
    text = tiff.pages[0].description
    if (pixels := _ome_pixels(text)) is not None:
        _require_single(path, {"channels": pixels.get("SizeC", "1"), "time steps": pixels.get("SizeT", "1")})
        (size,) = parse_numbers([pixels.get("SizeZ", "1")]) or [math.nan]
        if len(tiff.pages) == tiff.pages[0].imagedepth == 1 < size:
            raise CaptureError(f"'{path}' holds one of the {size:g} slices that it tells of; give a file of them all.")
        return Description(None, _positive(path, _ome_distances(path, pixels)))
    return Description(_shaped(path, text))


def _require_single(path: Path, counts: dict[str, Any]) -> None:
    for what, count in counts.items():
        if str(count) != "1":
            raise CaptureError(f"'{path}' holds {count} {what}; give a stack of the slices of one of them.")


def _positive(path: Path, distances: Distances) -> Distances:
    if all(0 < value < math.inf for value in distances.values):
        return distances
    return Distances(
        _NONE.values,
        (f"The distances of samples that '{path}' tells are not positive; they are taken as equal.",),
    )


def _imagej_distances(path: Path, page: Any, told: dict[str, Any]) -> Distances:
    """The pixels' sizes from their resolution, the slices' distance as told: 1 where it is not, as in ImageJ."""
    sides = []
    for name in ("XResolution", "YResolution"):
        pixels, units = page.tags[name].value if name in page.tags else (1, 1)
        sides.append(float(units) / float(pixels) if pixels else 0.0)
    unit = str(told.get("unit", ""))
    units = [unit, str(told.get("yunit", unit)), str(told.get("zunit", unit))]
    values = [*sides, *(parse_numbers([told.get("spacing", 1.0)]) or [0.0])]
    distances = in_one_unit(values, units, path)
    if "spacing" in told or sides == [1.0, 1.0]:
        return distances
    note = f"'{path}' does not tell the distance of its slices, which is 1 then; --spacing says otherwise."
    return Distances(distances.values, (*distances.notes, note))


def _ome_distances(path: Path, pixels: ElementTree.Element) -> Distances:
    sizes = [pixels.get(f"PhysicalSize{axis}") for axis in "XYZ"]
    if set(sizes) == {None}:
        return _NONE
    units = [pixels.get(f"PhysicalSize{axis}Unit", _UNIT_OF_OME) for axis in "XYZ"]
    known = [None if size is None else (parse_numbers([size]) or [math.nan])[0] for size in sizes]
    # What is not given has no unit, either.
    assumed = next(unit for unit, size in zip(units, known) if size is not None)
    units = [assumed if size is None else unit for unit, size in zip(units, known)]
    given = filled(known, path)
    distances = in_one_unit(given.values, units, path, _UNIT_OF_OME)
    return Distances(distances.values, (*given.notes, *distances.notes))


def _ome_pixels(description: str) -> ElementTree.Element | None:
    """OME's description of the pixels; None where a page has none."""
    if "<OME" not in description[:1000]:
        return None
    try:
        root = ElementTree.fromstring(description.encode())
    except ElementTree.ParseError:
        return None
    return next((element for element in root.iter() if element.tag.rpartition("}")[2] == "Pixels"), None)


def _shaped(path: Path, description: str) -> int | None:
    """Slices by tifffile's own description, {"shape": [6, 8, 10]}.

    Raises:
        CaptureError: It has more than three axes.
    """
    try:
        told = json.loads(description) if description.startswith("{") else {}
        shape = [int(n) for n in told.get("shape", ())]
    except (ValueError, TypeError, RecursionError, OverflowError):
        return None
    while len(shape) > 3 and shape[0] == 1:
        shape.pop(0)
    if len(shape) > 3 and shape[-1] != 1:
        sizes = " x ".join(map(str, shape[:8]))
        raise CaptureError(f"'{path}' holds {sizes} values, more than three axes; give a stack of slices.")
    return shape[0] if len(shape) > 2 else None
