"""Data of Gmsh's files, its views: values of nodes, of elements, or of each node of each element, at several times."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from difftetvr.mesh.io.content import as_indices, chosen_step, parse_numbers
from difftetvr.mesh.io.formats.gmsh.elements import Elements
from difftetvr.mesh.io.formats.gmsh.nodes import positions, tagged
from difftetvr.mesh.io.source import Source

PLACES = ("NodeData", "ElementData", "ElementNodeData")
"""Sections, which say what values belong to."""

_MOST_OF_ONE_NAME = 100

_Step = tuple[int, float]
"""Number and time of a step."""


@dataclass(frozen=True)
class Record:
    """One section.

    Attributes:
        tags: (N,) of nodes or elements.
        values: (N, ...); of each node of each element (N, n, ...), NaN where an element has fewer nodes.
    """

    tags: np.ndarray
    values: np.ndarray


@dataclass
class View:
    """One quantity: its records by step; several of one step are of parts of a mesh."""

    place: str
    name: str
    records: dict[_Step, list[Record]] = field(default_factory=dict)

    def takes(self, step: _Step, record: Record) -> bool:
        """Whether a record can belong to it: none of its values is there already."""
        there = self.records.get(step, [])
        return not any(np.intersect1d(r.tags, record.tags).size for r in there)

    def repeats(self, step: _Step, record: Record) -> bool:
        """Whether a record says what is there already, as where a file holds everything twice."""
        return any(
            np.array_equal(r.tags, record.tags) and np.array_equal(r.values, record.values, equal_nan=True)
            for r in self.records.get(step, [])
        )


class Views:
    """All data of a file."""

    def __init__(self) -> None:
        self._views: dict[tuple[str, str], View] = {}
        self.notes: list[str] = []

    @property
    def names(self) -> list[str]:
        """Names of the quantities."""
        return [view.name for view in self._views.values()]

    def read(self, source: Source, place: str) -> None:
        """Reads a section."""
        strings = [source.line() or "" for _ in range(source.count(source.words("names")[0], "names"))]
        reals = [source.words("times")[0] for _ in range(source.count(source.words("times")[0], "times"))]
        integers = [source.words("sizes")[0] for _ in range(source.count(source.words("sizes")[0], "sizes"))]
        if not strings or len(integers) < 3:
            raise source.damaged("data lack their name or size")
        name = strings[0].strip().strip('"')
        if len(strings) > 1 and strings[1].strip().strip('"'):
            self._say(f"The data {name[:80]!r} come with an interpolation scheme, which was left out.")
        step = (_integer(source, integers[0]), _real(source, reals[0]) if reals else 0.0)
        columns, count = source.count(integers[1], "components"), source.count(integers[2], "values")
        what = f"values of {name[:40]!r}"
        if place == "ElementNodeData":
            tags, values = _of_elements(source, count, columns, what)
        else:
            tags, values = tagged(source, count, columns, what)
        record = Record(tags, values[..., 0] if columns == 1 else values)
        self._add(source, View(place, name, {step: [record]}))

    def chosen(self, path: Path, step: int | None) -> list[View]:
        """The views, each with the records of the chosen step only.

        What has one step only holds for all times.

        Raises:
            MeshError: There is no such step.
        """
        steps = sorted({s for view in self._views.values() if len(view.records) > 1 for s in view.records})
        index, notes = chosen_step(path, [time for _, time in steps] or [0.0], step)
        self.notes += notes
        found = []
        for view in self._views.values():
            wanted = steps[index] if len(view.records) > 1 else next(iter(view.records))
            if wanted in view.records:
                found.append(View(view.place, view.name, {wanted: view.records[wanted]}))
            else:
                self._say(f"The data {view.name[:80]!r} have no values at this time step and were left out.")
        return found

    def _add(self, source: Source, view: View) -> None:
        """Adds a record; what has values of other data of its name gets a name with a number."""
        ((step, (record,)),) = view.records.items()
        for number in range(1, _MOST_OF_ONE_NAME + 1):
            name = view.name if number == 1 else f"{view.name} ({number})"
            there = self._views.setdefault((view.place, name), View(view.place, name))
            if there.repeats(step, record):
                return
            if there.takes(step, record):
                there.records.setdefault(step, []).append(record)
                return
        raise source.damaged(f"it has more than {_MOST_OF_ONE_NAME} data {view.name[:40]!r} at one time")

    def _say(self, sentence: str) -> None:
        if sentence not in self.notes:
            self.notes.append(sentence)


def spread(source: Source, tags: np.ndarray, records: list[Record], what: str) -> np.ndarray:
    """Data in the order of the tags they belong to, NaN where there are none.

    Args:
        source: The file, for the sentence.
        tags: (N,) of all nodes or elements.
        records: Of one step.
        what: What is wrong where a tag is not there.
    """
    found = np.full((len(tags), *records[0].values.shape[1:]), np.nan)
    for record in records:
        if record.values.shape[1:] != found.shape[1:]:
            raise source.damaged("the parts of data have different numbers of components")
        found[positions(source, tags, record.tags, what)] = record.values
    return found


def at_nodes(
    source: Source, node_tags: np.ndarray, elements: list[Elements], records: list[Record]
) -> tuple[np.ndarray, bool]:
    """Means at nodes of values that each element has for each of its own nodes.

    Args:
        source: The file, for sentences.
        node_tags: (V,) tags of all nodes.
        elements: All elements.
        records: Values of one step.

    Returns:
        (V, ...) means, NaN where there are none, and whether elements disagree at some node.
    """
    tail = records[0].values.shape[2:]
    nodes, values = [np.empty(0, np.int64)], [np.empty((0, *tail))]
    taken = 0
    for e in elements:
        order = np.argsort(e.tags, kind="stable")
        for record in records:
            if record.values.shape[2:] != tail:
                raise source.damaged("the parts of data have different numbers of components")
            places = np.searchsorted(e.tags[order], record.tags).clip(max=len(order) - 1)
            rows = np.flatnonzero(e.tags[order][places] == record.tags)
            taken += len(rows)
            width = min(record.values.shape[1], e.nodes.shape[1])
            nodes.append(e.nodes[order[places[rows]], :width].ravel())
            values.append(record.values[rows, :width].reshape(-1, *tail))
    if taken < sum(len(record.tags) for record in records):
        raise source.damaged("data belong to an element that is not there")
    places, flat = positions(source, node_tags, np.concatenate(nodes), "an element uses a node"), np.concatenate(values)
    known = ~np.isnan(flat.reshape(len(flat), -1)).any(1)
    places, flat = places[known], flat[known]
    sums, counts = np.zeros((len(node_tags), *tail)), np.bincount(places, minlength=len(node_tags))
    np.add.at(sums, places, flat)
    with np.errstate(invalid="ignore", divide="ignore"):
        means = sums / counts.reshape(-1, *[1] * len(tail))
    first = np.zeros_like(sums)
    first[places[::-1]] = flat[::-1]
    is_same = np.array_equal(first[places], flat)
    return (np.where(counts.reshape(-1, *[1] * len(tail)) > 0, first, np.nan) if is_same else means), not is_same


def _of_elements(source: Source, count: int, columns: int, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Tags (count,) and values (count, n, columns) of rows of a tag, a number of nodes, and values of each."""
    if source.text:
        start = source.position()
        numbers = parse_numbers(source.path, source.until(b"$EndElementNodeData", what))
        source.seek(start)  # the caller looks for the end
        heads, sizes = _heads(source, numbers, count, columns, what)
        tags = as_indices(source.path, numbers[heads])
        table = _padded(numbers, heads + 2, sizes * columns)
    else:
        parts = [_row(source, columns, what) for _ in range(count)]
        tags = np.array([tag for tag, _ in parts], np.int64)
        sizes = np.array([len(values) // max(columns, 1) for _, values in parts], np.int64)
        flat = np.concatenate([values for _, values in parts] or [np.empty(0)])
        table = _padded(flat, np.cumsum(sizes * columns) - sizes * columns, sizes * columns)
    return tags, table.reshape(count, -1, columns) if table.size else np.empty((count, 0, columns))


def _row(source: Source, columns: int, what: str) -> tuple[int, np.ndarray]:
    tag, size = source.numbers(2, "i4", what).tolist()
    if size < 0:
        raise source.damaged(f"{what} have an impossible size")
    return tag, source.numbers(size * columns, "f8", what)


def _heads(source: Source, numbers: np.ndarray, count: int, columns: int, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Where each row begins, and how many nodes it has values of."""
    if count and numbers.size % count == 0 and numbers.size // count > 1:
        table = numbers.reshape(count, -1)
        if (table[:, 1] * columns + 2 == table.shape[1]).all():
            return np.arange(count) * table.shape[1], table[:, 1].astype(np.int64)
    heads, sizes, position = [], [], 0
    for _ in range(count):
        size = numbers[position + 1] if position + 1 < numbers.size else -1
        if not 0 <= size <= numbers.size:
            raise source.damaged(f"{what} are incomplete")
        heads.append(position)
        sizes.append(int(size))
        position += 2 + int(size) * columns
    if position != numbers.size:
        raise source.damaged(f"{what} are not as many as announced")
    return np.array(heads, np.int64), np.array(sizes, np.int64)


def _padded(numbers: np.ndarray, begins: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """(N, n) rows of numbers that begin somewhere and have some size, with NaN behind the shorter ones."""
    width = int(sizes.max(initial=0))
    columns = np.arange(width)
    is_there = columns < sizes[:, None]
    places = np.where(is_there, begins[:, None] + columns, 0)
    return np.where(is_there, numbers[places] if numbers.size else np.nan, np.nan)


def _integer(source: Source, word: str) -> int:
    if not word.lstrip("-").isascii() or not word.lstrip("-").isdigit() or len(word) > 18:
        raise source.damaged(f"{word[:40]!r} is no number of a time step")
    return int(word)


def _real(source: Source, word: str) -> float:
    try:
        return float(word)
    except ValueError as error:
        raise source.damaged(f"{word[:40]!r} is no time") from error
