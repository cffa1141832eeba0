"""VTK's XML files of every kind: of a data set, or lists of pieces (.pvtu), of blocks (.vtm), of time steps (.pvd)."""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree.ElementTree import Element

from difftetvr.errors import MeshError, counted
from difftetvr.mesh.io.content import Content, chosen_step
from difftetvr.mesh.io.formats.vtk.grid import Grid
from difftetvr.mesh.io.formats.vtk.merging import merged
from difftetvr.mesh.io.formats.vtk.xml import KINDS, read_pieces
from difftetvr.trust import file_beside
from difftetvr.vtk_xml import Document

_PARALLEL = {f"P{kind}" for kind in KINDS}
_SEVERAL = ("vtkMultiBlockDataSet", "vtkPartitionedDataSet", "vtkPartitionedDataSetCollection")
_STEPS = "Collection"
_SURFACES = ("PolyData", "PPolyData")
_DEEPEST = 4  # a list of steps of lists of blocks of lists of pieces


def read(path: Path, step: int | None = None) -> Content:
    """Read a VTK XML file with all files that it names.

    Args:
        path: The file: a grid, structured or not, or a list of such files.
        step: Time step of a list of steps; see `difftetvr.mesh.io.content.chosen_step`.

    Returns:
        Its content; pieces are one mesh where they meet.

    Raises:
        MeshError: The file or one that it names is damaged, is not there, or holds no grid.
    """
    reader = _Reader(path)
    reader.read(path, step, depth=0)
    if not reader.grids:
        raise MeshError(f"{path} holds no cells; give a volume mesh.")
    grid, notes = merged(path, reader.grids)
    return grid.content(path, (*reader.notes(), *notes))


class _Reader:
    """Collects the data sets of a file and of those that it names."""

    def __init__(self, path: Path) -> None:
        self.grids: list[Grid] = []
        self._notes: dict[str, None] = {}
        self._texts: set[str] = set()
        self._surfaces = 0
        # Not Path.resolve, which raises where links lead in a circle.
        self._open = [os.path.realpath(path)]
        self._seen: set[str] = set()

    def notes(self) -> list[str]:
        """What is to be said of all files together."""
        notes = list(self._notes)
        if self._texts:
            notes.append(f"Left out data that are no numbers: {', '.join(sorted(self._texts))}.")
        if self._surfaces:
            notes.append(f"Left out {counted(self._surfaces, 'piece')} that only {_hold(self._surfaces)} surfaces.")
        return notes

    def read(self, path: Path, step: int | None, depth: int) -> None:
        """Take in a file and whatever it names."""
        document = Document(path, MeshError)
        kind = document.root.get("type", "")
        if kind in KINDS:
            pieces = read_pieces(document, step)
            self.grids += pieces.grids
            self._texts |= pieces.texts
            self._notes |= dict.fromkeys(pieces.notes)
        elif kind in _SURFACES and depth:
            self._surfaces += 1
        elif kind in _SURFACES:
            raise MeshError(f"{path} holds a surface; fill it with tetrahedra (difftetvr mesh), or give a volume mesh.")
        elif kind in _PARALLEL:
            self._read_all(document, [e for e in document.root.iter("Piece") if e.get("Source")], "Source", step, depth)
        elif kind in _SEVERAL:
            self._read_all(document, [e for e in document.root.iter("DataSet") if e.get("file")], "file", step, depth)
        elif kind == _STEPS:
            self._read_all(document, self._chosen(document, step), "file", None, depth)
        else:
            raise MeshError(f"{path} holds a data set of kind {kind[:40]!r}; give an unstructured grid.")

    def _read_all(self, document: Document, elements: list[Element], key: str, step: int | None, depth: int) -> None:
        if depth == _DEEPEST:
            raise document.damaged("files name each other without end")
        for element in elements:
            file = file_beside(document.path, element.get(key, ""), MeshError)
            target = os.path.realpath(file)
            if target in self._open:
                raise document.damaged(f"{file.name} is named by itself, or by what it names")
            if target in self._seen:
                self._notes[f"{file.name} is named several times, and was read once."] = None
                continue
            if not os.path.isfile(file):
                raise MeshError(f"{document.path} names {file.name}, which is not there; put it where it was.")
            self._seen.add(target)
            self._open.append(target)
            self.read(file, step, depth + 1)
            self._open.pop()

    def _chosen(self, document: Document, step: int | None) -> list[Element]:
        """The files of one time step."""
        by_time: dict[float, list[Element]] = {}
        for element in document.root.iter("DataSet"):
            has_time = element.get("timestep", "").strip() != ""
            time = document.numbers(element, "timestep", 1, "")[0] if has_time else 0.0
            by_time.setdefault(time, []).append(element)
        if not by_time:
            raise MeshError(f"{document.path} names no files; write it again.")
        times = sorted(by_time)
        index, notes = chosen_step(document.path, times, step)
        self._notes |= dict.fromkeys(notes)
        return by_time[times[index]]


def _hold(number: int) -> str:
    return "holds" if number == 1 else "hold"
