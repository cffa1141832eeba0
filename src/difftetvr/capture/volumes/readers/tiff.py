"""Volumes in TIFF files: a stack of pages, or a folder of slices. tifffile reads the pages.

Sources: TIFF 6.0; https://imagej.net/formats/tiff and https://ome-model.readthedocs.io for the distances of samples.
"""

from __future__ import annotations

import logging
import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.capture.volumes.readers.packages import package
from difftetvr.capture.volumes.stored import Stored, file_size, require_memory
from difftetvr.capture.volumes.volume_file import RawVolume, parse_numbers
from difftetvr.errors import CaptureError
from difftetvr.trust import file_beside, require_modest

_LOG = logging.getLogger("tifffile")
SUFFIXES = (".tif", ".tiff")
# What photographs with cameras have beside or above their images.
_OF_PHOTOGRAPHS = re.compile(r"(transforms.*|cameras)\.json|(cameras|images|points3D)\.(bin|txt)|sparse", re.IGNORECASE)


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
        count, spacing = _stack_of(path, tiff, len(pages))
        if count < 2:
            raise CaptureError(f"'{path}' holds a single slice; give a stack of them, or the folder with all slices.")
        if count > len(pages):
            values = _one_behind_the_other(path, pages[0], count, tiff.byteorder)
        else:
            require_modest(path, sum(page.nbytes for page in pages), "slices", CaptureError)
            values = np.stack([_samples(path, page) for page in pages])
    return RawVolume(values, spacing, notes=faults.notes(path))


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
            if len(pages) != 1:
                raise CaptureError(f"'{file}' holds {len(pages)} pages; give a folder of single slices, or one stack.")
            require_modest(file, pages[0].nbytes, "slices", CaptureError)
            if not layers:
                require_memory(path, len(files) * pages[0].nbytes)
            layers.append(_samples(file, pages[0]))
        if (layers[-1].shape, layers[-1].dtype) != (layers[0].shape, layers[0].dtype):
            raise CaptureError(f"'{file}' has another size or type than '{files[0]}'; give slices that are alike.")
        notes = notes or faults.notes(file)
    return RawVolume(np.stack(layers), (1.0, 1.0, 1.0), notes=notes)


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
        if page.samplesperpixel != 1 or page.ndim != 2 or page.dtype is None or page.dtype.kind not in "buif":
            raise CaptureError(f"'{path}' holds pictures with colours, or no numbers; give slices of one channel.")
        if (page.shape, page.dtype) != (pages[0].shape, pages[0].dtype):
            raise CaptureError(f"The pages of '{path}' differ in size or type; give slices that are alike.")
        stored = sum(page.databytecounts)
        ends = [start + count for start, count in zip(page.dataoffsets, page.databytecounts)]
        is_short = page.compression == 1 and 8 * stored < page.bitspersample * page.imagewidth * page.imagelength
        if not ends or max(ends) > size or 0 in page.databytecounts or is_short:
            raise CaptureError(f"'{path}' is damaged: it is shorter than its pages need; get the file anew.")
    if not pages:
        raise CaptureError(f"'{path}' holds no page; get the file anew.")
    return pages


def _samples(path: Path, page: Any) -> np.ndarray:
    """(ny, nx) values of a page; truth values count as numbers from 0 to 1."""
    values = np.asarray(page.asarray())
    if values.shape != (page.imagelength, page.imagewidth):
        raise CaptureError(f"'{path}' is damaged: a page has another size than it says; get the file anew.")
    values = values.astype(np.int8) if values.dtype == np.bool_ else values
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def _one_behind_the_other(path: Path, first: Any, count: int, order: str) -> np.ndarray:
    """(count, ny, nx) slices of which ImageJ describes the first only, because they lie one behind the other."""
    dtype = first.dtype.newbyteorder(order)
    size = count * first.nbytes
    data = Stored(path, start=first.dataoffsets[0]).read(size)[:size]
    if first.compression != 1 or len(data) != size:
        raise CaptureError(f"'{path}' is damaged: it holds fewer than the {count} slices it tells of; get it anew.")
    return np.frombuffer(data, dtype).reshape(count, *first.shape).astype(first.dtype.newbyteorder("="), copy=False)


def _stack_of(path: Path, tiff: Any, pages: int) -> tuple[int, tuple[float, float, float]]:
    """Number of slices and the distances of samples, as ImageJ or OME tell them, else 1."""
    told = tiff.imagej_metadata or {}
    more = {"channels": told.get("channels", 1), "time steps": told.get("frames", 1)}
    spacing = None
    if told:
        spacing = _imagej_spacing(tiff.pages[0], told)
    elif (pixels := _ome_pixels(tiff.pages[0].description)) is not None:
        more = {"channels": pixels.get("SizeC", "1"), "time steps": pixels.get("SizeT", "1")}
        spacing = parse_numbers([pixels.get(f"PhysicalSize{axis}", "1") for axis in "XYZ"])
    for what, count in more.items():
        if str(count) != "1":
            raise CaptureError(f"'{path}' holds {count} {what}; give a stack of the slices of one of them.")
    count = told.get("images", pages) if pages == 1 else pages
    if not isinstance(count, int) or not spacing or not all(0 < s < float("inf") for s in spacing):
        return (count if isinstance(count, int) else pages), (1.0, 1.0, 1.0)
    return count, (spacing[0], spacing[1], spacing[2])


def _imagej_spacing(page: Any, told: dict[str, Any]) -> Sequence[float]:
    """Along x, y and z: the pixels' size from their resolution, the slices' distance as told."""
    sides = []
    for name in ("XResolution", "YResolution"):
        pixels, units = page.tags[name].value if name in page.tags else (1, 1)
        sides.append(float(units) / float(pixels) if pixels else 0.0)
    return (*sides, *(parse_numbers([told.get("spacing", 1.0)]) or [0.0]))


def _ome_pixels(description: str) -> ElementTree.Element | None:
    """OME's description of the pixels; None where a page has none."""
    if "<OME" not in description[:1000]:
        return None
    try:
        root = ElementTree.fromstring(description.encode())
    except ElementTree.ParseError:
        return None
    return next((element for element in root.iter() if element.tag.rpartition("}")[2] == "Pixels"), None)
