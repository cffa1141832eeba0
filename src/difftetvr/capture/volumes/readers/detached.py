"""The data files that NRRD and MetaImage headers name: one, a list, or a pattern with a range of numbers."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

from difftetvr.errors import CaptureError
from difftetvr.trust import file_beside, require_regular

# All that a pattern may hold of printf's language: one whole number, filled up with zeros or spaces.
_PLACE = re.compile(r"%(?P<zero>0?)(?P<width>\d?)[diu]")


def data_files(owner: Path, value: str, listed: Sequence[str], shape: tuple[int, int, int]) -> list[Path]:
    """The files of a volume in the order of its samples.

    Args:
        owner: The header.
        value: What it says in place of the data: the name of a file; ``LIST``, ``LIST 2``; ``slice%03d.raw 1 60 1``,
            ``slice%03d.raw 1 60 1 2``. The last number is the number of dimensions of a file's part; 2, the default,
            is a slice, 3 a slab of slices, 1 a row.
        listed: Names of files, for ``LIST``.
        shape: Samples (nx, ny, nz).

    Raises:
        CaptureError: A file does not exist, lies outside of the header's folder, or their number does not fit.
    """
    if match := re.fullmatch(r"LIST(?:\s+(\d))?", value):
        names, dimensions = list(listed), int(match[1] or 2)
        _require_parts(owner, len(names), dimensions, shape)
    elif "%" in value and (counting := _trailing_numbers(value)):
        first, last, step, dimensions = (*counting, 2)[:4]
        numbers = _numbers(owner, first, last, step)
        _require_parts(owner, len(numbers), dimensions, shape)
        names = [_numbered(owner, value.rsplit(maxsplit=len(counting))[0], number) for number in numbers]
    else:
        names = [value]
    files = [file_beside(owner, name, CaptureError) for name in names]
    for name, file in zip(names, files):
        if not os.path.exists(file):
            raise CaptureError(f"'{owner}' names the data file '{name[:80]}', which does not exist beside it.")
        require_regular(file, CaptureError)
    return files


def _trailing_numbers(value: str) -> list[int]:
    """The three or four whole numbers behind a pattern; an empty list where there are not as many."""
    words = value.split()[-4:]
    for count in (4, 3):
        if len(words) >= count and all(re.fullmatch(r"-?\d{1,9}", word) for word in words[-count:]):
            return [int(word) for word in words[-count:]]
    return []


def _numbers(owner: Path, first: int, last: int, step: int) -> range:
    if step == 0:
        raise CaptureError(f"'{owner}' numbers its data files in steps of 0; correct its header.")
    return range(first, last + (1 if step > 0 else -1), step)


def _numbered(owner: Path, pattern: str, number: int) -> str:
    place = _PLACE.search(pattern)
    if place is None or pattern.count("%") != 1:
        raise CaptureError(
            f"'{owner}' names its data files by the pattern '{pattern}', which needs one whole number, such as %03d."
        )
    fill = f"{number:{place['zero']}{place['width']}d}"
    return pattern[: place.start()] + fill + pattern[place.end() :]


def _require_parts(owner: Path, count: int, dimensions: int, shape: tuple[int, int, int]) -> None:
    nx, ny, nz = shape
    needed = {1: ny * nz, 2: nz, 3: nz}.get(dimensions, 0)
    fits = count > 0 and (needed % count == 0 if dimensions == 3 else count == needed)
    if not fits:
        raise CaptureError(
            f"'{owner}' names {count} data files for {nx} x {ny} x {nz} samples, which is no whole number of slices "
            "for each; correct its header."
        )
