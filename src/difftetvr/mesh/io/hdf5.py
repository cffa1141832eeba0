"""HDF5 files from strangers: arrays that lie in the file itself, no larger than is allowed.

HDF5 can fetch what it calls a dataset from any other file: by external links, by raw storage outside, by virtual
layouts. And a few bytes of it can announce any number of copies of one value.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import damaged
from difftetvr.trust import file_beside, require_modest, require_regular

_MOST_LINKS = 16


class PlainFile:
    """An HDF5 file, open to be read; a context manager.

    Links to files beside it are followed, as `difftetvr.trust.file_beside` allows.
    """

    def __init__(self, path: Path) -> None:
        """Open a file.

        Args:
            path: The file.

        Raises:
            MeshError: It is no HDF5 file, or the package h5py is not installed.
        """
        self.path = path
        self._size = 0
        self._h5py = load_h5py(path)
        require_regular(path, MeshError)
        with _sentences(path):
            self._file = self._h5py.File(path, "r")

    def __enter__(self) -> PlainFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def array(self, inside: str, part: tuple[slice, ...] = ()) -> np.ndarray:
        """An array of numbers.

        Args:
            inside: Its path in the file.
            part: What of it to read; default: all.

        Raises:
            MeshError: There is none, it lies elsewhere, is too large, holds something else, or is damaged.
        """
        return self._array(inside, part, _MOST_LINKS)

    @property
    def names(self) -> list[str]:
        """What lies at the root of the file.

        Raises:
            MeshError: The file is damaged.
        """
        with _sentences(self.path):
            return sorted(map(str, self._file))

    def holds(self, inside: str) -> bool:
        """Whether there is something at a path in the file; it need not be an array of numbers."""
        try:
            return inside in self._file
        # As in `_sentences`.
        except Exception:
            return False

    def text(self, inside: str) -> str:
        """One text. HDF5 packs none, so it is no longer than the file.

        Args:
            inside: Its path in the file.

        Raises:
            MeshError: There is none, it lies elsewhere, or is damaged.
        """
        with _sentences(self.path):
            link = self._file.get(inside, getlink=True)
            found = self._file[inside] if isinstance(link, self._h5py.HardLink) else None
            is_text = isinstance(found, self._h5py.Dataset) and self._h5py.check_string_dtype(found.dtype) is not None
            if found is None or not is_text or found.size != 1 or found.external or found.is_virtual:
                raise damaged(self.path, f"{inside[:80]!r} in it is no text")
            self._require_modest(found.dtype.itemsize)
            value = found[()]
            return value.decode() if isinstance(value, bytes) else str(value)

    def unit_of(self, inside: str) -> str:
        """What an array's attribute ``units`` says; empty where there is none, or no text."""
        with contextlib.suppress(Exception):  # as in `_sentences`
            value = self._file[inside].attrs["units"]
            return value.decode() if isinstance(value, bytes) else value if isinstance(value, str) else ""
        return ""

    def shape_of(self, inside: str) -> tuple[int, ...]:
        """How many numbers an array has along its axes; none where there is no array."""
        with _sentences(self.path):
            found = self._file.get(inside) if self.holds(inside) else None
            return tuple(found.shape) if isinstance(found, self._h5py.Dataset) and found.shape else ()

    def require_plain(self, sized: bool = True) -> None:
        """Checks all that is in the file, for readers that are less careful.

        Args:
            sized: Whether to hold the size of all arrays against what is allowed, too.

        Raises:
            MeshError: Something in it lies elsewhere, or all together is too large.
        """
        with _sentences(self.path):
            groups, seen = [self._file["/"]], set()
            while groups:
                group = groups.pop()
                for name in group:
                    link = group.get(name, getlink=True)
                    if isinstance(link, self._h5py.ExternalLink):
                        raise self._outside(name)
                    if isinstance(link, self._h5py.SoftLink):
                        continue  # it leads to what is found elsewhere in the file, or to an external link found there
                    found = group[name]
                    address = self._h5py.h5o.get_info(found.id).addr
                    if address in seen:
                        continue
                    seen.add(address)
                    if isinstance(found, self._h5py.Group):
                        groups.append(found)
                    elif isinstance(found, self._h5py.Dataset):
                        self._require_inside(found, name)
                        self._require_modest(found.nbytes if sized and found.shape is not None else 0)

    def _array(self, inside: str, part: tuple[slice, ...], links: int) -> np.ndarray:
        with _sentences(self.path):
            found, names = self._file["/"], _names(inside)
            while names:
                name = names.pop(0)
                link = found.get(name, getlink=True) if isinstance(found, self._h5py.Group) else None
                if link is None:
                    raise damaged(self.path, f"there is no array {inside[:80]!r} in it")
                links -= not isinstance(link, self._h5py.HardLink)
                if links < 0:
                    raise damaged(self.path, "its links go in circles")
                if isinstance(link, self._h5py.ExternalLink):
                    with PlainFile(file_beside(self.path, link.filename, MeshError)) as other:
                        return other._array("/".join((link.path, *names)), part, links)
                if isinstance(link, self._h5py.SoftLink):
                    names = [*_names(link.path), *names]
                    found = self._file["/"] if link.path.startswith("/") else found
                else:
                    found = found[name]
            if not isinstance(found, self._h5py.Dataset) or found.shape is None or found.dtype.kind not in "fiub":
                raise damaged(self.path, f"{inside[:80]!r} in it is no array of numbers")
            self._require_inside(found, inside)
            count = [len(range(*s.indices(n))) for s, n in zip(part, found.shape)] + list(found.shape[len(part) :])
            self._require_modest(found.dtype.itemsize * int(np.prod(count, dtype=object)))
            return np.asarray(found[part if part else ()])

    def _require_inside(self, dataset: Any, name: str) -> None:
        if dataset.external or dataset.is_virtual:
            raise self._outside(name)
        if dataset.size and not dataset.id.get_storage_size() and not dataset.attrs.get("CLASS") == b"DIMENSION_SCALE":
            raise damaged(self.path, f"the array {name[:80]!r} was announced but never written")

    def _require_modest(self, size: int) -> None:
        self._size += size
        require_modest(self.path, self._size, "arrays", MeshError)

    def _outside(self, name: str) -> MeshError:
        return MeshError(
            f"{self.path} takes {name[:80]!r} from another file; copy all into one file, as h5repack and h5copy do."
        )


def load_h5py(path: Path) -> Any:
    """The package h5py, which reads a file.

    Raises:
        MeshError: It is not installed.
    """
    try:
        return importlib.import_module("h5py")
    except ImportError as error:
        raise MeshError(
            f"{path} is kept in HDF5, which h5py reads; install it with pip install 'difftetvr[hdf5]'."
        ) from error


def _names(inside: str) -> list[str]:
    return [name for name in inside.split("/") if name not in ("", ".")]


@contextlib.contextmanager
def _sentences(path: Path) -> Iterator[None]:
    try:
        yield
    except (MeshError, MemoryError):
        raise
    # What damaged files raise is for h5py to decide, and no list of it is complete.
    except Exception as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise damaged(path, lines[0][:200].rstrip(".") if lines else type(error).__name__) from error
