"""Who reads which file of projections. A new format is a file beside this one, a row
here, and its suffix in `naming`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from difftetvr.capture.projections.naming import HDF5, META_FOLDER, PICKLES
from difftetvr.capture.projections.raw_scan import RawScan, ScanOptions
from difftetvr.capture.projections.readers.array import read_npy
from difftetvr.capture.projections.readers.meta_folder import read_meta_folder
from difftetvr.capture.projections.readers.own_files import read_hdf5, read_npz
from difftetvr.errors import CaptureError

READERS: dict[str, Callable[[Path, ScanOptions], RawScan]] = {
    ".npz": read_npz,
    **dict.fromkeys(HDF5, read_hdf5),
    ".npy": read_npy,
}
"""Readers of files, by suffix."""


def read_scan(path: Path, options: ScanOptions) -> RawScan:
    """The projections in a file or a folder.

    Raises:
        CaptureError: They are missing, damaged, or of an unknown kind.
    """
    suffix = path.suffix.lower()
    if not path.exists():
        raise CaptureError(f"There is no file '{path}'; check the path of the scan.")
    if path.is_dir() or path.name == META_FOLDER:
        if path.is_dir() and not (path / META_FOLDER).is_file():
            raise CaptureError(f"'{path}' is a folder without {META_FOLDER}; give the file of projections in it.")
        return read_meta_folder(path, options)
    if suffix in PICKLES:
        raise CaptureError(
            f"'{path}' is a pickle of Python, which can run any program when it is read; write its projections as .npy "
            "and its geometry as .json, in a program that trusts it."
        )
    if suffix not in READERS:
        known = f"{', '.join(READERS)}, or a folder with {META_FOLDER}"
        raise CaptureError(f"'{path}' is no file of projections that can be read; give {known}.")
    return READERS[suffix](path, options)
