"""Who reads which file of projections. A new format is a file beside this one and a row here."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from difftetvr.archive import array_names
from difftetvr.capture.projections.raw_scan import RawScan, ScanOptions
from difftetvr.capture.projections.readers.array import read_npy
from difftetvr.capture.projections.readers.meta_folder import NAME, read_meta_folder
from difftetvr.capture.projections.readers.own_files import GEOMETRY, read_hdf5, read_npz
from difftetvr.errors import CaptureError

READERS: dict[str, Callable[[Path, ScanOptions], RawScan]] = {
    ".npz": read_npz,
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".nxs": read_hdf5,
    ".npy": read_npy,
}
"""Readers of files, by suffix."""

_PICKLES = (".pickle", ".pkl", ".p")


def is_projection_source(path: str | Path) -> bool:
    """Whether a name says that there are projections that `ProjectionCapture.load` reads.

    A ``.npz`` is one if it holds a geometry, a ``.npy`` if there is a ``.json`` beside it, a folder if it holds a
    ``meta_data.json``.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if path.is_dir():
        return (path / NAME).is_file()
    if path.name == NAME:
        return True
    if suffix == ".npz":
        return {GEOMETRY} < array_names(path)
    if suffix == ".npy":
        return path.with_suffix(".json").is_file()
    return suffix in READERS or suffix in _PICKLES


def read_scan(path: Path, options: ScanOptions) -> RawScan:
    """The projections in a file or a folder.

    Raises:
        CaptureError: They are missing, damaged, or of an unknown kind.
    """
    suffix = path.suffix.lower()
    if not path.exists():
        raise CaptureError(f"There is no file '{path}'; check the path of the scan.")
    if path.is_dir() or path.name == NAME:
        if path.is_dir() and not (path / NAME).is_file():
            raise CaptureError(f"'{path}' is a folder without {NAME}; give the file of projections in it.")
        return read_meta_folder(path, options)
    if suffix in _PICKLES:
        raise CaptureError(
            f"'{path}' is a pickle of Python, which can run any program when it is read; write its projections as .npy "
            "and its geometry as .json, in a program that trusts it."
        )
    if suffix not in READERS:
        known = f"{', '.join(READERS)}, or a folder with {NAME}"
        raise CaptureError(f"'{path}' is no file of projections that can be read; give {known}.")
    return READERS[suffix](path, options)
