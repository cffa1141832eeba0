"""One mesh from the grids of an XDMF file: grids that share points or cells are told from those that add some."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from difftetvr.mesh.io.content import CellBlock, Content
from difftetvr.mesh.io.formats.vtk.grid import hidden_notes
from difftetvr.mesh.io.formats.xdmf.topology import Shape
from difftetvr.mesh.making.conversion import is_convertible


@dataclass(frozen=True)
class _Data:
    """Values (n, ...) of some rows (n,)."""

    rows: np.ndarray
    values: np.ndarray


class Assembly:
    """Puts grids together.

    A grid with the points of one before has these points, not others at the same places; and so it is with each of its
    cells. Programs write a grid for each quantity, and sets of cells as grids, too.

    Attributes:
        num_points: Number of all points so far.
    """

    def __init__(self) -> None:
        self._points: dict[bytes, tuple[int, np.ndarray]] = {}
        self.num_points = 0
        self._num_cells = 0
        self._cells: dict[str, list[CellBlock]] = {}
        self._data: dict[str, dict[str, list[_Data]]] = {"point": {}, "cell": {}}
        self._marks: list[_Data] = []

    def add(self, shape: Shape) -> tuple[np.ndarray, np.ndarray]:
        """Adds a grid.

        Args:
            shape: Its points and cells.

        Returns:
            (V,) rows of its points and (N,) rows of its cells, for `put`.
        """
        vertices = np.ascontiguousarray(shape.vertices)
        digest = hashlib.blake2b(vertices.data if vertices.size else b"", digest_size=16).digest()
        is_new = digest not in self._points
        if is_new:
            self._points[digest] = self.num_points, vertices
            self.num_points += len(vertices)
        begin = self._points[digest][0]
        rows = np.full(shape.num_cells, -1, np.int64)
        for block in shape.cells:
            moved = block.nodes + begin
            rows[block.rows] = -1 if is_new else self._known(block.kind, moved)
        fresh = np.flatnonzero(rows < 0)
        rows[fresh] = self._num_cells + np.arange(len(fresh))
        for block in shape.cells:
            added = np.flatnonzero(rows[block.rows] >= self._num_cells)
            cells = CellBlock(block.kind, block.nodes[added] + begin, rows[block.rows][added])
            self._cells.setdefault(block.kind, []).append(cells)
        self._num_cells += len(fresh)
        return begin + np.arange(len(vertices)), rows

    def put(self, place: str, name: str, rows: np.ndarray, values: np.ndarray) -> None:
        """Adds data of a grid; a name that its points or cells have already been given other values for is changed.

        Args:
            place: "point" or "cell".
            name: Of the data.
            rows: (n,) as `add` returns them.
            values: (n, ...).
        """
        there, number, unique = self._data[place], 1, name
        while unique in there:
            if there[unique][0].values.shape[1:] == values.shape[1:]:
                clash = [data for data in there[unique] if np.intersect1d(data.rows, rows).size]
                if not clash:
                    break
                if any(np.array_equal(d.rows, rows) and np.array_equal(d.values, values) for d in clash):
                    return
            number += 1
            unique = f"{name} ({number})"
        there.setdefault(unique, []).append(_Data(rows, values))

    def mark(self, rows: np.ndarray, unseen: np.ndarray) -> None:
        """Takes note of cells that are not to be seen, unless another grid that tells these says that they are.

        Args:
            rows: (N,) of a grid's cells, as `add` returns them.
            unseen: (N,) truth values.
        """
        self._marks.append(_Data(rows, unseen))

    def content(self, notes: tuple[str, ...]) -> Content:
        """What was put together."""
        arrays = [vertices for _, vertices in self._points.values()]
        hidden, blocks = self._hidden(), [_joined(kind, blocks) for kind, blocks in self._cells.items()]
        left_out = sum(int(hidden[block.rows].sum()) for block in blocks if is_convertible(block.kind))
        cells = tuple(CellBlock(b.kind, b.nodes[~hidden[b.rows]], b.rows[~hidden[b.rows]]) for b in blocks)
        point_data = {n: _spread(data, self.num_points) for n, data in self._data["point"].items()}
        cell_data = {n: _spread(data, self._num_cells) for n, data in self._data["cell"].items()}
        vertices = np.concatenate(arrays or [np.empty((0, 3))])
        notes = (*notes, *hidden_notes(left_out))
        return Content(vertices, cells, point_data, cell_data, notes, hidden=left_out)

    def _hidden(self) -> np.ndarray:
        """(N,) which of all cells are not to be seen."""
        seen, unseen = np.zeros(self._num_cells, bool), np.zeros(self._num_cells, bool)
        for mark in self._marks:
            seen[mark.rows[~mark.values]] = True
            unseen[mark.rows[mark.values]] = True
        return unseen & ~seen

    def _known(self, kind: str, nodes: np.ndarray) -> np.ndarray:
        """(N,) rows of cells that are there already, with the same nodes in any order; -1 for others."""
        blocks = [b for b in self._cells.get(kind, []) if b.nodes.shape[1] == nodes.shape[1]]
        if not blocks or not nodes.shape[1]:
            return np.full(len(nodes), -1, np.int64)
        there = np.sort(np.concatenate([b.nodes for b in blocks]), 1)
        rows = np.concatenate([b.rows for b in blocks])
        _, numbers = np.unique(np.concatenate((there, np.sort(nodes, 1))), axis=0, return_inverse=True)
        numbers = numbers.reshape(-1)
        row_of = np.full(len(numbers), -1, np.int64)
        row_of[numbers[: len(there)][::-1]] = rows[::-1]
        return row_of[numbers[len(there) :]]


def _joined(kind: str, blocks: list[CellBlock]) -> CellBlock:
    if len({block.nodes.shape[1] for block in blocks}) > 1:  # polygons
        rows = np.concatenate([block.rows for block in blocks])
        return CellBlock(kind, np.empty((len(rows), 0), np.int64), rows)
    nodes, rows = (np.concatenate(arrays) for arrays in zip(*((b.nodes, b.rows) for b in blocks)))
    return CellBlock(kind, nodes, rows)


def _spread(data: list[_Data], count: int) -> np.ndarray:
    """(count, ...) values by row, NaN where there are none."""
    rows = np.concatenate([d.rows for d in data])
    values = np.concatenate([d.values for d in data])
    if len(rows) == count and np.array_equal(rows, np.arange(count)):
        return values
    if len(np.unique(rows)) == count:
        spread = np.empty((count, *values.shape[1:]), values.dtype)
    else:
        spread = np.full((count, *values.shape[1:]), np.nan, values.dtype if values.dtype.kind == "f" else np.float64)
    spread[rows] = values
    return spread
