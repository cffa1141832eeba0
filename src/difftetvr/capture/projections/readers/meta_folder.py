"""Folders with ``meta_data.json``, as R2-Gaussian keeps projections: a ``.npy`` for each view.

Their scanner has TIGRE's names, but volumes in the order x, y, z, offsets in the order u, v, and the first row on top.

Source: https://github.com/Ruyi-Zha/r2_gaussian, ``data_generator/synthetic_dataset/generate_data.py`` and
``r2_gaussian/utils/ct_utils.py``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.archive import read_array
from difftetvr.capture.projections.descriptions.described import Parts
from difftetvr.capture.projections.descriptions.entries import Entries, read_json
from difftetvr.capture.projections.descriptions.tigre import scan_of
from difftetvr.capture.projections.geometry import geometry_of
from difftetvr.capture.projections.naming import META_FOLDER
from difftetvr.capture.projections.noise import log_variance
from difftetvr.capture.projections.raw_scan import RawScan, ScanOptions, require_room
from difftetvr.errors import CaptureError, shown
from difftetvr.trust import file_beside

_SPLITS = ("proj_train", "proj_test")
_REVERSED = ("sVoxel", "nVoxel", "dVoxel", "offOrigin", "offDetector")


def read_meta_folder(path: Path, options: ScanOptions) -> RawScan:
    """Read a folder; its test views are held out.

    Raises:
        CaptureError: A file is missing, damaged, a pickle, or of another size than the scanner tells.
    """
    options.refuse_others(path)
    file = path / META_FOLDER if path.is_dir() else path
    meta = Entries(read_json(file, "scan"), f"'{file}'")
    scanner = meta.required("scanner")
    if not isinstance(scanner, Mapping):
        meta.refuse("scanner", "give an object with names and values")
    frames = [(split == "proj_test", frame) for split in _SPLITS for frame in _frames(meta, split)]
    if not frames:
        raise CaptureError(f"'{file}' names no projections in proj_train; add them.")
    turned = {k: v[::-1] if k in _REVERSED and isinstance(v, list) else v for k, v in scanner.items()}
    entries = Entries(turned, f"The scanner of '{file}'")
    angles = np.array([Entries(frame, f"A frame of '{file}'").number("angle") for _, frame in frames])
    scan = scan_of(entries, angles, upward=False)
    bounds = _bounds(meta, entries)
    geometry = geometry_of(Parts(scan.detector(), bounds, entries.text("unit"), np.rad2deg(angles)), file)
    require_room(file, geometry.shape)
    line_integrals = np.empty(geometry.shape, dtype=np.float32)
    for into, (_, frame) in zip(line_integrals, frames):
        into[...] = _projection(file, frame, into.shape)
    test = np.array([held_out for held_out, _ in frames])
    variance, notes = _variance(scanner, line_integrals, test, file)
    return RawScan(geometry, line_integrals, variance=variance, test=test, notes=notes)


def _frames(meta: Entries, split: str) -> list[Any]:
    frames = meta.values.get(split) or []
    if not isinstance(frames, list) or not all(isinstance(frame, Mapping) for frame in frames):
        meta.refuse(split, "give a list of objects with file_path and angle")
    return list(frames)


def _bounds(meta: Entries, scanner: Entries) -> np.ndarray:
    """(2, 3) the box of the volume; the entry bbox is in units of another scale, and only counts without one."""
    if "sVoxel" in scanner or "nVoxel" in scanner:
        size = scanner.numbers("sVoxel", (3,), positive=True) if "sVoxel" in scanner else None
        if size is None:
            size = scanner.numbers("nVoxel", (3,), positive=True) * scanner.numbers("dVoxel", (3,), positive=True)
        offset = scanner.numbers("offOrigin", (3,), (0.0, 0.0, 0.0))
        return (offset + np.array([[-0.5], [0.5]]) * size)[:, ::-1]
    bounds = meta.rows("bbox", 3)
    if len(bounds) != 2:
        meta.refuse("bbox", "give a lower and an upper corner")
    return bounds


def _projection(file: Path, frame: Mapping[str, Any], shape: tuple[int, ...]) -> np.ndarray:
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise CaptureError(f"'{file}' has a frame whose file_path is {shown(name)}; give the name of a .npy.")
    path = file_beside(file, name, CaptureError)
    if not path.name.lower().endswith(".npy"):
        raise CaptureError(f"'{file}' names the projection '{path}', which is no .npy; convert it.")
    if not path.exists():
        raise CaptureError(f"'{file}' names the projection '{path}', which is not there; get the folder anew.")
    values = read_array(path, CaptureError)
    if values.dtype.kind not in "iuf" or values.shape != shape:
        size = " x ".join(map(str, shape))
        raise CaptureError(f"'{path}' holds {values.dtype} of shape {values.shape}; the scanner needs {size} numbers.")
    return values


def _variance(
    scanner: Mapping[str, Any], values: np.ndarray, test: np.ndarray, file: Path
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Variances by the noise that the scanner tells, TIGRE's; test views have none, and count as noisy as others."""
    photons: Any
    gaussian: Any
    photons, gaussian = scanner.get("possion_noise"), scanner.get("gaussian_noise")  # as they write it
    is_told = isinstance(photons, int | float) and isinstance(gaussian, list) and len(gaussian) == 2
    scale = float(np.nanmax(values[~test])) if not test.all() else 0.0
    if not scanner.get("noise") or not is_told or not scale > 0 or not isinstance(gaussian[1], int | float):
        return None, ()
    counts = np.maximum(photons * np.exp(-values.astype(np.float64) / scale), 0.5)
    note = f"The variances of '{file}' are those of TIGRE's noise, {photons:g} photons and {gaussian[1]:g} counts."
    return (scale**2 * log_variance(counts, float(gaussian[1]))).astype(np.float32), (note,)
