"""Who reads and writes which file: one row for each suffix. A new format is a file beside this one and a row here."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from difftetvr.errors import MeshError, shown
from difftetvr.mesh.io.content import Content, Output
from difftetvr.mesh.io.formats import abaqus, bintet, exodus, medit, npz, ovm, tetgen, through_meshio, unsupported
from difftetvr.mesh.io.formats.gmsh import reading as gmsh_reading
from difftetvr.mesh.io.formats.gmsh import writing as gmsh_writing
from difftetvr.mesh.io.formats.vtk import legacy, legacy_writing, lists, series, xml_writing
from difftetvr.mesh.io.formats.xdmf import reading as xdmf_reading
from difftetvr.mesh.io.formats.xdmf import writing as xdmf_writing
from difftetvr.trust import require_regular

_LONGEST_SHOWN = 400


@dataclass(frozen=True)
class Format:
    """What is known about the files of one suffix.

    Attributes:
        read: From a file to its content; where the format has time steps, from a file and the step to read, too.
        write: From a mesh to a file, with sentences about what was written otherwise than it was given, if there are
            any; None for formats that are only read.
        holds_field: Whether it holds colour and density beside the geometry.
        holds_data: Whether it holds any other data of vertices and cells by their names.
        holds_harmonics: Whether it holds what colours owe to the direction, too.
        holds_groups: Whether it holds names of groups of cells.
        is_single: Whether it holds float32 only.
        has_steps: Whether a file may hold several time steps; see `difftetvr.mesh.io.content.chosen_step`.
    """

    read: Callable[..., Content]
    write: Callable[[Path, Output], tuple[str, ...] | None] | None = None
    holds_field: bool = True
    holds_data: bool = False
    holds_harmonics: bool = False
    holds_groups: bool = False
    is_single: bool = False
    has_steps: bool = False

    def content(self, path: Path, step: int | None) -> Content:
        """Read a file.

        Args:
            path: The file.
            step: Its time step to read, from 0; negative ones count from the last; None: the last.

        Raises:
            MeshError: It cannot be read, or has no such step.
        """
        if self.has_steps:
            return self.read(path, step)
        if step is not None:
            raise MeshError(f"{path} has no time steps, as files of this kind have none; leave out --step.")
        return self.read(path)


def format_of(path: Path) -> Format:
    """The format that a file's name ends with; those that meshio reads for us are not in `FORMATS`.

    Raises:
        MeshError: It is none that is read.
    """
    suffix = path.suffix.lower()
    if suffix in FORMATS:
        return FORMATS[suffix]
    if through_meshio.is_known(path):
        return Format(through_meshio.read)
    raise unsupported.sentence(path)


def read_content(path: Path, step: int | None = None) -> Content:
    """Read a file in any format.

    Args:
        path: The file.
        step: Its time step to read; see `Format.content`.

    Raises:
        MeshError: There is no such file, or it cannot be read.
    """
    if os.path.isdir(path):
        raise MeshError(f"{path} is a folder; give the mesh file in it.")
    require_regular(path, MeshError)
    # Not Path.is_file, which raises where a name is too long.
    if not os.path.isfile(path):
        name = str(path) if len(str(path)) <= _LONGEST_SHOWN else shown(str(path))
        raise MeshError(f"There is no mesh file {name}; check the path.")
    try:
        return format_of(path).content(path, step)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise MeshError(f"{path} cannot be read ({reason}); check the disk and the file's permissions.") from error


_VTK_XML = (
    *(".pvtu", ".vts", ".pvts", ".vtr", ".pvtr", ".vti", ".pvti", ".vtp", ".pvtp"),
    *(".vtm", ".vtmb", ".vtpd", ".vtpc", ".pvd"),
)


FORMATS: dict[str, Format] = {
    ".vtu": Format(lists.read, xml_writing.write, holds_data=True, holds_harmonics=True, has_steps=True),
    ".vtk": Format(legacy.read, legacy_writing.write, holds_data=True),
    ".msh": Format(gmsh_reading.read, gmsh_writing.write, holds_data=True, holds_groups=True, has_steps=True),
    ".xdmf": Format(xdmf_reading.read, xdmf_writing.write, holds_data=True, has_steps=True),
    ".xmf": Format(xdmf_reading.read, has_steps=True),
    ".npz": Format(npz.read, npz.write, holds_data=True, holds_harmonics=True),
    ".bintet": Format(bintet.read, bintet.write, is_single=True),
    ".ovm": Format(ovm.read, ovm.write),
    ".node": Format(tetgen.read, tetgen.write),
    ".ele": Format(tetgen.read, tetgen.write),
    **dict.fromkeys(exodus.SUFFIXES, Format(exodus.read, has_steps=True)),
    ".inp": Format(abaqus.read),
    ".mesh": Format(medit.read, medit.write, holds_field=False),
    **dict.fromkeys(_VTK_XML, Format(lists.read, has_steps=True)),
    ".series": Format(series.read, has_steps=True),
}
"""Formats by suffix; those that are written are offered in this order."""
