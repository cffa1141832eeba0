"""What a mesh file holds, before it is checked and made a mesh."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

import numpy as np

from difftetvr.errors import MeshError, counted

_LINES_AT_ONCE = 10_000


@dataclass(frozen=True)
class CellBlock:
    """Cells of one kind.

    Attributes:
        kind: Name of the kind as meshio has it: "tetra", "hexahedron20", "triangle", ...
        nodes: (N, n) integer vertex indices, unchecked; corners come first.
        rows: (N,) integer rows of the cells in the file's cell data.
    """

    kind: str
    nodes: np.ndarray
    rows: np.ndarray


@dataclass(frozen=True)
class Content:
    """A mesh file's content.

    Attributes:
        vertices: (V, 3) positions of any numeric type.
        cells: Cells of all kinds, those that bound a volume included.
        point_data: Arrays of V rows.
        cell_data: Arrays of one row for each cell, in the order that `CellBlock.rows` refers to.
        notes: Sentences about what the file holds and the content does not: one for each kind of thing.
        group_names: Names of the groups of volumes in the cell data ``gmsh:physical``, by number.
        hidden: Number of volume cells that are not among the cells, as the file says that they are not to be seen.
    """

    vertices: np.ndarray
    cells: tuple[CellBlock, ...]
    point_data: dict[str, np.ndarray]
    cell_data: dict[str, np.ndarray]
    notes: tuple[str, ...] = ()
    group_names: dict[int, str] = field(default_factory=dict)
    hidden: int = 0


@dataclass(frozen=True)
class Output:
    """A mesh to be written.

    Attributes:
        vertices: (V, 3) positions.
        tets: (T, 4) vertex indices of cells with positive volume.
        point_data: Arrays of V rows by name, among them those of a field on the vertices.
        cell_data: Arrays of T rows by name, among them those of a field on the cells.
        is_per_cell: Whether colour and density belong to the cells.
        path: Where the file will be in the end; a temporary one is written first.
        group_names: As of `Content`.
    """

    vertices: np.ndarray
    tets: np.ndarray
    point_data: dict[str, np.ndarray]
    cell_data: dict[str, np.ndarray]
    is_per_cell: bool
    path: Path
    group_names: dict[int, str] = field(default_factory=dict)

    @property
    def rgba(self) -> np.ndarray | None:
        """(V, 4) or (T, 4) red, green, blue, density; None where there are none."""
        arrays = self.cell_data if self.is_per_cell else self.point_data
        return np.column_stack((arrays["color"], arrays["density"])) if "color" in arrays else None


def chosen_step(path: Path, times: Sequence[float], step: int | None) -> tuple[int, tuple[str, ...]]:
    """Which of a file's time steps to read.

    Args:
        path: The file.
        times: Of its steps, in their order.
        step: The wanted one, from 0; negative ones count from the last; None: the last.

    Returns:
        Its index, and what to tell who did not choose.

    Raises:
        MeshError: There is no such step.
    """
    count = len(times)
    index = count - 1 if step is None else step + count if step < 0 else step
    if not 0 <= index < count:
        raise MeshError(
            f"{path} has no time step {step}; its {counted(count, 'step')} have the numbers 0 to {count - 1}."
        )
    if step is not None or count == 1:
        return index, ()
    note = (
        f"Of {count:,} time steps the last was read, number {index} at time {times[index]:g}; --step chooses another."
    )
    return index, (note,)


def damaged(path: Path, problem: str) -> MeshError:
    """The error for a file that breaks the rules of its format.

    Args:
        path: The file.
        problem: What is wrong and where, part of a sentence.
    """
    return MeshError(f"{path} cannot be read as a mesh ({problem}); check that it is complete or write it again.")


def tetra_block(tets: np.ndarray) -> CellBlock:
    """A block of tetrahedra that are all the cells of a file; (T, 4) indices."""
    return CellBlock("tetra", tets, np.arange(len(tets)))


def split_rgba(values: np.ndarray) -> dict[str, np.ndarray]:
    """The field arrays from (N, 4) values red, green, blue, density."""
    return {"color": values[:, :3], "density": values[:, 3]}


def require_array(path: Path, what: str, values: np.ndarray, columns: int, kinds: str = "fiu") -> None:
    """Check an array's shape (N, columns) and that it holds numbers.

    Args:
        path: The file it comes from.
        what: What it holds, for the sentence.
        values: The array.
        columns: Expected length of a row.
        kinds: NumPy kinds that it may have.

    Raises:
        MeshError: It has another shape or type.
    """
    numbers = "integers" if "f" not in kinds else "numbers"
    if values.ndim != 2 or values.shape[1] != columns or values.dtype.kind not in kinds:
        raise MeshError(
            f"{path} has {what} of shape {values.shape} and type {values.dtype}; they must be (N, {columns}) {numbers}."
        )


def parse_numbers(path: Path, text: bytes, dtype: type = np.float64) -> np.ndarray:
    """All numbers of a text that holds nothing else.

    Args:
        path: The file it comes from.
        text: Numbers separated by white space.
        dtype: Their type.

    Returns:
        (N,) numbers.

    Raises:
        MeshError: Something in the text is no number.
    """
    if not text.strip():
        return np.empty(0, dtype)
    try:
        with warnings.catch_warnings():
            # NumPy only warns of, and cuts off, what follows the last number that it understands.
            warnings.simplefilter("error", DeprecationWarning)
            return np.fromstring(text, dtype, sep=" ")
    except (DeprecationWarning, ValueError) as error:
        raise damaged(path, "there is something else where numbers must be") from error


def write_table(file: TextIO, values: np.ndarray, row: str) -> None:
    """Write numbers as lines of text, many lines at once: ten times faster than `numpy.savetxt`.

    Args:
        file: Where to write.
        values: (N, n) or (N,) numbers.
        row: Format of a line without its end, in the style of printf.
    """
    line = row + "\n"
    for start in range(0, len(values), _LINES_AT_ONCE):
        part = values[start : start + _LINES_AT_ONCE]
        file.write(line * len(part) % tuple(part.ravel().tolist()))


def all_digits(values: np.ndarray) -> str:
    """Format of a line, in the style of printf, that says each number of an array exactly."""
    number = "%d" if values.dtype.kind in "iu" else "%.17g" if values.dtype.itemsize == 8 else "%.9g"
    return " ".join([number] * (values.shape[1] if values.ndim == 2 else 1))


def as_indices(path: Path, values: np.ndarray) -> np.ndarray:
    """Whole numbers that were parsed as floating-point ones.

    Args:
        path: The file they come from.
        values: float64 numbers.

    Returns:
        int64 numbers of the same shape.

    Raises:
        MeshError: One is no whole number, or too large to be one.
    """
    if not (np.abs(values) < 2.0**53).all() or (values != np.floor(values)).any():
        raise damaged(path, "an index is no whole number")
    return values.astype(np.int64)
