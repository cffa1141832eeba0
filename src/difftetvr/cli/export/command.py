"""The command ``difftetvr export``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import OmitArgPrefixes, Positional, arg

from difftetvr.cli.arguments import Groups
from difftetvr.cli.export.grids import GridOptions
from difftetvr.cli.export.job import Job
from difftetvr.cli.export.pages import PageOptions
from difftetvr.cli.export.surfaces import SurfaceOptions
from difftetvr.cli.options import TRUST_GROUPS, MeshOptions, TrustOptions
from difftetvr.errors import MeshError, counted, listed
from difftetvr.files import require_writable

if TYPE_CHECKING:
    from rich.console import Console

    from difftetvr.mesh.io import MeshData


@dataclass(frozen=True)
class Export:
    """Write a mesh in another format, what it holds on a regular grid, the surface of a level, or a page to send."""

    model: Annotated[Path, Positional, arg(metavar="MODEL")]
    """Mesh, in any format that is read."""
    output: Annotated[Path, Positional, arg(metavar="OUT")]
    """File to write. A mesh: .vtu, .vtk, .msh, .xdmf, .npz, .bintet, .ovm, .node with its .ele, or .mesh with
    --geometry. A grid: .nrrd, .vti, .nii or .npy. A surface: .ply, .glb, .vtp, .obj or .stl. A page for
    browsers: .html."""
    geometry: bool = False
    """Leave out color, density and all other data."""
    without_harmonics: bool = False
    """Leave out what colours owe to the direction, which only .vtu and .npz can hold."""
    scalar: tuple[str, ...] = ()
    """Name of the point or cell data to sample, to show, or whose surface to take, with a component if wanted
    (velocity:x); for .vti one or more; default: density, in .vti density and color or all data, or the only data there
    are; for a page color and density."""
    grid: OmitArgPrefixes[GridOptions] = field(default_factory=GridOptions)
    surface: OmitArgPrefixes[SurfaceOptions] = field(default_factory=SurfaceOptions)
    page: OmitArgPrefixes[PageOptions] = field(default_factory=PageOptions)
    reading: OmitArgPrefixes[MeshOptions] = field(default_factory=MeshOptions)
    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)
    groups: ClassVar[Groups] = {
        "Meshes": ("geometry", "without-harmonics"),
        "Grids, surfaces and pages": ("scalar",),
        "Grids": ("spacing", "size", "like", "fitted", "samples", "outside", "device"),
        "Surfaces": ("level", "colors"),
        "Pages": ("transfer-function", "value-range", "attenuation", "background", "camera", "title"),
        "How MODEL is read": ("split", "step"),
        **TRUST_GROUPS,
    }

    def run(self, console: Console) -> None:
        """Reads and writes."""
        kind = self._kind()
        require_writable(self.output, MeshError)
        data = self.reading.load(self.model, console, only_draws=kind != "mesh")
        job = Job(self.model, self.output, self.scalar, data, console)
        if kind == "grid":
            self.grid.write(job)
        elif kind == "surface":
            self.surface.write(job)
        elif kind == "page":
            self.page.write(job)
        else:
            self._write_mesh(data, console)

    def _kind(self) -> str:
        """Whether a mesh, a grid, a surface or a page is written.

        Raises:
            MeshError: None of them, or an option is for another.
        """
        from difftetvr.mesh.io import GEOMETRY_SUFFIXES, WRITABLE_SUFFIXES
        from difftetvr.sampling.grid_files import GRID_SUFFIXES
        from difftetvr.sampling.surface_files import SURFACE_SUFFIXES

        kinds = {
            "mesh": (*WRITABLE_SUFFIXES, *GEOMETRY_SUFFIXES),
            "grid": GRID_SUFFIXES,
            "surface": SURFACE_SUFFIXES,
            "page": (".html",),
        }
        suffix = self.output.suffix.lower()
        kind = next((kind for kind, suffixes in kinds.items() if suffix in suffixes), None)
        if kind is None:
            known = ", or ".join(f"a {kind} ({', '.join(suffixes)})" for kind, suffixes in kinds.items())
            raise MeshError(f"{self.output}: '{self.output.suffix}' is no format that is written; write {known}.")
        of_mesh = {"geometry": self.geometry, "without_harmonics": self.without_harmonics}
        others = {"grid": self.grid, "surface": self.surface, "page": self.page}
        given = {"mesh": of_mesh, **{name: _changed(options) for name, options in others.items()}}
        if kind == "mesh" and self.scalar:
            raise MeshError(f"--scalar is for a grid, a surface or a page, which {self.output} is not; leave it out.")
        for other, options in given.items():
            name = next((name for name, is_given in options.items() if is_given), None)
            if other != kind and name is not None:
                raise MeshError(
                    f"--{name.replace('_', '-')} is for a {other} ({', '.join(kinds[other])}), which {self.output} is "
                    "not; leave it out."
                )
        return kind

    def _write_mesh(self, data: MeshData, console: Console) -> None:
        from difftetvr.mesh.io import FIELD_ARRAYS, HARMONICS, holds_data, require_writable_format, save

        field_on_mesh = None if self.geometry else data.field
        if field_on_mesh is not None and self.without_harmonics:
            field_on_mesh = dataclasses.replace(field_on_mesh, harmonics=None)
        if field_on_mesh is not None:
            require_writable_format(self.output)
        written = () if field_on_mesh is None else FIELD_ARRAYS
        if field_on_mesh is not None and field_on_mesh.harmonics is not None:
            written = (*written, HARMONICS)
        of_field = (*FIELD_ARRAYS, HARMONICS) if data.field is not None else ()
        others = [{n: v for n, v in d.items() if n not in of_field} for d in (data.point_data, data.cell_data)]
        if self.geometry or not holds_data(self.output):
            others = [{}, {}]
        names = data.group_names if any(others) else {}
        save(self.output, data.mesh, field_on_mesh, point_data=others[0], cell_data=others[1], group_names=names)
        written = (*written, *sorted({*others[0], *others[1]}))
        left_out = sorted({*data.point_data, *data.cell_data}.difference(written))
        content = listed(written) if written else "geometry only"
        without = f", without {', '.join(left_out)}" if left_out else ""
        console.print(f"Wrote {self.output} ({counted(data.mesh.num_cells, 'cell')}, {content}{without})")


def _changed(options: Any) -> dict[str, bool]:
    """Which options are not what they are where they are not given."""
    usual = type(options)()
    return {f.name: getattr(options, f.name) != getattr(usual, f.name) for f in dataclasses.fields(options)}
