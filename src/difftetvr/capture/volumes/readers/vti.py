"""Volumes in VTK XML image files (.vti), in every encoding and with every compressor."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

from difftetvr.capture.volumes.volume_file import (
    RawVolume,
    World,
    parse_numbers,
    parse_origin,
    parse_shape,
    parse_steps,
)
from difftetvr.errors import CaptureError
from difftetvr.vtk_xml import Document, is_numeric


def read_vti(path: Path) -> RawVolume:
    """Read the active (or only, or first) scalar point array of an image in one piece.

    Raises:
        CaptureError: The file is damaged, or has no scalar point data or several pieces.
    """
    document = Document(path, CaptureError)
    root = document.root
    image = root.find("ImageData")
    if root.get("type") != "ImageData" or image is None:
        raise CaptureError(f"'{path}' holds no VTK ImageData; give a .vti file.")
    pieces = image.findall("Piece")
    if len(pieces) != 1:
        raise CaptureError(f"'{path}' has {len(pieces)} pieces; save it in one.")
    extent = (pieces[0].get("Extent") or image.get("WholeExtent") or "").split()
    try:
        limits = [int(n) for n in extent]
    except ValueError:
        limits = []
    if len(limits) != 6:
        raise CaptureError(f"'{path}' has no valid Extent; get the file anew.")
    shape = parse_shape([limits[2 * axis + 1] - limits[2 * axis] + 1 for axis in range(3)], path)
    steps = _steps(image)
    spacing, directions = parse_steps(steps, path)
    array, note = _point_array(path, pieces[0])
    if not is_numeric(array):
        raise CaptureError(f"'{path}' has values of type '{array.get('type')}'; give integers or floats.")
    values = document.array(array, shape[0] * shape[1] * shape[2])
    world = World(_first_place(image, steps, limits[::2]))
    return RawVolume(values.reshape(shape[::-1]), spacing, directions, note, world)


def _steps(image: Element) -> list[list[float]]:
    """From a sample to the next along each axis in the world; an empty list where the image does not tell."""
    spacing = parse_numbers((image.get("Spacing") or "1 1 1").split())
    # Row by row; the columns are the axes.
    matrix = parse_numbers((image.get("Direction") or "1 0 0 0 1 0 0 0 1").split())
    if len(spacing) != 3 or len(matrix) != 9:
        return []
    return [[spacing[axis] * matrix[axis + 3 * row] for row in range(3)] for axis in range(3)]


def _first_place(image: Element, steps: list[list[float]], first: list[int]) -> tuple[float, float, float]:
    """Where the sample of the first indices lies; the origin is that of the indices 0."""
    origin = parse_origin(parse_numbers((image.get("Origin") or "").split()))
    return parse_origin([x + sum(n * step[k] for n, step in zip(first, steps)) for k, x in enumerate(origin)])


def _point_array(path: Path, piece: Element) -> tuple[Element, tuple[str, ...]]:
    """The array to show, with a note on those that are not."""
    data = piece.find("PointData")
    arrays = [] if data is None else data.findall("DataArray")
    scalars = [a for a in arrays if (a.get("NumberOfComponents") or "1").strip() in ("1", "0")]
    if data is None or not scalars:
        raise CaptureError(f"'{path}' has no point array with one component; give a scalar volume.")
    active = [a for a in scalars if a.get("Name") == data.get("Scalars")]
    taken = (active or scalars)[0]
    if len(scalars) == 1:
        return taken, ()
    others = ", ".join(repr(array.get("Name")) for array in scalars if array is not taken)
    why = "its active one" if active else "its first one"
    return taken, (f"Of the scalars in '{path}', {taken.get('Name')!r} is read, {why}; passed over: {others}.",)
