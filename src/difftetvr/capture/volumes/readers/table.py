"""Who reads which volume file: one row for each suffix. A new format is a file beside this one and a row here."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

from difftetvr.capture.volumes.readers.metaimage import read_metaimage
from difftetvr.capture.volumes.readers.nifti import read_nifti
from difftetvr.capture.volumes.readers.nrrd import read_nrrd
from difftetvr.capture.volumes.readers.numpy_array import read_npy
from difftetvr.capture.volumes.readers.raw import read_dat, read_raw
from difftetvr.capture.volumes.readers.tiff import is_folder_of_slices, read_slices, read_tiff
from difftetvr.capture.volumes.readers.vti import read_vti
from difftetvr.capture.volumes.volume_file import RawVolume
from difftetvr.errors import CaptureError
from difftetvr.trust import require_regular

READERS: dict[str, Callable[[Path], RawVolume]] = {
    ".dat": read_dat,
    ".nrrd": read_nrrd,
    ".nhdr": read_nrrd,
    ".vti": read_vti,
    ".nii": read_nifti,
    ".nii.gz": read_nifti,
    ".mha": read_metaimage,
    ".mhd": read_metaimage,
    ".tif": read_tiff,
    ".tiff": read_tiff,
    ".npy": read_npy,
}
"""Readers of files that say themselves what they hold, by suffix."""

_UNDESCRIBED = (".raw", ".raw.gz", ".raw.xz")

KNOWN = ", ".join([_UNDESCRIBED[0], *READERS, "or a folder of .tif slices"])
"""What can be read, in words."""


def is_volume_file(path: str | Path) -> bool:
    """Whether a name says that there is a volume that `Volume.load` reads: by its suffix, or as a folder of slices."""
    path = Path(path)
    if os.path.isdir(path):
        return is_folder_of_slices(path)
    return path.name.lower().endswith((*_UNDESCRIBED, *READERS))


def read_volume(path: Path, shape: Sequence[int] | None, dtype: str | None) -> RawVolume:
    """The volume in a file.

    Args:
        path: The file, or a folder of slices.
        shape: (nx, ny, nz) of a ``.raw`` file.
        dtype: NumPy name of the type of its values.

    Raises:
        CaptureError: It is missing, damaged, of another size than described, or of an unknown kind.
    """
    if not is_volume_file(path):
        if os.path.isdir(path):
            raise CaptureError(f"'{path}' is a folder without TIFF slices; give the volume file in it.")
        raise CaptureError(f"'{path}' is no volume that can be read; give {KNOWN}.")
    if not os.path.exists(path):
        raise CaptureError(f"There is no file '{path}'; check the path of the volume.")
    is_folder, name = os.path.isdir(path), path.name.lower()
    if not is_folder:
        require_regular(path, CaptureError)
        if name.endswith(_UNDESCRIBED):
            return read_raw(path, shape, dtype)
    if shape is not None or dtype is not None:
        raise CaptureError(f"'{path}' says itself what it holds; leave out the shape and the dtype.")
    if is_folder:
        return read_slices(path)
    return next(read for suffix, read in READERS.items() if name.endswith(suffix))(path)
