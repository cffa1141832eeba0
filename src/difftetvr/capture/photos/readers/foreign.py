"""Exports of programs whose cameras are not read here: what they are, and what to export instead."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

_PEEKED_BYTES = 4096
_PEEKED_FILES = 64
_FOR_COLMAP = "export the cameras for COLMAP there"
_CONVERTED = "or convert them to a transforms.json with nerfstudio (ns-process-data {})"
# By the end of a file's name and how its content begins: who wrote it, and what to do.
_EXPORTS = (
    (
        ".xml",
        re.compile(rb"<document\b.{0,999}?<chunk\b", re.DOTALL),
        "cameras of Metashape",
        f"{_FOR_COLMAP} (File, Export, Export Cameras), {_CONVERTED.format('metashape')}",
    ),
    (
        ".csv",
        re.compile(rb"\A\W*name,x,y,(?:alt|z)\b"),
        "cameras of RealityCapture",
        f"{_FOR_COLMAP} (Alignment, Export, Registration), {_CONVERTED.format('realitycapture')}",
    ),
    (
        ".out",
        re.compile(rb"\A# Bundle file"),
        "cameras of Bundler",
        f"{_FOR_COLMAP}, where that can be chosen",
    ),
    (
        ".r3d",
        re.compile(rb"\APK"),
        "a recording of Record3D",
        "export it as EXR and RGB in the app, which gives a folder with metadata.json",
    ),
)


def known_export(path: Path) -> str | None:
    """What a file, or a folder with such a file, is, and what to do about it, as the rest of a sentence; None: unknown.

    Args:
        path: File or folder.
    """
    for file in _candidates(path):
        for suffix, pattern, what, advice in _EXPORTS:
            if file.suffix.lower() == suffix and pattern.search(_beginning(file)):
                where = "" if file == path else f" ({file.name})"
                return f"holds {what}{where}, which are not read; {advice}"
    return None


def _candidates(path: Path) -> Iterator[Path]:
    if not os.path.isdir(path):
        yield path
        return
    suffixes = {suffix for suffix, *_ in _EXPORTS}
    try:
        names = sorted(name for name in os.listdir(path) if Path(name).suffix.lower() in suffixes)
    except OSError:
        return
    yield from (path / name for name in names[:_PEEKED_FILES])


def _beginning(file: Path) -> bytes:
    try:
        if not file.is_file():
            return b""
        with file.open("rb") as stream:
            return stream.read(_PEEKED_BYTES)
    except OSError:
        return b""
