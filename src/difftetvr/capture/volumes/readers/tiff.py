"""Volumes in TIFF files: a stack of pages, or a folder of slices. tifffile reads the pages.

Sources: TIFF 6.0; the tag ImageDepth is that of SGI, for pages that are volumes.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.capture.volumes.readers.packages import package
from difftetvr.capture.volumes.readers.tiff_description import described
from difftetvr.capture.volumes.stored import Stored, file_size, require_memory
from difftetvr.capture.volumes.volume_file import RawVolume
from difftetvr.errors import CaptureError
from difftetvr.trust import file_beside, require_modest

_LOG = logging.getLogger("tifffile")
SUFFIXES = (".tif", ".tiff")
# What photographs with cameras have beside or above their images.
_OF_PHOTOGRAPHS = re.compile(r"(transforms.*|cameras)\.json|(cameras|images|points3D)\.(bin|txt)|sparse", re.IGNORECASE)
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _PALETTE = 0, 1, 3


def is_folder_of_slices(path: Path) -> bool:
    """Whether a folder holds TIFF files, at least two, and nothing that tells of cameras."""
    return len(_slices(path)) > 1 and not any(map(_OF_PHOTOGRAPHS.fullmatch, _entries(path)))


def read_tiff(path: Path) -> RawVolume:
    """Read a stack of pages of one size.

    Raises:
        CaptureError: The file is damaged, holds colours or one page only, or tifffile is missing.
    """
    with _opened(path) as (tiff, faults):
        pages = _pages(path, tiff)
        told = described(path, tiff)
        depth = sum(page.imagedepth for page in pages)
        if depth == 1 and (told.slices or 1) > 1:
            values = _one_behind_the_other(path, pages[0], told.slices or 1, tiff.byteorder)
        elif depth == 1:
            raise CaptureError(f"'{path}' holds a single slice; give a stack of them, or the folder with all slices.")
        else:
            require_modest(path, sum(page.nbytes for page in pages), "slices", CaptureError)
            values = np.concatenate([_samples(path, page) for page in pages])
        values, notes = _as_brightness(path, pages[0], values, told.is_imagej)
    return RawVolume(values, told.distances.values, notes=(*faults.notes(path), *told.distances.notes, *notes))


def read_slices(path: Path) -> RawVolume:
    """Read a folder of TIFF files of one page each, by their names: slice 2 before slice 10.

    Raises:
        CaptureError: A file is damaged, or of another size or type than the first.
    """
    layers: list[np.ndarray] = []
    notes: tuple[str, ...] = ()
    files = _slices(path)
    for name in files:
        file = file_beside(path, name, CaptureError)
        with _opened(file) as (tiff, faults):
            pages = _pages(file, tiff)
            if len(pages) != 1 or pages[0].imagedepth != 1:
                raise CaptureError(f"'{file}' holds more than one slice; give a folder of single slices, or one stack.")
            require_modest(file, pages[0].nbytes, "slices", CaptureError)
            if not layers:
                require_memory(path, len(files) * pages[0].nbytes)
            layer, said = _as_brightness(file, pages[0], _samples(file, pages[0]), bool(tiff.imagej_metadata))
            layers.append(layer)
        if (layers[-1].shape, layers[-1].dtype) != (layers[0].shape, layers[0].dtype):
            raise CaptureError(f"'{file}' has another size or type than '{files[0]}'; give slices that are alike.")
        notes = notes or (*faults.notes(file), *said)
    return RawVolume(np.concatenate(layers), (1.0, 1.0, 1.0), notes=notes)


def _slices(path: Path) -> list[str]:
    """Names of the TIFF files in a folder; numbers in them count as such."""
    names = [name for name in _entries(path) if name.lower().endswith(SUFFIXES) and not name.startswith(".")]
    return sorted(names, key=_in_order)


def _entries(path: Path) -> list[str]:
    try:
        return os.listdir(path)
    except OSError:
        return []


def _in_order(name: str) -> list[tuple[int, str]]:
    # Every other part is a number.
    parts = enumerate(re.split(r"(\d{1,18})", name))
    return [(int(part), "") if index % 2 else (-1, part) for index, part in parts]


class _Faults(logging.Handler):
    """Hears what tifffile finds wrong with a file and passes over."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.count = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Counts a message, which speaks of the inside of files too closely to be printed."""
        self.count += 1

    def notes(self, path: Path) -> tuple[str, ...]:
        """A sentence where there was anything."""
        return (f"Parts of '{path}' are damaged and were passed over; samples may be missing.",) if self.count else ()


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, _Faults]]:
    tifffile = package("tifffile", path)
    file_size(path)
    faults = _Faults()
    _LOG.addHandler(faults)
    try:
        # Taken for OME's, a file could lead to others.
        with tifffile.TiffFile(path, is_ome=False) as tiff:
            yield tiff, faults
    except (CaptureError, MemoryError):
        raise
    except Exception as error:
        if "imagecodecs" in str(error):
            raise CaptureError(
                f"'{path}' is compressed in a way that needs the package imagecodecs; install it, or save the slices "
                "uncompressed."
            ) from error
        # What damaged files raise is for tifffile, zlib and numpy to decide, and no list of it is complete.
        raise CaptureError(f"'{path}' is no intact TIFF file; get the file anew.") from error
    finally:
        _LOG.removeHandler(faults)


def _pages(path: Path, tiff: Any) -> list[Any]:
    """The pages that are slices, checked to be alike and as large as they say."""
    pages: list[Any] = []
    seen: set[int] = set()
    size = file_size(path)
    for page in tiff.pages:
        if page.offset in seen:
            raise CaptureError(f"'{path}' is damaged: its pages lead in a circle; get the file anew.")
        seen.add(page.offset)
        if page.is_reduced or page.is_mask:
            continue
        pages.append(page)
        _require_scalars(path, page)
        if _kind(page) != _kind(pages[0]):
            raise CaptureError(f"The pages of '{path}' differ in size or type; give slices that are alike.")
        if page.imagedepth > 1 < len(pages):
            raise CaptureError(f"'{path}' holds several volumes, one a page; save one of them.")
        stored = sum(page.databytecounts)
        ends = [start + count for start, count in zip(page.dataoffsets, page.databytecounts)]
        samples = page.imagewidth * page.imagelength * page.imagedepth
        is_short = page.compression == 1 and 8 * stored < page.bitspersample * samples
        if not ends or max(ends) > size or 0 in page.databytecounts or is_short:
            raise CaptureError(f"'{path}' is damaged: it is shorter than its pages need; get the file anew.")
    if not pages:
        raise CaptureError(f"'{path}' holds no page; get the file anew.")
    return pages


def _kind(page: Any) -> tuple[Any, ...]:
    """What pages of a stack have in common."""
    return page.shape, page.dtype, page.photometric, page.bitspersample


def _require_scalars(path: Path, page: Any) -> None:
    """Checks that a page holds one number for each sample."""
    if page.dtype is None or page.dtype.kind not in "buif":
        raise CaptureError(f"'{path}' holds no integers or floats; give slices of such.")
    kind = page.photometric
    if page.samplesperpixel != 1 or kind not in (_WHITE_IS_ZERO, _BLACK_IS_ZERO, _PALETTE):
        name = str(getattr(kind, "name", kind))
        raise CaptureError(f"'{path}' holds pictures with colours ({name}); give slices of one channel.")
    if page.shape not in ((page.imagelength, page.imagewidth), (page.imagedepth, page.imagelength, page.imagewidth)):
        raise CaptureError(f"'{path}' holds no pictures of rows and columns; give slices of such.")


def _samples(path: Path, page: Any) -> np.ndarray:
    """(nz, ny, nx) values of a page, mostly one layer; truth values count as numbers from 0 to 1."""
    values = np.asarray(page.asarray())
    if values.shape != page.shape:
        raise CaptureError(f"'{path}' is damaged: a page has another size than it says; get the file anew.")
    values = values.reshape(page.imagedepth, page.imagelength, page.imagewidth)
    values = values.astype(np.int8) if values.dtype == np.bool_ else values
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def _as_brightness(path: Path, page: Any, values: np.ndarray, is_imagej: bool) -> tuple[np.ndarray, tuple[str, ...]]:
    """Values of which the greater are the brighter, of pages that are stored otherwise, and what to say of it.

    Raises:
        CaptureError: They stand for colours.
    """
    if page.photometric == _PALETTE:
        return _without_palette(path, page, values, is_imagej)
    if page.photometric == _BLACK_IS_ZERO:
        return values, ()
    if page.dtype.kind not in "bu":
        return values, (f"'{path}' shows its least values as the brightest (WhiteIsZero); they are read as they are.",)
    # Samples of 12 bits are unpacked to 16, and those of 1 bit are truth values.
    most = values.dtype.type(2**page.bitspersample - 1)
    return most - values, (f"'{path}' stores black as the greatest value (WhiteIsZero); its values are inverted.",)


def _without_palette(path: Path, page: Any, values: np.ndarray, is_imagej: bool) -> tuple[np.ndarray, tuple[str, ...]]:
    colors = np.asarray(() if page.colormap is None else page.colormap)
    if is_imagej:
        # Its look-up tables are how measured values are shown.
        return values, (f"'{path}' is shown in colours by ImageJ; its values are read as they are.",)
    if page.dtype.kind != "u" or colors.shape != (3, 2**page.bitspersample) or (colors != colors[0]).any():
        raise CaptureError(f"'{path}' holds pictures with colours, by a palette; give slices of one channel.")
    if np.array_equal(colors[0] >> 8, np.arange(256)):
        return values, ()
    return colors[0][values], (f"The greys of '{path}' are taken from its palette, from 0 to 65535.",)


def _one_behind_the_other(path: Path, first: Any, count: int, order: str) -> np.ndarray:
    """(count, ny, nx) slices of which the first has a page only, because they lie one behind the other."""
    dtype = first.dtype.newbyteorder(order)
    size = count * first.nbytes
    data = Stored(path, start=first.dataoffsets[0]).read(size)[:size]
    if first.compression != 1 or len(data) != size:
        raise CaptureError(f"'{path}' is damaged: it holds fewer than the {count} slices it tells of; get it anew.")
    return np.frombuffer(data, dtype).reshape(count, *first.shape).astype(first.dtype.newbyteorder("="), copy=False)
