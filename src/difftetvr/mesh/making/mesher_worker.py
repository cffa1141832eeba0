"""Runs fTetWild or TetGen in a process of its own: ``python mesher_worker.py REQUEST.npz ANSWER.npz``.

Both are C++ libraries that leave files in the current folder, cannot be interrupted, and end the process where an
assertion of theirs fails. This script imports nothing of difftetvr, so that it starts quickly.
"""

from __future__ import annotations

import sys
from typing import Any


def ftetwild(points: Any, faces: Any, edge: float, tolerance: float) -> dict[str, Any]:
    """Mesh with fTetWild.

    Args:
        points: (V, 3) float64.
        faces: (F, 3) int32.
        edge: Edge length, in diagonals of the bounding box.
        tolerance: Distance of the boundary from the surface, in the same unit.

    Returns:
        Arrays ``vertices`` and ``tets``.
    """
    import pytetwild

    # Without coarsening, no edge length makes fewer than some thousand cells.
    vertices, tets = pytetwild.tetrahedralize(
        points, faces, edge_length_fac=min(edge, 1.0), epsilon=tolerance, coarsen=True
    )
    return {"vertices": vertices, "tets": tets}


def tetgen(points: Any, faces: Any, edge: float, _: float) -> dict[str, Any]:
    """Mesh with TetGen.

    Args:
        points: (V, 3) float64.
        faces: (F, 3) int32.
        edge: Edge length, in diagonals of the bounding box; cells have at most the volume of the regular tetrahedron.

    Returns:
        Arrays ``vertices``, ``tets``, and ``regions`` (T,): which cells the surface does not part.
    """
    import numpy as np
    from tetgen import TetGen

    volume = (edge * np.linalg.norm(np.ptp(points, axis=0))) ** 3 / (6.0 * 2.0**0.5)
    vertices, tets, regions, *_rest = TetGen(points, faces).tetrahedralize(
        quality=True, minratio=1.5, fixedvolume=True, maxvolume=volume, regionattrib=True
    )
    return {"vertices": vertices, "tets": tets, "regions": np.asarray(regions).reshape(len(tets))}


def main(request: str, answer: str) -> None:
    """Reads points, faces, edge, tolerance and mesher; writes the mesher's arrays, or ``missing`` or ``refused``."""
    import numpy as np

    with np.load(request) as asked:
        run = {"ftetwild": ftetwild, "tetgen": tetgen}[str(asked["mesher"])]
        arguments = (asked["points"], asked["faces"], float(asked["edge"]), float(asked["tolerance"]))
    try:
        result = run(*arguments)
    except ImportError as error:
        result = {"missing": np.array(error.name or "")}
    except (RuntimeError, ValueError) as error:
        result = {"refused": np.array(" ".join(str(error).split()))}
    np.savez(answer, **result)


if __name__ == "__main__":
    sys.path.pop(0)  # this script's folder, whose modules would stand in for others of their names
    main(*sys.argv[1:])
