"""Readers of others in a process of their own: they may loop for ever, take all memory, or crash with their library.

A limit of time and one of memory hold there, both by the size of the files. Nothing that can be run comes back: plain
arrays and sentences.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import CellBlock, Content
from difftetvr.trust import current_trust, require_modest

SECONDS = 6.0
"""Of processor time that any file may take."""

_SECONDS_PER_BYTE = 5.0 / 2**20
_WAIT = 6.0  # seconds of the clock for each one of the processor, as other programs want it, too
_WORKER = Path(__file__).with_name("isolation_worker.py")
# Signals are negative codes, and the limit of processor time ends the process by one where the system knows it.
_TIMED_OUT = (None, -signal.SIGXCPU) if hasattr(signal, "SIGXCPU") else (None,)
_LIBRARY_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def isolated(
    reader: Callable[[Path, int | None], Content], path: Path, step: int | None = None, besides: Sequence[Path] = ()
) -> Content:
    """What a reader says that is not to be trusted with this process.

    Args:
        reader: A function of a module, from a file and the number of a time step to a content; it raises `MeshError`.
        path: The file.
        step: As `difftetvr.mesh.io.content.chosen_step` takes it.
        besides: Other files that will be read; what is allowed grows with the size of all.

    Raises:
        MeshError: What the reader raised, or it took too long or too much memory, or broke off.
    """
    files = [path, *besides]
    memory = max(require_modest(file, 0, "a mesh", MeshError) for file in files)
    seconds = SECONDS + _SECONDS_PER_BYTE * sum(file.stat().st_size for file in files)
    trust = current_trust()
    request: dict[str, Any] = {
        "reader": [reader.__module__, reader.__name__],
        "path": str(path),
        "step": step,
        "outside": trust.outside and str(trust.outside),
        "large": trust.large,
        # As much again, since readers of text hold numbers as Python's objects until they have all of them.
        "memory": 2 * memory,
        "seconds": seconds,
    }
    with tempfile.TemporaryDirectory() as folder:
        code = _run(request, Path(folder))
        if code in _TIMED_OUT:
            raise MeshError(
                f"{path} took its reader more than {seconds:.0f} s of computing; it is most likely damaged, so write "
                "it again, or convert it to .vtu."
            )
        answer = Path(folder) / "answer.json"
        said = json.loads(answer.read_text(encoding="utf-8")) if code == 0 else {}
        if "error" in said:
            raise MeshError(said["error"])
        if "content" in said:
            return _content(said["content"], Path(folder) / "arrays.npz")
    if "memory" in said:
        raise MeshError(
            f"{path} takes its reader more memory than {memory / 2**30:.3g} GiB; if you trust it, allow more with "
            "--allow-large (in Python: with dtv.trusting(large=True))."
        )
    raise MeshError(
        f"{path} made its reader break off (exit code {code}); it is most likely damaged, so write it again, or "
        "convert it to .vtu."
    )


def _run(request: dict[str, Any], folder: Path) -> int | None:
    """Exit code of the process; None where it did not end in time."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(os.path.abspath(p) for p in sys.path)}
    environment.update(dict.fromkeys(_LIBRARY_THREADS, "1"))
    try:
        return subprocess.run(
            [sys.executable, str(_WORKER), str(folder)],
            env=environment,
            input=json.dumps(request).encode(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=_WAIT * request["seconds"],
        ).returncode
    except subprocess.TimeoutExpired:
        return None


def _content(said: dict[str, Any], arrays: Path) -> Content:
    with np.load(arrays, allow_pickle=False) as archive:
        blocks = [CellBlock(kind, archive[nodes], archive[rows]) for kind, nodes, rows in said["cells"]]
        point_data, cell_data = (
            {name: archive[key] for name, key in said[place]} for place in ("point_data", "cell_data")
        )
        notes = tuple(said["notes"])
        return Content(archive[said["vertices"]], tuple(blocks), point_data, cell_data, notes, hidden=said["hidden"])
