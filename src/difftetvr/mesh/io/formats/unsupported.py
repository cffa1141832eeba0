"""What to say of files that are none of ours, by what they are."""

from __future__ import annotations

import re
from pathlib import Path

from difftetvr.errors import MeshError

_CONVERT = "open it in ParaView and save it as .vtu"
_PARTS = {
    ".case": ("the list of an EnSight result, whose data lie in several files", _CONVERT),
    ".encas": ("the list of an EnSight result, whose data lie in several files", _CONVERT),
    ".geo": ("a geometry (of Gmsh or EnSight), no volume mesh", "mesh it with Gmsh, or " + _CONVERT),
    ".foam": (
        "a marker for a folder of OpenFOAM, whose data lie in several files",
        "run foamToVTK there, or " + _CONVERT,
    ),
    ".openfoam": ("a marker for a folder of OpenFOAM", "run foamToVTK there, or " + _CONVERT),
    ".sol": ("data for the vertices of a mesh that lies in another file", "give the .mesh, or convert both to .vtu"),
    ".solb": ("data for the vertices of a mesh that lies in another file", "give the .mesh, or convert both to .vtu"),
    ".pos": ("data of Gmsh without its mesh", "save both as .msh: gmsh -save -format msh41"),
    ".h5": ("HDF5, in which every program keeps its arrays elsewhere", "give the .xdmf that belongs to it"),
    ".hdf5": ("HDF5, in which every program keeps its arrays elsewhere", "give the .xdmf that belongs to it"),
    ".vtkhdf": ("VTK's kind of HDF5", _CONVERT),
    ".plt": ("a binary result of Tecplot", "save it as .vtu or as text (.tec)"),
    ".cas": ("a case of ANSYS Fluent, whose data lie in a .dat beside it", _CONVERT),
    ".rst": ("a binary result of ANSYS", "convert it to .vtu with pymapdl-reader"),
    ".odb": ("a binary result of Abaqus", "convert it to .vtu, or give the .inp"),
    ".frd": ("a result of CalculiX", "convert it to .vtu with ccx2paraview"),
    ".cdb": ("an archive of ANSYS", "convert it to .vtu with mapdl-archive"),
    ".step": ("a model of surfaces of CAD", "mesh it with Gmsh"),
    ".stp": ("a model of surfaces of CAD", "mesh it with Gmsh"),
    ".iges": ("a model of surfaces of CAD", "mesh it with Gmsh"),
    ".brep": ("a model of surfaces of CAD", "mesh it with Gmsh"),
}
"""What a file is, and what to do with it, by its suffix."""

_PIECE_OF_EXODUS = re.compile(r"\.(?:e|exo|ex2|exoII|g|gen)(?:-s\d+)?\.\d+\.\d+$", re.IGNORECASE)


def sentence(path: Path) -> MeshError:
    """The error for a file whose suffix no reader has.

    Args:
        path: The file.
    """
    if _PIECE_OF_EXODUS.search(path.name):
        return MeshError(f"{path} is one of several pieces of an Exodus file; join them with epu and give the result.")
    if path.suffix.lower() in _PARTS:
        what, advice = _PARTS[path.suffix.lower()]
        return MeshError(f"{path} is {what}, and is not read; {advice}.")
    # Late: the table asks here for what it lacks.
    from difftetvr.mesh.io.formats.table import FORMATS
    from difftetvr.mesh.io.formats.through_meshio import SURFACES, VOLUMES

    known = ", ".join(sorted({*FORMATS, *VOLUMES} - set(SURFACES)))
    return MeshError(f"{path}: '{path.suffix}' is no suffix of a mesh file that is read; give one of {known}.")
