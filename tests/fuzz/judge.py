"""The child: reads what it is told, line by line, and says what became of it.

A line in is `[kind, path]`; a line out is `[outcome, details, bytes of memory at most]`, with the outcome "content",
"sentence" or "FAILURE". What never ends or takes all memory is for the parent to see.
"""

from __future__ import annotations

import contextlib
import json
import sys
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path

import torch

import difftetvr as dtv
from difftetvr.cli.mesh import load_points
from difftetvr.errors import CaptureWarning, DiffTetError
from difftetvr.mesh.making.surfaces import load_surface


def mesh(path: Path) -> None:
    """All that can be drawn."""
    _check_mesh(dtv.load_data(path, flat="drop", loose=True, split=True))


def strict_mesh(path: Path) -> None:
    """Only what is a mesh as it stands."""
    data = dtv.load_data(path)
    data.mesh.validate()
    _check_mesh(data)


def _check_mesh(data: dtv.MeshData) -> None:
    tets, points = data.mesh.tets, data.mesh.num_vertices
    assert int(tets.min()) >= 0 and int(tets.max()) < points, "a cell names a vertex that is not there"
    assert all(len(values) == points for values in data.point_data.values()), "data do not fit the vertices"
    assert all(len(values) == len(tets) for values in data.cell_data.values()), "data do not fit the cells"
    for warning in data.warnings:
        _check_sentence(warning)


def _check_sentence(text: str) -> None:
    assert text.endswith("."), f"no sentence: {text!r}"
    assert text.isprintable(), f"not one plain line: {text!r}"


READERS: dict[str, Callable[[Path], object]] = {
    "mesh": mesh,
    "strict mesh": strict_mesh,
    "capture": dtv.load_capture,
    "volume": dtv.Volume.load,
    "scan": dtv.capture.ProjectionCapture.load,
    "geometry": dtv.capture.ProjectionGeometry.load,
    "transfer function": dtv.TransferFunction.load,
    "points": load_points,
    "surface": load_surface,
}
"""What is asked to read a file, by kind."""


def judge(kind: str, path: Path) -> tuple[str, str]:
    """What became of a file, and why."""
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("error")  # NumPy's belong to no user
            warnings.simplefilter("always", CaptureWarning)
            try:
                READERS[kind](path)
                outcome, details = "content", ""
            except DiffTetError as error:
                outcome, details = "sentence", str(error)
                _check_sentence(details)
        for warning in said:
            _check_sentence(str(warning.message))
    except BaseException:
        return "FAILURE", traceback.format_exc()
    return outcome, details


def _peak() -> int:
    """Bytes of memory at most since the last call; 0 where the system does not say."""
    with contextlib.suppress(OSError, ValueError):
        status = Path("/proc/self/status").read_text(encoding="ascii")
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
        return 1024 * int(status.split("VmHWM:")[1].split()[0])
    return 0


def main() -> None:
    """Answers until there are no more lines."""
    torch.set_num_threads(1)
    answers, sys.stdout = sys.stdout, sys.stderr  # what a library prints is no answer
    for line in sys.stdin:
        kind, path = json.loads(line)
        _peak()
        answers.write(json.dumps([*judge(kind, Path(path)), _peak()]) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
