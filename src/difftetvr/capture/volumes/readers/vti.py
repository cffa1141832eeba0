"""Volumes in VTK XML image files (.vti), in every encoding and with every compressor."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from difftetvr.capture.volumes.volume_file import RawVolume, byte_count, parse_shape, parse_spacing
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
    spacing = parse_spacing((image.get("Spacing") or "1 1 1").split(), path)
    array = _point_array(path, pieces[0])
    if not is_numeric(array):
        raise CaptureError(f"'{path}' has values of type '{array.get('type')}'; give integers or floats.")
    # What is too large to be drawn, whatever its type, need not be decoded.
    byte_count(shape, np.dtype(np.uint8), path)
    values = document.array(array, shape[0] * shape[1] * shape[2])
    return RawVolume(values.reshape(shape[::-1]), spacing)


def _point_array(path: Path, piece: Element) -> Element:
    data = piece.find("PointData")
    arrays = [] if data is None else data.findall("DataArray")
    scalars = [a for a in arrays if (a.get("NumberOfComponents") or "1").strip() in ("1", "0")]
    if data is None or not scalars:
        raise CaptureError(f"'{path}' has no point array with one component; give a scalar volume.")
    active = [a for a in scalars if a.get("Name") == data.get("Scalars")]
    return (active or scalars)[0]
