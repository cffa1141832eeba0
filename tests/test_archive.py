"""NumPy's archives from strangers: what they may hold, and how much they may take."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from difftetvr.archive import read_arrays
from difftetvr.errors import CaptureError


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_compression_that_cannot_be_bounded_is_refused(tmp_path: Path, method: int) -> None:
    """zipfile unpacks gigabytes of bzip2 or LZMA at once, also of a member of which only the header is wanted."""
    np.savez(tmp_path / "a.npz", wanted=np.arange(3))
    with zipfile.ZipFile(tmp_path / "a.npz", "a", method) as archive:
        archive.writestr("other.npy", bytes(1000))
    with pytest.raises(CaptureError, match=r"write it with numpy\.savez_compressed\.$"):
        read_arrays(tmp_path / "a.npz", CaptureError, lambda name, _: name == "wanted")


def test_members_that_are_no_arrays_do_not_disturb(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", wanted=np.arange(3))
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
        archive.writestr("readme.txt", "words")
    assert read_arrays(tmp_path / "a.npz", CaptureError)["wanted"].tolist() == [0, 1, 2]
