"""The command ``difftetvr mesh``."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from tyro.conf import OmitArgPrefixes, Positional, arg

from difftetvr.archive import read_array, read_arrays
from difftetvr.cli.options import Output, TrustOptions
from difftetvr.errors import MeshError, counted
from difftetvr.files import require_writable
from difftetvr.terminal import waiting
from difftetvr.trust import require_regular

if TYPE_CHECKING:
    from rich.console import Console

    from difftetvr.mesh.tetmesh import TetMesh

_GRID_CELLS = 20_000


@dataclass(frozen=True)
class Mesh:
    """Make a tetrahedral mesh, without colour and density, of the inside of a surface, of points, or of a box.

    The meshers fTetWild (pytetwild, MPL-2.0) and TetGen (tetgen, whose core is AGPL-3.0) are packages of their own:
    pip install 'difftetvr[mesh]'. Whoever hands on or serves a program with TetGen must follow the AGPL.
    """

    output: Output
    """File to write: .vtu, .vtk, .msh or .mesh; begin a reconstruction with it by fit --initial-mesh."""
    source: Annotated[Path | None, Positional, arg(metavar="SOURCE")] = None
    """A closed surface (.ply, .stl, .obj, .off, .msh); for delaunay, points (.npy, .npz, .ply, .xyz, .txt, .csv)."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Mesh this box instead of a SOURCE: its lowest and its highest x y z."""
    mesher: Literal["ftetwild", "tetgen", "delaunay", "grid"] = "ftetwild"
    """ftetwild takes any surface and follows it within a tolerance, tetgen keeps a clean surface as it is, delaunay
    fills the convex hull of points, grid cuts a box into cubes of six tetrahedra."""
    cells: int | None = None
    """Number of cells, met as nearly as the mesher can; default: 20000 for grid, elsewhere --edge-length decides."""
    edge_length: float | None = None
    """Length of edges inside; default: 1/20 of the bounding box's diagonal."""
    tolerance: float = 1e-3
    """How far ftetwild may leave the surface, in diagonals of its bounding box."""

    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)

    def run(self, console: Console) -> None:
        """Reads, meshes and writes."""
        self._require_consistent()
        from difftetvr.mesh.io import require_writable_format, save

        require_writable_format(self.output, with_field=False)
        require_writable(self.output, MeshError)
        with waiting(console, f"Meshing {self.source or 'the box'}"):
            mesh = self._of_box(self.box) if self.box else self._of_file(self.source or Path(), console)
        save(self.output, mesh)
        console.print(f"Wrote {self.output} ({counted(mesh.num_cells, 'cell')}, {mesh.num_vertices:,} vertices)")

    def _require_consistent(self) -> None:
        if (self.source is None) == (self.box is None):
            raise MeshError("Give either a file to mesh, or --box and six numbers.")
        if self.mesher == "grid" and (self.box is None or self.edge_length is not None):
            raise MeshError("The mesher grid cuts a --box into --cells; it takes neither a file nor --edge-length.")
        sized = self.cells is not None or self.edge_length is not None
        if self.mesher == "delaunay" and (self.box is not None or sized):
            raise MeshError(
                "The mesher delaunay joins the points of a file; it takes no --box, --cells or --edge-length."
            )

    def _of_box(self, box: tuple[float, ...]) -> TetMesh:
        from difftetvr.mesh.making.generators import grid_cubes
        from difftetvr.mesh.making.surfaces import MesherOptions, tetrahedralize_box
        from difftetvr.mesh.tetmesh import TetMesh

        lower, upper = box[:3], box[3:]
        if not all(math.isfinite(a) and math.isfinite(b) and a < b for a, b in zip(lower, upper)):
            raise MeshError(f"The --box goes from {lower} to {upper}; give three finite ends, each lower < upper.")
        options = MesherOptions(self.cells, self.edge_length, self.tolerance)
        if self.mesher == "grid":
            extent = [b - a for a, b in zip(lower, upper)]
            return TetMesh.grid(grid_cubes(options.cells or _GRID_CELLS, extent), lower, upper)
        return tetrahedralize_box(lower, upper, self.mesher, options)  # type: ignore[arg-type]

    def _of_file(self, source: Path, console: Console) -> TetMesh:
        from difftetvr.mesh.making.surfaces import MesherOptions, load_surface, open_edges, tetrahedralize
        from difftetvr.mesh.tetmesh import TetMesh

        if self.mesher == "delaunay":
            return TetMesh.delaunay(load_points(source)).without_unused_vertices()[0]
        options = MesherOptions(self.cells, self.edge_length, self.tolerance)
        surface = load_surface(source)
        if self.mesher == "ftetwild" and (edges := open_edges(surface[1])):
            console.print(f"{source} is open along {edges:,} edges; fTetWild closes it as it sees fit.")
        return tetrahedralize(*surface, self.mesher, options)  # type: ignore[arg-type]


def load_points(path: Path) -> NDArray[Any]:
    """Read points: .npy, .npz with an array ``points``, text with three numbers a line, or any mesh.

    Args:
        path: The file; .xyz, .txt and .csv are text, in which lines that begin with # are left out.

    Returns:
        (N, 3) numbers.

    Raises:
        MeshError: The file cannot be read, or holds something else.
    """
    from difftetvr.mesh.io.formats.table import read_content

    require_regular(path, MeshError)
    if not path.is_file():
        raise MeshError(f"There is no file of points {path}; check the path.")
    suffix = path.suffix.lower()
    try:
        if suffix == ".npy":
            points = read_array(path, MeshError)
        elif suffix == ".npz":
            points = read_arrays(path, MeshError, lambda name, _: name == "points")["points"]
        elif suffix in (".xyz", ".txt", ".csv"):
            delimiter = "," if suffix == ".csv" else None
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of a file without rows: see below
                points = np.loadtxt(path, delimiter=delimiter, usecols=(0, 1, 2), ndmin=2)
        else:
            points = read_content(path).vertices
    except KeyError as error:
        raise MeshError(f"{path} has no array 'points'; store the points under this name.") from error
    except (ValueError, OSError) as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise MeshError(
            f"{path} cannot be read as points ({reason}); give .npy, .npz, .ply, .xyz, .txt or .csv."
        ) from error
    if not points.size:
        raise MeshError(f"{path} holds no points; give a file that does.")
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise MeshError(f"{path} holds {points.dtype} of shape {points.shape}; points must be numbers of shape (N, 3).")
    return points
