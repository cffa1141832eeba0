"""Runs a reader in a process of its own: ``python isolation_worker.py FOLDER``, with a request as JSON on its input.

Into the folder go ``answer.json`` and ``arrays.npz``; see `difftetvr.mesh.io.isolation`.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from difftetvr.mesh.io.content import Content


def main(folder: Path, request: dict[str, Any]) -> None:
    """Reads what the request names and writes the answer: the content, an error's sentence, or a lack of memory."""
    from difftetvr.errors import MeshError
    from difftetvr.mesh.io.content import damaged
    from difftetvr.trust import trusting

    module, name = request["reader"]
    reader, path = getattr(importlib.import_module(module), name), Path(request["path"])
    _limit(request["memory"], request["seconds"])
    answer: dict[str, Any]
    try:
        with trusting(request["outside"], request["large"]):
            answer = {"content": _write(folder / "arrays.npz", reader(path, request["step"]))}
    except MeshError as error:
        answer = {"error": str(error)}
    except MemoryError:
        answer = {"memory": True}
    except OSError as error:
        answer = {"error": str(damaged(path, error.strerror or type(error).__name__))}
    # Libraries raise what they like on damaged files.
    except Exception as error:
        first = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
        answer = {"error": str(damaged(path, first[:200].rstrip(".")))}
    (folder / "answer.json").write_text(json.dumps(answer), encoding="utf-8")


def _limit(memory: int, seconds: float) -> None:
    """Holds for what comes from now on; without limits where the system has none, as Windows."""
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        used = resource.getrusage(resource.RUSAGE_SELF)
        end = int(used.ru_utime + used.ru_stime + seconds + 1)
        resource.setrlimit(resource.RLIMIT_CPU, (end, resource.getrlimit(resource.RLIMIT_CPU)[1]))
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        most = pages * resource.getpagesize() + memory
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))


def _write(file: Path, content: Content) -> dict[str, Any]:
    """Writes the arrays and returns the rest, with their keys in place of them."""
    import numpy as np

    arrays: dict[str, Any] = {}

    def key(values: Any) -> str:
        array = np.asarray(values)
        arrays[str(len(arrays))] = np.empty((len(array), 0), np.int64) if array.dtype.hasobject else array
        return str(len(arrays) - 1)

    said = {
        "vertices": key(content.vertices),
        "cells": [[block.kind, key(block.nodes), key(block.rows)] for block in content.cells],
        "point_data": [[name, key(values)] for name, values in content.point_data.items()],
        "cell_data": [[name, key(values)] for name, values in content.cell_data.items()],
        "notes": list(content.notes),
        "hidden": content.hidden,
    }
    np.savez(file, **arrays)
    return said


if __name__ == "__main__":
    sys.path.pop(0)  # this script's folder, whose modules would stand in for others of their names
    main(Path(sys.argv[1]), json.load(sys.stdin))
