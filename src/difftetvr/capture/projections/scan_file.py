"""Writing our own files of projections: arrays with the names of what they hold, and the geometry as text."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.capture.projections.raw_scan import as_capture_errors
from difftetvr.errors import CaptureError
from difftetvr.files import atomic_write, require_room
from difftetvr.mesh.io.hdf5 import load_h5py

SUFFIXES = (".npz", ".h5", ".hdf5")
"""Suffixes of files of ours."""

_PACKED = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
_PACKED_TYPES = "b"  # masks; noise does not become smaller


def require_scan_format(path: str | Path) -> None:
    """Checks that a path names a file of ours that can be written here.

    Raises:
        CaptureError: The suffix is another, or the package h5py is missing.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise CaptureError(f"'{path}' is no file of projections that is written; use one of {', '.join(SUFFIXES)}.")
    if suffix != ".npz":
        with as_capture_errors(Path(path)):
            load_h5py(Path(path))


def write_scan(path: str | Path, geometry: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Writes projections; the file appears whole or not at all.

    Args:
        path: The file.
        geometry: As `ProjectionGeometry.to_dict` has it.
        arrays: By name: ``line_integrals`` and, where there are any, ``variance``, ``valid`` and ``test``.

    Raises:
        CaptureError: The suffix is another, the package h5py is missing, or the file cannot be written.
    """
    require_scan_format(path)
    text = json.dumps(geometry)
    named: dict[str, Any] = dict(arrays)
    require_room(
        path, len(text) + sum(array.nbytes for array in arrays.values() if array.dtype.kind != "b"), CaptureError
    )
    with atomic_write(path, CaptureError) as temporary:
        if Path(path).suffix.lower() == ".npz":
            with temporary.open("wb") as file:
                np.savez(file, geometry=np.array(text), **named)
            return
        h5py = load_h5py(Path(path))
        # The file is locked already, as a sign of life.
        with h5py.File(temporary, "w", locking=False) as file:
            file.attrs["format"] = "difftetvr-projections"
            file["geometry"] = text
            for name, array in arrays.items():
                file.create_dataset(name, data=array, **(_PACKED if array.dtype.kind in _PACKED_TYPES else {}))
