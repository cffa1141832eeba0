"""Our own files of projections, .npz and .h5: arrays with the names of what they hold, and the geometry as text."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.archive import read_arrays
from difftetvr.capture.projections.descriptions.entries import parse_json
from difftetvr.capture.projections.geometry import geometry_of, parse_parts
from difftetvr.capture.projections.naming import GEOMETRY
from difftetvr.capture.projections.raw_scan import RawScan, ScanOptions, as_capture_errors, require_room
from difftetvr.errors import CaptureError
from difftetvr.mesh.io.hdf5 import PlainFile

_ARRAYS = ("line_integrals", "intensities", "flat", "dark", "variance", "valid", "test")
_VALUES = ("line_integrals", "intensities")
_KNOWN = (*_ARRAYS, GEOMETRY)


def read_npz(path: Path, options: ScanOptions) -> RawScan:
    """Read an archive of NumPy.

    Raises:
        CaptureError: It is damaged, or an array is missing.
    """
    options.refuse_others(path, "gaussian")
    names: list[str] = []

    def is_known(name: str, _: tuple[int, ...]) -> bool:
        names.append(name)
        return name in _KNOWN

    arrays = read_arrays(path, CaptureError, is_known)
    text = arrays.pop(GEOMETRY, None)
    if text is None or (text.size != 1 and text.dtype.kind != "u"):
        raise CaptureError(f"'{path}' has no 'geometry', the text of a geometry file; add it.")
    _require_known(path, names)
    return _scan(path, _decoded(text), arrays)


def read_own_hdf5(path: Path, file: PlainFile, options: ScanOptions) -> RawScan:
    """Read a file in HDF5 that is open.

    Raises:
        CaptureError: It is damaged, or an array is missing.
    """
    options.refuse_others(path, "gaussian")
    _require_known(path, file.names)
    found = [name for name in _ARRAYS if file.holds(name)]
    for name in set(found) & set(_VALUES):
        require_room(path, file.shape_of(name))
    return _scan(path, file.text(GEOMETRY), {name: file.array(name) for name in found})


def _require_known(path: Path, names: list[str]) -> None:
    """Refuse arrays that would be passed over, such as a mask by another name.

    Raises:
        CaptureError: Names the first of them.
    """
    for name in names:
        if name not in _KNOWN:
            known = ", ".join(_KNOWN)
            raise CaptureError(
                f"'{path}' holds '{name}', which is no array of a scan; rename or remove it (known: {known})."
            )


def read_hdf5(path: Path, options: ScanOptions) -> RawScan:
    """Read a file in HDF5, ours or one of Data Exchange.

    Raises:
        CaptureError: It is neither, damaged, or h5py is missing.
    """
    from difftetvr.capture.projections.readers.data_exchange import PROJECTIONS, read_exchange  # see there

    with as_capture_errors(path), PlainFile(path) as file:
        if file.holds(GEOMETRY):
            return read_own_hdf5(path, file, options)
        if file.holds(PROJECTIONS):
            return read_exchange(path, file, options)
    raise CaptureError(f"'{path}' holds neither 'geometry', as files of ours, nor '{PROJECTIONS}', as Data Exchange.")


def _scan(path: Path, geometry: str, arrays: dict[str, Any]) -> RawScan:
    values = [name for name in _VALUES if name in arrays]
    if len(values) != 1:
        raise CaptureError(f"'{path}' needs either 'line_integrals' or 'intensities'; store one of them.")
    if values == ["intensities"] and "flat" not in arrays:
        raise CaptureError(f"'{path}' has intensities without 'flat', what pixels count without an object; add it.")
    for name in values:
        if arrays[name].ndim == 2:  # of a single row
            rows = [key for key in (name, "variance", "valid") if key in arrays and arrays[key].ndim == 2]
            arrays |= {key: arrays[key][:, None] for key in rows}
    source = f"The geometry of '{path}'"
    parts = parse_parts(parse_json(geometry, source), source)
    return RawScan(geometry_of(parts, path), **arrays)


def _decoded(text: np.ndarray) -> Any:
    if text.dtype.kind == "u":
        return text.astype(np.uint8).tobytes()
    value = text.reshape(-1)[0]
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)
