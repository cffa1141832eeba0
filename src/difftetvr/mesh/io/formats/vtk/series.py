"""Lists of VTK's files in JSON, as ParaView keeps the time steps of a series (.vtu.series, .vtk.series)."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import Content, chosen_step, damaged
from difftetvr.mesh.io.formats.vtk import legacy, lists
from difftetvr.trust import file_beside, require_modest, require_regular


def read(path: Path, step: int | None = None) -> Content:
    """Read one file of a series.

    Args:
        path: The list.
        step: Which file, in the order of their times; see `difftetvr.mesh.io.content.chosen_step`.

    Raises:
        MeshError: The list or the file is damaged or not there, or there is no such step.
    """
    files = _files(path)
    index, notes = chosen_step(path, [time for time, _ in files], step)
    file = file_beside(path, files[index][1], MeshError)
    require_regular(file, MeshError)
    if not os.path.isfile(file):
        raise MeshError(f"{path} names {file.name}, which is not there; put it where it was.")
    content = legacy.read(file) if file.suffix.lower() == ".vtk" else lists.read(file)
    return replace(content, notes=(*notes, *content.notes))


def _files(path: Path) -> list[tuple[float, str]]:
    """Times and names, in the order of the times."""
    require_modest(path, path.stat().st_size, "names", MeshError)
    try:
        entries = json.loads(path.read_bytes())["files"]
        files = [(_time(entry.get("time", i)), str(entry["name"])) for i, entry in enumerate(entries)]
    # What is no list of such entries has other keys or methods, or none.
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError, OverflowError) as error:
        raise damaged(path, "it is no list of files with their times") from error
    if not files:
        raise damaged(path, "it names no files")
    return sorted(files, key=lambda file: file[0])


def _time(value: Any) -> float:
    if not math.isfinite(time := float(value)):
        raise ValueError
    return time
