"""NumPy's archives (.npz) from strangers: only what is wanted is unpacked, no more than announced and allowed."""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO

import numpy as np

from difftetvr.errors import DiffTetError
from difftetvr.trust import require_modest, require_regular

_SUFFIX = ".npy"
_AT_ONCE = 2**20


def array_names(path: str | Path) -> set[str]:
    """Names of the arrays in an archive; none for what is no archive or cannot be read."""
    try:
        if not os.path.isfile(path):
            return set()
        with zipfile.ZipFile(path) as archive:
            return {_plain(name) for name in archive.namelist()}
    # What damaged archives raise is for zipfile to decide, and no list of it is complete.
    except Exception:
        return set()


def read_arrays(
    path: str | Path, error: type[DiffTetError], wanted: Callable[[str, tuple[int, ...]], bool] = lambda *_: True
) -> dict[str, np.ndarray]:
    """Arrays of an archive, by name.

    Args:
        path: The .npz file.
        error: The exception to raise.
        wanted: Whether to unpack an array, by its name and shape; headers of all members are read, and no more of
            those that are not wanted.

    Returns:
        The wanted arrays. Members that are no arrays are left out.

    Raises:
        DiffTetError: (of type ``error``) It cannot be read, is damaged, holds Python objects, or unpacks to too much.
    """
    path = Path(path)
    require_regular(path, error)
    try:
        with zipfile.ZipFile(path) as archive:
            _require_compression_of_numpy(archive, path, error)
            members = {m: header for m in archive.infolist() if (header := _header(archive, m)) is not None}
            chosen = {m: h for m, h in members.items() if wanted(_plain(m.filename), h.shape)}
            require_modest(path, sum(header.size for header in chosen.values()), "arrays", error)
            return {_plain(m.filename): _read(archive, m, header) for m, header in chosen.items()}
    except DiffTetError:
        raise
    except OSError as problem:
        raise error(f"Cannot read {path}: {problem.strerror or problem}; check the path and the disk.") from problem
    except MemoryError as problem:
        raise error(f"{path} needs more memory than there is; make its arrays smaller.") from problem
    # What damaged archives raise is for zipfile, zlib, ast and tokenize to decide, and no list of it is complete.
    except Exception as problem:
        raise error(f"{path} is no intact numpy archive of plain arrays; write it again or get it anew.") from problem


def read_array(path: str | Path, error: type[DiffTetError]) -> np.ndarray:
    """The array of a .npy file, under the same rules as :func:`read_arrays`."""
    path = Path(path)
    require_regular(path, error)
    try:
        with path.open("rb") as file:
            header = _Header.of(file, os.path.getsize(path))
            return header.array(bytearray(file.read(header.data_size)))  # so that it can be written to
    except OSError as problem:
        raise error(f"Cannot read {path}: {problem.strerror or problem}; check the path and the disk.") from problem
    except MemoryError as problem:
        raise error(f"{path} needs more memory than there is; make it smaller.") from problem
    # As above.
    except Exception as problem:
        raise error(f"{path} is no intact file of a plain numpy array; write it again or get it anew.") from problem


class _Header:
    """What the header of an array says, held against the bytes that are there."""

    def __init__(self, shape: tuple[int, ...], fortran: bool, dtype: np.dtype, size: int, begin: int) -> None:
        self.shape, self.fortran, self.dtype, self.size, self.begin = shape, fortran, dtype, size, begin
        if dtype.hasobject or not all(isinstance(n, int) and n >= 0 for n in shape):
            raise ValueError("it is no plain array")
        self.data_size = math.prod(shape) * dtype.itemsize
        if self.data_size != size - begin:
            raise ValueError("it announces another size than it has")

    @classmethod
    def of(cls, file: IO[bytes], size: int) -> _Header:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(file)
        return cls(shape, fortran, dtype, size, file.tell())

    def array(self, data: bytes | bytearray) -> np.ndarray:
        if len(data) != self.data_size:
            raise ValueError("it is cut short")
        values = np.frombuffer(data, self.dtype) if data else np.empty(math.prod(self.shape), self.dtype)
        return values.reshape(self.shape[::-1]).T if self.fortran else values.reshape(self.shape)


def _require_compression_of_numpy(archive: zipfile.ZipFile, path: Path, error: type[DiffTetError]) -> None:
    """Of other methods zipfile unpacks gigabytes at once where a header's bytes are asked for."""
    for member in archive.infolist():
        if member.filename.endswith(_SUFFIX) and member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise error(
                f"{path} is compressed as numpy does not compress archives; write it with numpy.savez_compressed."
            )


def _header(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> _Header | None:
    """None for a member that is no array."""
    if not member.filename.endswith(_SUFFIX):
        return None
    with archive.open(member) as file:
        return _Header.of(file, member.file_size)


def _read(archive: zipfile.ZipFile, member: zipfile.ZipInfo, header: _Header) -> np.ndarray:
    with archive.open(member) as file:
        file.seek(header.begin)
        data = bytearray()
        while len(data) <= header.data_size and (piece := file.read(_AT_ONCE)):
            data += piece
    return header.array(data)


def _plain(name: str) -> str:
    return name.removesuffix(_SUFFIX)
